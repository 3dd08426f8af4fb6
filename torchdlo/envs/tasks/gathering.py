"""Gather three objects with a rope.

A soft plastic ball, a pebble and a cylinder lie between two arms and the rope whose ends they hold. Success: all three
are within 16 cm of each other, and no hand came within 6 cm of one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from torchdlo.coupling import BodyMpmCoupling
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.coupling.mpm.constitutive_models import Plastic
from torchdlo.coupling.mpm.particles import Grid, ParticleBlock, assemble, fill_ball
from torchdlo.envs.assets.rigid_objects import pebble
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Gathering", "GatheringSurrogate"]

FINE, CELL = 0.0064, 0.01
"""Distance of particles and spacing of the grid [m]."""
BALL, PEBBLE, CYLINDER = (0.25, 0.02, 0.07), (0.5, -0.05, 0.07), (0.08, -0.08, 0.025)
"""Where the objects start [m]."""
BOX = Grid((-0.4, -0.6, 0.0), (0.9, 0.4, 0.4), CELL, ("open", "open", "open", "open", "separate", "open"), (26, 26, 26))
"""Where matter may be. The window follows the ball: 26 nodes are twice its width."""
ROOM = 200
"""Nodes that there is room for next to pebble and cylinder; the gathered ball has 96 there."""
DRUMS = ((0.06, 0.033), (0.045, 0.03), (0.05, 0.025))
"""Radius and half height of rigid stand-ins for ball, pebble and cylinder [m]."""
MASSES = (0.524, 0.123, 0.236)
"""Masses of the three [kg]."""
NEAR, CLEAR = 0.16, 0.06
"""Success: how far objects may be from each other, and how near hands may come [m]."""
SHORT, SPARE = 10.0, 0.03
"""What each missing condition counts at most, and by which share it is to be more than met."""


@dataclass(frozen=True)
class Gathering(Task):
    """Gather three objects with a rope."""

    name: ClassVar[str] = "gathering"
    arms: ClassVar[Arms] = Arms(base=((-0.2, -0.63, 0.0), (0.5, -0.63, 0.0)), vertex=(1, 43), grip_force=10.0)
    combine: ClassVar[Literal["sum", "product"]] = "product"
    stretch: ClassVar[float] = 1.1
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.025, 0.0),) * 3

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; each of the objects may be moved."""
        rub: dict[str, Any] = {"mu_s": 0.3, "mu_k": 0.3, "density": 600.0}
        at = [moved[:, k] + moved.new_tensor(p) for k, p in enumerate((BALL, PEBBLE, CYLINDER))]
        solids = [
            pebble().solid(at[1].double(), name="pebble", **rub),
            RigidBody("cylinder", (0.05, 0.025), at[2], **rub),
        ]
        points = fill_ball((0.0, 0.0, 0.0), 0.05, FINE, moved) + at[0][:, None]
        numbers: dict[str, float | Tensor] = {"youngs": 1e5, "poisson": 0.3, "yield_stress": 1e3, "density": 1000.0}
        return self._made(moved, solids, assemble([ParticleBlock(points, Plastic(), FINE**3, numbers=numbers)], BOX))

    def _made(self, like: Tensor, solids: list[RigidBody], material_points: tuple = ()) -> tuple[Scene, Params, State]:
        """Return the scene of some objects, on a plane, with the rope beside them."""
        x = straight((-0.15, 0.1, 0.012), 45, like.new_zeros(len(like), 3))
        rope = Rope(x, RADIUS, mass=0.44, youngs=1e3, stretch=1e5 * math.pi * RADIUS**2)
        floor = RigidBody("plane", motion="fixed", mu_s=0.3, mu_k=0.3)
        values = {"damping": {"rate": 15.0, "twist_rate": 10.0}}
        # A wall of the box is the floor for matter.
        meet = [BodyMpmCoupling(room=ROOM, planes=False)] if material_points else []
        return make(self, [rope], meet, values, solids=[floor, *solids], material_points=material_points)

    def _objects(self, seen: TaskState) -> Tensor:
        """Return the centres of the objects [m], shape (B, 3, 3)."""
        return torch.cat(
            [
                tree.part(seen.state.material_points).pos.mean(-2, keepdim=True),
                tree.part(seen.state.bodies).pos[:, 1:],
            ],
            -2,
        )

    def _apart(self, seen: TaskState) -> Tensor:
        """Return how far each two objects are from each other [m], shape (B, 3)."""
        objects = self._objects(seen)
        return curve_geometry.distances(objects, objects.roll(1, -2)).diagonal(dim1=-2, dim2=-1)

    def _hands(self, seen: TaskState) -> Tensor:
        """Return the distances of the hands to their nearest objects [m], shape (B, 2)."""
        return curve_geometry.nearest(seen.tool.pos, self._objects(seen))

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return exponentials of how far objects are from each other and from the rope, and of hands too close."""
        return {
            "together": torch.exp(-self._apart(seen).sum(-1)),
            "rope": torch.exp(-0.1 * curve_geometry.nearest(self._objects(seen), seen.x).sum(-1)),
            "clear": torch.exp(-100 * (0.1 - self._hands(seen)).clamp(min=0).sum(-1)),
        }

    def auxiliary_loss(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how far the hands are from each other: far from the objects, nothing else tells the way."""
        return {"span": 0.1 * safe_norm(seen.tool.pos[:, 0] - seen.tool.pos[:, 1]).squeeze(-1)}

    def note(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how close hands came to objects so far [m], shape (B,)."""
        now = self._hands(seen).amin(-1)
        return {"closest": torch.minimum(now, seen.notes.get("closest", now))}

    def failed(self, seen: TaskState) -> Tensor:
        """Return whether a hand has lost the rope."""
        return (seen.closed == 0).any(-1).any(-1)

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the objects are together and no hand came too close."""
        return (self._apart(seen) <= NEAR).all(-1) & (seen.notes["closest"] >= CLEAR)

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return what is missing of each condition of success: of each two objects, and of the nearer hand."""
        apart = self._apart(seen) / (1 - SPARE) / NEAR - 1
        clear = 1 - seen.notes["closest"] / (1 + SPARE) / CLEAR
        missing = torch.cat([apart, clear[:, None]], -1).clamp(min=0)
        return SHORT * (missing / (1 + missing)).sum(-1)

    def surrogate(self) -> GatheringSurrogate | None:
        """Return the task with rigid objects only."""
        return GatheringSurrogate(
            self.horizon, self.frame_skip, self.settle_steps, self.release, self.rope, self.fidelity
        )

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way by which the hands draw the rope round the objects, until it is a narrow bow about them."""
        return [[(0.04, -0.2, 0.018), (-0.07, -0.2, 0.018)], [(0.23, -0.5, 0.018), (-0.41, -0.5, 0.018)]]


@dataclass(frozen=True)
class GatheringSurrogate(Gathering):
    """Upright cylinders in place of the soft ball and the pebble, as wide, high and heavy as they are at rest."""

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; each of the objects may be moved."""
        solids = []
        for k, (place, (radius, half), mass) in enumerate(zip((BALL, PEBBLE, CYLINDER), DRUMS, MASSES, strict=True)):
            at = moved[:, k] + moved.new_tensor([*place[:2], half])
            solids.append(RigidBody("cylinder", (radius, half), at, mass=mass, mu_s=0.3, mu_k=0.3))
        return self._made(moved, solids)

    def surrogate(self) -> None:
        """Return nothing: this is it."""

    def _objects(self, seen: TaskState) -> Tensor:
        return tree.part(seen.state.bodies).pos[:, 1:]
