"""Quaternions (w, x, y, z), rotation of vectors, and parallel transport.

Parallel transport along an edge: Bergou et al. 2008, doi:10.1145/1360612.1360662, section 3.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.physics.linalg.numerics import cross, dot, normalize, safe_norm


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product of quaternions, shape (..., 4)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return torch.cat([aw * bw - dot(av, bv), aw * bv + bw * av + cross(av, bv)], -1)


def rotate(quat: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors, shape (..., 3), by unit quaternions, shape (..., 4)."""
    w, v = quat[..., :1], quat[..., 1:]
    t = 2 * cross(v, vector)
    return vector + w * t + cross(v, t)


def about(axis: Tensor, angle: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors about unit axes, shapes (..., 3), by angles [rad], shape (..., 1) (Rodrigues)."""
    c, s = torch.cos(angle), torch.sin(angle)
    return vector * c + cross(axis, vector) * s + axis * dot(axis, vector) * (1 - c)


def transport(vector: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Carry vectors by the smallest rotation that turns unit tangents `start` into `end`, shapes (..., 3).

    Undefined for opposite tangents; there it returns a finite vector.
    """
    axis = cross(start, end)
    # R v = v + a x v + a x (a x v) / (1 + start.end) for the rotation with a = start x end.
    once = cross(axis, vector)
    return vector + once + cross(axis, once) / (1 + dot(start, end)).clamp(min=1e-6)


def signed_angle(start: Tensor, end: Tensor, axis: Tensor) -> Tensor:
    """Return the angle [rad] in (-pi, pi] from `start` to `end` about unit `axis`, shape (..., 1)."""
    return torch.atan2(dot(cross(start, end), axis), dot(start, end))


def turn_towards(start: Tensor, end: Tensor, share: Tensor) -> Tensor:
    """Turn unit vectors by a share of the angle to `end`, shapes (..., 3); undefined for opposite ones."""
    angle = torch.atan2(safe_norm(cross(start, end)), dot(start, end))
    small = angle < 1e-4
    sine = torch.where(small, 1.0, angle).sin()
    before = torch.where(small, 1 - share, torch.sin((1 - share) * angle) / sine)
    after = torch.where(small, share, torch.sin(share * angle) / sine)
    return before * start + after * end


def any_normal(tangent: Tensor) -> Tensor:
    """Return a unit vector normal to each unit tangent, shape (..., 3), from the axis least aligned with it."""
    least = tangent.abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(tangent).scatter(-1, least, 1.0)
    return normalize(axis - tangent * dot(axis, tangent))
