"""Bodies of tasks that no closed form of `bodies.shape_sdf` describes: unions of such forms, sampled on a grid."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import BodyState, conjugate
from torchdlo.coupling.bodies.mesh_sdf import MeshShape
from torchdlo.coupling.common.pose import from_matrix
from torchdlo.physics.linalg.rotation import multiply, rotate

__all__ = ["RING", "TUBE", "c_ring", "origin", "pebble", "union"]

RING, TUBE = 0.045, 0.012
"""Radius of a C-ring's circle and of its tube [m]."""
GAP = math.radians(90)
"""Angle that is missing from its circle."""
FOOT = (0.02, 0.03, 0.004)
"""Half lengths of the foot on which it stands [m]."""
HEIGHT = 0.06
"""Height of its centre above the floor on which it stands [m]."""
LUMPS = (
    (0.0, 0.0, 0.0, 0.03),
    (0.026, 0.008, -0.004, 0.024),
    (-0.02, 0.014, -0.002, 0.026),
    (0.002, -0.018, 0.006, 0.024),
)
"""Balls that a pebble is made of: centres and radii [m]."""


def union(
    distance: Callable[[Tensor], Tensor], low: tuple[float, ...], high: tuple[float, ...], balls: Tensor
) -> MeshShape:
    """Return a body from its signed distance, with its mass, principal axes and moments found by counting cells.

    Args:
        distance: signed distances [m] of points, shapes (n, 3) to (n, 1).
        low: least coordinates of the body [m].
        high: greatest ones [m].
        balls: balls within that touch its surface, centre and radius [m], shape (P, 4).
    """
    x, cell = _lattice(low, high, 1.5e-3)
    inside = x[distance(x)[:, 0] < 0]
    volume = torch.tensor([len(inside) * cell], dtype=torch.float64)
    centre = inside.mean(0)
    arm = inside - centre
    tensor = torch.diag(arm.square().sum(-1).mean().expand(3)) - arm.T @ arm / len(arm)
    moments, axes = torch.linalg.eigh(tensor)
    axes = axes * torch.linalg.det(axes).sign()
    reach = 0.5 * sum((h - a) ** 2 for a, h in zip(low, high, strict=True)) ** 0.5
    spread = (inside - centre) @ axes
    half = torch.maximum(spread.abs().amax(0) + 0.012, torch.tensor(0.2 * reach, dtype=torch.float64))
    cells = [2 * math.ceil(float(h) / 4e-3) for h in half]
    half = half.new_tensor([0.5 * n * 4e-3 for n in cells])
    corners = _corners(half, cells)
    grid = distance(corners @ axes.T + centre).reshape([n + 1 for n in cells])
    placed = torch.cat([(balls[:, :3] - centre) @ axes, balls[:, 3:]], -1)
    none = torch.zeros(0, 3, dtype=torch.float64)
    return MeshShape(grid, half, placed, volume, moments, centre, from_matrix(axes), none, none.long())


def _lattice(low: tuple[float, ...], high: tuple[float, ...], spacing: float) -> tuple[Tensor, float]:
    """Return the middles of about cubic cells (n, 3), and the volume of one."""
    axes, cell = [], 1.0
    for a, b in zip(low, high, strict=True):
        count = math.ceil((b - a) / spacing)
        axes.append(a + (b - a) / count * (torch.arange(count, dtype=torch.float64) + 0.5))
        cell *= (b - a) / count
    return torch.cartesian_prod(*axes), cell


def _corners(half: Tensor, cells: list[int]) -> Tensor:
    axes = [torch.linspace(-float(h), float(h), n + 1, dtype=torch.float64) for h, n in zip(half, cells, strict=True)]
    return torch.cartesian_prod(*axes)


def origin(shape: MeshShape, bodies: BodyState, k: int) -> Tensor:
    """Return where the origin of a shape's own frame is in the world, body `k` being of that shape, shape (..., 3)."""
    pos, quat = bodies.pos[..., k, :], bodies.quat[..., k, :]
    own = multiply(quat, conjugate(shape.axes.to(quat)).expand_as(quat))
    return pos - rotate(own, shape.centre.to(pos).expand_as(pos))


@functools.cache
def c_ring() -> MeshShape:
    """Return an open ring on a foot; its frame has the ring's centre at the origin, its axis along x, its gap at -y."""
    size = torch.tensor([RING, TUBE, 2 * math.pi - GAP], dtype=torch.float64)
    foot, below = torch.tensor(FOOT, dtype=torch.float64), torch.tensor([0.0, 0.0, FOOT[2] - HEIGHT]).double()

    def distance(p: Tensor) -> Tensor:
        ring = shape_sdf.distance("ring", size, p[:, [1, 2, 0]])
        return torch.minimum(ring, shape_sdf.distance("box", foot, p - below))

    # The arc is centred on +y.
    angle = torch.linspace(-0.5, 0.5, 9, dtype=torch.float64) * (2 * math.pi - GAP)
    tube = torch.stack([0 * angle, RING * angle.cos(), RING * angle.sin(), 0 * angle + TUBE], -1)
    corner = torch.cartesian_prod(*torch.tensor([[-1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64))
    x, y = (corner * (foot[:2] - FOOT[2])).unbind(-1)
    corners = torch.stack([x, y, 0 * x + below[2], 0 * x + FOOT[2]], -1)
    out = RING + TUBE
    return union(distance, (-FOOT[0], -out, -HEIGHT), (FOOT[0], out, out), torch.cat([corners, tube]))


@functools.cache
def pebble() -> MeshShape:
    """Return an irregular body about 10 cm wide, of four balls."""
    lumps = torch.tensor(LUMPS, dtype=torch.float64)

    def distance(p: Tensor) -> Tensor:
        apart = (p[:, None] - lumps[:, :3]).norm(dim=-1) - lumps[:, 3]
        return apart.amin(-1, keepdim=True)

    low, high = lumps[:, :3] - lumps[:, 3:], lumps[:, :3] + lumps[:, 3:]
    return union(distance, tuple(low.amin(0).tolist()), tuple(high.amax(0).tolist()), lumps)
