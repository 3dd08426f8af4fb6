"""Steps without Python between their operations: recorded once for given shapes, then replayed.

Recording takes less than a second where compiling takes many. A step of two ropes of 40 vertices then takes a quarter
of the time that its operations take one by one in TorchScript (`programs`), one of 56 ropes two fifths. It is for
simulations without gradients.
"""

from __future__ import annotations

import math
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch.autograd import forward_ad

from torchdlo.physics import tree
from torchdlo.physics.execution import programs

_ROUND = 8
"""Larger batches are filled up to multiples of this."""


def batch(scenes: int) -> int:
    """Return how many scenes to run in place of so many: to record a step for a new size takes longer than its use."""
    return next((size for size in (1, 2, 3, 5, 8) if size >= scenes), -(-scenes // _ROUND) * _ROUND)


def record(step: Callable[..., Any], *inputs: Any) -> Callable[..., Any]:
    """Return a function that does what `step` does to trees of tensors of the same shapes as `inputs`.

    Its first two arguments are read once for as long as they are the same objects; give it new ones rather than change
    them. What it returns may be the second.
    Whatever `step` captures besides its arguments stays as it is now, and so does every choice that Python makes.
    """
    leaves, build = tree.flatten(inputs)
    rebuild: list[Callable[..., Any]] = []

    def traced(*values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found, back = tree.flatten(step(*build(values)))
        rebuild.append(back)
        return tuple(found)

    with torch.no_grad(), warnings.catch_warnings():
        # Shapes are meant to be fixed.
        warnings.simplefilter("ignore", torch.jit.TracerWarning)
        # What `torch.jit.trace` makes is kept for as long as the process lives, some 30 MB each.
        graph, _ = torch._C._create_graph_by_tracing(traced, tuple(leaves), lambda _: "", True, False, None, [])
        numbers = _close_constants(graph)
        # Sizes are fixed: numbers made of them are computed now.
        torch._C._jit_pass_peephole(graph, True)
        torch._C._jit_pass_constant_propagation(graph)
        # Terms of a step look at the same edges and hinges: what several of them compute is computed once.
        torch._C._jit_pass_cse(graph)
        torch._C._jit_pass_dce(graph)
        run = _replay(graph, numbers, programs.ready(leaves))

    known: dict[int, tuple[Any, Sequence[torch.Tensor]]] = {}

    def kept(place: int, given: Any) -> Sequence[torch.Tensor]:
        # Constants stay the same over many steps, and what a step returns is given to the next one.
        if place not in known or known[place][0] is not given:
            known[place] = given, tree.leaves(given)
        return known[place][1]

    @torch.no_grad()
    def replayed(first: Any, *others: Any) -> Any:
        now = kept(1, others[0]) if others else ()
        last = tree.leaves(others[1:])
        found = run([*kept(0, first), *now, *last])
        made = rebuild[0](found)
        known[1] = made, found
        return made

    return replayed


_Run = Callable[[Sequence[torch.Tensor]], Sequence[torch.Tensor]]


def _replay(graph: Any, numbers: Sequence[torch.Tensor], ready: bool) -> _Run:
    """Return what does the operations of a graph to its inputs: programs for their strides, or else TorchScript."""
    known: dict[Hashable, _Run] = {}

    def scripted() -> _Run:
        function = torch._C._create_function_from_graph("step", graph)

        def run(inputs: Sequence[torch.Tensor]) -> Sequence[torch.Tensor]:
            # Nothing here has a gradient: operations need not look, which is a tenth of a step of one scene.
            with torch._C._AutoDispatchBelowAutograd():
                return function(*inputs, *numbers)

        return run

    def run(inputs: Sequence[torch.Tensor]) -> Sequence[torch.Tensor]:
        layout = tuple([x.stride() for x in inputs])
        if layout not in known:
            known[layout] = programs.program(graph, inputs, numbers) or scripted()
        return known[layout](inputs)

    return run if ready else scripted()


_CLOSE = 1e-6
"""Relative difference below which TorchScript may take numbers for the same: it does up to 6e-8."""


def _close_constants(graph: Any) -> list[torch.Tensor]:
    """Turn numbers that are nearly another one into inputs of the graph, added behind the others; return their values.

    TorchScript keeps one of them only: a velocity times 1 became one times 1 + 1e-10, in every substep.
    """
    moved: list[torch.Tensor] = []
    seen: list[float] = []
    for node in list(graph.nodes()):
        if node.kind() != "prim::Constant" or not node.hasAttribute("value") or node.kindOf("value") != "t":
            continue
        value = node.t("value")
        if value.dim() or not value.is_floating_point():
            continue
        number = value.item()
        if any(number != other and math.isclose(number, other, rel_tol=_CLOSE) for other in seen):
            given = graph.addInput()
            given.setType(node.output().type())
            node.output().replaceAllUsesWith(given)
            node.destroy()
            moved.append(value)
        else:
            seen.append(number)
    return moved


class Recordings:
    """The steps that were recorded or used last."""

    def __init__(self, most: int) -> None:
        """Prepare to keep `most` of them; each takes some 30 MB."""
        self._most, self._kept = most, OrderedDict[Hashable, Callable[..., Any]]()

    def find(self, key: Hashable, step: Callable[..., Any], *inputs: Any) -> Callable[..., Any]:
        """Return `step`, recorded with inputs of these shapes unless it is known already.

        Args:
            key: equal for steps that do the same.
            step: see `record`.
            inputs: likewise.
        """
        tensors, keys = tree.described(inputs)
        key = key, keys, tuple((x.shape, x.dtype) for x in tensors)
        if key not in self._kept:
            self._kept[key] = record(step, *inputs)
        self._kept.move_to_end(key)
        if len(self._kept) > self._most:
            self._kept.popitem(last=False)
        return self._kept[key]


class RecordedStep:
    """A step that is recorded when it is first used without gradients, and runs as it is where they are asked for.

    So it does where recording does not know one of its operations.
    """

    def __init__(self, step: Callable[..., Any], most: int = 2) -> None:
        """Prepare the step; see `record`. `most` recordings are kept."""
        self._step, self._recordings, self._known = step, Recordings(most), True

    def __call__(self, *inputs: Any) -> Any:
        """Do the step."""
        with_gradient = torch.is_grad_enabled() and any(x.requires_grad for x in tree.leaves(inputs))
        with_gradient |= forward_ad._current_level >= 0  # dual numbers
        if with_gradient or not self._known or torch.jit.is_tracing() or torch.compiler.is_compiling():
            return self._step(*inputs)
        try:
            recorded = self._recordings.find((), self._step, *inputs)
        except RuntimeError:
            self._known = False
            return self._step(*inputs)
        return recorded(*inputs)
