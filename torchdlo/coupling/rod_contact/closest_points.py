"""Closest points of two straight segments, with derivatives that stay finite for parallel and for empty segments.

The squared distance |a(s) - b(t)|^2 is a convex quadratic of (s, t) on the unit square (Ericson 2005, Real-Time
Collision Detection, section 5.1.9), flat along a line when the segments are parallel. A weak pull of s and t to the
middle, `PULL` times the squared length, makes the minimum unique and its derivative bounded. It moves the points by
about PULL / sin^2(angle) of a length and so changes the distance d by less than PULL length^2 / (4 d), also when
parallel: 0.1 % of the diameter for edges twice as long as thick.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.physics.linalg.numerics import dot, tiny

PULL = 1e-3
"""Strength of the pull to the middle over the squared length."""


def closest_points(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return where the closest points of two segments lie, as shares of them, each of shape (..., 1).

    Args:
        a: ends of one segment [m], shape (..., 3) each.
        b: ends of the other.
    """
    u, v, w = a[1] - a[0], b[1] - b[0], a[0] - b[0]
    uu, vv, uv, uw, vw = dot(u, u), dot(v, v), dot(u, v), dot(u, w), dot(v, w)
    pull = 0.5 * PULL * (uu + vv) + tiny(uu) ** 2
    along, across = uu + pull, vv + pull
    first, second = 0.5 * pull - uw, 0.5 * pull + vw
    determinant = along * across - uv * uv
    s = ((first * across + uv * second) / determinant.clamp(min=torch.finfo(uu.dtype).tiny)).clamp(0.0, 1.0)
    # On the border of the square the other share is solved for again; two steps reach the minimum.
    t = ((second + uv * s) / across).clamp(0.0, 1.0)
    s = ((first + uv * t) / along).clamp(0.0, 1.0)
    return s, t
