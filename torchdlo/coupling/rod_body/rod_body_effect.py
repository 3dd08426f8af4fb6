"""Contact of ropes with rigid bodies, along whole edges, in both directions.

Per substep, for every edge and every body: the two ends of the edge and the point between them that is nearest to the
body (several where bodies are not convex), see `edge_points`. A point of the centreline at the share s of an edge has
the gap g = distance - radius and the unit normal n, out of the body. From then on contact is as among ropes (see
`contact`): no overlap at the end of the substep, n . (d_rod - d_body) >= -g with the motions d that are foreseen;
rebound; Coulomb friction; forces by projected Jacobi sweeps with row sums as inverse masses, held vertices counted as
heavy ones; then the lengths of the edges. All edges are tried with all bodies in every substep, so nothing can be
missed for lack of room; the sign of the gap comes from the start of the substep, so a fast edge does not get past a
thin post.

The body takes the opposite impulse at the same place, its torque included: linear and angular momentum are exact. The
normal force acts along the normal through the centreline. Friction acts at the surface of the rope, r n off the
centreline; the couple that this makes is exerted by the ends of the edge, but for its part about the edge, which a
centreline cannot exert: ropes slide across a body and do not roll on it.

Implicit steps find these forces together with the lengths, by a stiff law of the end of the step, see
`physics.constraints.contact_penalty` and `physics.integrators.contact_step`; `sweeps`, `rounds` and the kernel belong
to explicit ones.

The derivative is the one of the step as computed, of nearest points and normals too; it is finite everywhere, and
one-sided where a point starts to touch or to slide.

Stewart and Trinkle 1996, doi:10.1002/(SICI)1097-0207(19960815)39:15<2673::AID-NME972>3.0.CO;2-I (velocity-level time
stepping); Tonge, Benevolenski, Voroshilov 2012, doi:10.1145/2185520.2185601 (Jacobi sweeps with split masses).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.contact_solver import inertia
from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion, conjugate
from torchdlo.coupling.bodies.segment_distance import EdgePoints, find_contact_points, points_per_edge
from torchdlo.coupling.common.coulomb_friction import (
    compared,
    friction_force,
    overlap_recovery,
    rebound_separation,
    separation_needed,
)
from torchdlo.coupling.rod_body import body_touch_op
from torchdlo.coupling.rod_body import rod_body_op as body_sweeps
from torchdlo.physics.constraints.contact_penalty import Touch
from torchdlo.physics.effects.base import ContactForces, Effect, EffectKind, PredictedMotion, Values
from torchdlo.physics.linalg.numerics import cross, dot, safe_norm
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.rod.kinematics import View


@dataclass(frozen=True)
class _Axes:
    """How the V slots of the rods and the K bodies meet in the points: F per slot, on an axis in front of the slots."""

    view: View
    of: Tensor
    """1 where points are those of a body [1], shape (F, K, 1)."""

    def wide(self, x: Tensor) -> Tensor:
        """Return values of slots (..., V, C) at the points, shape (..., 1, V, C)."""
        return x.unsqueeze(-3)

    def of_bodies(self, x: Tensor) -> Tensor:
        """Return values of bodies (..., K, C) at the points, shape (..., F, 1, C)."""
        return (self.of * x.unsqueeze(-3)).sum(-2, keepdim=True)

    def bodies(self, x: Tensor) -> Tensor:
        """Return the sum of values of points (..., F, V, C) over the points of each body, shape (..., K, C)."""
        return (self.of * x.sum(-2, keepdim=True)).sum(-3)

    def vertices(self, first: Tensor, second: Tensor) -> Tensor:
        """Return what points give to the two ends of their edges (..., F, V, C), summed over vertices, (..., V, C)."""
        return first.sum(-3) + self.view.prev(second.sum(-3))


@dataclass(frozen=True)
class _Points:
    """Points at the start of a substep, and how forces there act on ends of edges and on bodies."""

    axes: _Axes
    at: EdgePoints
    real: Tensor
    """1 for points of real edges [1], shape (..., F, V, 1)."""
    tangent: Tensor
    """Directions of the edges [1], shape (..., F, V, 3)."""
    lever: Tensor
    """Radius over length of the edges [1], shape (..., F, V, 1)."""
    radius: Tensor
    """Radius of the edges [m], shape (..., F, V, 1)."""

    def exerted(self, normal: Tensor, friction: Tensor) -> ContactForces:
        """Return what normal forces (..., F, V, 1) and friction (..., F, V, 3) on the points exert [N]."""
        at, s = self.at, self.at.share
        whole = normal * at.normal + friction
        couple = -cross(at.normal, friction)
        pair = self.lever * cross(couple, self.tangent)
        across = self.radius * (couple - self.tangent * dot(self.tangent, couple))
        return ContactForces(
            self.axes.vertices((1 - s) * whole - pair, s * whole + pair),
            self.axes.bodies(-whole),
            self.axes.bodies(-cross(at.arm, whole) - across),
        )

    def seen(self, change: Tensor, bodies: PredictedBodyMotion) -> tuple[Tensor, Tensor]:
        """Return how far points part from their body [m], (..., F, V, 1), and slip on it, (..., F, V, 3).

        Args:
            change: displacements of the vertices [m], shape (..., V, 3).
            bodies: the bodies, with their displacements.
        """
        at, axes, n = self.at, self.axes, self.at.normal
        after = axes.view.next(change) - change
        stretch, turn = axes.wide(after), axes.of_bodies(bodies.turn)
        apart = axes.wide(change) + at.share * stretch - axes.of_bodies(bodies.change) - cross(turn, at.arm)
        # The surface of the rope is r n off the centreline: it moves by the turn of the edge against the body's, too.
        across = turn - self.tangent * dot(self.tangent, turn)
        slip = apart - cross(self.lever * cross(self.tangent, stretch) - self.radius * across, n)
        along = dot(n, apart)
        return along, slip - n * dot(n, slip)


def _points(view: View, bodies: PredictedBodyMotion, pieces: int) -> _Points:
    at = find_contact_points(view, bodies, pieces)
    count = [points_per_edge(b, pieces) for b in bodies.bodies]
    of = [[[float(k == j)] for k in range(len(count))] for j, n in enumerate(count) for _ in range(n)]
    axes = _Axes(view, at.share.new_tensor(of))
    mask, radius = view.params.rest.edge_mask, view.params.material.radius
    return _Points(
        axes, at, axes.wide(mask), axes.wide(view.tangent), axes.wide(radius / view.length), axes.wide(radius)
    )


@dataclass(frozen=True)
class _Softness:
    """How far points part or slip under one newton on every active point: row sums, so that sweeps converge."""

    points: _Points
    first: Tensor
    """By how much a force counts as moving the first vertices of the edges [m/N], shape (..., 1, V, 1)."""
    second: Tensor
    """The same for the second ones [m/N], shape (..., 1, V, 1)."""
    mobility: Tensor
    """By how much a force moves the bodies [m/N], shape (..., F, V, 1)."""
    turning: Tensor
    """By how much a normal force, by turning the body, moves its own point, its root [m/N], shape (..., F, V, 1)."""
    sliding: Tensor
    """The same at most for a force across the normal, its root [m/N], shape (..., F, V, 1)."""

    def _whole(self, active: Tensor, lever: Tensor) -> Tensor:
        axes, s = self.points.axes, self.points.at.share
        load = axes.vertices(active * (1 - s), active * s)
        rod = (1 - s) * axes.wide(load) * self.first + s * axes.wide(axes.view.next(load)) * self.second
        # |a . J b| <= |J^1/2 a| |J^1/2 b| for the levers a, b of two points and the answer J to torques.
        count, levers = axes.of_bodies(axes.bodies(torch.cat([active, active * lever], -1))).split(1, -1)
        return rod + self.mobility * count + lever * levers

    def normal(self, active: Tensor) -> Tensor:
        """Return by how much active points part [m/N], shape (..., F, V, 1)."""
        return self._whole(active, self.turning)

    def friction(self, active: Tensor) -> Tensor:
        """Return by how much active points slip at most [m/N], shape (..., F, V, 1)."""
        # Couples of one edge add up; those of neighbouring edges cancel where friction is even.
        many = self.points.axes.wide(active.sum(-3))
        return self._whole(active, self.sliding) + self.points.lever.square() * (self.first + self.second) * many


def _softness(points: _Points, give: Tensor, bodies: PredictedBodyMotion) -> _Softness:
    """Return how points give way; `give` is that of `PredictedMotion`."""
    axes, at = points.axes, points.at
    inverse_inertia = axes.of_bodies(bodies.inverse_inertia)
    local = rotate(conjugate(axes.of_bodies(bodies.state.quat)), cross(at.arm, at.normal))
    turning, sliding = dot(inverse_inertia * local, local), inverse_inertia.amax(-1, keepdim=True) * dot(at.arm, at.arm)
    turning, sliding = (
        torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0) for square in (turning, sliding)
    )
    return _Softness(
        points, axes.wide(give), axes.wide(axes.view.next(give)), axes.of_bodies(bodies.mobility), turning, sliding
    )


@dataclass(frozen=True)
class RodBody(Effect):
    """Ropes stay outside rigid bodies, rebound, and rub with Coulomb friction; bodies feel the opposite.

    Coefficients belong to the bodies, see `bodies.BodyParams`.
    """

    sweeps: int = 6
    """Sweeps per round; more of them for light bodies under long ropes, and for less creep of sticking ropes."""
    rounds: int = 1
    """Rounds of contact and lengths per substep; more of them for hits of taut ropes."""
    friction: bool = True
    """Whether ropes rub; False is cheaper than coefficients of 0."""
    pieces: int = 2
    """Pieces of an edge whose nearest points are found one by one where bodies are not convex."""
    recovery: float = 0.2
    """Share of a shallow overlap that a substep removes; a small one lets ropes come to rest."""
    slowest: float = 0.02
    """Approach below which nothing rebounds [m/s]. In implicit and coupled steps it is that of a rope of 5 mm radius,
    goes with the root of the radius, and is the slip below which friction is static, too."""
    left_out: tuple[tuple[int, int], ...] = ()
    """Edges and bodies, by their places in the scene, that go through each other: those next to joints."""

    name: ClassVar[str] = "rod_body"
    kind: ClassVar[EffectKind] = "force"
    is_contact: ClassVar[bool] = True
    engages: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, least in (("sweeps", 1), ("rounds", 1), ("pieces", 1), ("slowest", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"RodBody: {name} is {getattr(self, name)}; expected at least {least}")
        if not 0 < self.recovery <= 1:
            raise ValueError(f"RodBody: recovery is {self.recovery}; expected a share above 0, up to 1")

    def engage(self, view: View, motion: PredictedMotion, values: Values) -> Touch:
        """Return the points of edges that may touch bodies in an implicit substep."""
        bodies = motion.bodies
        free = [k for k, b in enumerate(bodies.bodies) if b.motion == "free"]
        count = [points_per_edge(b, self.pieces) for b in bodies.bodies]
        of = [[float(k == j) for j in free] for k, n in enumerate(count) for _ in range(n)]
        place = [[float(k == j) for j in free] for k in range(len(count))]
        mask, radius, rubs = view.params.rest.edge_mask, view.params.material.radius, 1.0 if self.friction else 0.0
        if body_touch_op.kernel_fits(bodies):
            law, searched = (self.recovery, self.slowest), [n - 2 for n in count]
            found = body_touch_op.find_touches(view, motion, searched, friction=self.friction, law=law)
        else:
            found = self._touches(view, motion)
        share, normal, wanted, given, mu, arm = found
        edges = mask, view.tangent, radius, rubs * radius / view.length
        shape = torch.broadcast_shapes(share.shape, *((*x.unsqueeze(-3).shape[:-1], 1) for x in edges))[:-1]
        real, tangent, radius, lever = (x.unsqueeze(-3).expand(*shape, x.shape[-1]) for x in edges)
        share, normal, wanted, given, mu, arm = (x.expand(*shape, x.shape[-1]) for x in found)
        if self.left_out:
            real = real * self._kept(real, count)
        resist = inertia(bodies, free) if free else share.new_zeros(0, 6, 6)
        like = share.new_tensor
        body = like(of).reshape(len(of), len(free)), resist, like(place).reshape(len(count), len(free))
        return Touch(real, share, normal, tangent, radius, lever, wanted, given, mu, arm, *body)

    def _touches(self, view: View, motion: PredictedMotion) -> tuple[Tensor, ...]:
        """Return share, normal, wanted, given, mu and arm of points by tensor operations; see `Touch`."""
        bodies = motion.bodies
        points, state = _points(view, bodies, self.pieces), bodies.state
        at, axes = points.at, points.axes
        still, slip = points.seen(torch.zeros_like(motion.change), bodies)
        wanted = self._target(points, view, bodies, points.seen(motion.change, bodies)[0], calm=True)
        now = dataclasses.replace(bodies, change=state.vel, turn=state.omega)
        slip_speed = safe_norm(points.seen(view.state.vel, now)[1]).detach()
        slides = slip_speed > compared(self.slowest, points.radius)
        mu_s, mu_k = (axes.of_bodies(mu) for mu in (bodies.params.mu_s, bodies.params.mu_k))
        mu = torch.where(slides, mu_k, mu_s) if self.friction else torch.zeros_like(at.share)
        return at.share, at.normal, wanted, still * at.normal + slip, mu, at.arm

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> ContactForces:
        """Return the forces that keep ropes outside of bodies and rub [N]."""
        bodies = motion.bodies
        if body_sweeps.kernel_fits(bodies) and not self.left_out:
            pieces = [points_per_edge(b, self.pieces) - 2 for b in bodies.bodies]
            law = (self.recovery, self.slowest)
            return body_sweeps.contact_wrenches(
                view, motion, pieces, sweeps=self.sweeps, friction=self.friction, law=law
            )
        points = self._points(view, bodies)
        along, slip = points.seen(motion.change, bodies)
        wanted = self._target(points, view, bodies, along)
        softness = _softness(points, motion.give, bodies)
        normal, friction = torch.zeros_like(along), torch.zeros_like(slip)
        normal, friction = self._sweep(points, (normal, friction), (along, slip), wanted, softness, bodies)
        push = points.exerted(normal, friction)
        for _ in range(self.sweeps - 1):
            along, slip = points.seen(motion.change + motion.answer * push.force, bodies.pushed(push))
            normal, friction = self._sweep(points, (normal, friction), (along, slip), wanted, softness, bodies)
            push = points.exerted(normal, friction)
        return push

    def _kept(self, like: Tensor, count: Sequence[int]) -> Tensor:
        """Return 0 at points of what is left out, else 1 [1], shape (F, V, 1); of so many points for each body."""
        whole = torch.ones(len(count), like.shape[-2])
        for edge, body in self.left_out:
            whole[body, edge] = 0.0
        rows = [whole[k] for k, n in enumerate(count) for _ in range(n)]
        return torch.stack(rows).unsqueeze(-1).to(like)

    def _points(self, view: View, bodies: PredictedBodyMotion) -> _Points:
        points = _points(view, bodies, self.pieces)
        if not self.left_out:
            return points
        kept = self._kept(points.at.share, [points_per_edge(b, self.pieces) for b in bodies.bodies])
        return dataclasses.replace(points, real=points.real * kept)

    def _target(
        self, points: _Points, view: View, bodies: PredictedBodyMotion, along: Tensor, calm: bool = False
    ) -> Tensor:
        """Return by how much points have to part at least [m], shape (..., F, V, 1); slowly, if that is asked for."""
        wanted = separation_needed(points.at.distance - points.radius, 0.1 * points.radius, self.recovery)
        wanted = overlap_recovery(wanted, view.dt) if calm else wanted
        pressed = points.real * (along < wanted)
        now = dataclasses.replace(bodies, change=bodies.state.vel, turn=bodies.state.omega)
        approach = -points.seen(view.state.vel, now)[0]
        restitution = points.axes.of_bodies(bodies.params.restitution)
        slowest = compared(self.slowest, points.radius) if calm else self.slowest
        return rebound_separation(wanted, pressed, approach, restitution, slowest, view.dt)

    def _sweep(
        self,
        points: _Points,
        forces: tuple[Tensor, Tensor],
        motion: tuple[Tensor, Tensor],
        wanted: Tensor,
        softness: _Softness,
        bodies: PredictedBodyMotion,
    ) -> tuple[Tensor, Tensor]:
        """Return normal forces and friction after one projected Jacobi sweep."""
        active = points.real * ((forces[0] > 0) | (motion[0] < wanted))
        normal = (forces[0] + _step(wanted - motion[0], softness.normal(active), active)).clamp(min=0.0)
        if not self.friction:
            return normal, forces[1]
        # Where nothing presses, nothing rubs: those points have no part in how far the others slip.
        active = points.real * (normal > 0)
        mu_s, mu_k = (points.axes.of_bodies(mu) for mu in (bodies.params.mu_s, bodies.params.mu_k))
        return normal, friction_force(
            forces[1] - _step(motion[1], softness.friction(active), active), normal, mu_s, mu_k
        )


def _step(miss: Tensor, softness: Tensor, active: Tensor) -> Tensor:
    """Return the forces that would undo displacements at active points; where nothing can move there are none."""
    mobile = active * (softness > 0)
    return mobile * miss / torch.where(mobile > 0, softness, 1.0)
