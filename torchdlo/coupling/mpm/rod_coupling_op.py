"""Momentum between ropes and nodes of a grid as a C++ kernel, with its derivative.

The formulas stand in `exchange`, as tensor operations; these are used on a GPU and where there is no C++ compiler. The
kernel does the same with the pairs of edges and nodes that can exchange momentum alone, so that it has room for any
number of them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing

_INPUTS = (
    "Tensor vel, Tensor mass, Tensor share, Tensor corner, Tensor pos, Tensor moving, Tensor inverse, Tensor reach, "
    "Tensor friction, Tensor after"
)
_STATIC = "int[] size, int sweeps, float spacing, float relaxation"
_COUNT = 10
_FIXED = (3, 7, 9)
"""Inputs that have no derivative: the first node's place, how far off an edge nodes are felt, and what comes next."""
_function, ready = scene_packing.kernel("node_sweeps", "RodMpmCoupling, the forces of contact")


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("scenes", "nodes", "vertices", "sweeps")),
        *((name, ctypes.c_void_p) for name in ("size", "after")),
        *((name, ctypes.c_double) for name in ("spacing", "relaxation")),
    )


def _run(what: str, inputs: Sequence[Tensor], others: Sequence, static: Sequence) -> None:
    size, sweeps, *numbers = static
    (scenes, nodes, _), vertices = inputs[0].shape, inputs[4].shape[1]
    lists = scene_packing.integers(tuple(size)), inputs[9].data_ptr()
    sizes = ctypes.byref(_Sizes(scenes, nodes, vertices, sweeps, *lists, *numbers))
    _function(what, inputs[0].dtype)(_places(inputs), *others, sizes, torch.get_num_threads())


def _places(tensors: Sequence[Tensor]) -> ctypes.Array:
    return (ctypes.c_void_p * len(tensors))(*(x.data_ptr() for x in tensors))


def _sweep(*args) -> tuple[Tensor, Tensor]:
    inputs, static = args[:_COUNT], args[_COUNT:]
    given, vel = _sweep_meta(*args)
    _run("sweep", inputs, [ctypes.c_void_p(x.data_ptr()) for x in (given, vel)], static)
    return given, vel


def _sweep_meta(*args) -> tuple[Tensor, Tensor]:
    return torch.empty_like(args[4]), torch.empty_like(args[0])


def _back(*args) -> list[Tensor]:
    inputs, (given, vel), static = args[:_COUNT], args[_COUNT : _COUNT + 2], args[_COUNT + 2 :]
    rest = enumerate(inputs[1:], 1)
    out = [vel.clone(), *(torch.empty_like(x) if k in _FIXED else torch.zeros_like(x) for k, x in rest)]
    _run("back", inputs, (ctypes.c_void_p(given.data_ptr()), _places(out)), static)
    return out


def _back_meta(*args) -> list[Tensor]:
    return [torch.empty_like(x) for x in args[:_COUNT]]


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:_COUNT])
    ctx.static = inputs[_COUNT:]


def _backward(ctx, given: Tensor, vel: Tensor):
    both = (given.contiguous(), vel.contiguous())
    found = torch.ops.torchdlo.node_sweeps_back(*ctx.saved_tensors, *both, *ctx.static)
    return *(None if k in _FIXED else x for k, x in enumerate(found)), *(None for _ in ctx.static)


scene_packing.operator(f"node_sweeps({_INPUTS}, {_STATIC}) -> (Tensor, Tensor)", _sweep, _sweep_meta, _save, _backward)
scene_packing.operator(
    f"node_sweeps_back({_INPUTS}, Tensor by_given, Tensor by_vel, {_STATIC}) -> Tensor[]",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def sweep(
    inputs: Sequence[Tensor], size: Sequence[int], sweeps: int, spacing: float, relaxation: float
) -> tuple[Tensor, Tensor]:
    """Return impulses on vertices [N s] (B, V, 3), and velocities of nodes after them [m/s]; differentiable once.

    Args:
        inputs: velocities (B, N, 3) and masses (B, N) of nodes, the part of an impulse that acts (B, 1), the first
            node's place (B, 3); places and velocities of vertices (B, V, 3), their change of velocity per impulse (B,
            V), how far off each edge nodes are felt (B, V); the coefficient of friction (B, 1); the next vertex, -1
            where there is no edge, int64 (V,).
        size: nodes along each axis.
        sweeps: projected Jacobi sweeps.
        spacing: of the nodes [m].
        relaxation: change per sweep over that of a Jacobi step.
    """
    stored = (x.contiguous() for x in inputs)
    return torch.ops.torchdlo.node_sweeps(*stored, list(size), sweeps, spacing, relaxation)
