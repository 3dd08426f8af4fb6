"""Gradients through long rollouts in little memory: keep the state at the start of a segment, run it again backward.

`replay` knows trees of tensors, not rods. It is reverse-mode checkpointing (Griewank and Walther 2000,
doi:10.1145/347837.347846) with the leaves of trees as the only interface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchdlo.physics import tree

T = TypeVar("T")


class _Replay(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, run: Callable[[list[Tensor]], list[Tensor]], offloaded: Sequence[bool], *inputs: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.run = run
        ctx.set_materialize_grads(False)
        ctx.devices = [x.device for x in inputs]
        kept = [_to_cpu(x) if offload and x.is_cuda else x for x, offload in zip(inputs, offloaded, strict=True)]
        ctx.save_for_backward(*kept)
        with torch.no_grad():
            return tuple(run(list(inputs)))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Any, ...]:
        needed = ctx.needs_input_grad[2:]
        inputs = [
            x.detach().to(device, non_blocking=True).requires_grad_(need)
            for x, device, need in zip(ctx.saved_tensors, ctx.devices, needed, strict=True)
        ]
        with torch.enable_grad():
            outputs = ctx.run(inputs)
        pairs = [(o, g) for o, g in zip(outputs, cotangents, strict=True) if g is not None and o.requires_grad]
        wanted = [x for x in inputs if x.requires_grad]
        found = iter(
            torch.autograd.grad([o for o, _ in pairs], wanted, [g for _, g in pairs], allow_unused=True)
            if pairs and wanted
            else [None] * len(wanted)
        )
        return None, None, *(next(found) if need else None for need in needed)


def _to_cpu(x: Tensor) -> Tensor:
    """Return a copy in page-locked memory of the CPU, which is written and read in the order of the device's stream."""
    return torch.empty_like(x, device="cpu", pin_memory=True).copy_(x, non_blocking=True)


def replay(fn: Callable[..., Any], *trees: Any, offload: bool | Sequence[bool] = True) -> Any:
    """Run `fn(*trees)` without recording it; the backward pass runs it again with recording.

    Every tensor that needs a gradient has to be in `trees`: captured ones get none. Random numbers have to be inputs,
    too. Second derivatives are not available.

    Args:
        fn: pure function of trees of tensors that returns such a tree.
        trees: its arguments.
        offload: keep the inputs of a GPU run in CPU memory until they are needed; of all trees or of each.
    """
    inputs, rebuild = tree.flatten(trees)
    each = (offload,) * len(trees) if isinstance(offload, bool) else offload
    offloaded = [k for part, k in zip(trees, each, strict=True) for _ in tree.leaves(part)]
    shape: list[Any] = []

    def run(values: list[Tensor]) -> list[Tensor]:
        outputs, back = tree.flatten(fn(*rebuild(values)))
        shape[:] = [back]
        return outputs

    moved = [i for i, x in enumerate(inputs) if x.is_floating_point() and x.requires_grad]
    if not moved or not torch.is_grad_enabled():
        return fn(*trees)
    return _finish(_Replay.apply(run, offloaded, *inputs), shape)


def _finish(outputs: tuple[Tensor, ...], shape: list[Any]) -> Any:
    return shape[0](outputs)


def alike(state: Any, others: Any) -> Any:
    """Let every tensor of `state` need a gradient if any tensor of it or of `others` does.

    Compiled steps are made for which of their inputs need one; in a rollout, first steps are then as all later ones.
    """
    own = tree.leaves(state)
    if all(x.requires_grad for x in own):
        return state
    if not any(x.requires_grad for x in (*own, *tree.leaves(others))):
        return state
    return tree.map(lambda x: x if x.requires_grad else x.detach().requires_grad_(), state)


def laid_out(
    state: T, stored: Callable[[Tensor], Tensor] = tree.stored, logical: Callable[[Tensor], Tensor] = tree.logical
) -> T:
    """Return a state with its tensors stored in one way, batch-innermost unless told otherwise, to the last stride.

    Compiled steps are made for the strides of their inputs, also of axes of size 1, where operations leave any: later
    states are then stored as first ones.

    Args:
        state: what to store.
        stored: returns a view of a tensor (..., V, C) with its axes in the order of storage.
        logical: returns a view of that with its axes in the logical order.
    """

    def lay(x: Tensor) -> Tensor:
        if x.dim() < 3:
            return x
        rows = stored(x)
        if rows.stride() == _dense(rows.shape):
            return x
        return logical(rows.clone(memory_format=torch.contiguous_format))

    return tree.map(lay, state)


def _dense(shape: Sequence[int]) -> tuple[int, ...]:
    strides, step = [], 1
    for size in reversed(shape):
        strides.append(step)
        step *= max(size, 1)
    return tuple(reversed(strides))


def rollout(
    step: Callable[[Any, Any, Any], Any],
    params: Any,
    state: Any,
    controls: Any,
    *,
    segment: int | None = None,
    nested: bool = False,
    keep: Callable[[Any], Any] = lambda state: state,
) -> tuple[Any, Any]:
    """Apply `step` once per entry of `controls`.

    Args:
        step: `step(params, state, control) -> state`.
        params: constant along the rollout.
        state: where it starts.
        controls: tree whose leaves have time as the first axis, T.
        segment: steps per replayed segment; None records everything.
        nested: also replay runs of segments, so that about sqrt(T / segment) states are kept instead of T / segment.
        keep: what to return of each new state, e.g. positions.

    Returns:
        The last state, and the kept trees stacked along a first time axis.
    """
    counts = {tuple(x.shape)[:1] for x in tree.leaves(controls)}
    if len(counts) != 1 or () in counts:
        shapes = [tuple(x.shape) for x in tree.leaves(controls)]
        raise ValueError(f"rollout: controls are {shapes}; expected the same number of steps as first axis of each")
    ((count,),) = counts
    if count == 0:
        raise ValueError("rollout: controls have 0 steps; give at least one")

    def run(params: Any, state: Any, controls: Any) -> tuple[Any, Any]:
        kept = []
        for k in range(tree.leaves(controls)[0].shape[0]):
            state = step(params, state, tree.map(lambda c, k=k: c[k], controls))
            kept.append(keep(state))
        return state, tree.stack(kept)

    def split(size: int, inner: Callable[..., Any]) -> Callable[..., Any]:
        def pieces(params: Any, state: Any, controls: Any) -> tuple[Any, Any]:
            kept = []
            for a in range(0, tree.leaves(controls)[0].shape[0], size):
                part = tree.map(lambda c, a=a: c[a : a + size], controls)
                # Parameters and controls stay on the device all along; only states are many.
                state, seen = replay(inner, params, state, part, offload=(False, True, False))
                kept.append(seen)
            return state, tree.map(lambda *parts: torch.cat(parts), kept[0], *kept[1:])

        return pieces

    if segment is None:
        return run(params, state, controls)
    if segment < 1:
        raise ValueError(f"rollout: segment is {segment}; expected at least 1 step, or None to record everything")
    pieces = split(segment, run)
    if nested and count > segment:
        outer = segment * max(1, round((count / segment) ** 0.5))
        pieces = split(outer, pieces)
    return pieces(params, state, controls)
