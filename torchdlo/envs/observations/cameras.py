"""Cameras of tasks: in front of the arms, and one at the wrist of each arm."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.errors import InputError

__all__ = ["SIDES", "WRIST_EYE", "WRIST_TARGET", "TaskCamera", "front_camera", "wrist_names"]

SIDES = ("right", "left")
"""What the arms of a task are called, in order."""
WRIST_EYE, WRIST_TARGET = (0.135, 0.0, -0.03), (0.045, 0.0, 0.125)
"""Where a camera at the wrist is and what it looks at, in the frame of the hand [m]: 13 cm beside it, tilted inwards,
so that the fingers are in the picture and the hand does not fill it."""


@dataclass(frozen=True)
class TaskCamera:
    """A camera of a task, in the world or on the hand of an arm."""

    name: str
    """Its name: "front", "wrist_right", "wrist_left", or another."""
    eye: tuple[float, float, float]
    """Where it is, in the frame of the hand if it is on one [m]."""
    target: tuple[float, float, float]
    """What is in the middle of its picture [m]."""
    opening: float = 0.75
    """Angle that its picture covers from top to bottom [rad]."""
    arm: int | None = None
    """The arm that carries it; None for the world."""

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise InputError(f"camera: its name is {self.name!r}; expected a word of letters, digits and underscores.")
        if not 0.05 < self.opening < 3.0 or self.eye == self.target:
            raise InputError(
                f"camera {self.name}: it opens by {self.opening:g} rad from {self.eye} towards {self.target}; expected "
                "0.05 to 3 rad, and two different places."
            )


_ASIDE, _STEEP, _OPENING = math.radians(20), 0.8, 0.75
"""By how much the camera in front is beside the direction in which arms reach [rad], its rise per way, and its opening
[rad]."""


def front_camera(bases: Tensor, tools: Tensor, things: Tensor, *, name: str = "front") -> TaskCamera:
    """Return a camera that faces the arms and sees all that is to be handled.

    Args:
        bases: where arms stand [m], shape (R, 3).
        tools: where their tools start [m], shape (R, 3).
        things: points of ropes and bodies at the start [m], shape (N, 3).
        name: its name.
    """
    bases, tools, things = bases.double().cpu(), tools.double().cpu(), things.double().cpu()
    way = (tools - bases)[:, :2]
    ahead = way.mean(0)
    if float(ahead.norm()) < 0.5 * float(way.norm(dim=1).mean()):
        # They reach from two sides: look from the third.
        side = torch.stack([way[0, 1], -way[0, 0]])
        ahead = side if float(side @ ahead) >= 0 else -side
    x, y = (ahead / ahead.norm()).tolist()
    cos, sin = math.cos(_ASIDE), math.sin(_ASIDE)
    to_eye = torch.tensor([cos * x - sin * y, sin * x + cos * y, _STEEP], dtype=torch.float64)
    to_eye = to_eye / to_eye.norm()
    # Room above for the hands.
    seen = torch.cat([things, tools + torch.tensor([0.0, 0.0, 0.12], dtype=torch.float64)])
    right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), to_eye)
    right = right / right.norm()
    axes = torch.stack([right, torch.linalg.cross(to_eye, right)])
    half, away = math.tan(0.5 * _OPENING), 0.4
    middle = 0.5 * (seen.amin(0) + seen.amax(0))
    for _ in range(8):
        # The least distance at which all is within the picture; then aim at the middle of what is seen.
        off = (seen - middle) @ axes.T
        nearer = (seen - middle) @ to_eye
        away = max(float((off.abs().amax(1) / half + nearer).amax()), 0.3)
        place = off / (away - nearer)[:, None]
        middle = middle + away * 0.5 * (place.amin(0) + place.amax(0)) @ axes
    eye = middle + 1.12 * away * to_eye
    return TaskCamera(name, tuple(eye.tolist()), tuple(middle.tolist()), _OPENING)


def wrist_names(count: int) -> tuple[str, ...]:
    """Return names of the cameras of so many arms: "right" is the first arm of a task, as in data sets."""
    return tuple(f"wrist_{side}" for side in SIDES[:count]) if count <= len(SIDES) else _numbered(count)


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"wrist_{k}" for k in range(count))
