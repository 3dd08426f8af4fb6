"""Contact of ropes with surfaces and ropes inside of an implicit step: a stiff law of its end, solved with the lengths.

At each point of an edge that may touch, with m by how much it misses where it has to be at the end of the step, the
normal force is k w ln(1 + e^(m / w)), a spring that is rounded over a length w much smaller than the radius, and
nothing beyond a distance of 30 w. Out of contact it falls by e with every w: at rest surfaces are w ln(k w / f) apart
under a force f, some hundredths of the radius at most, and edges beside the one that touches have no part in it. (With
a force that falls with the distance itself, ropes hover at a tenth of the radius on several edges, whose tilted normals
put friction off by a seventh.) That is times 1 - tanh(s / s0), s by how much the point parts more than it is asked to
and s0 the way at the speed sqrt(0.1 r) in a step: surfaces take energy out of what leaves them, and things come to
rest. Friction is mu f s / sqrt(s^2 + (mu f / k)^2) against the slip s: never more than Coulomb allows,
and opposed to the slip at the end of the step, so that it takes energy away. Forces and their derivatives by the
displacements of the ends of the edge and of the body are exact; surfaces are taken as they are, to first order, at the
start of the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import added, dot
from torchdlo.physics.rod.topology import Topology, following, preceding

HARD = 100.0
"""Stiffness of contacts over what resists motion at the ends of their edge."""
ROUND = 1 / 300
"""Length over which contacts set in, over the radius."""
FAR = 30.0
"""Distance at which they begin to be felt, over that length; there they are exp(-FAR) of what they are in contact."""
LEAVING = 0.1
"""Square of the speed with which surfaces are left, over the radius [m/s^2]: a hundredth of gravity, so that things hop
by half a hundredth of the radius at most."""


@tree.struct
class Pairs:
    """Pairs of edges of ropes that may touch, K of them."""

    at: Tensor
    """Their four corners, see `corners` in `physics.linalg.gather_scatter` [1], shape (..., 4, K)."""
    real: Tensor
    """1 for pairs, 0 where the list has room left [1], shape (..., K, 1)."""
    normal: Tensor
    """Unit vectors from the second edge to the first [1], shape (..., K, 3)."""
    radius: Tensor
    """Mean radius of the two edges [m], shape (..., K, 1)."""
    wanted: Tensor
    """By how much they have to part at least [m], shape (..., K, 1)."""
    mu: Tensor
    """Coefficients of friction [1], shape (..., K, 1)."""
    linear: tuple[Tensor, ...]
    """How they move against each other with their corners [1], shape (..., K, 3, 3) each."""


@dataclass(frozen=True)
class PairsFelt:
    """What pairs do at some displacements, times `scale`."""

    forces: tuple[Tensor, ...]
    """Forces on their four corners [N s^2], shape (..., K, 3) each."""
    parts: tuple[Tensor, ...]
    """Numbers of pairs [-] that `pair_gradient` reads, shapes (...)."""


def feel_pairs(pairs: Pairs, firm: Tensor, ends: tuple[Tensor, ...], dt: float) -> PairsFelt:
    """Return what pairs do.

    Args:
        pairs: the pairs.
        firm: their stiffness, times `scale` [kg], shape (..., K, 1).
        ends: displacements of their corners since the start of the step [m], shape (..., K, 3) each.
        dt: substep [s].
    """
    n = pairs.normal
    moved = added(_times(m, y) for m, y in zip(pairs.linear, ends, strict=True))
    along = dot(n, moved)
    slip = moved - n * along
    normal, drag, parts = _law(pairs.wanted, along, slip, firm, pairs.radius, pairs.mu, pairs.real, dt)
    force = normal * n - drag * slip
    return PairsFelt(tuple(_times(m.mT, force) for m in pairs.linear), parts)


def pair_gradient(pairs: Pairs, felt: PairsFelt, exact: bool) -> Tensor:
    """Return how the force between the edges of pairs falls with their motion, times `scale`, shape (..., K, 3, 3)."""
    return _gradient(pairs.normal, pairs.mu, felt.parts, exact)


@tree.struct
class Touch:
    """Points of edges that may touch bodies, F per edge, and the free bodies, J of them, that take part."""

    real: Tensor
    """1 for points of real edges [1], shape (..., F, V, 1)."""
    share: Tensor
    """Where along the edge, 0 to 1 [1], shape (..., F, V, 1)."""
    normal: Tensor
    """Outward normals of the bodies there [1], shape (..., F, V, 3)."""
    tangent: Tensor
    """Directions of the edges [1], shape (..., F, V, 3)."""
    radius: Tensor
    """Radius of the edges [m], shape (..., F, V, 1)."""
    lever: Tensor
    """Radius over length of the edges where friction acts at the surface [1], shape (..., F, V, 1)."""
    wanted: Tensor
    """By how much points have to part from their bodies at least [m], shape (..., F, V, 1)."""
    given: Tensor
    """By how much they part from and slip on bodies that nothing touches if edges stay [m], shape (..., F, V, 3)."""
    mu: Tensor
    """Coefficients of friction [1], shape (..., F, V, 1)."""
    arm: Tensor
    """From the body's centre of mass to the point [m], shape (..., F, V, 3)."""
    of: Tensor
    """1 where points are those of a free body [1], shape (F, J)."""
    resist: Tensor
    """How free bodies resist displacements and turns [N/m, N m/rad], shape (..., J, 6, 6)."""
    place: Tensor
    """1 where a body of the scene is a free one [1], shape (K, J)."""

    def spread(self, wrench: Tensor) -> tuple[Tensor, Tensor]:
        """Return forces and torques on the bodies of the scene, (..., K, 3) each, of those on the free ones."""
        return (self.place @ wrench).split(3, -1)


def untouched(like: Tensor, resist: Tensor | None = None, place: Tensor | None = None) -> Touch:
    """Return that nothing may touch bodies; vertices are (..., V, 3), and the others as in `Touch`, None for none."""
    v = like.shape[-2]
    resist = like.new_zeros(0, 6, 6) if resist is None else resist
    place = like.new_zeros(1, 0) if place is None else place
    widths = (1, 1, 3, 3, 1, 1, 1, 3, 1, 3)
    none = [like.new_zeros(0, v, width) for width in widths]
    return Touch(*[*none, like.new_zeros(0, resist.shape[-3]), resist, place])


@dataclass(frozen=True)
class ContactGradients:
    """How what contact does falls with displacements, times `scale`."""

    same: Tensor
    """Force on vertices with their own [kg], shape (..., V, 3, 3)."""
    after: Tensor
    """Force on vertices with the following one's [kg], shape (..., V, 3, 3)."""
    before: Tensor
    """Force on the following vertices with this one's [kg], shape (..., V, 3, 3)."""
    border: Tensor
    """Force on vertices with those of bodies [kg], shape (..., V, 3, 6 J)."""
    back: Tensor
    """Wrenches with those of vertices [kg], shape (..., V, 6 J, 3)."""
    corner: Tensor
    """Wrenches with those of bodies [kg], shape (..., 6 J, 6 J)."""


@dataclass(frozen=True)
class Felt:
    """What contact does at some displacements, times `scale`."""

    force: Tensor
    """Force on vertices [N s^2], shape (..., V, 3)."""
    wrench: Tensor
    """Force and torque on free bodies [N s^2, N m s^2], shape (..., J, 6)."""
    parts: tuple[Tensor, ...]
    """Numbers of points [-] that `gradients` reads, shapes (...)."""
    points: Tensor
    """Force on edges at each point [N s^2], shape (..., F, V, 3)."""


def _column(x: Tensor) -> Tensor:
    return x.unsqueeze(-1)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a.unsqueeze(-1) * b.unsqueeze(-2)


def _skew(r: Tensor) -> Tensor:
    """Return the matrices of r x, shape (..., 3, 3)."""
    x, y, z = r.unbind(-1)
    none = torch.zeros_like(x)
    return torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))


def maps(touch: Touch) -> tuple[Tensor, Tensor, Tensor]:
    """Return how points move against bodies with first and second ends of edges and with bodies.

    Displacements along the normal count at the centreline, those across it at the surface, which turns with the edge.
    Shapes (..., F, V, 3, 3) twice and (..., F, V, 3, 6).
    """
    n, t = touch.normal, touch.tangent
    unit = torch.eye(3, dtype=n.dtype, device=n.device)
    swing = _column(touch.lever) * (_outer(t, n) - _column(dot(n, t)) * unit)
    swing = swing - _outer(n, (n.unsqueeze(-2) @ swing).squeeze(-2))
    s = _column(touch.share)
    held = _column(touch.radius) * (_column(touch.lever) > 0)  # 0 where friction is left out
    turn = _skew(touch.arm) - held * (_skew(n) @ (unit - _outer(t, t)))
    unit = unit.expand_as(swing)
    return (1 - s) * unit - swing, s * unit + swing, torch.cat([-unit, turn.expand_as(unit)], -1)


def feel(
    topology: Topology,
    touch: Touch,
    linear: tuple[Tensor, ...],
    firm: Tensor,
    y: Tensor,
    q: Tensor,
    dt: float,
) -> Felt:
    """Return what contact does.

    Args:
        topology: the ropes.
        touch: the points.
        linear: what `maps` returned.
        firm: stiffness of points, times `scale` [kg], shape (..., F, V, 1).
        y: displacements of vertices since the start of the step [m], shape (..., V, 3).
        q: displacements and turns of free bodies by contact [m, rad], shape (..., J, 6).
        dt: substep [s].
    """
    first, second, body = linear
    n = touch.normal
    ends = y.unsqueeze(-3), following(topology, y).unsqueeze(-3)
    moved = touch.given + _times(first, ends[0]) + _times(second, ends[1])
    if touch.of.shape[-1]:
        moved = moved + _times(body, torch.einsum("fj,...jc->...fc", touch.of, q).unsqueeze(-2))
    along = dot(n, moved)
    slip = moved - n * along
    normal, drag, parts = _law(touch.wanted, along, slip, firm, touch.radius, touch.mu, touch.real, dt)
    force = normal * n - drag * slip
    exerted = preceding(topology, _times(second.mT, force).sum(-3))
    wrench = torch.einsum("...fvi,fj->...ji", _times(body.mT, force), touch.of)
    return Felt(_times(first.mT, force).sum(-3) + exerted, wrench, parts, force)


def _law(
    wanted: Tensor, along: Tensor, slip: Tensor, firm: Tensor, radius: Tensor, mu: Tensor, real: Tensor, dt: float
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """Return normal forces, friction over the slip, and what `_gradient` reads; shapes of numbers of points (...)."""
    width = ROUND * radius
    miss = (wanted - along) / width
    # ln(1 + e^x), and its derivative, for any x.
    push = width * (miss.clamp(min=0.0) + torch.log1p(torch.exp(-miss.abs())))
    leave = dt * (LEAVING * radius).sqrt()
    left = torch.tanh((along - wanted.clamp(min=0.0)) / leave)
    fade, on = 1 - left, real * (miss > -FAR)
    normal = firm * push * fade * on
    steep = firm * (torch.sigmoid(miss) * fade + push * (1 - left.square()) / leave) * on
    # Rubbing sets in over the slip that a stuck point has.
    limit = mu * normal
    little = limit / firm
    size = (slip.square().sum(-1, keepdim=True) + little.square() + (1e-9 * radius).square()).sqrt()
    drag = limit / size
    return normal, drag, (steep, drag, slip / size, little / size)


def _gradient(n: Tensor, mu: Tensor, parts: tuple[Tensor, ...], exact: bool) -> Tensor:
    """Return how forces fall with motions, (..., 3, 3); without the turning of friction unless `exact`."""
    steep, drag, ahead, stuck = parts
    unit = torch.eye(3, dtype=n.dtype, device=n.device)
    gradient = _column(steep) * _outer(n, n) + _column(drag) * (unit - _outer(n, n))
    if exact:
        gradient = gradient - _column(drag) * _outer(ahead, ahead)
        gradient = gradient - _column(mu * steep * (1 - stuck.square())) * _outer(ahead, n)
    return gradient


def gradients(
    topology: Topology, touch: Touch, linear: tuple[Tensor, ...], felt: Felt, exact: bool
) -> ContactGradients:
    """Return how that falls; without the turning of friction unless `exact`, which is safer far from the solution."""
    of = touch.of
    gradient = _gradient(touch.normal, touch.mu, felt.parts, exact)
    a, b, c = linear
    ka, kb, kc = gradient @ a, gradient @ b, gradient @ c
    ending = (b.mT @ kb).sum(-4)
    border = [torch.einsum("...fvij,fk->...vikj", x.mT @ kc, of).flatten(-2) for x in (a, b)]
    back = [torch.einsum("...fvij,fk->...vkij", c.mT @ x, of).flatten(-3, -2) for x in (ka, kb)]
    corner = torch.einsum("...fvij,fk->...kij", c.mT @ kc, of)
    return ContactGradients(
        (a.mT @ ka).sum(-4) + moved(topology, ending),
        (a.mT @ kb).sum(-4),
        (b.mT @ ka).sum(-4),
        border[0] + moved(topology, border[1]),
        back[0] + moved(topology, back[1]),
        blocks(corner),
    )


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def moved(topology: Topology, x: Tensor) -> Tensor:
    """Return at each slot the matrix (..., V, n, m) of the preceding one."""
    return preceding(topology, x.flatten(-2)).unflatten(-1, x.shape[-2:])


def blocks(x: Tensor) -> Tensor:
    """Return blocks (..., J, 6, 6) on the diagonal of a matrix (..., 6 J, 6 J)."""
    count = x.shape[-3]
    if count == 1:
        return x[..., 0, :, :]
    unit = torch.eye(count, dtype=x.dtype, device=x.device)
    return torch.einsum("...kij,kl->...kilj", x, unit).flatten(-2).flatten(-3, -2)
