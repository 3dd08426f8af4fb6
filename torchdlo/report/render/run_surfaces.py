"""Surfaces of ropes and bodies as triangles, for pictures: corners (N, 3), triangles (T, 3), outwards oriented."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import resources

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.robot import urdf
from torchdlo.scene_files.run import Frames
from torchdlo.vision.arm_surfaces import panda_surfaces

__all__ = ["COLORS", "DrawnSurface", "bounds", "extent", "pieces", "points_of", "rotations", "spacing"]

Surface = tuple[np.ndarray, np.ndarray]
"""Corners [m] and triangles."""

_ROUND = 16
"""Corners round a tube."""
_ROPES = ("#c8792b", "#2f6f9f", "#5a8f3c", "#a04668", "#7a5ea8", "#b0913a")
"""Colours of ropes, in turn."""
COLORS = {
    "free": "#b9574b",
    "fixed": "#9aa3ab",
    "kinematic": "#7f8fa0",
    "robot": "#e6e3dc",
    "joint": "#4b5158",
    "finger": "#2e3236",
    "weight": "#5c6670",
    "table": "#e9e5dd",
    "elastic": "#c4584a",
    "plastic": "#8a7f6d",
    "liquid": "#3f86c4",
    "sand": "#c9a868",
}
"""Colours of what is not a rope."""
_NEAR = 0.15
"""Links of robots within this distance of all else are in the picture [m]."""
_STEEL = 7850.0
"""Density by which weights are drawn [kg/m^3]."""


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """Something that is drawn as one surface."""

    name: str
    color: str
    faces: np.ndarray
    """Triangles, shape (T, 3)."""
    corners: np.ndarray | None
    """Corners in its own frame if it is rigid [m], shape (N, 3)."""
    slots: np.ndarray
    """Vertices of the rope that it is; or the one number of its body, or of the vertex on which it hangs."""
    kind: str
    """"rope", "body" or "weight"."""

    def at(self, frames: Frames, k: int) -> np.ndarray:
        """Return its corners in the world at a frame [m], shape (N, 3)."""
        if self.kind == "rope":
            closed = bool(frames.closed[frames.rope[self.slots[0]]])
            return _tube(_fine(frames.pos[k, self.slots], closed), frames.radius[self.slots[0]], closed)
        pos, turn = self.pose(frames, k)
        return self.corners @ turn.T + pos

    def pose(self, frames: Frames, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return position [m] and rotation matrix of a rigid piece at a frame."""
        slot = int(self.slots[0])
        if self.kind == "weight":
            return frames.pos[k, slot], np.eye(3)
        return frames.body_pos[k, slot], rotations(frames.body_quat[k, slot])


def rotations(quat: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a quaternion (w, x, y, z)."""
    return Rotation.from_quat(np.roll(quat, -1)).as_matrix()


def _fine(line: np.ndarray, closed: bool) -> np.ndarray:
    """Return points on a smooth curve through vertices: three per edge, round the corners of the eye."""
    points = np.concatenate([line, line[:1]]) if closed else line
    s = np.concatenate([[0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
    s += np.arange(len(s)) * 1e-12 * (s[-1] or 1.0)  # vertices that coincide
    at = np.interp(np.arange(3 * (len(points) - 1) + 1) / 3, np.arange(len(points)), s)
    return CubicSpline(s, points, bc_type="periodic" if closed else "not-a-knot" if len(s) > 3 else "natural")(at)


def _tube(x: np.ndarray, radius: np.ndarray, closed: bool) -> np.ndarray:
    """Return the corners of a tube about a fine line: rings, closed by the two points of its ends if it is open."""
    t = np.gradient(x, axis=0)
    if closed:
        t[0] = t[-1] = x[1] - x[-2]
    t /= np.maximum(np.linalg.norm(t, axis=1, keepdims=True), 1e-12)
    normal = np.cross(t[0], np.eye(3)[np.abs(t[0]).argmin()])
    normals = np.empty_like(x)
    for k, tangent in enumerate(t):
        normal = normal - tangent * (normal @ tangent)
        normal = normal / np.linalg.norm(normal)
        normals[k] = normal
    other = np.cross(t, normals)
    angle = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    across = np.cos(angle)[:, None] * normals[:, None] + np.sin(angle)[:, None] * other[:, None]
    rings = (x[:, None] + np.reshape(radius, (-1, 1, 1)) * across).reshape(-1, 3)
    return rings if closed else np.concatenate([rings, x[:1], x[-1:]])


def _strip(count: int, round_: int = _ROUND) -> np.ndarray:
    """Return triangles between `count` rings of corners."""
    i, j = np.meshgrid(np.arange(count - 1) * round_, np.arange(round_), indexing="ij")
    k = (j + 1) % round_
    a, b, c, d = i + j, i + k, i + round_ + j, i + round_ + k
    return np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)], -2).reshape(-1, 3)


def _tube_faces(rings: int, closed: bool) -> np.ndarray:
    faces = _strip(rings)
    if closed:
        return faces
    j = np.arange(_ROUND)
    k, last = (j + 1) % _ROUND, (rings - 1) * _ROUND
    first = np.stack([np.full(_ROUND, rings * _ROUND), k, j], -1)
    end = np.stack([np.full(_ROUND, rings * _ROUND + 1), last + j, last + k], -1)
    return np.concatenate([faces, first, end])


def _revolved(profile: np.ndarray, count: int = 40) -> Surface:
    """Return the surface of a profile (radius, height) that turns about z, from its top down."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    corners = np.concatenate([np.column_stack([r * ring, np.full(count, z)]) for r, z in profile])
    return corners, _strip(len(profile), count)[:, ::-1]


def _arc(start: float, end: float, count: int = 13) -> tuple[np.ndarray, np.ndarray]:
    angle = np.linspace(start, end, count)
    return np.cos(angle), np.sin(angle)


def _box(size: np.ndarray) -> Surface:
    # Each face has its own corners, so that its edges are not shaded round.
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    corners: list[np.ndarray] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for side in (-1, 1):
            face = np.empty((4, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, square[:, 0], square[:, 1]
            start = 4 * len(corners)
            corners.append(face[::side])
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return np.concatenate(corners) * size, np.array(faces)


def _ring(size: np.ndarray) -> Surface:
    big, small, angle = size
    along = np.linspace(-angle / 2, angle / 2, 41)
    line = big * np.stack([np.cos(along), np.sin(along), 0 * along], -1)
    line[:, 0] -= float(shape_sdf.ring_centre(torch.as_tensor(size)))
    # Half balls beyond its ends.
    wide, out = (small * x for x in _arc(0, np.pi / 2, 9))
    ahead = [np.array([-np.sin(a), np.cos(a), 0.0]) for a in along[[0, -1]]]
    before, after = line[0] - out[:0:-1, None] * ahead[0], line[-1] + out[1:, None] * ahead[1]
    radius = np.concatenate([wide[:0:-1], np.full(len(line), small), wide[1:]])
    x = np.concatenate([before, line, after])
    return _tube(x, radius, False), _tube_faces(len(x), False)


def _solid(shape: str, size: np.ndarray, reach: float) -> Surface:
    """Return the surface of a shape of `shapes.SIZES`; planes end at `reach` [m]."""
    a, b, _ = size
    if shape == "plane":
        return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * reach, np.array([[0, 1, 2], [0, 2, 3]])
    if shape == "box":
        return _box(size)
    if shape == "ring":
        return _ring(size)
    if shape in ("sphere", "capsule"):
        half = b if shape == "capsule" else 0.0
        (c, s), (d, u) = _arc(np.pi / 2, 0), _arc(0, -np.pi / 2)
        return _revolved(np.column_stack([np.r_[c, d] * a, np.r_[s * a + half, u * a - half]]))
    if shape == "cylinder":
        # Rims are there twice, so that they are not shaded round.
        return _revolved(np.array([[0, b], [a, b], [a, b], [a, -b], [a, -b], [0, -b]]))
    if shape == "cone":
        return _revolved(np.array([[0, 0.75 * b], [a, -0.25 * b], [a, -0.25 * b], [0, -0.25 * b]]))
    c, s = _arc(np.pi, -np.pi, 33)
    return _revolved(np.column_stack([a + b * c, b * s]))


def bounds(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest corner of what `extent` returns [m]."""
    points = extent(frames)
    return points.min(0), points.max(0)


def extent(frames: Frames) -> np.ndarray:
    """Return points round all that moves, and round bodies not much larger than that [m], shape (N, 3).

    Links of robots count where they are near.
    """
    thin = max(1, frames.material_points.size // 300_000)
    moving = [frames.pos.reshape(-1, 3), frames.material_points.reshape(-1, 3)[::thin]]
    points = np.concatenate(moving)
    span, middle = float(np.linalg.norm(np.ptp(points, axis=0))), 0.5 * (points.min(0) + points.max(0))
    for k, shape in enumerate(frames.body_shape):
        corners, _ = _local(frames, k, 0.0)
        if shape == "plane" or (
            frames.body_motion[k] == "fixed" and np.linalg.norm(np.ptp(corners, axis=0)) > 2 * span
        ):
            continue
        far = np.linalg.norm(frames.body_pos[:, k] - middle, axis=1).min() > 0.5 * span + _NEAR
        if frames.body_motion[k] == "robot" and far:
            continue
        corners = np.stack(np.meshgrid(*zip(corners.min(0), corners.max(0), strict=True)), -1).reshape(-1, 3)
        turns = Rotation.from_quat(np.roll(frames.body_quat[:, k], -1, axis=1)).as_matrix()
        moving.append((corners @ turns.transpose(0, 2, 1) + frames.body_pos[:, k, None]).reshape(-1, 3))
    points = np.concatenate(moving)
    return points[np.isfinite(points).all(1)]


def _local(frames: Frames, k: int, reach: float) -> Surface:
    """Return the surface of a body in its own frame."""
    if frames.body_shape[k] != "mesh":
        return _solid(str(frames.body_shape[k]), frames.body_size[k], reach)
    used, faces = np.unique(frames.mesh_faces[frames.mesh_body == k], return_inverse=True)
    return frames.mesh_vertices[used], faces.reshape(-1, 3)


def points_of(frames: Frames) -> dict[str, np.ndarray]:
    """Return the numbers of the points of matter by their law."""
    return {str(law): np.flatnonzero(frames.constitutive_model == law) for law in np.unique(frames.constitutive_model)}


def pieces(frames: Frames) -> list[DrawnSurface]:
    """Return all surfaces of a run."""
    low, high = bounds(frames)
    reach = 1.5 * float(np.linalg.norm(high - low))
    found = []
    for number, closed in enumerate(frames.closed):
        slots = np.flatnonzero(frames.rope == number)
        color, faces = _ROPES[number % len(_ROPES)], _tube_faces(3 * (len(slots) - (not closed)) + 1, bool(closed))
        found.append(DrawnSurface(f"rope {number}", color, faces, None, slots, "rope"))
    for slot in np.flatnonzero(frames.weight):
        radius = (0.75 * frames.weight[slot] / (np.pi * _STEEL)) ** (1 / 3)
        corners, faces = _solid("sphere", np.array([radius, 0.0, 0.0]), reach)
        found.append(DrawnSurface(f"weight {slot}", COLORS["weight"], faces, corners, np.array([slot]), "weight"))
    arms = _arms(frames)
    for first in arms:
        found += _arm(first)
    drawn = {first + k for first in arms for k in range(len(_panda_shapes()))}
    for k, shape in enumerate(frames.body_shape):
        if k in drawn:
            continue
        corners, faces = _local(frames, k, reach)
        motion = "table" if shape == "plane" else str(frames.body_motion[k])
        found.append(DrawnSurface(f"body {k}", COLORS[motion], faces, corners, np.array([k]), "body"))
    return found


@functools.cache
def _panda_shapes() -> tuple[urdf.CollisionShape, ...]:
    """Return the shapes that stand for the links of the arm that comes with the package."""
    text = resources.files("torchdlo").joinpath("data/robots/panda.urdf").read_text(encoding="utf-8")
    return urdf.read_urdf(text).shapes


def _arms(frames: Frames) -> list[int]:
    """Return the number of the first body of each arm of that kind."""
    said, found, k = _panda_shapes(), [], 0
    size = np.zeros((len(said), 3))
    for row, shape in zip(size, said, strict=True):
        row[: len(shape.size)] = shape.size
    while k + len(said) <= len(frames.body_shape):
        own = slice(k, k + len(said))
        alike = list(frames.body_shape[own]) == [s.kind for s in said] and set(frames.body_motion[own]) == {"robot"}
        if alike and np.allclose(frames.body_size[own], size, atol=1e-5):
            found.append(k)
        k += len(said) if found and found[-1] == k else 1
    return found


def _arm(first: int) -> list[DrawnSurface]:
    """Return how an arm looks, whose links' bodies begin with a number."""
    said, found = _panda_shapes(), []
    for part in panda_surfaces(0.02):
        k = next(k for k, shape in enumerate(said) if shape.link == part.link)
        # Bodies stand in the middles of their shapes.
        back = np.linalg.inv(said[k].origin.numpy())
        corners = part.surface.vertices @ back[:3, :3].T + back[:3, 3]
        color = COLORS["robot" if part.part == "shell" else part.part]
        name = f"body {first + k} {part.part}"
        found.append(DrawnSurface(name, color, part.surface.faces, corners, np.array([first + k]), "body"))
    return found


def spacing(points: np.ndarray) -> float:
    """Return the distance of neighbouring points of matter [m]."""
    some = points[:: max(1, len(points) // 500)]
    return float(np.median(KDTree(points).query(some, k=2)[0][:, 1])) if len(points) > 1 else 0.01
