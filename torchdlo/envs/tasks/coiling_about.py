"""Coil a rope round a cone in the direction that words tell: two tasks in one scene that look alike at the start.

The rope lies on the line through the cone's axis, so that either way about is as good as the other and no picture tells
which one is meant. Success: the rope turns by a whole turn within 6 cm of the cone, in the direction of the task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.envs.tasks.coiling import BASE, HEIGHT, winding_angle
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["CoilingLeft", "CoilingRight"]

START = (0.2, 0.0, 0.012)
"""Where the rope's first end is [m]; from there it lies along +x."""
TOP = 0.193
"""Height by which the hand is lifted [m]."""
OUT = 0.056
"""Distance from the axis at which it goes round [m]."""
AROUND = 1.25
"""Turns of the hand about the axis [1]."""


@dataclass(frozen=True)
class _CoilingAbout(Task):
    """Coil a rope round a cone, one way about."""

    side: ClassVar[float]
    """Which way about the hand goes, seen from above [-]: 1 counterclockwise, -1 clockwise."""
    arms: ClassVar[Arms] = Arms(base=((-0.35, 0.0, 0.0),), vertex=(1,))
    anchored: ClassVar[bool] = True
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.03, 0.01),)
    cameras: ClassVar[tuple[TaskCamera, ...]] = (TaskCamera("front", (0.65, 0.35, 0.75), (0.05, 0.0, 0.11)),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the rope may be moved."""
        cone = RigidBody("cone", (BASE, HEIGHT), (0.0, 0.0, HEIGHT / 4), motion="fixed", mu_s=0.7, mu_k=0.7)
        return make(self, [Rope(straight(START, 60, moved[:, 0]), RADIUS, mass=0.059, youngs=1e3)], solids=[cone])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how near the rope is to the cone, as in Coiling, and the turns in the task's direction, up to 1."""
        missing = safe_norm(seen.x - seen.x.new_tensor([0.0, 0.0, HEIGHT / 2])).sum((-1, -2))
        # Vertices are counted from the end that the hand leads, against its way.
        turns = -self.side * winding_angle(seen.x) / (2 * math.pi)
        return {"near": torch.exp(-0.1 * missing), "turned": turns.clamp(-1, 1)}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the rope turns by a whole turn in the task's direction."""
        return -self.side * winding_angle(seen.x) >= 2 * math.pi

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way up beside the cone and round it."""
        way, steps = [], 16
        for k in range(int(AROUND * steps) + 1):
            # It begins on the near side of the cone, 60 degrees before the line of the rope.
            angle = self.side * (2 * math.pi * k / steps - math.radians(60))
            x, y = OUT * math.cos(angle) - (START[0] + 0.02), OUT * math.sin(angle) - START[1]
            way.append([(x, y, TOP)])
        return way


@dataclass(frozen=True)
class CoilingLeft(_CoilingAbout):
    """Coil a rope round a cone counterclockwise."""

    name: ClassVar[str] = "coiling_left"
    counterpart: ClassVar[str] = "coiling_right"
    side: ClassVar[float] = 1.0


@dataclass(frozen=True)
class CoilingRight(_CoilingAbout):
    """Coil a rope round a cone clockwise."""

    name: ClassVar[str] = "coiling_right"
    counterpart: ClassVar[str] = "coiling_left"
    side: ClassVar[float] = -1.0
