"""Coil a rope round a cone.

A straight rope lies behind a cone; one arm holds it near its end. Success: the part of the rope that is near the cone
turns by a whole turn round its axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Coiling"]

BASE, HEIGHT = 0.12, 0.30
"""Radius and height of the cone [m]."""
NEAR = 0.06
"""Distance from the cone's surface within which the rope counts as wound round it [m]."""
SHORT, SPARE = 100.0, 0.02
"""What a whole turn that is missing counts in the return, and the share by which it is to be exceeded. It is much: a
rope that is hung over the cone earns more than one that is wound round it, and its loss is a little smaller, too."""
FADE = 0.2
"""Distance beyond `NEAR` over which turns come to count a third in half of the shortfall [m]."""


@dataclass(frozen=True)
class Coiling(Task):
    """Coil a rope round a cone."""

    name: ClassVar[str] = "coiling"
    arms: ClassVar[Arms] = Arms(base=((-0.25, -0.4, 0.0),), vertex=(1,))
    anchored: ClassVar[bool] = True
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.05, 0.01),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the rope may be moved."""
        x = straight((-0.6, 0.265, 0.012), 60, moved[:, 0])
        cone = RigidBody("cone", (BASE, HEIGHT), (0.0, 0.0, HEIGHT / 4), motion="fixed", mu_s=0.7, mu_k=0.7)
        return make(self, [Rope(x, RADIUS, mass=0.059, youngs=1e3)], solids=[cone])

    def _missing(self, seen: TaskState) -> Tensor:
        """Return the sum of the vertices' distances to the middle of the cone [m]."""
        return safe_norm(seen.x - seen.x.new_tensor([0.0, 0.0, HEIGHT / 2])).sum((-1, -2))

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return 1 for a rope in the middle of the cone, less the further its vertices are from it."""
        return {"near": torch.exp(-0.1 * self._missing(seen))}

    def auxiliary_loss(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the exponent: the exponential is flat far from the goal."""
        return {"distance": 0.1 * self._missing(seen)}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the rope turns by a whole turn within 6 cm of the cone."""
        return winding_angle(seen.x).abs() >= 2 * math.pi

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return by how many turns the rope goes round the cone."""
        return {"turns": winding_angle(seen.x) / (2 * math.pi)}

    def measured(self) -> dict[str, str]:
        """Return what it is."""
        return {"turns": "turns of the rope round the cone, with a sign, where it is within 6 cm of it"}

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return what a whole turn that is missing counts: coils that are wide and loose may earn as much.

        Half of it counts what turns further out, too, by less the further: the other half does not say how to get near.
        """
        done = torch.stack([winding_angle(seen.x), winding_angle(seen.x, FADE)]).abs() / (1 + SPARE) / (2 * math.pi)
        return SHORT * (1 - done).clamp(min=0).mean(0)

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way up and straight to the cone's upper part, and on round it at its side. It earns 12.1.

        The hand goes round at 20 cm above the floor and 5 to 6 cm from the axis, where that is short and the rope still
        stays outside of the cone. The rope follows, and what trails behind it goes round too, from below.
        """
        way = [
            (0.551, -0.315, 0.193),
            (0.609, -0.315, 0.193),
            (0.638, -0.265, 0.193),
            (0.609, -0.215, 0.193),
            (0.551, -0.215, 0.193),
            (0.524, -0.25, 0.193),
        ]
        return [[point] for point in way]


def winding_angle(x: Tensor, fade: float = 0.0) -> Tensor:
    """Return by how much curves turn round the cone where they are near it [rad], shape (...).

    Args:
        x: a polyline, shape (..., V, 3).
        fade: distance further out over which turns come to count a third [m]; 0: they count nothing.
    """
    # Distance from the cone's flank, positive outside: its profile leads from (BASE, 0) to (0, HEIGHT).
    across = 0.5 * (x[..., 1:, :] + x[..., :-1, :])
    slant = math.hypot(BASE, HEIGHT)
    out = ((safe_norm(across[..., :2]).squeeze(-1) - BASE) * HEIGHT + across[..., 2] * BASE) / slant - RADIUS
    share = torch.exp(-(out - NEAR).clamp(min=0) / fade) if fade else out <= NEAR
    return (curve_geometry.turning_angles(x, x.new_zeros(2)) * share).sum(-1)
