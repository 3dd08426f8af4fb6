"""Signed distances to closed surfaces of triangles.

Distances: only triangles that can be the closest to some point of a block of the grid are tried for it. For the centre
c and the half diagonal r of a block, |d(p) - d(c)| <= r for every point p in it, so that the closest triangle of p is
no farther than d(c) + 2 r from c. Signs: crossings of the surface along lines of the grid, with their orientation.

Closest point of a triangle: Ericson 2005, Real-Time Collision Detection, section 5.1.5.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

LEAF = 4
"""Nodes along each side of a block within which all triangles that are left are tried."""
SHIFTS = (1.4142e-7, 3.1416e-6, 2.7183e-5, 1.6180e-4)
"""How far lines pass beside the nodes, in spacings, so that they miss vertices and edges; the next if one fails."""


def edge_counts(faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the undirected edges of triangles, how many triangles share each, and how their directions balance.

    A surface is closed if every edge has two triangles, and consistently oriented if they run along it in opposite
    directions: count 2, balance 0.

    Args:
        faces: vertex indices, integer, shape (F, 3).
    """
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, at = torch.unique(directed.sort(-1).values, dim=0, return_inverse=True)
    sign = torch.where(directed[:, 0] < directed[:, 1], 1, -1)
    zero = torch.zeros(len(edges), dtype=torch.int64)
    return edges, zero.index_add(0, at, torch.ones_like(sign)), zero.index_add(0, at, sign)


def enclosed_volume(triangles: Tensor) -> float:
    """Return the volume [m^3] that triangles (F, 3, 3) enclose; negative if they are oriented inwards."""
    a, b, c = triangles.unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def triangle_distances(points: Tensor, triangles: Tensor) -> Tensor:
    """Return distances of points (P, 3) from triangles (F, 3, 3) [m], shape (P, F).

    Products of points and triangles are matrix products about the middle of the points, which rounds distances to the
    root of the precision: 1e-8 of the size of the surface.
    """
    middle = points.mean(0)
    p = points - middle
    a, b, c = (triangles - middle).unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = (normal * normal).sum(-1)
    inside = area > 0
    squares: list[Tensor] = []
    own = (p * p).sum(-1, keepdim=True)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, side = end - start, torch.linalg.cross(normal, end - start)
        # Degenerate triangles are the segments that are left of them.
        length = (edge * edge).sum(-1).clamp(min=1e-300)
        along = p @ edge.T - (start * edge).sum(-1)
        share = (along / length).clamp(0, 1)
        squares.append(own - 2 * (p @ start.T) + (start * start).sum(-1) + share * (share * length - 2 * along))
        inside = inside & (p @ side.T >= (start * side).sum(-1))
    height = p @ normal.T - (a * normal).sum(-1)
    nearest = torch.minimum(torch.minimum(squares[0], squares[1]), squares[2])
    return torch.where(inside, height.square() / area.clamp(min=1e-300), nearest.clamp(min=0.0)).sqrt()


def grid_distances(axes: tuple[Tensor, ...], triangles: Tensor) -> Tensor:
    """Return unsigned distances [m] of the nodes of a grid from triangles, shape (X, Y, Z).

    Args:
        axes: coordinates of the nodes along x, y and z [m].
        triangles: corners [m], shape (F, 3, 3).
    """
    out = triangles.new_empty([len(a) for a in axes])
    work = [(tuple((0, len(a)) for a in axes), triangles)]
    while work:
        block, near = work.pop()
        parts = [a[lo:hi] for a, (lo, hi) in zip(axes, block, strict=True)]
        if all(len(part) <= LEAF for part in parts):
            points = torch.cartesian_prod(*parts)
            where = tuple(slice(lo, hi) for lo, hi in block)
            out[where] = triangle_distances(points, near).amin(-1).reshape([len(part) for part in parts])
            continue
        halves = []
        for lo, hi in block:
            middle = (lo + hi + 1) // 2
            halves.append([(lo, hi)] if hi - lo <= LEAF else [(lo, middle), (middle, hi)])
        for child in itertools.product(*halves):
            low = torch.stack([a[lo] for a, (lo, _) in zip(axes, child, strict=True)])
            high = torch.stack([a[hi - 1] for a, (_, hi) in zip(axes, child, strict=True)])
            far = triangle_distances(((low + high) / 2)[None], near)[0]
            work.append((child, near[far <= (far.min() + (high - low).norm()) * (1 + 1e-6)]))
    return out


def _crossings(axes: tuple[Tensor, ...], triangles: Tensor, shift: float) -> Tensor:
    """Return how often lines along x, near the nodes, leave less enter the surface beyond each node, (X, Y, Z)."""
    x, y, z = axes
    step = x[1] - x[0]
    # An edge is looked at from the same end for both of its triangles: a line passes exactly one of them.
    lines = torch.cartesian_prod(y + shift * step, z + 0.7071 * shift * step)
    jumps = torch.zeros(len(lines), len(x) + 1, dtype=torch.int64)
    for chunk in triangles.split(max(1, 4_000_000 // len(lines))):
        corners = chunk[..., 1:]
        left = []
        for i, j in ((0, 1), (1, 2), (2, 0)):
            p, q = corners[:, i], corners[:, j]
            swap = (p[:, 0] > q[:, 0]) | ((p[:, 0] == q[:, 0]) & (p[:, 1] > q[:, 1]))
            p, q = torch.where(swap[:, None], q, p), torch.where(swap[:, None], p, q)
            side = (q[:, 0] - p[:, 0]) * (lines[:, None, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (
                lines[:, None, 0] - p[:, 0]
            )
            left.append((side > 0) ^ swap)
        out, into = left[0] & left[1] & left[2], ~(left[0] | left[1] | left[2])
        line, face = (out | into).nonzero(as_tuple=True)
        a, b, c = chunk[face].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        at = a[:, 0] - ((lines[line] - a[:, 1:]) * normal[:, 1:]).sum(-1) / normal[:, 0]
        before = torch.searchsorted(x, at)  # nodes below the crossing
        jumps.index_put_((line, before), torch.where(out[line, face], 1, -1), accumulate=True)
    beyond = jumps.flip(1).cumsum(1).flip(1)  # [:, k]: of crossings with at least k nodes below
    return beyond.T.reshape(len(x) + 1, len(y), len(z))


def grid_inside(axes: tuple[Tensor, ...], triangles: Tensor) -> Tensor:
    """Return which nodes of a grid lie inside a closed, outwards oriented surface, bool, shape (X, Y, Z).

    Nodes within overlapping parts of a surface count as inside (winding number above zero).
    """
    for shift in SHIFTS:
        beyond = _crossings(axes, triangles, shift)
        # A line that enters a closed surface as often as it leaves it has met no edge end-on.
        if not bool(beyond[0].any()):
            return beyond[1:] > 0
    raise ValueError("mesh: the inside could not be told from the outside; mend self-touching or degenerate triangles")
