"""Compiled functions of trees of tensors, called without what `torch.compile` does around their code.

At each call, `torch.compile` looks up the code, takes a scene apart into the tensors that it reads and puts together
what it made: as much work as a substep of one rope. `Compiled` notes at the first call with inputs of a kind which of
their tensors the code was given and which of its results became what, and then calls the code itself.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchdlo.physics import tree

T = TypeVar("T")


def compile_graph(graph: torch.fx.GraphModule, examples: Sequence[Any], options: dict[str, Any]) -> Callable[..., Any]:
    """Return the code of a graph, as torch's default compiler makes it with some options."""
    from torch._inductor.compile_fx import compile_fx

    code: Any = compile_fx(graph, examples, config_patches=options)
    return code


@dataclass(frozen=True)
class _Call:
    """How compiled code is called for inputs of a kind."""

    code: Callable[..., Sequence[Any]]
    given: tuple[int, ...]
    """Where what it reads stands among the tensors of the inputs."""
    made: tuple[int, ...]
    """Where the tensors of the result stand among what it returns; -1 - k is the k-th of the inputs."""
    build: Callable[[Iterable[Tensor]], Any] = field(compare=False)
    """Makes a result of its tensors."""

    def run(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Return the tensors of the result for those of inputs."""
        found = self.code(*[inputs[k] for k in self.given])
        return [found[k] if k >= 0 else inputs[-1 - k] for k in self.made]


@dataclass(eq=False)
class Kind:
    """What is known of inputs of a kind."""

    known: bool = False
    """Whether a step with them is over: code that was made for them then is not looked for again."""
    calls: dict[Hashable, Any] = field(default_factory=dict)
    """How code was called in that step, by the function that was compiled; None where it cannot be without torch."""


class Kinds:
    """Inputs of steps by their kind, which decides what code runs and what that does to them."""

    def __init__(self, prepare: Callable[[Any], Any]) -> None:
        """Begin without any kind.

        Args:
            prepare: makes inputs, a tree, what compiled code expects. What it does to them depends on their kind only,
                that is on the shape, the storage and the need for a gradient of each tensor and on which of them are
                the same one, and it leaves them as they are where it did it already.
        """
        self._prepare, self._found = prepare, dict[Hashable, Kind]()

    @contextmanager
    def __call__(self, inputs: Any, *others: Hashable) -> Iterator[tuple[Any, Kind]]:
        """Prepare inputs and run what is compiled inside on them; `others` is all that their structure depends on."""
        kind = self._found.get(name := _name(inputs, others))
        if kind is None:
            inputs = self._prepare(inputs)
            name = _name(inputs, others)
            kind = self._found.get(name) or Kind()
        yield inputs, kind
        if not kind.known:
            kind.known, self._found[name] = True, kind


def _name(inputs: Any, others: Hashable) -> Hashable:
    tensors, keys = tree.described(inputs)
    first: dict[int, int] = {}
    same = tuple([first.setdefault(id(x), k) for k, x in enumerate(tensors)])
    # Code is made for a number of threads.
    each = [(x.shape, x.stride(), x.dtype, x.device, x.requires_grad) for x in tensors]
    mixed = tensors[0].device.type if tensors else "cpu"
    return others, torch.get_num_threads(), torch.is_autocast_enabled(mixed), keys, same, *each


class Compiled:
    """A function of trees of tensors, compiled."""

    def __init__(self, function: Callable[..., Any], *static: Any, options: dict[str, Any] | None = None) -> None:
        """Compile nothing yet.

        Args:
            function: what to compile; nothing but what it returns depends on its calls.
            static: its first arguments, the same in each call.
            options: of the compiler.
        """

        def backend(graph: torch.fx.GraphModule, examples: Sequence[Any]) -> Callable[..., Any]:
            code = compile_graph(graph, examples, options or {})

            def noted(*given: Any) -> Any:
                made = code(*given)
                if self._seen is not None:
                    self._seen.append((code, given, made))
                return made

            return noted

        self._static = static
        self._seen: list[tuple[Callable[..., Any], Sequence[Any], Sequence[Any]]] | None = None
        compile: Any = torch.compile  # whose stubs lack an argument
        self._function = compile(function, fullgraph=True, dynamic=False, isolate_recompiles=True, backend=backend)

    def __call__(self, kind: Kind, *inputs: Any) -> Any:
        """Return what the function makes of some inputs, whose kinds follow from that of the step; once in a step."""
        call = kind.calls.get(self)
        if call is not None:
            return call.build(call.run(tree.leaves(inputs)))
        if kind.known:
            return self._plain(kind, inputs)
        result, kind.calls[self] = self._noted(kind, inputs)
        return result

    def repeat(self, kind: Kind, params: Any, state: T, fixed: Any, varied: Iterable[Tensor]) -> T:
        """Return the last state of repeated calls with (params, state, *fixed, one of `varied`); once in a step."""
        calls: Sequence[_Call] | None = kind.calls.get(self)
        if calls is not None:
            before, after, now = tree.leaves(params), tree.leaves(fixed), tree.leaves(state)
            for known, x in zip(calls, varied, strict=True):
                now = known.run([*before, *now, *after, x])
            return calls[-1].build(now)
        noted: list[_Call | None] = []
        for x in varied:
            inputs = params, state, *fixed, x
            if kind.known:
                state = self._plain(kind, inputs)
            else:
                state, call = self._noted(kind, inputs)
                noted.append(noted[-1] if noted and noted[-1] == call else call)
        if not kind.known:
            kind.calls[self] = None if None in noted else noted
        return state

    def _plain(self, kind: Kind, inputs: Sequence[Any]) -> Any:
        with torch.compiler.set_stance(skip_guard_eval_unsafe=kind.known):
            return self._function(*self._static, *inputs)

    def _noted(self, kind: Kind, inputs: Sequence[Any]) -> tuple[Any, _Call | None]:
        """Return the result, and how to come to it without torch."""
        seen = self._seen = []
        try:
            result = self._plain(kind, inputs)
        finally:
            self._seen = None
        tensors, found = tree.leaves(inputs), tree.leaves(result)
        if len(seen) != 1 or tensors[0].is_cuda:  # there, steps are recorded as graphs
            return result, None
        code, given, made = seen[0]
        at = {id(x): k for k, x in reversed([*enumerate(tensors)])}
        out = {id(x): -1 - k for k, x in enumerate(tensors)} | {id(x): k for k, x in enumerate(made)}
        if not all(id(x) in at for x in given) or not all(id(x) in out for x in found):
            return result, None
        places = tuple(at[id(x)] for x in given), tuple(out[id(x)] for x in found)
        return result, _Call(code, *places, tree.builder(result))
