"""Signed distances of solids in closed form, their outward normals, volumes and moments of inertia.

Every shape stands in the frame of its body: centre of mass at the origin, principal axes along x, y, z. Distances are
exact (of length 1 in gradient) outside and inside, negative inside. Sizes are tensors, so that they may be learned.

Round shapes are all points within a radius of a core (a point, a segment, a circle, an arc); their normal points away
from the nearest point of the core. Box, cylinder and cone have faces: inside, the nearest face decides, outside the
nearest face, edge or corner. Where the nearest point is not unique, one of them is taken, so that normals always have
length 1 and all derivatives stay finite.

Ericson 2005, Real-Time Collision Detection, chapter 5 (closest points).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import added, dot, safe_norm

SIZES: dict[str, tuple[str, ...]] = {
    "plane": (),
    "sphere": ("radius",),
    "box": ("half length in x", "half length in y", "half length in z"),
    "capsule": ("radius", "half length of the segment"),
    "cylinder": ("radius", "half height"),
    "cone": ("radius of the base", "height"),
    "torus": ("radius of the circle", "radius of the tube"),
    "ring": ("radius of the circle", "radius of the tube", "angle of the arc [rad]"),
    "mesh": ("half length of the grid in x", "half length of the grid in y", "half length of the grid in z"),
}
"""What the numbers of a shape's size are [m]. A plane is the space below z = 0. Capsule, cylinder, cone, torus and ring
have z as their axis; a cone points up; a ring is open, round at its ends, and its arc is centred on +x."""

CONVEX = ("plane", "sphere", "box", "capsule", "cylinder", "cone")
"""Shapes that a straight line enters only once."""


def _unit(vector: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the length of vectors and their direction, a coordinate axis for zero vectors."""
    length = safe_norm(vector)
    other = vector.new_tensor([float(k == axis) for k in range(vector.shape[-1])])
    zero = length == 0
    return length, torch.where(zero, other, vector / torch.where(zero, 1.0, length))


def _sign(x: Tensor) -> Tensor:
    return torch.where(x < 0, -1.0, 1.0).to(x.dtype)


def _faces(beyond: Tensor) -> tuple[Tensor, Tensor]:
    """Return distance and normal of a box from how far a point is beyond its faces, shape (..., N, 2 or 3)."""
    deepest = beyond.amax(-1, keepdim=True)
    nearest = (beyond == deepest).to(beyond.dtype)
    outside, away = _unit(beyond.clamp(min=0.0), 0)
    out = outside > 0
    return torch.where(out, outside, deepest), torch.where(out, away, nearest / dot(nearest, nearest).sqrt())


def _box(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    distance, normal = _faces(p.abs() - size)
    return distance, normal * _sign(p)


def _turned(normal: Tensor, out: Tensor, z: Tensor | float) -> Tensor:
    """Return the normal in space of a profile's normal (radial, axial), shape (..., N, 3)."""
    return torch.cat([normal[..., :1] * out, normal[..., 1:] * z], -1)


def _cylinder(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    across, out = _unit(p[..., :2], 0)
    z = p[..., 2:]
    distance, normal = _faces(torch.cat([across - size[..., :1], z.abs() - size[..., 1:2]], -1))
    return distance, _turned(normal, out, _sign(z))


def _cone(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    radius, height = size[..., :1], size[..., 1:2]
    across, out = _unit(p[..., :2], 0)
    # From the rim of the base: `side` is beyond the gradient, `along` up the gradient, `below` beyond the base.
    gradient = (radius.square() + height.square()).sqrt()
    x, z = across - radius, p[..., 2:] + height / 4
    side, along, below = (x * height + z * radius) / gradient, (z * height - x * radius) / gradient, -z
    to_apex, from_apex = _unit(torch.cat(torch.broadcast_tensors(across, z - height), -1), 1)
    to_rim, from_rim = _unit(torch.cat(torch.broadcast_tensors(x, z), -1), 0)
    slanted = torch.cat([height, radius], -1) / gradient
    down = p.new_tensor([0.0, -1.0])
    outside = torch.maximum(side, below) > 0
    by_side = (side > 0) & (along >= 0)
    at_apex, at_rim = by_side & (along > gradient), outside & ~by_side & (x > 0)
    face = torch.where(outside, by_side, side > below)
    distance = torch.where(at_apex, to_apex, torch.where(at_rim, to_rim, torch.where(face, side, below)))
    normal = torch.where(at_apex, from_apex, torch.where(at_rim, from_rim, torch.where(face, slanted, down)))
    return distance, _turned(normal, out, 1.0)


def _round(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    distance, normal = _unit(p, 2)
    return distance - size[..., :1], normal


def _capsule(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    half, z = size[..., 1:2], p[..., 2:]
    beyond = z - torch.maximum(torch.minimum(z, half), -half)
    distance, normal = _unit(torch.cat([p[..., :2], beyond], -1), 0)
    return distance - size[..., :1], normal


def _torus(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    _, out = _unit(p[..., :2], 0)
    distance, normal = _unit(torch.cat([p[..., :2] - size[..., :1] * out, p[..., 2:]], -1), 2)
    return distance - size[..., 1:2], normal


def _ring_integrals(size: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return volume, and integrals of x, x^2, y^2 and z^2 over a ring about the centre of its circle.

    The tube by its sections, which have the area pi r^2 and the second moment pi r^4 / 4; the ends are half balls with
    their centre of mass 3 r / 8 beyond the end and second moments r^2 / 5 per volume.
    """
    big, r, half = size[..., :1], size[..., 1:2], 0.5 * size[..., 2:3]
    c, s = torch.cos(half), torch.sin(half)
    area, ball = math.pi * r.square(), 4 / 3 * math.pi * r**3
    wide = area * (big**3 + 0.75 * big * r.square())
    volume = 2 * half * big * area + ball
    first = 2 * s * area * (big.square() + 0.25 * r.square()) + ball * (big * c - 0.375 * r * s)
    ends = 0.75 * big * r * s * c
    x2 = wide * (half + s * c) + ball * ((big * c).square() - ends + 0.2 * r.square())
    y2 = wide * (half - s * c) + ball * ((big * s).square() + ends + 0.2 * r.square())
    z2 = half * big * area * 0.5 * r.square() + ball * 0.2 * r.square()
    return volume, first, x2, y2, z2


def ring_centre(size: Tensor) -> Tensor:
    """Return how far in x the centre of mass of a ring is from the centre of its circle [m], shape (..., 1)."""
    volume, first, *_ = _ring_integrals(size)
    return first / volume


def _ring(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    big, half = size[..., :1], 0.5 * size[..., 2:3]
    x, y = p[..., :1] + ring_centre(size), p[..., 1:2]
    flat = torch.cat([x, y], -1)
    c, s = torch.cos(half), torch.sin(half)
    _, out = _unit(flat, 0)
    # Beside the arc, sin(half - angle) > 0; else the nearer end decides.
    beside = s * x - c * y.abs() > 0
    end = torch.cat(torch.broadcast_tensors(c, s * _sign(y)), -1)
    distance, normal = _unit(torch.cat([flat - big * torch.where(beside, out, end), p[..., 2:]], -1), 2)
    return distance - size[..., 1:2], normal


def _plane(size: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    return p[..., 2:], p.new_tensor([0.0, 0.0, 1.0]).expand_as(p)


def _mesh(size: Tensor, p: Tensor, grid: Tensor, cells: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Interpolate a grid of distances trilinearly; beyond the grid, go on from the surface nearest to its border."""
    count = p.new_tensor(cells)
    inside = torch.maximum(torch.minimum(p, size), -size)
    place = (inside / size + 1) * 0.5 * count
    low = torch.minimum(place.detach().floor().clamp(min=0.0), count - 1)
    f = place - low
    # A place that is not a number may be looked up anywhere: its share f makes the answer not a number.
    low = low.nan_to_num().to(torch.int64)
    _, ny, nz = (n + 1 for n in cells)
    first = (low[..., 0] * ny + low[..., 1]) * nz + low[..., 2]
    values = grid[..., 0, :].expand(*first.shape[:-1], grid.shape[-1])

    def at(i: int, j: int, k: int) -> Tensor:
        return torch.gather(values, -1, first + (i * ny + j) * nz + k).unsqueeze(-1)

    x, y, z = f[..., :1], f[..., 1:2], f[..., 2:]
    low_z = [[at(i, j, 0) * (1 - z) + at(i, j, 1) * z for j in (0, 1)] for i in (0, 1)]
    step_z = [[at(i, j, 1) - at(i, j, 0) for j in (0, 1)] for i in (0, 1)]
    low_y = [pair[0] * (1 - y) + pair[1] * y for pair in low_z]
    distance = low_y[0] * (1 - x) + low_y[1] * x
    dx = low_y[1] - low_y[0]
    dy = (low_z[0][1] - low_z[0][0]) * (1 - x) + (low_z[1][1] - low_z[1][0]) * x
    dz = added(w * (pair[0] * (1 - y) + pair[1] * y) for w, pair in zip((1 - x, x), step_z, strict=True))
    _, normal = _unit(torch.cat([dx, dy, dz], -1) * count / size, 2)
    far, away = _unit(p - inside + distance * normal, 2)
    out = (p - inside).abs().amax(-1, keepdim=True) > 0
    return torch.where(out, far, distance), torch.where(out, away, normal)


_PROBES = {
    "plane": _plane,
    "sphere": _round,
    "box": _box,
    "capsule": _capsule,
    "cylinder": _cylinder,
    "cone": _cone,
    "torus": _torus,
    "ring": _ring,
}


def probe(
    shape: str, size: Tensor, points: Tensor, grid: Tensor | None = None, cells: tuple[int, ...] = ()
) -> tuple[Tensor, Tensor]:
    """Return signed distances [m], shape (..., N, 1), and outward normals, shape (..., N, 3), in the body's frame.

    Args:
        shape: a name of `SIZES`.
        size: its size, padded to three numbers, shape (..., 1, 3).
        points: where to measure [m], shape (..., N, 3).
        grid: distances of a mesh at the corners of its cells, z running fastest [m], shape (..., 1, n) where n is the
            product of the numbers of cells plus one.
        cells: numbers of cells in x, y and z.
    """
    if shape == "mesh":
        return _mesh(size, points, tree.part(grid), cells)
    return _PROBES[shape](size, points)


def distance(
    shape: str, size: Tensor, points: Tensor, grid: Tensor | None = None, cells: tuple[int, ...] = ()
) -> Tensor:
    """Return signed distances [m], negative inside, shape (..., N, 1); arguments as in `probe`."""
    return probe(shape, size, points, grid, cells)[0]


def bulk(shape: str, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return volume [m^3], shape (..., 1), and principal moments per mass [m^2], shape (..., 3), of a solid body.

    Args:
        shape: a name of `SIZES`, but "plane" and "mesh", which have none of their own.
        size: its size, padded to three numbers, shape (..., 3).
    """
    a, b = size[..., :1], size[..., 1:2]
    if shape == "sphere":
        volume, x2, y2, z2 = 4 / 3 * math.pi * a**3, *(0.2 * a.square(),) * 3
    elif shape == "box":
        volume, (x2, y2, z2) = 8 * size.prod(-1, keepdim=True), (size.square() / 3).split(1, -1)
    elif shape == "capsule":
        middle, ends = 2 * math.pi * a.square() * b, 4 / 3 * math.pi * a**3
        volume = middle + ends
        x2 = y2 = (0.25 * middle + 0.2 * ends) * a.square() / volume
        z2 = (middle * b.square() / 3 + ends * (b.square() + 0.75 * a * b + 0.2 * a.square())) / volume
    elif shape == "cylinder":
        volume, x2, y2, z2 = 2 * math.pi * a.square() * b, 0.25 * a.square(), 0.25 * a.square(), b.square() / 3
    elif shape == "cone":
        volume, x2, y2, z2 = math.pi / 3 * a.square() * b, 0.15 * a.square(), 0.15 * a.square(), 3 / 80 * b.square()
    elif shape == "torus":
        volume = 2 * math.pi**2 * a * b.square()
        x2 = y2 = 0.5 * a.square() + 0.375 * b.square()
        z2 = 0.25 * b.square()
    elif shape == "ring":
        volume, first, *second = _ring_integrals(size)
        x2, y2, z2 = (q / volume for q in second)
        x2 = x2 - (first / volume).square()
    else:
        raise ValueError(f"shapes: a {shape} has no volume of its own; give mass and inertia")
    return volume, torch.cat([y2 + z2, x2 + z2, x2 + y2], -1)
