"""Shoot a ball at a cube with a slingshot.

A rubber band is fixed at both ends in front of a table with a ball and a cube; the fingers of an arm hold its middle,
pull it back and let go. Success: the ball has hit the cube, which is 5 cm or more further away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core.fidelity import Fidelity
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Slingshot"]

BALL, CUBE = 1, 2
"""Numbers of the bodies."""
BALL_Y, CUBE_Y = 0.06, 0.23
"""Where they start [m]."""
DRAW = 0.1
"""How far back the loss would have the band [m]."""
SNAP = 50.0
"""How fast the band becomes within a step when it is let go [m/s]."""
SLIPPERY = 0.02
"""Friction of the table with what lies on it [1]."""


@dataclass(frozen=True)
class Slingshot(Task):
    """Shoot a ball at a cube with a slingshot."""

    horizon: int = 30
    settle_steps: int = 100
    release: int = 200

    name: ClassVar[str] = "slingshot"
    arms: ClassVar[Arms] = Arms(base=((-0.33, -0.65, 0.0),), vertex=(6,), grip_force=3.0)
    cameras: ClassVar[tuple[TaskCamera, ...]] = (TaskCamera("front", (0.8, 0.55, 0.75), (0.1, 0.1, 0.18)),)
    coarse: ClassVar[Fidelity] = Fidelity(substeps=4)
    demonstration_noise: ClassVar[float] = 0.0003
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.03, 0.0),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; ball and cube may be moved together."""
        x = straight((0.0, 0.0, 0.21), 12, moved.new_zeros(len(moved), 3))
        band = Rope(x, RADIUS, mass=0.011, youngs=1e5, stretch=8e5 * math.pi * RADIUS**2)
        # Coefficients of two bodies make their harmonic mean: 1 and 1 for ball and cube, 1 and this for the table.
        table = SLIPPERY / (2 - SLIPPERY)
        ball = moved[:, 0] + moved.new_tensor([0.12, BALL_Y, 0.2])
        cube = moved[:, 0] + moved.new_tensor([0.12, CUBE_Y, 0.22])
        solids = [
            RigidBody("box", (0.4, 0.95, 0.09), (0.12, 1.0, 0.09), motion="fixed", mu_s=table, mu_k=table),
            RigidBody("sphere", 0.02, ball, density=200.0, mu_s=1.0, mu_k=1.0),
            RigidBody("box", (0.04, 0.04, 0.04), cube, density=20.0, mu_s=1.0, mu_k=1.0),
        ]
        return make(self, [band], solids=solids, fixed=(0, 1, 10, 11), burst=SNAP)

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how far away the cube is."""
        return {"cube": tree.part(seen.state.bodies).pos[:, CUBE, 1].clamp(0.0, 5.0)}

    def auxiliary_loss(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how far the middle of the band is from a point behind it: the ball tells only at the end."""
        return {"draw": safe_norm(seen.x[:, 6] - seen.x.new_tensor([0.12, -DRAW, 0.21])).squeeze(-1)}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the cube is further away and the ball left its place, which has nothing else to push it."""
        y = tree.part(seen.state.bodies).pos[..., 1]
        return (y[:, CUBE] >= CUBE_Y + 0.05) & (y[:, BALL] >= BALL_Y + 0.05)

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way straight back and at last aside, so that the band slips out. It earns 17.1.

        Fingers hold the band across them by 3 N only: they keep to where its longer and its shorter half pull evenly,
        within 0.7 mm, until they go aside by 1 cm, to the longer half. The band is about four times as stiff sideways
        as forwards and swings back twice as fast, so that it meets the ball as far on the other side. Let go without
        that, it throws the ball towards its shorter half, past a cube that is moved by 2 cm to +x.
        """
        way = [(0.0005, -0.0198), (0.0018, -0.0396), (0.0034, -0.0594), (0.0049, -0.0792), (0.0054, -0.0891)]
        return [[(x, y, 0.0)] for x, y in [*way, (-0.0046, -0.0891)]]
