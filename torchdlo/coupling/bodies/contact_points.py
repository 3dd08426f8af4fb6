"""Where two bodies touch: balls that stand for one body, in the distance field of the other.

A ball lies within its body and touches its surface from inside, so that contact is never found where there is none.
Against planes, balls of bodies with edges have radius zero and corners are exact. Against all else, edges are rounded
by `ROUND` of the smallest half length: a corner within a face then has the normal of the face, and equal boxes on top
of each other have no ambiguous one. Round bodies are exact. A circle (rim of a cylinder or cone, core of a torus) has
balls at fixed places to stand on and one at its deepest point to roll on; a segment (edge of a box, core of a capsule)
one at its point nearest to the other body.

Rounded points against distance fields: Macklin et al. 2020, doi:10.1145/3384538, section 3.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import Body, PredictedBodyMotion, conjugate
from torchdlo.coupling.bodies.segment_distance import _Line, _nearest
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.tree import cat_vertices, struct

ROUND = 0.04
"""Radius of rounded edges over the smallest half length, against bodies other than planes."""
FEET = 6
"""Fixed balls on a circle."""
ARC = 17
"""Fixed balls along an open ring."""
SPREAD = 0.05
"""How much deeper a point must be than one farther from the others, over how much farther that is."""
FLAT = 0.05
"""Gradient of a circle against a surface below which its rolling ball is drawn to the middle, so that it is
continuous."""
EDGES = tuple(
    (a, b)
    for a, b in itertools.combinations(tuple(itertools.product((-1.0, 1.0), repeat=3)), 2)
    if sum(x != y for x, y in zip(a, b, strict=True)) == 1
)
"""The edges of a cube by their ends."""


@struct
class Touches:
    """Points where pairs of bodies are nearest, C in all: those of the first pair first."""

    normal: Tensor
    """From the second body to the first [1], shape (..., C, 3)."""
    point: Tensor
    """Where they would touch [m], shape (..., C, 3)."""
    gap: Tensor
    """Distance of the surfaces, negative if they overlap [m], shape (..., C, 1)."""


def _rows(*columns: Tensor | float) -> Tensor:
    """Return columns (..., 1) side by side, of one shape."""
    like = next(c for c in columns if isinstance(c, Tensor))
    return torch.cat(
        torch.broadcast_tensors(*(c if isinstance(c, Tensor) else like.new_tensor([c]) for c in columns)), -1
    )


def _on_circle(height: Tensor, radius: Tensor, thick: Tensor, count: int, arc: Tensor | None = None) -> Tensor:
    """Return balls at even distances on a circle about z, or on an arc centred on +x with balls at its ends."""
    if arc is None:
        angle = height.new_tensor([[2 * math.pi * k / count] for k in range(count)])
    else:
        angle = arc * height.new_tensor([[k / (count - 1) - 0.5] for k in range(count)])
    return _rows(radius * torch.cos(angle), radius * torch.sin(angle), height + 0 * angle, thick + 0 * angle)


def fixed_balls(body: Body, size: Tensor, balls: Tensor, edge: Tensor) -> Tensor:
    """Return the fixed balls of a body in its frame: centre and radius [m], shape (..., P, 4).

    Args:
        body: static choices.
        size: its size [m], shape (..., 1, 3).
        balls: balls of a mesh, shape (..., 1, 4 P).
        edge: radius of rounded edges [m], shape (..., 1, 1).
    """
    a, b, zero = size[..., :1], size[..., 1:2], torch.zeros_like(edge)
    if body.shape == "sphere":
        return _rows(zero, zero, zero, a)
    if body.shape == "box":
        corner = size.new_tensor(list(itertools.product((-1.0, 1.0), repeat=3)))
        inner = corner * (size - edge)
        return torch.cat([inner, edge.expand(*inner.shape[:-1], 1)], -1)
    if body.shape == "capsule":
        return torch.cat([_rows(zero, zero, -b, a), _rows(zero, zero, b, a)], -2)
    if body.shape == "cylinder":
        return torch.cat([_on_circle(z, a - edge, edge, FEET) for z in (edge - b, b - edge)], -2)
    if body.shape == "cone":
        # The ball at the apex is as far below it as makes it touch the gradient.
        below = edge * (1 + (b / a).square()).sqrt()
        apex = _rows(zero, zero, 0.75 * b - below, edge)
        return torch.cat([_on_circle(edge - 0.25 * b, a - _slack(a, b) * edge, edge, FEET), apex], -2)
    if body.shape == "torus":
        return _on_circle(zero, a, b, FEET)
    if body.shape == "ring":
        found = _on_circle(zero, a, b, ARC, size[..., 2:3])
        return found - _rows(shape_sdf.ring_centre(size), 0.0, 0.0, 0.0)
    return balls[..., 0, : 4 * body.balls].unflatten(-1, (body.balls, 4))


def _slack(radius: Tensor, height: Tensor) -> Tensor:
    """Return by how many radii a ball that touches base and gradient of a cone is inside the rim, shape (..., 1, 1)."""
    # The corner at the rim has the angle atan2(height, radius); a ball in it is 1 / tan(half of it) from the rim.
    gradient = (radius.square() + height.square()).sqrt()
    return (gradient + radius) / height


def contact_circles(body: Body, size: Tensor, edge: Tensor) -> Tensor:
    """Return circles about z: height, radius, and radius of their balls [m], shape (..., Q, 3); Q may be 0."""
    a, b = size[..., :1], size[..., 1:2]
    if body.shape == "cylinder":
        return torch.cat([_rows(z, a - edge, edge) for z in (edge - b, b - edge)], -2)
    if body.shape == "cone":
        return _rows(edge - 0.25 * b, a - _slack(a, b) * edge, edge)
    if body.shape == "torus":
        return _rows(torch.zeros_like(a), a, b)
    return size[..., :0, :]


def contact_segments(body: Body, size: Tensor, edge: Tensor) -> Tensor:
    """Return segments: start, end, and radius of their balls [m], shape (..., S, 7); S may be 0."""
    a, b, zero = size[..., :1], size[..., 1:2], torch.zeros_like(edge)
    if body.shape == "box":
        start, end = (size.new_tensor([e[k] for e in EDGES]) * (size - edge) for k in (0, 1))
        return torch.cat([start, end, edge.expand(*start.shape[:-1], 1)], -1)
    if body.shape == "capsule":
        return _rows(zero, zero, -b, zero, zero, b, a)
    if body.shape == "cylinder":
        thick = torch.minimum(a, b)
        return _rows(zero, zero, thick - b, zero, zero, b - thick, thick)
    return size.new_zeros(*size.shape[:-2], 0, 7)


def _one_way(motion: PredictedBodyMotion, first: int, second: int) -> list[Tensor]:
    """Return normal, point, gap and rank of balls of one body in the field of another, (..., P, 8), in the world."""
    state, params, bodies = motion.state, motion.params, motion.bodies
    one, other = (slice(k, k + 1) for k in (first, second))
    size, flat = params.size[..., one, :], bodies[second].shape == "plane"
    used = params.size[..., one, : len(shape_sdf.SIZES[bodies[first].shape])]
    if bodies[first].shape == "cone":
        used = used / 2
    edge = (0.0 if flat else ROUND) * used.amin(-1, keepdim=True)
    field = (bodies[second].shape, params.size[..., other, :])
    more = (params.grid[..., other, :], bodies[second].cells)
    quat, back = state.quat[..., one, :], conjugate(state.quat[..., other, :])
    between = state.pos[..., one, :] - state.pos[..., other, :]

    def seen(local: Tensor) -> Tensor:
        return rotate(back, rotate(quat, local) + between)

    fixed = fixed_balls(bodies[first], size, params.balls[..., one, :], edge)
    found = [(seen(fixed[..., :3]), fixed[..., 3:], 0.0)]
    round_ = contact_circles(bodies[first], size, edge)
    if round_.shape[-2]:
        height, radius, thick = round_.split(1, -1)
        middle = _rows(torch.zeros_like(height), torch.zeros_like(height), height)
        _, normal = shape_sdf.probe(*field, seen(middle), *more)
        down = -rotate(conjugate(quat), rotate(state.quat[..., other, :], normal))[..., :2]
        steep = safe_norm(down)
        out = radius * down / torch.maximum(steep, torch.full_like(steep, FLAT))
        found.append((seen(_rows(out[..., :1], out[..., 1:], height + 0 * steep)), thick, 0.0))
    lines = contact_segments(bodies[first], size, edge) if not flat else size[..., :0, :]
    if lines.shape[-2]:
        start = seen(lines[..., :3])
        line = _Line(bodies[second], params.size[..., other, :], more[0], start, seen(lines[..., 3:6]) - start)
        (share,) = _nearest(line, 1)
        # Where an end is as near, it shall come first: flat faces stand on their corners.
        found.append((start + share * line.edge, lines[..., 6:], 0.25))
    out = []
    for local, thick, late in found:
        distance, normal = shape_sdf.probe(*field, local, *more)
        middle = local - 0.5 * (distance + thick) * normal
        gap = distance - thick
        turn = state.quat[..., other, :]
        point = rotate(turn, middle) + state.pos[..., other, :]
        out.append(_rows_of([rotate(turn, normal), point, gap, gap + late * edge]))
    return out


def _rows_of(parts: list[Tensor]) -> Tensor:
    batch = torch.broadcast_shapes(*(p.shape[:-1] for p in parts))
    return torch.cat([p.expand(*batch, p.shape[-1]) for p in parts], -1)


def _ways(bodies: tuple[Body, ...], pair: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Return whose balls are looked at in whose field."""
    a, b = pair
    if bodies[b].shape == "plane" or bodies[a].shape == "sphere":
        return ((a, b),)
    if bodies[a].shape == "plane" or bodies[b].shape == "sphere":
        return ((b, a),)
    return ((a, b), (b, a))


def _spread(rows: Tensor, count: int) -> Tensor:
    """Return which points are used, the deepest first, then deep ones far from those before, shape (..., count).

    Without the distance, many points of a flat face that are equally deep would leave it on a random corner of itself.
    """
    point, rank = rows[..., 3:6], rows[..., 7]
    chosen, far = [], torch.zeros_like(rank)
    for k in range(count):
        best = (rank - SPREAD * far).argmin(-1, keepdim=True)
        chosen.append(best)
        there = torch.gather(point, -2, best.unsqueeze(-1).expand(*best.shape, 3))
        away = (point - there).norm(dim=-1)
        far = away if k == 0 else torch.minimum(far, away)
        rank = rank.scatter(-1, best, torch.inf)
    return torch.cat(chosen, -1)


def deepest_points(
    motion: PredictedBodyMotion, pairs: tuple[tuple[int, int], ...], most: int
) -> tuple[Touches, tuple[int, ...]]:
    """Return the deepest points of pairs of bodies, and how many each pair has.

    Args:
        motion: the bodies.
        pairs: which of them may touch.
        most: points per pair, if it has that many.
    """
    every, counts = [], []
    for pair in pairs:
        rows = []
        for first, second in _ways(motion.bodies, pair):
            sign = motion.state.pos.new_tensor([1.0 if first == pair[0] else -1.0] * 3 + [1.0] * 5)
            rows += [sign * row for row in _one_way(motion, first, second)]
        batch = torch.broadcast_shapes(*(r.shape[:-2] for r in rows))
        points = torch.cat([r.expand(*batch, *r.shape[-2:]) for r in rows], -2)
        if points.shape[-2] > most:
            nearest = _spread(points.detach(), most)
            points = torch.gather(points, -2, nearest.unsqueeze(-1).expand(*nearest.shape, points.shape[-1]))
        every.append(points)
        counts.append(points.shape[-2])
    batch = torch.broadcast_shapes(*(r.shape[:-2] for r in every))
    whole = cat_vertices([r.expand(*batch, *r.shape[-2:]) for r in every])
    return Touches(whole[..., :3], whole[..., 3:6], whole[..., 6:7]), tuple(counts)
