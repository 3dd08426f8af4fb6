"""Rotation of rigid bodies without torque, and how it follows the angular velocity that it begins with.

A body turns by five turns about its principal axes one after the other, x y z y x, each exact: second order,
symplectic, and of exactly constant angular momentum (Dullweber, Leimkuhler, McLachlan 1997, doi:10.1063/1.474310).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.physics.linalg.vector_components import axes, local, world

_TURNS = ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5))
"""Axes, and which share of the time is spent on them."""


def spin_freely(quat: Tensor, inertia: Tensor, omega: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Return orientations and angular velocities after a time without torque, shape (..., K, 4) and (..., K, 3).

    Dullweber et al. 1997, eq. 3.6: in the frame of the body, the angular momentum p turns about axis i by -t p_i / I_i
    while the body turns by the opposite.
    """
    moments = inertia.split(1, -1)
    p = [m * o for m, o in zip(moments, local(axes(quat), omega.split(1, -1)), strict=True)]
    q = list(quat.split(1, -1))
    for axis, share in _TURNS:
        angle = share * dt * p[axis] / moments[axis]
        j, k = (axis + 1) % 3, (axis + 2) % 3
        c, s = torch.cos(angle), torch.sin(angle)
        p[j], p[k] = c * p[j] + s * p[k], c * p[k] - s * p[j]
        # The product with the quaternion of a turn about that axis.
        c, s = torch.cos(0.5 * angle), torch.sin(0.5 * angle)
        w, own, one, two = q[0], q[1 + axis], q[1 + j], q[1 + k]
        q[0], q[1 + axis], q[1 + j], q[1 + k] = w * c - own * s, own * c + w * s, one * c + two * s, two * c - one * s
    quat = torch.cat(q, -1)
    quat = quat / quat.square().sum(-1, keepdim=True).sqrt()  # rounding only
    return quat, torch.cat(world(axes(quat), [a / m for a, m in zip(p, moments, strict=True)]), -1)


def matrix(quat: Tensor) -> Tensor:
    """Return the rotation matrices of quaternions (..., 4), shape (..., 3, 3)."""
    w, v = quat[..., :1, None], quat[..., 1:]
    unit = torch.eye(3, dtype=quat.dtype, device=quat.device)
    shape = (1 - 2 * v.square().sum(-1)[..., None, None]) * unit
    return shape + 2 * (v.unsqueeze(-1) * v.unsqueeze(-2) + w * skew(v))


def skew(r: Tensor) -> Tensor:
    """Return the matrices of the vector product r x, shape (..., 3, 3)."""
    x, y, z = r.unbind(-1)
    none = torch.zeros_like(x)
    return torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))


def spin_gradient(quat: Tensor, inertia: Tensor, omega: Tensor, dt: float, end: Tensor) -> Tensor:
    """Return how `end`, the orientation after `spin_freely`, turns with `omega` [s], both in the world, (..., 3, 3)."""
    moments = inertia.split(1, -1)
    inward = matrix(quat).mT
    momentum = inertia * (inward @ omega.unsqueeze(-1)).squeeze(-1)
    p = list(momentum.split(1, -1))
    # Rows of the derivatives of p, and of the turn in the frame of the body, by the angular velocity in the world.
    change = [m * row for m, row in zip(moments, inward.unbind(-2), strict=True)]
    turn = [torch.zeros_like(row) for row in change]
    for axis, share in _TURNS:
        angle, more = share * dt * p[axis] / moments[axis], share * dt * change[axis] / moments[axis]
        j, k = (axis + 1) % 3, (axis + 2) % 3
        c, s = torch.cos(angle), torch.sin(angle)
        p[j], p[k] = c * p[j] + s * p[k], c * p[k] - s * p[j]
        change[j], change[k] = c * change[j] + s * change[k] + p[k] * more, c * change[k] - s * change[j] - p[j] * more
        turn[j], turn[k] = c * turn[j] + s * turn[k], c * turn[k] - s * turn[j]
        turn[axis] = turn[axis] + more
    return matrix(end) @ torch.stack(turn, -2)
