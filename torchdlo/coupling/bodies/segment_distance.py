"""Points of rope edges that are nearest to rigid bodies, all along the edges and not at vertices alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.coupling.bodies import edge_search_op, shape_sdf
from torchdlo.coupling.bodies.dynamics import Body, PredictedBodyMotion, conjugate
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import dot, safe_norm, tiny
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.rod.kinematics import View

PULL = 0.01
"""Slope of the distance along an edge below which its nearest point is drawn to the middle: it makes that point unique
on flat surfaces. From a surface of radius R it moves the point by less than PULL R / 2, the gap by PULL^2 R / 8."""
PLACES = 8
"""Parts into which a piece of an edge is cut where the distance from a shape may have several minima along it."""
HALVES = {True: 5, False: 4}
"""How often what is left of a piece is halved before Newton's method finds its nearest point; by whether the distance
from the shape is convex."""
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


def points_per_edge(body: Body, pieces: int) -> int:
    """Return how many points per edge are looked at: its ends, and the nearest one of each piece where that helps."""
    if body.shape == "plane":
        return 2
    return 3 if body.shape in shape_sdf.CONVEX else 2 + pieces


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
        return shape_sdf.probe(self.body.shape, self.size, self.start + share * self.edge, self.grid, self.body.cells)

    def slope(self, share: Tensor, middle: float) -> Tensor:
        """Return the slope of the distance by the share, with the pull to the middle of a piece [m]."""
        return self.rise(self.probe(share)[1], share, middle)

    def rise(self, normal: Tensor, share: Tensor, middle: float) -> Tensor:
        """Return the same where the normal is known."""
        return dot(normal, self.edge) + PULL * safe_norm(self.edge) * (share - middle)

    def still(self) -> _Line:
        """Return the edges without gradient history, with room for several shares in front of the vertex axis."""
        parts = (self.size, self.grid, self.start, self.edge)
        return _Line(self.body, *(x.detach().unsqueeze(-3) for x in parts))


def _nearest(line: _Line, count: int) -> list[Tensor]:
    """Return the shares at which edges are nearest to a body (or deepest in it) in each of their pieces, (..., V, 1).

    Slopes enclose the nearest point, about the best of some places where the distance may have several minima; Newton's
    method finds it, and one more step of it, with graph, gives it the derivative of the implicit function theorem.
    """
    if edge_search_op.kernel_fits(line.body, line.grid):
        found = edge_search_op.search(line.body, line.size, line.grid, line.start, line.edge, count)
    else:
        found = [_search(line, j / count, (j + 1) / count) for j in range(count)]
    shares = []
    for j, (share, steep, left, right) in enumerate(found):
        share = share - line.slope(share, (j + 0.5) / count) / steep
        shares.append(torch.minimum(torch.maximum(share, left), right))
    return shares


@torch.no_grad()
def _search(line: _Line, low: float, high: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the share between two shares before the last step, the slope's rise there, and bounds, (..., V, 1)."""
    middle = 0.5 * (low + high)
    step = 1e-4 if line.start.dtype == torch.float64 else 2e-3
    still = line.still()
    length = safe_norm(line.edge).detach()

    def newton(share: Tensor) -> tuple[Tensor, Tensor]:
        three = share.unsqueeze(-3) + step * torch.arange(-1, 2, dtype=share.dtype, device=share.device)[:, None, None]
        before, here, after = still.slope(three, middle).unbind(-3)
        return here, torch.maximum((after - before) / (2 * step), PULL * length).clamp(min=tiny(length))

    left, right = torch.full_like(length, low), torch.full_like(length, high)
    convex = line.body.shape in shape_sdf.CONVEX
    if not convex:
        left, right = _about_best(still, low, high)
    for _ in range(HALVES[convex]):
        half = 0.5 * (left + right)
        falling = still.slope(half.unsqueeze(-3), middle).squeeze(-3) <= 0
        left, right = torch.where(falling, half, left), torch.where(falling, right, half)
    # The middle of a piece is nearest to what is flat: it must not be a bound, where the share has no derivative.
    spare = 0.25 * (right - left)
    left, right = (left - spare).clamp(min=low), (right + spare).clamp(max=high)
    share = 0.5 * (left + right)
    for _ in range(NEWTON):
        slope, steep = newton(share)
        share = torch.minimum(torch.maximum(share - slope / steep, left), right)
    return share, newton(share)[1], left, right


def _about_best(still: _Line, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Return shares between which edges come nearest to a body, as far as some places tell, shape (..., V, 1) each."""
    middle, part, length = 0.5 * (low + high), (high - low) / PLACES, safe_norm(still.edge)
    share = low + part * torch.arange(PLACES + 1, dtype=length.dtype, device=length.device)[:, None, None]
    distance, normal = still.probe(share)
    best = (distance + 0.5 * PULL * length * (share - middle).square()).argmin(-3, keepdim=True)
    rise = torch.take_along_dim(still.rise(normal, share, middle), best, -3).squeeze(-3)
    here = low + part * best.squeeze(-3).to(length.dtype)
    left, right = torch.where(rise <= 0, here, here - part), torch.where(rise <= 0, here + part, here)
    return left.clamp(min=low), right.clamp(max=high)


def find_contact_points(view: View, motion: PredictedBodyMotion, pieces: int) -> EdgePoints:
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
        count = points_per_edge(body, pieces) - 2
        for share in _nearest(line, count) if count else []:
            distance, normal = line.probe(share)
            place = arm + share * (view.next(arm) - arm)
            found.append((share, rotate(quat, normal), place, distance))
    return EdgePoints(
        *(torch.stack([x.expand(*batch, *x.shape[-2:]) for x in parts], -3) for parts in zip(*found, strict=True))
    )
