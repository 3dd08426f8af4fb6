"""Lead a rope through two rings.

Two rings stand upright and fixed, at right angles to each other. Hands may not pass through them: one pushes the lead
end through, the other takes hold of it behind. Success: the rope passes through the first and then through the second,
and its lead end is 3 cm or more beyond that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, SPACING, Arms, Stage, Task, TaskState, make, straight
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["WiringRing"]

RINGS = ((0.27, 0.0, 0.05), (0.09, -0.27, 0.05))
"""Centres of the rings [m]."""
ALONG = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
"""Directions in which the lead end is to pass them [1]."""
INNER, TUBE, OUTER = 0.035, 0.007, 0.049
"""Inner radius of the rings, radius of their tubes, and outer radius [m]; they stand on the floor."""
BEYOND = 0.03
"""How far the lead end is to be beyond the second ring [m]."""
START = (0.32, 0.0, 0.012)
"""Where the lead end is at the start, 5 cm before the first ring [m]."""
COUNT = 30
HALF = math.sqrt(0.5)


@dataclass(frozen=True)
class WiringRing(Task):
    """Lead a rope through two rings."""

    name: ClassVar[str] = "wiring_ring"
    arms: ClassVar[Arms] = Arms(base=((0.3, -0.6, 0.0), (-0.35, -0.1, 0.0)), vertex=(2, 0))
    cameras: ClassVar[tuple[TaskCamera, ...]] = (TaskCamera("front", (0.2, 0.75, 0.75), (0.35, -0.08, 0.03)),)
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.01, 0.01),)
    anchored: ClassVar[bool] = True
    stages: ClassVar[tuple[Stage, ...]] = (
        Stage(0, (2, None)),
        Stage(20, (2, 0)),
        Stage(22, (None, 0)),
        Stage(54, (None, 3)),
        Stage(85, (1, 3)),
        Stage(87, (1, None)),
    )

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the rope may be moved."""
        x = straight(START, COUNT, moved[:, 0])
        rope = Rope(x, RADIUS, mass=0.029, youngs=1e4, stretch=1e5 * math.pi * RADIUS**2)
        size = (INNER + TUBE, TUBE)
        # A torus has its axis along z: a quarter turn about y lays it along x, one about x along y.
        quats = ((HALF, 0.0, HALF, 0.0), (HALF, HALF, 0.0, 0.0))
        rings = [RigidBody("torus", size, p, q, motion="fixed") for p, q in zip(RINGS, quats, strict=True)]
        return make(self, [rope], solids=rings)

    def _passes(self, x: Tensor) -> Tensor:
        """Return which edges pass through the discs of the rings, bool, shape (B, 2, E)."""
        return torch.stack(
            [curve_geometry.pierced_edges(x, x.new_tensor(p), x.new_tensor(n), INNER) for p, n in _discs()], -2
        )

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how near the rope is to both rings, how near its lead end is to its place, and rings passed."""
        x = seen.x
        centres = x.new_tensor(RINGS).expand(len(x), -1, -1)
        place = x.new_tensor(RINGS[1]) + 2 * BEYOND * x.new_tensor(ALONG[1])
        return {
            "near": torch.exp(-5 * curve_geometry.nearest(centres, x).sum(-1)),
            "lead": torch.exp(-5 * safe_norm(x[:, 0] - place).squeeze(-1)),
            "passed": (self._passes(x).sum(-1) % 2).to(x.dtype).sum(-1),
        }

    def note(self, seen: TaskState) -> dict[str, Tensor]:
        """Return where tools are (B, R, 3), and whether one went through a ring in the action before (B,)."""
        now = seen.tool.pos
        way = torch.stack([seen.notes.get("tool", now), now], -2)
        through = [curve_geometry.pierced_edges(way, way.new_tensor(p), way.new_tensor(n), OUTER) for p, n in _discs()]
        return {"tool": now, "through": torch.stack(through).any(0).flatten(1).any(-1)}

    def failed(self, seen: TaskState) -> Tensor:
        """Return whether the rope is stretched by more than a tenth, or a hand went through a ring."""
        return (curve_geometry.length(seen.x) > 1.1 * SPACING * (COUNT - 1)) | seen.notes["through"]

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how often the rope passes the rings, and where its lead end belongs."""
        passes = self._passes(seen.x).sum(-1).to(seen.x.dtype)
        place = seen.x.new_tensor(RINGS[1]) + 2 * BEYOND * seen.x.new_tensor(ALONG[1])
        return {"passes_0": passes[:, 0], "passes_1": passes[:, 1], "goal": place.expand(len(seen.x), 3)}

    def measured(self) -> dict[str, str]:
        """Return what they are."""
        return {
            "passes_0": "how often the rope passes through ring_0, whose axis is along x; no gradient",
            "passes_1": "how often the rope passes through ring_1, whose axis is along y; no gradient",
            "goal": "where vertex 0 belongs in the end, behind ring_1 [m]",
        }

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the rope passes both rings an odd number of times, the first one first, and ends behind."""
        passes = self._passes(seen.x)
        odd = passes.sum(-1) % 2 == 1
        index = torch.arange(COUNT - 1, device=seen.x.device)
        # Vertex 0 leads: along the rope, it has to come out of the second ring before it comes to the first.
        last = torch.where(passes[:, 1], index, -1).amax(-1)
        first = torch.where(passes[:, 0], index, COUNT).amin(-1)
        out = ((seen.x[:, 0] - seen.x.new_tensor(RINGS[1])) * seen.x.new_tensor(ALONG[1])).sum(-1)
        return odd.all(-1) & (last <= first) & (out >= BEYOND)

    def stage_waypoints(self) -> list[list[list[tuple[float, float, float]]]]:
        """Return a way of six stages: push the end through, draw it to the other ring, and the same there."""
        stay = (0.0, 0.0, 0.0)
        return [
            [[(0.0, 0.0, 0.045), stay], [(-0.075, 0.0, 0.045), stay]],
            [],
            [[(0.0, 0.0, 0.02), (-0.02, 0.0, 0.0)], [(-0.05, -0.17, 0.05), (-0.086, -0.166, -0.045)]],
            [[(0.0, -0.04, 0.0), (0.0, 0.0, 0.035)], [(-0.09, -0.17, 0.02), (-0.091, -0.137, 0.035)]],
            [],
            [[(-0.02, -0.06, 0.0), stay]],
        ]


def _discs() -> zip:
    return zip(RINGS, ALONG, strict=True)
