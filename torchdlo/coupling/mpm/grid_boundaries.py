"""The faces of the box that matter is in, on the nodes of the grid.

A wall that lets go takes what a node behind it moves into it, and by Coulomb's law `friction` times as much across,
down to rest; the others take all along their normal, or all. On the CPU a C++ kernel does it, which passes over the
nodes that are behind no wall; elsewhere, and without a compiler, tensor operations do.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.mpm.particles import MARGIN, WALLS, Grid
from torchdlo.physics.linalg.numerics import safe_norm

_INPUTS = "Tensor vel, Tensor origin, Tensor friction"
_STATIC = "int[] size, int[] nodes, int[] kinds"
_function, ready = scene_packing.kernel("walls", "material points, the walls of their box")


class _Sizes(ctypes.Structure):
    _fields_ = (
        ("scenes", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("size", "whole", "kinds")),
        ("margin", ctypes.c_int64),
    )


def _run(what: str, tensors: tuple[Tensor, ...], static: tuple[list[int], ...]) -> None:
    lists = (scene_packing.integers(tuple(x)) for x in static)
    places = (ctypes.c_void_p(x.data_ptr()) for x in tensors)
    sizes = ctypes.byref(_Sizes(tensors[0].shape[0], *lists, MARGIN))
    _function(what, tensors[0].dtype)(*places, sizes, torch.get_num_threads())


def _act(vel: Tensor, origin: Tensor, friction: Tensor, *static) -> Tensor:
    out = _act_meta(vel)
    _run("act", (vel, origin, friction, out), static)
    return out


def _act_meta(vel: Tensor, *others) -> Tensor:
    return vel.new_empty(*vel.shape[:2], 4)


def _back(vel: Tensor, origin: Tensor, friction: Tensor, by: Tensor, *static) -> tuple[Tensor, Tensor]:
    out = _back_meta(vel, origin, friction)
    _run("back", (vel, origin, friction, by, *out), static)
    return out


def _back_meta(vel: Tensor, origin: Tensor, friction: Tensor, *others) -> tuple[Tensor, Tensor]:
    return torch.empty_like(vel), torch.empty_like(friction)


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.static = inputs[3:]


def _backward(ctx, by: Tensor):
    vel, friction = torch.ops.torchdlo.walls_back(*ctx.saved_tensors, by.contiguous(), *ctx.static)
    return vel, None, friction, None, None, None


scene_packing.operator(f"walls({_INPUTS}, {_STATIC}) -> Tensor", _act, _act_meta, _save, _backward)
scene_packing.operator(
    f"walls_back({_INPUTS}, Tensor by, {_STATIC}) -> (Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def walls(grid: Grid, origin: Tensor, vel: Tensor, friction: Tensor) -> Tensor:
    """Return velocities of nodes after the faces of the box, and a zero behind each, shape (B, N, 4).

    Args:
        grid: box and walls.
        origin: number of the first computed node, shape (B, 3).
        vel: velocities of nodes [m/s], shape (B, N, 3).
        friction: coefficient [1], shape (B or 1, 1).
    """
    friction = friction.reshape(-1, 1)
    if ready(vel.device.type, vel.dtype):
        rows = (x.contiguous() for x in (vel, origin, friction.expand(vel.shape[0], 1)))
        kinds = [WALLS.index(w) for w in grid.walls]
        return torch.ops.torchdlo.walls(*rows, list(grid.size), list(grid.nodes), kinds)
    left, lost, sticks = _stopped(grid, origin, vel.unflatten(1, grid.size))
    # Coulomb: what the faces take along their normals, they take mu times as much across, down to rest.
    speed, press = safe_norm(left), safe_norm(lost)
    share = (1 - friction[..., None, None, None] * press / torch.where(speed > 0, speed, 1.0)).clamp(min=0.0)
    share = torch.where(sticks, 0.0, share)
    return torch.nn.functional.pad((share * left).flatten(1, 3), (0, 1))


def _stopped(grid: Grid, origin: Tensor, vel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return what faces leave of velocities (B, X, Y, Z, 3), what those that let go take, and where one sticks."""
    size = grid.size
    left, lost, sticks = [], [], torch.zeros_like(vel[..., :1], dtype=torch.bool)
    for axis, v in enumerate(vel.unbind(-1)):
        number = origin[:, axis, None] + torch.arange(size[axis], device=vel.device)
        number = number.reshape(-1, *(size[axis] if a == axis else 1 for a in range(3)))
        lower, upper = number <= MARGIN, number >= grid.nodes[axis] - 1 - MARGIN
        kept, taken = v, torch.zeros_like(v)
        for behind, kind, into in ((lower, grid.walls[2 * axis], v < 0), (upper, grid.walls[2 * axis + 1], v > 0)):
            stopped = behind & into if kind == "separate" else (behind if kind != "open" else torch.zeros_like(behind))
            kept = torch.where(stopped, 0.0, kept)
            taken = torch.where(stopped, v, taken) if kind == "separate" else taken
            sticks = sticks | behind[..., None] if kind == "stick" else sticks
        left.append(kept)
        lost.append(taken)
    return torch.stack(left, -1), torch.stack(lost, -1), sticks
