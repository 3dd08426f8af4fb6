"""Points of rope edges that are nearest to rigid bodies, all along the edges and not at vertices alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.coupling import shapes
from torchdlo.coupling.bodies import Body, BodyMotion, conjugate
from torchdlo.physics import tree
from torchdlo.physics.numerics import dot, safe_norm, tiny
from torchdlo.physics.rod import View
from torchdlo.physics.rotation import rotate

PULL = 0.01
"""Slope of the distance along an edge below which its nearest point is drawn to the middle: it makes that point unique
on flat surfaces. From a surface of radius R it moves the point by less than PULL R / 2, the gap by PULL^2 R / 8."""
PLACES = 8
"""Parts into which a piece of an edge is cut, twice, before Newton's method finds its nearest point."""
NEWTON = 2
"""Steps of that method without graph."""


@tree.struct
class EdgePoints:
    """Points of edges and the bodies that they are near to: F per edge, those near to the first body first."""

    share: Tensor
    """Where along the edge, 0 to 1 [1], shape (..., F, V, 1)."""
    normal: Tensor
    """Outward normals of the bodies there [1], shape (..., F, V, 3)."""
    arm: Tensor
    """From the body's centre of mass to the point of the centreline [m], shape (..., F, V, 3)."""
    distance: Tensor
    """Signed distance of the centreline from the body [m], shape (..., F, V, 1)."""


def families(body: Body, pieces: int) -> int:
    """Return how many points per edge are looked at: its ends, and the nearest one of each piece where that helps."""
    if body.shape == "plane":
        return 2
    return 3 if body.shape in shapes.CONVEX else 2 + pieces


@dataclass(frozen=True)
class _Line:
    """Edges in the frame of a body."""

    body: Body
    size: Tensor
    """Size of the body [m], shape (..., 1, 3)."""
    grid: Tensor
    """Distances of its grid, if it is a mesh [m], shape (..., 1, n)."""
    start: Tensor
    """First vertices [m], shape (..., V, 3)."""
    edge: Tensor
    """Edges [m], shape (..., V, 3)."""

    def probe(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """Return distance and normal at a share of the edges."""
        return shapes.probe(self.body.shape, self.size, self.start + share * self.edge, self.grid, self.body.cells)

    def slope(self, share: Tensor, middle: float) -> Tensor:
        """Return the slope of the distance by the share, with the pull to the middle of a piece [m]."""
        return dot(self.probe(share)[1], self.edge) + PULL * safe_norm(self.edge) * (share - middle)

    def still(self) -> _Line:
        """Return the edges without gradient history, with room for several shares in front of the vertex axis."""
        parts = (self.size, self.grid, self.start, self.edge)
        return _Line(self.body, *(x.detach().unsqueeze(-3) for x in parts))


def _nearest(line: _Line, low: float, high: float) -> Tensor:
    """Return the share at which edges are nearest to a body (or deepest in it) between two shares, shape (..., V, 1).

    The best of some places and the slopes around it enclose the nearest point, Newton's method finds it, and one more
    step of it, with graph, gives it the derivative of the implicit function theorem.
    """
    middle, part = 0.5 * (low + high), (high - low) / PLACES
    step = 1e-4 if line.start.dtype == torch.float64 else 2e-3
    still = line.still()
    length = safe_norm(line.edge).detach()
    node = torch.arange(PLACES + 1, dtype=length.dtype, device=length.device)[:, None, None]

    def newton(share: Tensor) -> tuple[Tensor, Tensor]:
        before, here, after = still.slope(share.unsqueeze(-3) + step * (node[:3] - 1), middle).unbind(-3)
        return here, torch.maximum((after - before) / (2 * step), PULL * length).clamp(min=tiny(length))

    with torch.no_grad():
        share = low + part * node
        pull = 0.5 * PULL * length.unsqueeze(-3) * (share - middle).square()
        value = still.probe(share)[0] + pull
        best = low + part * value.argmin(-3).to(value.dtype)
        left, right = (best - part).clamp(min=low), (best + part).clamp(max=high)
        share = left.unsqueeze(-3) + (right - left).unsqueeze(-3) * node[1:-1] / PLACES
        falling = (still.slope(share, middle) <= 0).to(left.dtype).sum(-3)
        left, right = (left + (right - left) * (falling + k) / PLACES for k in (0, 1))
        share = 0.5 * (left + right)
        for _ in range(NEWTON):
            slope, steep = newton(share)
            share = torch.minimum(torch.maximum(share - slope / steep, left), right)
        _, steep = newton(share)
    share = share - line.slope(share, middle) / steep
    return torch.minimum(torch.maximum(share, left), right)


def find(view: View, motion: BodyMotion, pieces: int) -> EdgePoints:
    """Return the points of all edges that may touch each body.

    Args:
        view: the rods.
        motion: the bodies.
        pieces: pieces of an edge that are searched by themselves where bodies are not convex.
    """
    state, params = motion.state, motion.params
    batch = torch.broadcast_shapes(view.state.pos.shape[:-2], state.pos.shape[:-2], params.size.shape[:-2])
    pos = view.state.pos.expand(*batch, -1, -1)
    found: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for k, body in enumerate(motion.bodies):
        quat, centre = state.quat[..., k : k + 1, :], state.pos[..., k : k + 1, :]
        arm = pos - centre
        local = rotate(conjugate(quat), arm)
        edge = view.next(local) - local
        line = _Line(body, params.size[..., k : k + 1, :], params.grid[..., k : k + 1, :], local, edge)
        distance, normal = line.probe(torch.zeros_like(local[..., :1]))
        zero = torch.zeros_like(distance)
        normal = rotate(quat, normal)
        found.append((zero, normal, arm, distance))
        found.append((zero + 1, view.next(normal), view.next(arm), view.next(distance)))
        count = families(body, pieces) - 2
        for j in range(count):
            share = _nearest(line, j / count, (j + 1) / count)
            distance, normal = line.probe(share)
            place = arm + share * (view.next(arm) - arm)
            found.append((share, rotate(quat, normal), place, distance))
    return EdgePoints(
        *(torch.stack([x.expand(*batch, *x.shape[-2:]) for x in parts], -3) for parts in zip(*found, strict=True))
    )
