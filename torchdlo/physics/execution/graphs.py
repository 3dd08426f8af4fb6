"""Steps on CUDA devices without the CPU between their kernels: recorded as CUDA graphs for given shapes, then replayed.

A compiled substep is dozens of kernels that take a GPU some ten microseconds each, less than it takes Python to ask for
them. `Graphs` records the third run with inputs of a kind: the first two compile it, and let the caches fill that
its operators keep. Numbers go into the graph and out of it by copies, so that what a step returned stays as it is.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdlo import notices
from torchdlo.physics import tree

RUNS = 2
"""Runs with inputs of a kind before they are recorded."""
KEPT = 4
"""Recordings that are kept; each keeps the memory of a step."""


def _narrow(x: Tensor) -> Tensor:
    """Return a tensor without what is the same along an axis."""
    return x[
        tuple(slice(0, 1) if step == 0 and n > 1 else slice(None) for n, step in zip(x.shape, x.stride(), strict=True))
    ]


def _copied(x: Tensor) -> Tensor:
    """Return a copy that is stored likewise."""
    return _narrow(x.detach()).clone().expand(x.shape)


class _Recording:
    """A step recorded for inputs of a kind, with its derivative if inputs need one."""

    def __init__(self, step: Callable[..., Any], leaves: Sequence[Tensor], build: Callable[..., Any]) -> None:
        self.given = [_copied(x).requires_grad_(x.requires_grad) for x in leaves]
        if any(one.stride() != x.stride() for one, x in zip(self.given, leaves, strict=True)):
            raise RuntimeError("inputs are stored in a way that copies are not")
        self.known: list[tuple[Tensor, int] | None] = [None] * len(leaves)
        self.forward, self.backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        self.run = 0
        """Which run it is whose numbers the derivative can be taken of; each has its own."""
        with torch.cuda.graph(self.forward):
            self.made, self.rebuild = tree.flatten(step(*build(self.given)))
        self.moved = [k for k, x in enumerate(self.made) if x.requires_grad]
        if self.moved:
            self.by = [torch.zeros_like(self.made[k]) for k in self.moved]
            wanted = [x for x in self.given if x.requires_grad]
            outputs = [self.made[k] for k in self.moved]
            with torch.cuda.graph(self.backward, pool=self.forward.pool()):
                found = iter(torch.autograd.grad(outputs, wanted, self.by, allow_unused=True))
                self.found = [next(found) if x.requires_grad else None for x in self.given]
            self.made = [x.detach() for x in self.made]

    def repeat(self, leaves: Sequence[Tensor]) -> None:
        """Do the step again."""
        for k, x in enumerate(leaves):
            known = self.known[k]
            if known is None or known[0] is not x or known[1] != x._version:
                _narrow(self.given[k].detach()).copy_(_narrow(x.detach()))
                # What has a history would keep it.
                self.known[k] = None if x.grad_fn is not None else (x, x._version)
        self.run += 1
        self.forward.replay()

    def derive(self, by: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Return derivatives by inputs of the last step, given those by what moved; once."""
        for k, each in zip(self.moved, range(len(self.by)), strict=True):
            given = by[k]
            if given is None:
                self.by[each].zero_()
            else:
                self.by[each].copy_(given)
        self.run += 1
        self.backward.replay()
        return [None if x is None else _copied(x) for x in self.found]


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, recording: _Recording, *leaves: Tensor) -> tuple[Tensor, ...]:
        recording.repeat(leaves)
        ctx.recording, ctx.run = recording, recording.run
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*leaves)
        made = [_copied(x) for x in recording.made]
        ctx.mark_non_differentiable(*(x for k, x in enumerate(made) if k not in recording.moved))
        return tuple(made)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *by: Tensor | None) -> tuple[Any, ...]:
        recording = ctx.recording
        if recording.run != ctx.run:  # another step came after it
            recording.repeat(ctx.saved_tensors)
        return None, *recording.derive(by)


class Graphs:
    """The steps that were recorded last."""

    def __init__(self) -> None:
        """Begin without any."""
        self._runs: dict[Hashable, int] = {}
        self._kept = OrderedDict[Hashable, _Recording]()

    def __call__(self, step: Callable[..., Any], inputs: tuple, *others: Hashable) -> Any:
        """Return step(*inputs); `others` is all that their structure depends on.

        Second derivatives are not available where inputs need a gradient.
        """
        leaves, build = tree.flatten(inputs)
        with_gradient = torch.is_grad_enabled() and any(x.requires_grad for x in leaves)
        if not all(x.is_cuda for x in leaves) or torch.cuda.is_current_stream_capturing():
            return step(*inputs)
        # Recordings are of the current device, and see by versions what was changed in place.
        if leaves[0].device.index != torch.cuda.current_device() or torch.is_inference_mode_enabled():
            return step(*inputs)
        _, keys = tree.described(inputs)
        kind = others, with_gradient, keys, *((x.shape, x.stride(), x.dtype, x.device, x.requires_grad) for x in leaves)
        if kind not in self._kept:
            runs = self._runs.get(kind, 0)
            self._runs[kind] = runs + 1
            if runs != RUNS:  # also if it could not be recorded
                return step(*inputs)
            stream = torch.cuda.current_stream()
            try:
                self._kept[kind] = _Recording(step, leaves, build)
            except RuntimeError as error:
                torch.cuda.set_stream(stream)  # a recording that broke off would leave its own
                notices.once("graphs", f"steps are not recorded as CUDA graphs, which is slower: {error}")
                return step(*inputs)
            if len(self._kept) > KEPT:
                gone, _ = self._kept.popitem(last=False)
                self._runs[gone] = 0
        self._kept.move_to_end(kind)
        recording = self._kept[kind]
        if with_gradient and recording.moved:
            return recording.rebuild(_Step.apply(recording, *leaves))
        recording.repeat(leaves)
        return recording.rebuild([_copied(x) for x in recording.made])
