"""Momentum between rigid bodies and matter, on the nodes of the grid.

A node with mass that lies within `reach` node spacings of a body's surface, or inside the body, and comes nearer, gets
an impulse along the body's normal at the node, and Coulomb friction across it. The body gets the opposite at the same
point, its torque included: linear and angular momentum are exact.

A node at the distance d off the surface answers by the share phi = clamp((reach h - d) / (RAMP h), 0, 1), h the node
spacing: n . (v_node - v_body) after the exchange is at least 1 - phi times what it was, if that is an approach.
Impulses are therefore continuous while a body moves through the grid.

Impulses are found by projected Jacobi sweeps. Unknown is the change of velocity u that a body gives to a node of mass
m; the body feels -m u. With weights w = phi m, generalised row sums of the inverse mass matrix bound its eigenvalues: a
sweep changes u by

    phi miss / (sum_k phi_k + 1/M sum_j phi_j m_j + l sum_j phi_j m_j l_j),

k the bodies at the node, j the nodes at the body, l = sqrt(a . J a) for its inverse inertia J and the arm a of a unit
impulse. Nodes at one fixed body are right after one sweep. Light bodies in much matter converge slower, and matter that
two heavy bodies squeeze gives way, some in every substep.

Velocities alone would leave matter inside a body where it is: nodes deeper than one spacing, which bear mass only where
matter is inside, are asked to leave with `recovery` times their further depth.

Bodies that are thinner than two spacings hold matter, but matter on both sides feels itself through them.

Hu et al. 2018, doi:10.1145/3197517.3201293, section 5.3 (bodies on nodes); Varga 2004, Gersgorin and His Circles,
doi:10.1007/978-3-642-17798-9, section 1.2 (row sums with weights); Tonge, Benevolenski, Voroshilov 2012,
doi:10.1145/2185520.2185601 (projected Jacobi sweeps).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion, conjugate
from torchdlo.coupling.common.coulomb_friction import friction_force
from torchdlo.coupling.mpm import body_broad_phase_op, body_coupling_op
from torchdlo.coupling.mpm.particles import Grid
from torchdlo.coupling.mpm.rod_coupling_effect import PredictedParticles, TouchedParticles
from torchdlo.coupling.mpm.substep import Nodes, places
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, Effect, EffectKind
from torchdlo.physics.linalg.numerics import cross, dot, safe_norm
from torchdlo.physics.linalg.rotation import rotate

RAMP = 0.5
"""Depth over which a node comes to feel all of a body, in node spacings."""


@dataclass(frozen=True)
class BodyMpmCoupling(Effect):
    """Rigid bodies and matter push each other and rub with the bodies' Coulomb friction.

    It acts once per substep, after all other contact: on what ropes and other bodies have left of both.
    """

    sweeps: int = 4
    """Jacobi sweeps per substep; more of them for bodies that are lighter than the matter that they move."""
    room: int = 0
    """Nodes per scene that there is room for, those next to bodies; 0: all. Fewer are faster."""
    reach: float = 1.0
    """Distance off the surface at which nodes begin to feel it, in node spacings."""
    recovery: float = 10.0
    """Rate at which matter leaves the inside of a body [1/s]."""
    planes: bool = True
    """Whether planes take part. Not where walls of the box stand for them, which cost less."""

    name: ClassVar[str] = "body_mpm_coupling"
    kind: ClassVar[EffectKind] = "force"

    def __post_init__(self) -> None:
        for name, least in (("sweeps", 1), ("room", 0), ("reach", 0.0), ("recovery", 0.0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"BodyMpmCoupling: {name} is {getattr(self, name)}; expected at least {least}")

    def couple_bodies_to_particles(
        self, motion: PredictedBodyMotion, material_points: PredictedParticles, push: ContactForces
    ) -> ContactForces:
        """Return what is exerted with the forces of this effect.

        Args:
            motion: where bodies would go without contact.
            material_points: where matter would go without contact.
            push: what all other contact exerts on bodies, and what it leaves of the matter.
        """
        part = [k for k, body in enumerate(motion.bodies) if self.planes or body.shape != "plane"]
        if not part:
            return push
        touched = push.material_points
        before, missed = (material_points.nodes, 0.0) if touched == () else (touched.nodes, touched.lost)
        batch = material_points.particles.pos.shape[:-2]
        met, some = motion.pushed(push), len(part) < len(motion.bodies)
        met = met.only(part) if some else met
        impulse, torque, nodes, lost = exchange(self, material_points.grid, before, met, batch)

        def force(x: Tensor) -> Tensor:
            x = (x / motion.dt).reshape(*batch, len(part), 3)
            if not some:
                return x
            rows, none = dict(zip(part, x.unbind(-2), strict=True)), x.new_zeros(*batch, 3)
            return torch.stack([rows.get(k, none) for k in range(len(motion.bodies))], -2)

        return dataclasses.replace(
            push,
            body_force=push.body_force + force(impulse),
            body_torque=push.body_torque + force(torque),
            material_points=TouchedParticles(nodes, missed + lost.to(impulse.dtype)),
        )


@tree.struct
class _Solids:
    """Bodies in a substep, all scenes on one axis; R is an axis for points."""

    pos: Tensor
    """Centres of mass [m], shape (B, K, 1, 3)."""
    quat: Tensor
    """Orientations [1], shape (B, K, 1, 4)."""
    vel: Tensor
    """Velocities without matter [m/s], shape (B, K, 1, 3)."""
    omega: Tensor
    """Angular velocities without matter, in the world [rad/s], shape (B, K, 1, 3)."""
    light: Tensor
    """Inverse masses, 0 if not free [1/kg], shape (B, K, 1, 1)."""
    agile: Tensor
    """Inverse moments of inertia about the principal axes, 0 if not free [1/(kg m^2)], shape (B, K, 1, 3)."""
    size: Tensor
    """Sizes, see `shapes.SIZES` [m or rad], shape (B, K, 1, 3)."""
    grid: Tensor
    """Distances of meshes [m], shape (B, K, 1, n)."""
    mu_s: Tensor
    """Coefficients of static friction [1], shape (B, K, 1, 1)."""
    mu_k: Tensor
    """Coefficients of sliding friction [1], shape (B, K, 1, 1)."""

    def turned(self, torque: Tensor) -> Tensor:
        """Return the change of angular velocity [rad/s] by angular impulses [N m s], shape (B, K, R, 3)."""
        return rotate(self.quat, self.agile * rotate(conjugate(self.quat), torque))


@tree.struct
class _Pairs:
    """Every body with every one of R nodes."""

    arm: Tensor
    """From the centre of mass to the node [m], shape (B, K, R, 3)."""
    normal: Tensor
    """Outward normal of the body there [1], shape (B, K, R, 3)."""
    share: Tensor
    """How much of the body the node feels, 0 where it has no mass [1], shape (B, K, R, 1)."""
    leaving: Tensor
    """Speed at which matter inside is to leave [m/s], shape (B, K, R, 1)."""
    mass: Tensor
    """Mass of the node [kg], shape (B, 1, R, 1)."""
    answer: Tensor
    """Part of an impulse that acts on matter in this substep [1], shape (B or 1, 1, 1, 1)."""


def _solids(motion: PredictedBodyMotion, batch: Sequence[int]) -> _Solids:
    def wide(x: Tensor) -> Tensor:
        return x.expand(*batch, *x.shape[-2:]).reshape(math.prod(batch), x.shape[-2], 1, x.shape[-1])

    state, params, dt = motion.state, motion.params, motion.dt
    rates = (motion.change / dt, motion.turn / dt, motion.mobility / dt**2, motion.inverse_inertia / dt**2)
    fields = (state.pos, state.quat, *rates, params.size, params.grid, params.mu_s, params.mu_k)
    return _Solids(*(wide(x) for x in fields))


def _probe(motion: PredictedBodyMotion, solids: _Solids, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return distances [m] (B, K, R, 1), normals and arms [m] (B, K, R, 3) of points (B, 1, R, 3) at bodies."""
    arm = points - solids.pos
    local = rotate(conjugate(solids.quat), arm)
    found = []
    for k, body in enumerate(motion.bodies):
        found.append(shape_sdf.probe(body.shape, solids.size[:, k], local[:, k], solids.grid[:, k], body.cells))
    distance, normal = (torch.stack([f[i] for f in found], 1) for i in (0, 1))
    return distance, rotate(solids.quat, normal), arm


def _chosen(motion: PredictedBodyMotion, solids: _Solids, nodes: Nodes, points: Tensor, reach: float, room: int):
    """Return the numbers of the nodes nearest to bodies (B, R), and how many found no room (B, 1); no derivative."""
    with torch.no_grad():
        off = _probe(motion, solids, points.unsqueeze(1))[0].amin(1)[..., 0]
        off = torch.where(nodes.mass > 0, off, torch.inf)
        # Ties keep the order of nodes.
        chosen = off.argsort(dim=-1, stable=True)[:, :room]
        lost = ((off < reach).sum(-1, keepdim=True) - room).clamp(min=0)
    return chosen, lost


def _pairs(
    effect: BodyMpmCoupling, motion: PredictedBodyMotion, solids: _Solids, nodes: Nodes, points: Tensor, spacing: float
) -> _Pairs:
    distance, normal, arm = _probe(motion, solids, points.unsqueeze(1))
    mass = nodes.mass[:, None, :, None]
    share = ((effect.reach - distance / spacing) / RAMP).clamp(0.0, 1.0)
    leaving = effect.recovery * (-distance - spacing).clamp(min=0.0)
    return _Pairs(arm, normal, torch.where(mass > 0, share, 0.0), leaving, mass, nodes.share.unsqueeze(-1))


def _steps(pairs: _Pairs, solids: _Solids) -> tuple[Tensor, Tensor]:
    """Return the change of u per speed that is missed, along the normal and across it, shape (B, K, R, 1)."""
    a = cross(pairs.arm, pairs.normal)
    square = dot(a, solids.turned(a))
    along = torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)
    across = solids.agile.amax(-1, keepdim=True).clamp(min=torch.finfo(a.dtype).tiny).sqrt() * safe_norm(pairs.arm)
    weight = pairs.share * pairs.mass
    one = pairs.answer * pairs.share.sum(1, keepdim=True) + solids.light * weight.sum(2, keepdim=True)
    there = pairs.share > 0

    def step(lever: Tensor) -> Tensor:
        whole = one + lever * (weight * lever).sum(2, keepdim=True)
        return torch.where(there, pairs.share / torch.where(there, whole, 1.0), 0.0)

    return step(along), step(across)


def _sweep(pairs: _Pairs, solids: _Solids, vel: Tensor, sweeps: int) -> Tensor:
    """Return the velocities that bodies give to nodes [m/s], shape (B, K, R, 3).

    Args:
        pairs: bodies and nodes.
        solids: the bodies.
        vel: velocities of the nodes before [m/s], shape (B, R, 3).
        sweeps: projected Jacobi sweeps.
    """
    along, across = _steps(pairs, solids)
    normal, rubbed = torch.zeros_like(pairs.share), torch.zeros_like(pairs.arm)
    u, wanted = rubbed, None
    for _ in range(sweeps):
        push, torque = _felt(pairs, u)
        there = vel.unsqueeze(1) + pairs.answer * u.sum(1, keepdim=True)
        moved = solids.vel + solids.light * push
        apart = there - moved - cross(solids.omega + solids.turned(torque), pairs.arm)
        parting = dot(apart, pairs.normal)
        if wanted is None:
            wanted = (1 - pairs.share) * parting.clamp(max=0.0) + pairs.leaving
        normal = (normal + along * (wanted - parting)).clamp(min=0.0)
        slip = apart - parting * pairs.normal
        rubbed = friction_force(rubbed - across * slip, normal, solids.mu_s, solids.mu_k)
        u = normal * pairs.normal + rubbed
    return u


def _felt(pairs: _Pairs, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return impulses [N s] and angular impulses [N m s] on bodies, shape (B, K, 1, 3)."""
    impulse = -pairs.mass * u
    return impulse.sum(2, keepdim=True), cross(pairs.arm, impulse).sum(2, keepdim=True)


def exchange(
    effect: BodyMpmCoupling, grid: Grid, nodes: Nodes, motion: PredictedBodyMotion, batch: Sequence[int]
) -> tuple[Tensor, Tensor, Nodes, Tensor]:
    """Return impulses [N s] and angular impulses [N m s] on bodies (B, K, 3), the nodes after it, and what was lost.

    Args:
        effect: static choices.
        grid: box and nodes.
        nodes: the grid with what moves it but for the bodies.
        motion: the bodies.
        batch: axes of the scenes, B of them.
    """
    solids, near, chosen = _solids(motion, batch), nodes, None
    lost = nodes.mass.new_zeros(nodes.mass.shape[0], 1)
    if 0 < effect.room < nodes.mass.shape[1]:
        reach, room = effect.reach * grid.spacing, effect.room
        if body_broad_phase_op.kernel_fits(motion):
            chosen, lost = body_broad_phase_op.choose(motion, grid, nodes, batch, reach, room)
        else:
            chosen, lost = _chosen(motion, solids, nodes, places(grid, nodes), reach, room)
        index = chosen.unsqueeze(-1).expand(-1, -1, 3)
        near = tree.replace(nodes, mass=nodes.mass.gather(1, chosen), vel=nodes.vel.gather(1, index))
    if body_coupling_op.kernel_fits(motion):
        numbers = chosen
        if numbers is None:
            numbers = torch.arange(nodes.mass.shape[1], device=nodes.mass.device).expand(nodes.mass.shape)
        law = (effect.reach, RAMP, effect.recovery)
        push, torque, given = body_coupling_op.exchange(motion, grid, near, numbers, batch, effect.sweeps, law)
    else:
        pairs = _pairs(effect, motion, solids, near, places(grid, near, chosen), grid.spacing)
        u = _sweep(pairs, solids, near.vel, effect.sweeps)
        push, torque = (x.squeeze(2) for x in _felt(pairs, u))
        given = (pairs.answer * u.sum(1, keepdim=True)).squeeze(1)
    vel = nodes.vel + given if chosen is None else nodes.vel.scatter_add(1, index, given)
    return push, torque, tree.replace(nodes, vel=vel), lost


def couple_bodies_to_particles(
    effects: Sequence[Effect], motion: PredictedBodyMotion, material_points: PredictedParticles, push: ContactForces
) -> ContactForces:
    """Return what is exerted once bodies and matter have met; `push` itself if no effect lets them do so."""
    for effect in effects:
        if isinstance(effect, BodyMpmCoupling):
            push = effect.couple_bodies_to_particles(motion, material_points, push)
    return push
