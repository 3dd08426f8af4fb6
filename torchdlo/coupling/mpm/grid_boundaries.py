"""The faces of the box that matter is in, on the nodes of the grid.

A wall that lets go takes what a node behind it moves into it, and by Coulomb's law `friction` times as much across,
down to rest; the others take all along their normal, or all. These are tensor operations; on the CPU a C++ kernel does
the same, see `transfer_op`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.coupling.mpm.particles import MARGIN, Grid
from torchdlo.physics.linalg.numerics import safe_norm


def walls(grid: Grid, origin: Tensor, vel: Tensor, friction: Tensor) -> Tensor:
    """Return velocities of nodes after the faces of the box, and a zero behind each, shape (B, N, 4).

    Args:
        grid: box and walls.
        origin: number of the first computed node, shape (B, 3).
        vel: velocities of nodes [m/s], shape (B, N, 3).
        friction: coefficient [1], shape (B or 1, 1).
    """
    friction = friction.reshape(-1, 1)
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
