"""Surfaces of solids as triangles with normals, for pictures: shapes in closed form, grids of distances, blended links.

Triangles turn anticlockwise as seen from outside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["Surface", "blended_isosurface", "isosurface", "joined", "moved", "plate", "smoothed", "solid", "strip"]


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with smooth normals, in a frame of their own."""

    vertices: np.ndarray
    """Corners [m], shape (N, 3)."""
    normals: np.ndarray
    """Outward normals at the corners [1], shape (N, 3)."""
    faces: np.ndarray
    """Corners of triangles, whole, shape (T, 3)."""


def strip(rings: int, around: int) -> np.ndarray:
    """Return triangles between rings of corners, each of which closes on itself; shape (T, 3)."""
    i, j = np.meshgrid(np.arange(rings - 1) * around, np.arange(around), indexing="ij")
    k = (j + 1) % around
    a, b, c, d = i + j, i + k, i + around + j, i + around + k
    return np.stack([np.stack([a, b, c], -1), np.stack([b, d, c], -1)], -2).reshape(-1, 3)


def _revolved(profile: np.ndarray, gradients: np.ndarray, around: int) -> Surface:
    """Return the surface of a profile (radius, height) with normals (radial, axial) about z, from its top down."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)

    def turned(rows: np.ndarray) -> np.ndarray:
        return np.concatenate([np.column_stack([r * ring, np.full(around, z)]) for r, z in rows])

    return Surface(turned(profile), turned(gradients), strip(len(profile), around)[:, ::-1])


def _ball(radius: float, half: float, around: int) -> Surface:
    angle = np.linspace(np.pi / 2, 0, max(4, around // 4) + 1)
    upper, lower = np.column_stack([np.cos(angle), np.sin(angle)]), np.column_stack([np.cos(angle), -np.sin(angle)])
    gradients = np.concatenate([upper, lower[::-1][0 if half else 1 :]])
    shift = np.repeat([half, -half], [len(upper), len(gradients) - len(upper)])
    return _revolved(radius * gradients + np.column_stack([0 * shift, shift]), gradients, around)


def _tapered(rims: np.ndarray, around: int) -> Surface:
    """Return the surface of a profile of straight lines with sharp rims, shape (n, 2)."""
    way = np.diff(rims, axis=0)
    across = np.column_stack([-way[:, 1], way[:, 0]])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return _revolved(np.repeat(rims, 2, 0)[1:-1], np.repeat(across, 2, 0), around)


def _bent(radius: float, thick: float, start: float, end: float, centre: float, around: int) -> Surface:
    """Return an arc of a torus about z; round at its ends if it is open."""
    closed = end - start > 2 * np.pi - 1e-6
    count, side = 2 * around, max(8, around // 2)
    along = np.linspace(start, end, count + 1)
    out = np.stack([np.cos(along), np.sin(along), 0 * along], -1)
    ahead = np.stack([-np.sin(along), np.cos(along), 0 * along], -1)
    middle, wide, tilt = radius * out - [centre, 0, 0], np.ones(count + 1), np.zeros(count + 1)
    if not closed:
        # Half balls beyond its ends.
        s, c = np.sin(np.linspace(0.05, np.pi / 2, 5)), np.cos(np.linspace(0.05, np.pi / 2, 5))
        middle = np.concatenate(
            [middle[0] - thick * c[:, None] * ahead[0], middle, (middle[-1] + thick * c[:, None] * ahead[-1])[::-1]]
        )
        wide, tilt = np.concatenate([s, wide, s[::-1]]), np.concatenate([-c, tilt, c[::-1]])
        out = np.concatenate([out[:1].repeat(5, 0), out, out[-1:].repeat(5, 0)])
        ahead = np.concatenate([ahead[:1].repeat(5, 0), ahead, ahead[-1:].repeat(5, 0)])
    angle = np.linspace(0, 2 * np.pi, side, endpoint=False)
    round_ = np.cos(angle)[:, None] * out[:, None] + np.sin(angle)[:, None] * np.array([0, 0, 1.0])
    normals = wide[:, None, None] * round_ + tilt[:, None, None] * ahead[:, None]
    corners = middle[:, None] + thick * wide[:, None, None] * round_
    return Surface(corners.reshape(-1, 3), normals.reshape(-1, 3), strip(len(middle), side)[:, ::-1])


def _box(half: np.ndarray) -> Surface:
    # Each face has its own corners, so that its edges are not shaded round.
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    corners: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for side in (-1, 1):
            face = np.empty((4, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, square[:, 0], square[:, 1]
            start = 4 * len(corners)
            corners.append(face[::side])
            normals.append(np.tile(side * np.eye(3)[axis], (4, 1)))
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return Surface(np.concatenate(corners) * half, np.concatenate(normals), np.array(faces))


def plate(low: tuple[float, float], high: tuple[float, float], top: float, thick: float) -> Surface:
    """Return a plate with edges along x and y, as a table top is [m]."""
    half = 0.5 * np.array([high[0] - low[0], high[1] - low[1], thick])
    middle = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), top - 0.5 * thick])
    box = _box(half)
    return Surface(box.vertices + middle, box.normals, box.faces)


def solid(shape: str, size: np.ndarray, around: int = 40) -> Surface:
    """Return the surface of a shape of `coupling.bodies.shape_sdf.SIZES`, but for "plane" and "mesh".

    Args:
        shape: its name.
        size: its size, see there [m or rad], shape (3,).
        around: corners round it.
    """
    a, b, c = (float(x) for x in size)
    if shape == "box":
        return _box(np.array([a, b, c]))
    if shape in ("sphere", "capsule"):
        return _ball(a, b if shape == "capsule" else 0.0, around)
    if shape == "cylinder":
        return _tapered(np.array([[0, b], [a, b], [a, -b], [0, -b]]), around)
    if shape == "cone":
        # The centre of mass is a quarter of the height above the base.
        return _tapered(np.array([[0, 0.75 * b], [a, -0.25 * b], [0, -0.25 * b]]), around)
    if shape == "torus":
        return _bent(a, b, 0.0, 2 * np.pi, 0.0, around)
    if shape == "ring":
        import torch

        from torchdlo.coupling.bodies import shape_sdf

        centre = float(shape_sdf.ring_centre(torch.tensor([a, b, c], dtype=torch.float64)))
        return _bent(a, b, -c / 2, c / 2, centre, around)
    raise ValueError(f"surface: there is no closed form of {shape!r}")


def smoothed(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """Return triangles with normals that are means of those round each corner, by their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across, normals = np.cross(b - a, c - a), np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    return Surface(vertices, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30), faces)


def isosurface(values: np.ndarray, low: np.ndarray, spacing: np.ndarray) -> Surface:
    """Return where a function on a grid is zero, by surface nets (Gibson 1998, doi:10.1007/BFb0056277).

    Args:
        values: at the nodes, negative inside, positive on the outermost nodes; shape (X, Y, Z).
        low: place of the first node [m], shape (3,).
        spacing: distances of nodes [m], shape (3,).
    """
    inside = values < 0
    shape = np.array(values.shape) - 1
    total, count = np.zeros((*shape, 3)), np.zeros(shape)
    corner = [np.array([k >> 2 & 1, k >> 1 & 1, k & 1]) for k in range(8)]

    def at(grid: np.ndarray, o: np.ndarray) -> np.ndarray:
        return grid[o[0] : o[0] + shape[0], o[1] : o[1] + shape[1], o[2] : o[2] + shape[2]]

    for first in corner:
        for axis in range(3):
            if first[axis]:
                continue
            other = first + np.eye(3, dtype=int)[axis]
            cross = at(inside, first) != at(inside, other)
            u, v = at(values, first), at(values, other)
            share = np.where(cross, u / np.where(u == v, 1, u - v), 0)
            total += cross[..., None] * (first + share[..., None] * np.eye(3)[axis])
            count += cross
    used = count > 0
    number = np.full(tuple(shape), -1)
    number[used] = np.arange(used.sum())
    vertices = low + spacing * (np.argwhere(used) + total[used] / count[used][:, None])
    faces = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        ahead = np.moveaxis(inside, axis, 0)
        first, second = np.moveaxis(ahead[:-1], 0, axis), np.moveaxis(ahead[1:], 0, axis)
        for enters, order in ((second & ~first, (0, 3, 2, 1)), (first & ~second, (0, 1, 2, 3))):
            where = np.argwhere(enters)
            where = where[(where[:, i] > 0) & (where[:, j] > 0)]
            around = []
            for a, b in ((1, 1), (0, 1), (0, 0), (1, 0)):
                cell = where.copy()
                cell[:, i] -= a
                cell[:, j] -= b
                around.append(number[tuple(cell.T)])
            quad = np.stack(around, -1)[:, order]
            faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return smoothed(vertices, np.concatenate(faces).reshape(-1, 3))


def blended_isosurface(
    distance: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, spacing: float
) -> Surface:
    """Return where a smooth function is zero, with corners and normals that are exact even where the grid is coarse.

    Args:
        distance: values at points [m], shapes (n, 3) to (n,); about distances, negative inside.
        low: least coordinates of what is inside [m], shape (3,).
        high: greatest ones [m], shape (3,).
        spacing: of the grid [m].
    """
    low = np.asarray(low, float) - 1.51 * spacing
    counts = np.ceil((np.asarray(high, float) + 1.51 * spacing - low) / spacing).astype(int) + 1
    nodes = low + spacing * np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1)
    made = isosurface(distance(nodes.reshape(-1, 3)).reshape(counts), low, np.full(3, spacing))
    x, tiny = made.vertices, 1e-5 * np.eye(3)
    for k in range(4):
        gradient = np.stack([distance(x + d) - distance(x - d) for d in tiny], -1) / 2e-5
        size = np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 0.2)
        if k < 3:
            step = distance(x)[:, None] * gradient / size**2
            x = x - np.clip(step, -spacing, spacing)
    return Surface(x, gradient / size, made.faces)


def moved(surface: Surface, turn: np.ndarray, shift: np.ndarray) -> Surface:
    """Return a surface turned by a rotation matrix and then shifted [m]."""
    return Surface(surface.vertices @ turn.T + shift, surface.normals @ turn.T, surface.faces)


def joined(parts: list[Surface]) -> Surface:
    """Return several surfaces as one."""
    starts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Surface(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.faces + s for p, s in zip(parts, starts, strict=True)]),
    )
