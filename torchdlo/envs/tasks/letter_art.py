"""Write D and L beside an O with three plastic wires.

The wires lie straight on a table with three posts to bend them round; the O is a band that is fixed there. Two hands
take one wire after the other. A wire that is bent over a post and held for a while keeps most of the bend. Success:
after the hands have let go, each letter is within 1.5 cm of its goal (the sum of both mean nearest distances).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, SPACING, Arms, Stage, Task, TaskState, make
from torchdlo.physics.effects.elastic import BendFrame
from torchdlo.physics.effects.material import BendingPlasticity
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["LetterArt"]

COUNTS, STIFFNESS = (24, 30, 25), (1e4, 1e4, 2e3)
"""Vertices and Young's moduli [Pa] of the wires: the stem of the D, its bow, and the L."""
PLASTIC = {"yield_curvature": 4.0, "rate": 10.0}
"""Elastic curvature beyond which wires flow [1/m], and how fast [1/s]."""
POST, TOP = 0.02, 0.04
"""Radius and height of the posts [m]."""
ROUND = POST + RADIUS
"""Radius of a wire that lies on a post [m]."""
BASE = -0.23
"""Where the letters stand, in y [m]."""
RING, MIDDLE = 0.12, (0.68, BASE + 0.12)
"""Radius of the O and where its centre is [m]."""
CORNERS = (
    ((0.0, 0.23), (0.0, BASE)),
    ((0.025, 0.2066), (0.175, 0.12), (0.175, -0.12), (0.025, -0.2066)),
    ((0.30, 0.07), (0.30, BASE), (0.60, BASE)),
)
"""Corners of the wires' goals, before they are rounded, from their upper ends [m]."""
STARTS = ((-0.06, 0.23), (0.20, 0.29), (0.265, 0.07))
"""Where the upper ends of the wires are at the start [m]."""
CLOSE = 0.015
"""How near the letters are to be to their goals [m]."""


def round_corners(corners: tuple[tuple[float, float], ...]) -> tuple[Tensor, Tensor]:
    """Return a dense curve (n, 2) through corners that are rounded by `ROUND`, and the centres of the arcs (m, 2)."""
    points = torch.tensor(corners, dtype=torch.float64)
    parts, centres = [points[:1]], []
    step = torch.linspace(0, 1, 100, dtype=torch.float64)[:, None]
    for a, b, c in zip(points[:-2], points[1:-1], points[2:], strict=True):
        u, v = (a - b) / (a - b).norm(), (c - b) / (c - b).norm()
        half = 0.5 * torch.acos((u @ v).clamp(-1, 1))  # half the angle between the legs
        inward = (u + v) / (u + v).norm()
        centre = b + inward * ROUND / half.sin()
        # From the foot of the centre on the first leg to that on the second, by as much as the curve turns.
        first, second = (b + leg * ROUND / half.tan() - centre for leg in (u, v))
        turn = step * (math.pi - 2 * half)
        across = second - first * (first @ second) / ROUND**2
        parts.append(centre + first * turn.cos() + across / across.norm() * ROUND * turn.sin())
        centres.append(centre)
    dense = torch.cat([*parts, points[-1:]])
    return dense, torch.stack(centres) if centres else dense[:0]


@functools.cache
def goal_vertices() -> tuple[Tensor, ...]:
    """Return where the vertices of the wires belong, shapes (V, 3)."""
    return tuple(_spaced(round_corners(c)[0], n) for c, n in zip(CORNERS, COUNTS, strict=True))


def _spaced(curve: Tensor, count: int) -> Tensor:
    """Return vertices along a plane curve from its start, at the rope's height."""
    along = torch.cat([curve.new_zeros(1), (curve[1:] - curve[:-1]).norm(dim=-1).cumsum(0)])
    wanted = SPACING * torch.arange(count, dtype=curve.dtype)
    k = torch.searchsorted(along, wanted).clamp(1, len(along) - 1)
    share = ((wanted - along[k - 1]) / (along[k] - along[k - 1]))[:, None]
    flat = (1 - share) * curve[k - 1] + share * curve[k]
    return torch.cat([flat, torch.full_like(flat[:, :1], RADIUS)], -1)


@functools.cache
def post_axes() -> tuple[tuple[float, float], ...]:
    """Return the axes of the posts [m]: the centres of all rounded corners."""
    return tuple((float(x), float(y)) for c in CORNERS for x, y in round_corners(c)[1])


@dataclass(frozen=True)
class LetterArt(Task):
    """Write D and L beside an O with three plastic wires."""

    horizon: int = 140
    release: int = 200

    name: ClassVar[str] = "letter_art"
    arms: ClassVar[Arms] = Arms(base=((0.1, 0.65, 0.0), (0.1, -0.75, 0.0)), vertex=(24, 53))
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.005, 0.01),) * 3
    anchored: ClassVar[bool] = True
    stages: ClassVar[tuple[Stage, ...]] = (Stage(0, (24, 53)), Stage(54, (0, 23)), Stage(80, (54, 78)))

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; each wire may be moved."""
        area = math.pi * RADIUS**2
        wires = []
        for k, (count, stiffness, start) in enumerate(zip(COUNTS, STIFFNESS, STARTS, strict=True)):
            along = SPACING * torch.arange(count, dtype=moved.dtype, device=moved.device)
            line = torch.stack([0 * along, -along, 0 * along], -1) + moved.new_tensor([*start, RADIUS])
            x = line + moved[:, k : k + 1]
            wires.append(Rope(x, RADIUS, mass=1e-3 * (count - 1), youngs=stiffness, stretch=1e5 * area))
        solids = [RigidBody("cylinder", (POST, TOP / 2), (*p, TOP / 2), motion="fixed") for p in post_axes()]
        solids.append(RigidBody("torus", (RING, RADIUS), (*MIDDLE, RADIUS), motion="fixed", name="O"))
        values = {"bending_plasticity": PLASTIC}
        return make(self, wires, [BendFrame(), BendingPlasticity()], values, solids=solids)

    def missing(self, seen: TaskState) -> tuple[Tensor, Tensor]:
        """Return how far the D and the L are from their goals [m], shape (B,) each."""
        stem, bow, ell = seen.x.split(COUNTS, -2)
        goal = [g.to(seen.x).expand(len(seen.x), -1, -1) for g in goal_vertices()]
        return curve_geometry.chamfer(torch.cat([stem, bow], -2), torch.cat(goal[:2], -2)), curve_geometry.chamfer(
            ell, goal[2]
        )

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return exponentials of how far either letter is from its goal."""
        d, ell = self.missing(seen)
        return {"d": torch.exp(-10 * d), "l": torch.exp(-10 * ell)}

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return where the wires belong."""
        return {f"goal_{k}": g.to(seen.x).expand(len(seen.x), -1, -1) for k, g in enumerate(goal_vertices())}

    def measured(self) -> dict[str, str]:
        """Return what they are."""
        wires = ("stem of the D", "bow of the D", "L")
        return {f"goal_{k}": f"where the vertices of rope_{k} belong, the {wire} [m]" for k, wire in enumerate(wires)}

    def failed(self, seen: TaskState) -> Tensor:
        """Return whether a wire is stretched by more than a tenth."""
        lengths = [curve_geometry.length(x) / (SPACING * (x.shape[-2] - 1)) for x in seen.x.split(COUNTS, -2)]
        return torch.stack(lengths).amax(0) > 1.1

    def success(self, seen: TaskState) -> Tensor:
        """Return whether both letters are near their goals."""
        return torch.stack(self.missing(seen)).amax(0) <= CLOSE

    def stage_waypoints(self) -> list[list[list[tuple[float, float, float]]]]:
        """Return a way of three stages: hands draw one wire after the other taut round its posts, and wait."""
        bow = [(-0.09, -0.005), (-0.1785, -0.0814)]
        ell = [((0.035, 0.004), (0.135, 0.01)), ((0.035, 0.004), (0.21, 0.09)), ((0.035, 0.004), (0.232, 0.18))]
        ell.append(((0.035, 0.0), (0.228, 0.18)))  # without tension a soft wire does not jump when it is let go
        return [
            [[(x, y, 0.0), (x, -y, 0.0)] for x, y in bow],
            [[(0.06, 0.003, 0.0), (0.06, -0.003, 0.0)]],
            [[(*a, 0.0), (*b, 0.0)] for a, b in ell],
        ]
