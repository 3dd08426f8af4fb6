"""What moves at the nodes of the grid, and what particles take back from there, as a C++ kernel with its derivative.

The formulas stand in `p2g_g2p` and `grid_boundaries`, as tensor operations; these are used on a GPU and where there is
no C++ compiler. The kernel works on one scene per thread, on the block of nodes about its particles alone; sums have
the same order in every run. What lies on the grid in between is made again backward: it costs less than to keep it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.mpm import grid_boundaries, p2g_g2p
from torchdlo.coupling.mpm.particles import MARGIN, WALLS, Grid

_GIVE = "Tensor at, Tensor value, Tensor slope"
_TAKE = "Tensor at, Tensor vel, Tensor origin, Tensor friction"
_STATIC = "int[] size, int[] nodes, int[] kinds"
_function, ready = scene_packing.kernel("transfer", "material points, the transfer between particles and grid")


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("scenes", "count", "margin")),
        *((name, ctypes.c_void_p) for name in ("size", "whole", "kinds")),
    )


def _run(what: str, tensors: Sequence[Tensor], size: list[int], nodes: Sequence[int] = (), kinds: Sequence[int] = ()):
    at = tensors[0]
    lists = (scene_packing.integers(tuple(x)) for x in (size, nodes, kinds))
    sizes = ctypes.byref(_Sizes(at.shape[0], at.shape[2], MARGIN, *lists))
    places = (ctypes.c_void_p(x.data_ptr()) for x in tensors)
    _function(what, at.dtype)(*places, sizes, torch.get_num_threads())


def _give(at, value, slope, size) -> tuple[Tensor, Tensor]:
    out = _give_meta(at, value, slope, size)
    _run("give", (at, value, slope, *out), size)
    return out


def _give_meta(at, value, slope, size) -> tuple[Tensor, Tensor]:
    nodes = size[0] * size[1] * size[2]
    return at.new_empty(at.shape[0], nodes, 3), at.new_empty(at.shape[0], nodes)


def _give_back(at, value, slope, vel_by, mass_by, size) -> tuple[Tensor, ...]:
    out = _give_back_meta(at, value, slope)
    _run("give_back", (at, value, slope, vel_by, mass_by, *out), size)
    return out


def _give_back_meta(at, value, slope, *others) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(x) for x in (at, value, slope))


def _take(at, vel, origin, friction, *static) -> tuple[Tensor, Tensor]:
    out = _take_meta(at)
    _run("take", (at, vel, origin, friction, *out), *static)
    return out


def _take_meta(at, *others) -> tuple[Tensor, Tensor]:
    return at.new_empty(at.shape[0], 4, at.shape[2]), at.new_empty(at.shape[0], 9, at.shape[2])


def _take_back(at, vel, origin, friction, value_by, slope_by, *static) -> tuple[Tensor, ...]:
    out = _take_back_meta(at, vel, origin, friction)
    _run("take_back", (at, vel, origin, friction, value_by, slope_by, *out), *static)
    return out


def _take_back_meta(at, vel, origin, friction, *others) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(x) for x in (at, vel, friction))


def _save_give(ctx, inputs, output) -> None:
    *tensors, ctx.size = inputs
    ctx.save_for_backward(*tensors)


def _save_take(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:4])
    ctx.static = inputs[4:]


def _backward_give(ctx, vel: Tensor, mass: Tensor):
    by = vel.contiguous(), mass.contiguous()
    return *torch.ops.torchdlo.nodes_give_back(*ctx.saved_tensors, *by, ctx.size), None


def _backward_take(ctx, value: Tensor, slope: Tensor):
    by = value.contiguous(), slope.contiguous()
    at, vel, friction = torch.ops.torchdlo.nodes_take_back(*ctx.saved_tensors, *by, *ctx.static)
    return at, vel, None, friction, None, None, None


_once = scene_packing.refuse_second_derivative
for _schema, _make, _empty, _save, _backward in (
    (f"nodes_give({_GIVE}, int[] size) -> (Tensor, Tensor)", _give, _give_meta, _save_give, _backward_give),
    (
        f"nodes_give_back({_GIVE}, Tensor vel_by, Tensor mass_by, int[] size) -> (Tensor, Tensor, Tensor)",
        _give_back,
        _give_back_meta,
        None,
        _once,
    ),
    (f"nodes_take({_TAKE}, {_STATIC}) -> (Tensor, Tensor)", _take, _take_meta, _save_take, _backward_take),
    (
        f"nodes_take_back({_TAKE}, Tensor value_by, Tensor slope_by, {_STATIC}) -> (Tensor, Tensor, Tensor)",
        _take_back,
        _take_back_meta,
        None,
        _once,
    ),
):
    scene_packing.operator(_schema, _make, _empty, _save, _backward)


def give_to_nodes(at: Tensor, value: Tensor, slope: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return velocities of nodes, zero where there is no mass [m/s] (B, N, 3), and masses [kg] (B, N).

    Differentiable once.

    Args:
        at: places of particles in node spacings from the first node [1], shape (B, 3, P).
        value: momentum [kg m/s] and mass [kg] of particles, shape (B, 4, P).
        slope: slopes of the momentum per node spacing, row by row, shape (B, 9, P).
        size: numbers of nodes (X, Y, Z), the last one fastest; N in all.
    """
    if not ready(at.device.type, at.dtype):
        return p2g_g2p.grid_velocities(p2g_g2p.particles_to_grid(at, value, slope, size))
    return torch.ops.torchdlo.nodes_give(at.contiguous(), value.contiguous(), slope.contiguous(), list(size))


def take_from_nodes(grid: Grid, at: Tensor, vel: Tensor, origin: Tensor, friction: Tensor) -> tuple[Tensor, Tensor]:
    """Return velocities of particles and a zero behind each (B, 4, P), and weighted sums of velocity times distance.

    Walls act on the nodes before. Sums are in m/s times node spacings, by rows, shape (B, 9, P). Differentiable once.

    Args:
        grid: box and walls.
        at: as in `give_to_nodes`.
        vel: velocities of nodes [m/s], shape (B, N, 3).
        origin: number of the first computed node, shape (B, 3).
        friction: coefficient of the walls [1], shape (B or 1, 1, 1).
    """
    if not ready(at.device.type, at.dtype):
        return p2g_g2p.grid_to_particles(at, grid_boundaries.walls(grid, origin, vel, friction), grid.size)
    rub = friction.reshape(-1, 1).expand(vel.shape[0], 1)
    rows = (x.contiguous() for x in (at, vel, origin, rub))
    kinds = [WALLS.index(w) for w in grid.walls]
    return torch.ops.torchdlo.nodes_take(*rows, list(grid.size), list(grid.nodes), kinds)
