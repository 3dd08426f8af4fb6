"""Poses of tools and links: a point and an orientation."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.physics import tree
from torchdlo.physics.linalg.rotation import multiply, rotate


@tree.struct
class Pose:
    """Where something is, and how it is turned."""

    pos: Tensor
    """Position [m], shape (..., 3)."""
    quat: Tensor
    """Orientation, unit quaternion (w, x, y, z), its frame to the world [1], shape (..., 4)."""


def compose_poses(outer: Pose, inner: Pose) -> Pose:
    """Return the pose in the world of what has the pose `inner` in the frame of `outer`."""
    quat = outer.quat.expand(*torch.broadcast_shapes(outer.quat.shape, inner.quat.shape))
    return Pose(outer.pos + rotate(outer.quat, inner.pos), multiply(quat, inner.quat.expand_as(quat)))


def relative_pose(outer: Pose, inner: Pose) -> Pose:
    """Return the pose of `inner` as seen from `outer`, both given in the world."""
    back = Pose(torch.zeros_like(outer.pos), conjugate(outer.quat))
    return compose_poses(back, Pose(inner.pos - outer.pos, inner.quat))


def from_matrix(matrix: Tensor) -> Tensor:
    """Return unit quaternions of rotation matrices, shape (..., 3, 3) to (..., 4).

    Each row of the matrix below is a multiple of the quaternion; the one with the largest number on the diagonal is
    taken, so that nothing is divided by a small one (Shepperd 1978, doi:10.2514/3.55767b).
    """
    m = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    a, b, c = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    d, e, f = m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2]
    x, y, z = m[0][0], m[1][1], m[2][2]
    rows = [1 + x + y + z, a, b, c, a, 1 + x - y - z, d, e, b, d, 1 - x + y - z, f, c, e, f, 1 - x - y + z]
    candidates = torch.stack(rows, -1).unflatten(-1, (4, 4))
    best = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    row = torch.take_along_dim(candidates, best[..., None, None], -2).squeeze(-2)
    return row / row.norm(dim=-1, keepdim=True)
