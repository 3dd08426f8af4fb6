"""Measures of curves and points that rewards and conditions of success are made of; all in batches.

Rewards are made of those that are differentiable: distances, `chamfer`, `winding` and `crossing_number`. The others
count, and say so. A curve is a polyline of vertices (..., V, 3).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdlo.physics.linalg.numerics import cross, dot, safe_norm

CORE = 0.02
"""Distance below which `crossing_number` stops growing [m]."""


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Return the distances of points (..., N, d) to points (..., M, d) [m], shape (..., N, M)."""
    return safe_norm(a.unsqueeze(-2) - b.unsqueeze(-3)).squeeze(-1)


def nearest(a: Tensor, b: Tensor) -> Tensor:
    """Return the distance of each point (..., N, d) to the nearest of the points (..., M, d) [m], shape (..., N)."""
    return distances(a, b).amin(-1)


def chamfer(a: Tensor, b: Tensor) -> Tensor:
    """Return the sum of the mean nearest distances from either side [m], shape (...)."""
    apart = distances(a, b)
    return apart.amin(-1).mean(-1) + apart.amin(-2).mean(-1)


def length(x: Tensor) -> Tensor:
    """Return the lengths of polylines [m], shape (...)."""
    return safe_norm(x[..., 1:, :] - x[..., :-1, :]).sum((-1, -2))


def turning_angles(x: Tensor, centre: Tensor) -> Tensor:
    """Return the angles by which edges turn about a vertical axis [rad], shape (..., V - 1).

    Args:
        x: a polyline, shape (..., V, 3); a loop has its first vertex at its end once more.
        centre: where the axis is [m], shape (..., 2).
    """
    arm = x[..., :2] - centre.unsqueeze(-2)
    a, b = arm[..., :-1, :], arm[..., 1:, :]
    return torch.atan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1))


def winding(x: Tensor, centre: Tensor) -> Tensor:
    """Return how often closed curves (..., V, 3) wind about a vertical axis at `centre` (..., 2) [1], shape (...)."""
    loop = torch.cat([x, x[..., :1, :]], -2)
    return turning_angles(loop, centre).sum(-1) / (2 * math.pi)


def _apart(x: Tensor, least: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return edges (..., E, 3), differences of their middles (..., E, E, 3), and which are that far apart (E, E)."""
    edge, middle = x[..., 1:, :] - x[..., :-1, :], 0.5 * (x[..., 1:, :] + x[..., :-1, :])
    index = torch.arange(edge.shape[-2], device=x.device)
    far = (index[:, None] - index[None, :]).abs() >= least
    return edge, middle.unsqueeze(-2) - middle.unsqueeze(-3), far


def crossing_number(x: Tensor) -> Tensor:
    """Return the average crossing number of open curves over all views [1], shape (...).

    Freedman and He 1991, doi:10.2307/2944326: the Gauss integral with its integrand's absolute value, here one
    midpoint per pair of edges that are not neighbours, each pair counted twice, and cut off at `CORE`.
    """
    edge, r, far = _apart(x, 2)
    volume = dot(r, cross(edge.unsqueeze(-2), edge.unsqueeze(-3))).squeeze(-1).abs()
    integrand = volume / (dot(r, r).squeeze(-1) + CORE**2) ** 1.5
    return (integrand * far).sum((-1, -2)) / (4 * math.pi)


def crowding_penalty(x: Tensor, reach: float) -> Tensor:
    """Return the sum of max(0, reach - r)^2 over ordered pairs of edges that are not neighbours [m^2], shape (...)."""
    _, r, far = _apart(x, 2)
    return ((reach - safe_norm(r).squeeze(-1)).clamp(min=0).square() * far).sum((-1, -2))


def _meetings(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return which edges of a (..., E + 1, 3) cross which of b (..., F + 1, 3) in the top view, and where on both."""
    p, q = a[..., :-1, None, :2], b[..., None, :-1, :2]
    d, e = a[..., 1:, None, :2] - p, b[..., None, 1:, :2] - q

    def area(u: Tensor, v: Tensor) -> Tensor:
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    whole = area(d, e)
    skew = whole != 0
    whole = torch.where(skew, whole, 1.0)
    s, t = area(q - p, e) / whole, area(q - p, d) / whole
    return skew & (s >= 0) & (s < 1) & (t >= 0) & (t < 1), s, t


def pierced_edges(x: Tensor, centre: Tensor, normal: Tensor, radius: float) -> Tensor:
    """Return which edges of polylines (..., V, 3) pass through a disc, either way, bool, shape (..., V - 1).

    Args:
        x: polylines.
        centre: the disc's centre [m], shape (3,).
        normal: unit vector normal to it, shape (3,).
        radius: its radius [m].
    """
    arm = x - centre
    height = (arm * normal).sum(-1)
    before, after = height[..., :-1], height[..., 1:]
    through = (before < 0) != (after < 0)
    share = before / torch.where(through, before - after, 1.0)
    place = torch.lerp(arm[..., :-1, :], arm[..., 1:, :], share.unsqueeze(-1))
    return through & (place.norm(dim=-1) <= radius)


def crossings(a: Tensor, b: Tensor | None = None) -> Tensor:
    """Return how often two curves, or a curve and itself, cross in the top view [1], shape (...)."""
    found, _, _ = _meetings(a, a if b is None else b)
    if b is None:
        found = found & _apart(a, 2)[2]
    return found.sum((-1, -2)) // (2 if b is None else 1)


def crossing_places(x: Tensor, other: Tensor | None = None) -> Tensor:
    """Return where a single curve (V, 3) crosses itself or another one in the top view, in vertices from its start."""
    found, s, _ = _meetings(x, x if other is None else other)
    i, j = (found & _apart(x, 2)[2] if other is None else found).nonzero(as_tuple=True)
    return (i + s[i, j]).sort().values


def knot_determinant(x: Tensor) -> Tensor:
    """Return the determinants of the knots that open curves make, 1 for the trivial one [1], shape (B,).

    It is the Alexander polynomial's magnitude at -1 (Alexander 1928, doi:10.1090/S0002-9947-1928-1501429-1): of all
    crossings of the top view, 2 over - before - after for the strands over, and before and after under, with one row
    and one column left out. The ends are carried upwards to infinity, where they meet: in the top view a line leads
    from end to end, above all others.

    Args:
        x: curves, shape (B, V, 3).
    """
    loop = torch.cat([x, x[:, :1]], -2)
    meet, s, t = _meetings(loop, loop)
    count = loop.shape[-2] - 1
    index = torch.arange(count, device=x.device)
    gap = (index[:, None] - index[None, :]).abs()
    meet = meet & (gap >= 2) & (gap != count - 1)
    height, rise = loop[:, :-1, 2], loop[:, 1:, 2] - loop[:, :-1, 2]
    first = height[:, :, None] + s * rise[:, :, None]
    second = height[:, None, :] + t * rise[:, None, :]
    lid = x[..., 2].amax(-1) - x[..., 2].amin(-1) + 1.0
    above = (index == count - 1).to(x.dtype) * lid[:, None]
    under = meet & (first + above[:, :, None] < second + above[:, None, :])
    # One row per place where the curve is under itself, in its own order: between two of them lies a strand.
    scene, i, j = under.nonzero(as_tuple=True)
    place = i + s[scene, i, j]
    over = j + t[scene, i, j]
    order = torch.argsort(place + scene * (count + 1))
    scene, place, over = scene[order], place[order], over[order]
    many = torch.bincount(scene, minlength=len(x))
    most = int(many.max()) if len(scene) else 0
    before = torch.arange(len(scene), device=x.device) - (many.cumsum(0) - many)[scene]
    earlier = (scene[:, None] == scene[None, :]) & (place[None, :] < over[:, None])
    strand = earlier.sum(-1) % many[scene]
    matrix = torch.zeros(len(x), most, most, dtype=torch.float64, device=x.device)
    after = (before + 1) % many[scene]
    for column, value in ((strand, 2.0), (before, -1.0), (after, -1.0)):
        matrix.index_put_((scene, before, column), matrix.new_tensor(value), accumulate=True)
    # Left out: the first row and column; rows that a scene does not have are those of the identity.
    spare = torch.arange(most, device=x.device)[None, :] >= many[:, None]
    matrix = matrix + torch.diag_embed(spare.to(matrix.dtype))
    return torch.linalg.det(matrix[:, 1:, 1:]).abs().round() if most > 1 else matrix.new_ones(len(x))
