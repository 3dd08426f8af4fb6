"""Lead a rope in an S round two posts.

The rope has to pass the first post on its -y side and the second on its +y side. Success: it does, turns by 45 degrees
or more round each, and lies within 3 cm of the goal.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, SPACING, Arms, Task, TaskState, make, straight
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["WiringPost"]

POSTS = ((0.28, 0.14), (0.1, 0.275))
"""Axes of the posts [m]."""
CLEAR = 0.03
"""Distance of the goal from the axes [m]."""
MIDDLE = (0.198, 0.198)
"""Where vertex 15 belongs [m]."""
COUNT = 30
NEAR, TURN = 0.03, math.pi / 4
"""How near the goal [m] and how much bent round each post [rad] a rope has to be."""
SHORT, SPARE = 30.0, 0.03
"""What a condition of success counts in the return as long as it is missed, and the share by which to exceed it."""


@functools.cache
def goal_vertices() -> Tensor:
    """Return where the vertices belong, shape (30, 3): an S of arcs about the posts and the line that touches both."""
    a, b = (torch.tensor(p, dtype=torch.float64) for p in POSTS)
    # The inner common tangent of circles of equal radius crosses the line of their centres in its middle.
    between = b - a
    far = float(between.norm())
    out = math.acos(2 * CLEAR / far)
    heading = math.atan2(float(between[1]), float(between[0]))
    step = torch.linspace(0, 1, 400, dtype=torch.float64)[:, None]

    def arc(centre: Tensor, start: float, end: float) -> Tensor:
        angle = start + step * (end - start)
        return centre + CLEAR * torch.cat([angle.cos(), angle.sin()], -1)

    # The rope comes from +x, with the first post on its right, and goes on to -x with the second one on its left.
    leave = heading + out
    turn = math.pi - (leave - math.pi / 2)
    first, second = arc(a, leave + turn, leave), arc(b, leave + math.pi, leave + math.pi + turn)
    line = torch.lerp(first[-1], second[0], step)
    return _spaced(torch.cat([_tail(first), first[1:], line[1:-1], second, _tail(second.flip(0)).flip(0)[1:]]))


def _tail(curve: Tensor, length: float = 0.4) -> Tensor:
    """Return a straight line that ends in the first point of a curve, along its direction there."""
    away = curve[0] - curve[1]
    return curve[0] + away / away.norm() * torch.linspace(length, 0, 400, dtype=curve.dtype)[:, None]


def _spaced(curve: Tensor) -> Tensor:
    """Return vertices along a plane curve, evenly, so that vertex 15 is nearest to its place; at the rope's height."""
    along = torch.cat([curve.new_zeros(1), (curve[1:] - curve[:-1]).norm(dim=-1).cumsum(0)])
    middle = along[(curve - curve.new_tensor(MIDDLE)).norm(dim=-1).argmin()]
    # Vertex 0 leads: it is at the far end.
    wanted = middle - (torch.arange(COUNT, dtype=curve.dtype) - 15) * SPACING
    k = torch.searchsorted(along, wanted).clamp(1, len(along) - 1)
    share = ((wanted - along[k - 1]) / (along[k] - along[k - 1]))[:, None]
    flat = (1 - share) * curve[k - 1] + share * curve[k]
    return torch.cat([flat, torch.full_like(flat[:, :1], RADIUS)], -1)


@dataclass(frozen=True)
class WiringPost(Task):
    """Lead a rope in an S round two posts."""

    name: ClassVar[str] = "wiring_post"
    arms: ClassVar[Arms] = Arms(base=((-0.2, -0.25, 0.0),), vertex=(3,))
    cameras: ClassVar[tuple[TaskCamera, ...]] = (TaskCamera("front", (0.8, 0.75, 0.75), (0.4, 0.13, 0.02)),)
    combine: ClassVar[Literal["sum", "product"]] = "product"
    anchored: ClassVar[bool] = True
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.05, 0.025),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the rope may be moved."""
        x = straight((0.3, 0.05, 0.012), COUNT, moved[:, 0])
        rub: dict[str, Any] = {"mu_s": 0.7, "mu_k": 0.7}
        posts = [RigidBody("cylinder", (0.02, 0.02), (*p, 0.02), motion="fixed", **rub) for p in POSTS]
        return make(self, [Rope(x, RADIUS, mass=0.029, youngs=1e4)], solids=posts)

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return exponentials of minus the distance to the goal, the height, and how far the middle is off."""
        x = seen.x
        off = safe_norm(x[:, 15, :2] - x.new_tensor(MIDDLE)).squeeze(-1)
        return {
            "goal": torch.exp(-curve_geometry.chamfer(x, goal_vertices().to(x).expand(len(x), -1, -1))),
            "flat": torch.exp(-(x[..., 2] - 0.04).clamp(min=0).mean(-1)),
            "middle": torch.exp(-5 * (off - 0.02).clamp(min=0)),
        }

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the goal curve."""
        return {"goal": goal_vertices().to(seen.x).expand(len(seen.x), -1, -1)}

    def measured(self) -> dict[str, str]:
        """Return what it is."""
        return {"goal": "the curve along which the rope is to lie [m]"}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the rope passes each post on its side, turns round it, and is near the goal."""
        beside, turn, off = self._judged(seen.x)
        return (off <= NEAR) & (beside > 0).all(-1) & (turn >= TURN).all(-1)

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return what is missing of each condition of success, 1 at most each: ropes that are near need not be bent."""
        beside, turn, off = self._judged(seen.x)
        off = (off / (1 - SPARE) - NEAR).clamp(min=0) / NEAR
        beside, turn = (-beside / CLEAR).clamp(min=0), 1 - turn / TURN / (1 + SPARE)
        missing = torch.cat([off[:, None], beside, turn.clamp(min=0)], -1)
        return SHORT * (missing / (1 + missing)).sum(-1)

    @staticmethod
    def _judged(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return by how much the rope passes posts on their sides [m] and turns there [rad], shape (B, 2), and how far
        it is from the goal [m], shape (B,)."""
        beside, turn = [], []
        for post, side in zip(POSTS, (-1.0, 1.0), strict=True):
            near = curve_geometry.distances(x[..., :2], x.new_tensor(post).expand(len(x), 1, 2)).squeeze(-1)
            closest = torch.take_along_dim(x[..., 1], near.argmin(-1, keepdim=True), -1).squeeze(-1)
            beside.append(side * (closest - post[1]))
            turn.append(bending_near_posts(x, near).abs())
        off = curve_geometry.chamfer(x, goal_vertices().to(x).expand(len(x), -1, -1))
        return torch.stack(beside, -1), torch.stack(turn, -1), off

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way along the floor: past the first post, between both, round the second. It earns 69.5."""
        way = [
            (-0.06, 0.035, 0.0),
            (-0.11, 0.06, 0.0),
            (-0.19, 0.185, 0.0),
            (-0.22, 0.25, 0.0),
            (-0.26, 0.265, 0.0),
            (-0.352, 0.255, 0.0),
        ]
        return [[point] for point in way]


def bending_near_posts(x: Tensor, near: Tensor, max_translation: float = 0.08) -> Tensor:
    """Return by how much curves change their direction in the top view within reach of a post [rad], shape (...).

    Args:
        x: vertices, shape (..., V, 3).
        near: their distances from the post [m], shape (..., V).
    """
    edge = x[..., 1:, :2] - x[..., :-1, :2]
    a, b = edge[..., :-1, :], edge[..., 1:, :]
    turn = torch.atan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1))
    return (turn * (near[..., 1:-1] <= max_translation)).sum(-1)
