"""Put a rubber band round three posts.

A closed loop lies in front of three posts; two arms hold it. Success: it goes once round all three, and is near each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Wrapping"]

POSTS = ((0.45, -0.115), (0.45, 0.115), (0.25, 0.0))
"""Axes of the posts [m]."""
TOP = 0.04
"""Their height [m]."""
POST = 0.015
"""Their radius [m]."""
LOW, NEAR = TOP + RADIUS, 0.03
"""How low and how near to a post's axis the loop has to be [m]."""
OUT, AWAY, SPARE = 10.0, 100.0, 0.001
"""What counts in the return: a post that the loop does not go round, a metre that it still has to go to one; how much
less than a limit it is to be [m]."""
COUNT, LOOP = 50, 0.14
"""Vertices of the loop and its radius [m]."""


@dataclass(frozen=True)
class Wrapping(Task):
    """Put a rubber band round three posts."""

    name: ClassVar[str] = "wrapping"
    arms: ClassVar[Arms] = Arms(
        base=((-0.05, 0.45, 0.0), (-0.05, -0.45, 0.0)),
        vertex=(17, 33),
        quat=((0.0, 0.9239, 0.3827, 0.0), (0.0, 0.3827, 0.9239, 0.0)),
    )
    cameras: ClassVar[tuple[TaskCamera, ...]] = (TaskCamera("front", (1.15, 0.15, 0.75), (0.47, 0.0, 0.02)),)
    floor: ClassVar[float] = 0.04
    stretch: ClassVar[float] = 1.2
    anchored: ClassVar[bool] = True
    forfeits: ClassVar[bool] = False  # as published
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.025, 0.01),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the loop may be moved."""
        angle = torch.arange(COUNT, dtype=moved.dtype, device=moved.device) * (2 * math.pi / COUNT)
        circle = torch.stack([LOOP * angle.cos(), LOOP * angle.sin(), 0 * angle], -1)
        x = circle + moved.new_tensor([0.6, 0.0, 0.012]) + moved[:, :1]
        stiff = 1e5 * math.pi * RADIUS**2
        loop = Rope(x, RADIUS, mass=0.05, youngs=1e4, stretch=stiff, closed=True)
        rub: dict[str, Any] = {"mu_s": 0.7, "mu_k": 0.7}
        posts = [RigidBody("cylinder", (POST, TOP / 2), (*p, TOP / 2), motion="fixed", **rub) for p in POSTS]
        return make(self, [loop], solids=posts)

    def _posts(self, x: Tensor) -> Tensor:
        return x.new_tensor([(*p, TOP / 2) for p in POSTS])

    def _wound(self, x: Tensor) -> Tensor:
        """Return how often the loop goes round each post, shape (B, 3)."""
        return torch.stack([curve_geometry.winding(x, post[:2]) for post in self._posts(x)], -1)

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return 1, how many posts the loop goes round, and how far it is off each."""
        posts = self._posts(seen.x).expand(len(seen.x), -1, -1)
        off = (curve_geometry.nearest(posts, seen.x) - POST).clamp(min=0).sum(-1)
        once = (self._wound(seen.x).abs() - 1).square().mean(-1)
        return {"present": torch.ones_like(off), "round": 1 - once, "near": -off}

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how often the loop goes round each post."""
        wound = self._wound(seen.x)
        return {f"winding_{k}": wound[:, k] for k in range(len(POSTS))}

    def measured(self) -> dict[str, str]:
        """Return what they are."""
        return {f"winding_{k}": f"how often the loop goes round post_{k}, 1 or -1 is once" for k in range(len(POSTS))}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the loop goes round every post once, and touches each within 5 mm below its top."""
        apart = self._apart(seen.x)
        near = torch.where((seen.x[..., 2] <= LOW).unsqueeze(-2), apart, math.inf).amin(-1) <= NEAR
        return (self._around(seen.x) & near).all(-1)

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return how far the loop has to go up and over posts, and then down beside them."""
        apart, height = self._apart(seen.x), seen.x[..., 2].unsqueeze(-2)
        over = (apart + (LOW + SPARE - height).clamp(min=0)).amin(-1)
        beside = (apart + (height - LOW + SPARE).clamp(min=0)).amin(-1) - (NEAR - SPARE)
        return torch.where(self._around(seen.x), AWAY * beside.clamp(min=0), OUT + AWAY * over).sum(-1)

    def _around(self, x: Tensor) -> Tensor:
        """Return whether the loop goes round each post once, bool, shape (B, 3)."""
        return (self._wound(x).abs() - 1).abs() < 0.5

    def _apart(self, x: Tensor) -> Tensor:
        """Return how far each vertex is from each post's axis [m], shape (B, 3, 50)."""
        return curve_geometry.distances(self._posts(x)[:, :2].expand(len(x), -1, -1), x[..., :2])

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way over the first two posts, down to lay the band outside of them, over the third, and back."""
        way = [
            (0.0, 0.03, 0.09),
            (-0.165, 0.03, 0.09),
            (-0.165, 0.03, 0.028),
            (-0.165, 0.03, 0.07),
            (-0.31, 0.02, 0.07),
            (-0.31, 0.0, 0.03),
            (-0.19, -0.04, 0.028),
        ]
        return [[(x, y, z), (x, -y, z)] for x, y, z in way]
