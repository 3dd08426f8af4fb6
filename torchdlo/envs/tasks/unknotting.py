"""Untie an overhand knot.

Two arms hold a rope with a loose overhand knot. Success: the rope, its ends carried to infinity, is not knotted, and
does not cross itself in the top view.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, SPACING, Arms, Task, TaskState, make, raised, resample_evenly, settled
from torchdlo.envs.observations.cameras import TaskCamera
from torchdlo.scene import Params, Rope, Scene, State

__all__ = ["Unknotting"]

COUNT = 50
SIDEWAYS = (0.0, 0.7071, 0.7071, 0.0)
"""Tools point down, turned by a quarter about the vertical."""


def tied() -> Tensor:
    """Return the knot as it is laid down, shape (50, 3): flat, with three crossings, over and under in turn.

    The curve is the long trefoil (t^3 - 3t, t^4 - 4t^2) of Shastri 1992, Tohoku Math. J. 44(1), seen from above.
    """
    t = torch.linspace(-2.12, 2.12, 4001, dtype=torch.float64)
    x = torch.stack([1.3 * (t**3 - 3 * t), t**4 - 4 * t**2], -1)
    before, after = x[0] - x[1], x[-1] - x[-2]
    out = torch.linspace(0, 7.0, 500, dtype=torch.float64)[1:, None]
    curve = torch.cat([x[0] + before / before.norm() * out.flip(0), x, x[-1] + after / after.norm() * out])
    curve = curve * ((COUNT - 1) * SPACING / float((curve[1:] - curve[:-1]).norm(dim=-1).sum()))
    flat = resample_evenly(torch.cat([curve, 0 * curve[:, :1]], -1), COUNT)
    middle = 0.5 * (flat.amax(0) + flat.amin(0))
    return raised(flat - middle + flat.new_tensor([0.7, -0.1, 0.0]), curve_geometry.crossing_places(flat)[1::2])


@functools.cache
def lying() -> Tensor:
    """Return the knot at rest, shape (50, 3)."""
    return settled(_made(Unknotting(), tied()[None]), 50)


def _made(task: Task, x: Tensor) -> tuple[Scene, Params, State]:
    stiff = 1e5 * math.pi * RADIUS**2
    return make(task, [Rope(x, RADIUS, mass=0.049, youngs=1e4, stretch=stiff)])


@dataclass(frozen=True)
class Unknotting(Task):
    """Untie an overhand knot."""

    name: ClassVar[str] = "unknotting"
    arms: ClassVar[Arms] = Arms(base=((0.25, -0.5, 0.0), (1.1, 0.2, 0.0)), vertex=(2, 37), quat=(SIDEWAYS, SIDEWAYS))
    cameras: ClassVar[tuple[TaskCamera, ...]] = (TaskCamera("front", (1.1, -0.6, 0.7), (0.68, -0.09, 0.03)),)
    combine: ClassVar[Literal["sum", "product"]] = "product"
    stretch: ClassVar[float] = 1.05
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.05, 0.025),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene; the rope may be moved."""
        return _made(self, lying().to(moved) + moved[:, :1])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return exponentials of minus the average crossing number and of how closely the rope lies to itself."""
        return {
            "crossings": torch.exp(-curve_geometry.crossing_number(seen.x)),
            "clear": torch.exp(-100 * curve_geometry.crowding_penalty(seen.x, 0.04)),
        }

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how often the rope crosses itself, and how closely it lies to itself."""
        return {
            "crossings": curve_geometry.crossings(seen.x).to(seen.x.dtype),
            "crossing_number": curve_geometry.crossing_number(seen.x),
            "crowding": curve_geometry.crowding_penalty(seen.x, 0.04),
        }

    def measured(self) -> dict[str, str]:
        """Return what they are."""
        return {
            "crossings": "how often the rope crosses itself in the top view; no gradient",
            "crossing_number": "average crossing number over all views, with gradient",
            "crowding": "sum of max(0, 0.04 - r)^2 over pairs of edges r apart that are no neighbours [m^2]",
        }

    def success(self, seen: TaskState) -> Tensor:
        """Return whether the rope is not knotted and does not cross itself."""
        return (curve_geometry.crossings(seen.x) == 0) & (curve_geometry.knot_determinant(seen.x) == 1)

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Return a way back through the knot and then apart. It earns 30.5.

        The first hand takes the rope's end under the strand that it crosses first, over the next one and out of the
        knot; what is left is a loop that crosses itself once. Both hands pull it open, the second one beside its own
        end, which follows without crossing.
        """
        still = (0.0, 0.0, 0.0)
        return [
            [(0.112, -0.168, 0.0), still],
            [(0.147, -0.198, 0.04), still],
            [(0.157, -0.303, 0.045), still],
            [(0.057, -0.453, 0.02), (0.053, -0.034, 0.07)],
            [(-0.123, -0.423, 0.03), (0.233, -0.014, 0.07)],
            [(-0.183, -0.383, 0.02), (0.273, 0.016, 0.01)],
        ]
