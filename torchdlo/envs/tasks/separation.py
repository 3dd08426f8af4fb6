"""Take two ropes apart.

Two ropes cross, and the free end of the second is hooked over the first. Success: in the top view they do not cross any
more, and they are 5 cm or more apart.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, SPACING, Arms, Task, TaskState, make, raised, resample_evenly, settled
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Separation"]

COUNT = 30
YAW = math.radians(15)
"""Angle at which the ropes cross."""
AHEAD = 0.1
"""How far the second rope goes on behind the first before it turns back [m]."""
HOOK = 0.06
"""Radius of the hook [m]."""


def laid() -> Tensor:
    """Return the ropes as they are laid down, shape (60, 3): the second under the first, its end back over it."""
    step = torch.linspace(0, 1, 400, dtype=torch.float64)[:, None]
    along = (torch.arange(COUNT, dtype=torch.float64) - 0.5 * (COUNT - 1)) * SPACING
    first = torch.stack([0.3 + along, 0 * along, 0 * along], -1)
    ahead, left = (step.new_tensor([math.cos(a), math.sin(a)]) for a in (YAW, YAW + math.pi / 2))
    # From the left along the yaw, under the first rope; then a turn to the right brings the end back over it.
    line = step.new_tensor([0.3, 0.0]) + (step * (0.3 + AHEAD) - 0.3) * ahead
    angle = step * ((COUNT - 1) * SPACING - 0.3 - AHEAD) / HOOK
    turn = line[-1] - HOOK * left + HOOK * (angle.cos() * left + angle.sin() * ahead)
    flat = torch.cat([line, turn[1:]])
    second = resample_evenly(torch.cat([flat, 0 * flat[:, :1]], -1), COUNT)
    over, back = curve_geometry.crossing_places(first, second), curve_geometry.crossing_places(second, first)
    return torch.cat([raised(first, over[:1], 5.0), raised(second, back[1:])])


@functools.cache
def lying() -> Tensor:
    """Return the ropes at rest, shape (60, 3)."""
    return settled(_made(Separation(), laid()[None]), 50)


def _made(task: Task, x: Tensor) -> tuple[Scene, Params, State]:
    ropes = [Rope(part, RADIUS, mass=0.029, youngs=5e3) for part in x.split(COUNT, -2)]
    return make(task, ropes)


@dataclass(frozen=True)
class Separation(Task):
    """Take two ropes apart."""

    name: ClassVar[str] = "separation"
    arms: ClassVar[Arms] = Arms(base=((0.8, -0.5, 0.0), (-0.2, -0.5, 0.0)), vertex=(27, 32))
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.05, 0.025),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; both ropes may be moved together."""
        return _made(self, lying().to(moved) + moved[:, :1])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the mean distances of the vertices of either rope to the other."""
        first, second = seen.x.split(COUNT, -2)
        apart = curve_geometry.distances(first, second)
        return {"first": apart.amin(-1).mean(-1), "second": apart.amin(-2).mean(-1)}

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how often the ropes cross each other."""
        first, second = seen.x.split(COUNT, -2)
        return {"crossings": curve_geometry.crossings(first, second).to(seen.x.dtype)}

    def measured(self) -> dict[str, str]:
        """Return what it is."""
        return {"crossings": "how often the ropes cross in the top view; no gradient"}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the ropes do not cross and are apart."""
        first, second = seen.x.split(COUNT, -2)
        return (curve_geometry.crossings(first, second) == 0) & (
            curve_geometry.distances(first, second).amin((-1, -2)) >= 0.05
        )

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way straight apart: the hook opens and slides off. It earns 94.9."""
        return [[(0.9, -0.25, 0.02), (-0.43, 0.05, 0.02)]]
