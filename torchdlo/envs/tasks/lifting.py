"""Lift two rings with one rope.

Two open rings stand upright on small feet, their gaps towards the arms; the rope lies behind them. Success: both have
been 5 cm or more above their start for 0.1 s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.assets.rigid_objects import GAP, RING, TUBE, c_ring, origin
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Lifting"]

CENTRES = ((0.53, 0.0, 0.06), (0.67, 0.0, 0.06))
"""Where the rings' centres are at the start [m]."""
LIFT = 0.05
"""By how much rings are to be lifted [m]."""
LATE = 5
"""Actions at the end that count: 0.1 s."""
AWAY, LOW, CLOSE = 100.0, 20.0, 0.01
"""What a metre counts in the return that the rope still has to go to where it lifts a ring, and a lift that is missing;
how close is close enough [m]."""
TOP = RING - TUBE - RADIUS
"""Height over a ring's centre at which the rope carries it [m]."""


@dataclass(frozen=True)
class Lifting(Task):
    """Lift two rings with one rope."""

    name: ClassVar[str] = "lifting"
    arms: ClassVar[Arms] = Arms(base=((0.25, -0.4, 0.0), (0.95, -0.4, 0.0)), vertex=(4, 25))
    stretch: ClassVar[float] = 1.1
    anchored: ClassVar[bool] = True
    forfeits: ClassVar[bool] = False  # as published
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.05, 0.025),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the rope may be moved."""
        x = straight((0.3, 0.1, 0.012), 30, moved[:, 0])
        rope = Rope(x, RADIUS, mass=0.029, youngs=5e3, stretch=1e5 * math.pi * RADIUS**2)
        rub: dict[str, Any] = {"mu_s": 0.6, "mu_k": 0.6}
        rings = [c_ring().solid(p, density=120.0, name=f"ring {k}", **rub) for k, p in enumerate(CENTRES)]
        return make(self, [rope], solids=[RigidBody("plane", motion="fixed", **rub), *rings])

    def _rings(self, seen: TaskState) -> Tensor:
        """Return the centres of the rings [m], shape (B, 2, 3)."""
        return torch.stack([origin(c_ring(), tree.part(seen.state.bodies), k) for k in (1, 2)], -2)

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how high the rings are, how near and how far below the rope is, and how close hands come to them."""
        rings = self._rings(seen)
        apart = curve_geometry.distances(rings, seen.x)
        near, which = apart.min(-1)
        above = torch.take_along_dim(seen.x[..., 2], which, -1) - rings[..., 2]
        close = (0.08 - safe_norm(seen.tool.pos - rings).squeeze(-1)).clamp(min=0)
        return {
            "present": torch.full_like(near[:, 0], 2.0),
            "height": 5.0 * rings[..., 2].sum(-1),
            "carried": 0.5 * above.clamp(0.0, 0.03).sum(-1),
            "near": -0.5 * near.sum(-1),
            "clear": -100.0 * close.sum(-1),
        }

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the centres of the rings, which are not their centres of mass."""
        rings = self._rings(seen)
        return {"ring_0": rings[:, 0], "ring_1": rings[:, 1]}

    def measured(self) -> dict[str, str]:
        """Return what they are."""
        return {f"ring_{k}": "centre of the upright open ring, whose axis is along x and gap at -y [m]" for k in (0, 1)}

    def note(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the heights of the rings after the last actions, shape (B, 5, 2)."""
        now = self._rings(seen)[:, None, :, 2]
        last = seen.notes.get("heights", now.expand(-1, LATE, -1))
        return {"heights": torch.cat([last[:, 1:], now], 1)}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether both rings stayed up for the last 0.1 s."""
        start = seen.x.new_tensor([c[2] for c in CENTRES])
        return (seen.notes["heights"] >= start + LIFT).all(-1).all(-1)

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return how far the rope has to go into the rings, and by how much they are too low.

        Behind a ring the rope is as near to its centre as in front of its gap, but has the whole way round to go.
        """
        rings, x = self._rings(seen).unsqueeze(-2), seen.x.unsqueeze(-3)
        side = x[..., 0] - rings[..., 0]
        way = safe_norm(torch.stack([side, distance_into_ring(x[..., 1:] - rings[..., 1:])], -1)).squeeze(-1).amin(-1)
        start = x.new_tensor([c[2] for c in CENTRES])
        low = (1 - (rings[..., 0, 2] - start) / LIFT).clamp(min=0)
        return (AWAY * (way - CLOSE).clamp(min=0) + LOW * low).sum(-1)

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way by which the rope, pulled straight, goes over the rings, into their gaps and up with them."""
        way = [(-0.033, 0.133), (-0.17, 0.133), (-0.19, 0.048), (-0.1, 0.048), (-0.1, 0.53)]
        return [[(-0.0025, y, z), (0.0225, y, z)] for y, z in way]


def distance_into_ring(p: Tensor) -> Tensor:
    """Return how far it is to the top of an upright ring's hole, over it and through its gap [m], shape (...).

    Args:
        p: points in its plane, along y and z from its centre; the gap is at -y; shape (..., 2).
    """
    far = safe_norm(p).squeeze(-1)
    # Angle from an end of the gap, over the top: the floor bars the way below. In the very middle there is none.
    q = torch.where(far.unsqueeze(-1) > 0, p, 1.0)
    angle = torch.atan2(q[..., 1], -q[..., 0]) - 0.5 * GAP
    angle = torch.where(angle < -GAP, angle + 2 * math.pi, angle)
    outside = (far > RING) & (angle > 0)
    # Round the ring as far out as it is now, to an end of the gap, and straight on from there.
    out = far.clamp(min=RING + TUBE + RADIUS)
    end = p.new_tensor([-math.cos(0.5 * GAP), math.sin(0.5 * GAP)]) * out.unsqueeze(-1)
    straight_on = safe_norm(torch.where(outside.unsqueeze(-1), end, p) - p.new_tensor([0.0, TOP])).squeeze(-1)
    return straight_on + torch.where(outside, (RING + TUBE + RADIUS) * angle, 0.0)
