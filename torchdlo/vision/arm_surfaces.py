"""How arms look: smooth shells over the links of a seven-joint arm, and plain solids over those of any other.

Shells are unions of cones with round ends that run into each other (smooth minimum of distances, Quilez 2013); they
follow the published joint axes and are no copy of anyone's meshes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from torchdlo.coupling.robot.robot_kinematics import Robot
from torchdlo.vision.surfaces import Surface, blended_isosurface, joined, moved, solid

__all__ = ["LinkSurface", "link_surfaces", "panda_surfaces"]


@dataclass(frozen=True, eq=False)
class LinkSurface:
    """A part of a link that has one paint."""

    link: str
    part: str
    """"shell", "joint" or "finger"."""
    surface: Surface
    """In the frame of the link."""


# Cones with round ends (start, end, radius at the start, at the end) [m], and by how much they run into each other.
_Cone = tuple[tuple[float, float, float], tuple[float, float, float], float, float]
_SHELLS: dict[str, tuple[float, list[_Cone]]] = {
    "link0": (
        0.05,
        [
            ((-0.1, -0.045, 0.03), (-0.1, 0.045, 0.03), 0.035, 0.035),
            ((-0.1, 0.0, 0.03), (0.0, 0.0, 0.045), 0.05, 0.06),
            ((0.0, -0.03, 0.035), (0.0, 0.03, 0.035), 0.05, 0.05),
            ((0.0, 0.0, 0.05), (0.0, 0.0, 0.09), 0.063, 0.056),
        ],
    ),
    "link1": (
        0.03,
        [
            ((0.0, 0.0, -0.13), (0.0, 0.0, -0.02), 0.058, 0.062),
            ((0.0, -0.035, 0.0), (0.0, 0.035, 0.0), 0.066, 0.066),
        ],
    ),
    "link2": (
        0.03,
        [
            ((0.0, 0.0, -0.062), (0.0, 0.0, 0.062), 0.056, 0.056),
            ((0.0, -0.02, 0.0), (0.0, -0.15, 0.0), 0.06, 0.058),
        ],
    ),
    "link3": (
        0.035,
        [
            ((0.0, 0.0, -0.09), (0.0, 0.0, -0.04), 0.058, 0.056),
            ((0.0, 0.0, -0.03), (0.075, 0.0, 0.0), 0.052, 0.05),
            ((0.0825, -0.03, 0.0), (0.0825, 0.03, 0.0), 0.055, 0.055),
        ],
    ),
    "link4": (
        0.035,
        [
            ((0.0, 0.0, -0.058), (0.0, 0.0, 0.058), 0.05, 0.05),
            ((0.0, 0.01, 0.0), (-0.0825, 0.07, 0.0), 0.05, 0.052),
            ((-0.0825, 0.06, 0.0), (-0.0825, 0.1, 0.0), 0.056, 0.057),
        ],
    ),
    "link5": (
        0.03,
        [
            ((0.0, 0.0, -0.215), (0.0, 0.01, -0.18), 0.056, 0.055),
            ((0.0, 0.01, -0.18), (0.0, 0.05, -0.09), 0.052, 0.04),
            ((0.0, 0.05, -0.09), (0.0, 0.055, -0.01), 0.04, 0.042),
            ((0.0, 0.02, 0.0), (0.0, 0.055, 0.0), 0.045, 0.045),
        ],
    ),
    "link6": (
        0.025,
        [
            ((0.0, 0.0, -0.015), (0.0, 0.0, 0.055), 0.046, 0.044),
            ((0.01, 0.0, 0.0), (0.085, 0.0, 0.0), 0.04, 0.042),
            ((0.088, 0.02, 0.0), (0.088, -0.03, 0.0), 0.044, 0.044),
        ],
    ),
    "link7": (
        0.02,
        [((0.0, 0.0, 0.05), (0.0, 0.0, 0.075), 0.042, 0.04), ((0.02, 0.02, 0.07), (0.03, 0.03, 0.07), 0.022, 0.018)],
    ),
    "hand": (
        0.02,
        [
            ((0.0, -0.075, 0.025), (0.0, 0.075, 0.025), 0.025, 0.025),
            ((0.0, -0.08, 0.045), (0.0, 0.08, 0.045), 0.018, 0.018),
            ((0.0, -0.025, 0.02), (0.0, 0.025, 0.02), 0.032, 0.032),
        ],
    ),
}
# Discs between links (link, axis, start along it, place across it, radius, half thickness) [m].
_RINGS = (
    ("link0", 2, 0.143, (0.0, 0.0), 0.053, 0.012),
    ("link2", 2, 0.105, (0.0, 0.0), 0.047, 0.016),
    ("link2", 2, -0.105, (0.0, 0.0), 0.047, 0.016),
    ("link2", 1, -0.2, (0.0, 0.0), 0.054, 0.012),
    ("link4", 2, 0.098, (0.0, 0.0), 0.042, 0.014),
    ("link4", 2, -0.098, (0.0, 0.0), 0.042, 0.014),
    ("link4", 1, 0.152, (0.0, -0.0825), 0.053, 0.012),
    ("link6", 2, 0.092, (0.0, 0.0), 0.037, 0.01),
    ("link7", 2, 0.1, (0.0, 0.0), 0.038, 0.012),
)
# Boxes of the fingers (middle, half lengths) [m].
_FINGER = (((0.0, 0.0085, 0.014), (0.01, 0.0085, 0.014)), ((0.0, 0.006, 0.04), (0.0085, 0.006, 0.014)))


def _cone(p: np.ndarray, cone: _Cone) -> np.ndarray:
    start, end = np.array(cone[0]), np.array(cone[1])
    way = end - start
    share = np.clip((p - start) @ way / (way @ way), 0, 1)
    return np.linalg.norm(p - start - share[:, None] * way, axis=1) - (cone[2] + share * (cone[3] - cone[2]))


def _shell(width: float, cones: list[_Cone], spacing: float) -> Surface:
    def distance(p: np.ndarray) -> np.ndarray:
        found = _cone(p, cones[0])
        for cone in cones[1:]:
            other = _cone(p, cone)
            near = np.maximum(width - np.abs(found - other), 0) / width
            found = np.minimum(found, other) - 0.25 * width * near**2
        return found

    # Where surfaces run into each other they swell by a quarter of the width at most.
    ends = [np.array(p) + side * (max(a, b) + 0.25 * width) for s, e, a, b in cones for p in (s, e) for side in (-1, 1)]
    return blended_isosurface(distance, np.min(ends, 0), np.max(ends, 0), spacing)


def _disc(axis: int, at: float, across: tuple[float, float], radius: float, half: float) -> Surface:
    made = solid("cylinder", np.array([radius, half, 0.0]), 20)
    turn = np.roll(np.eye(3), axis - 2, axis=0)
    shift = np.zeros(3)
    shift[axis], shift[(axis + 1) % 3], shift[(axis + 2) % 3] = at, *across
    return moved(made, turn, shift)


@functools.cache
def panda_surfaces(spacing: float = 0.015) -> tuple[LinkSurface, ...]:
    """Return the surfaces of the seven-joint arm and its gripper; `spacing` as in `link_surfaces`."""
    found = [LinkSurface(link, "shell", _shell(*shell, spacing)) for link, shell in _SHELLS.items()]
    for link in dict.fromkeys(row[0] for row in _RINGS):
        found.append(LinkSurface(link, "joint", joined([_disc(*row[1:]) for row in _RINGS if row[0] == link])))
    finger = joined([moved(solid("box", np.array(half)), np.eye(3), np.array(at)) for at, half in _FINGER])
    found += [LinkSurface(f"{side}_finger", "finger", finger) for side in ("left", "right")]
    return tuple(found)


def link_surfaces(robot: Robot, spacing: float = 0.015) -> tuple[LinkSurface, ...]:
    """Return the surfaces of a robot's links.

    Args:
        robot: the robot.
        spacing: about how far corners of shells are apart [m].
    """
    if {*_SHELLS, "left_finger", "right_finger"} <= set(robot.links):
        return panda_surfaces(spacing)
    found = []
    for shape in robot.shapes:
        size, origin = np.zeros(3), shape.origin.numpy()
        size[: len(shape.size)] = [float(x) for x in shape.size]
        placed = moved(solid(shape.kind, size, 20), origin[:3, :3], origin[:3, 3])
        found.append(LinkSurface(shape.link, "shell", placed))
    return tuple(found)
