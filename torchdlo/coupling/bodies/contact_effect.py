"""Contact among rigid bodies: no overlap, rebound, Coulomb friction.

Per substep, on a fixed number of points of each pair of bodies (see `balls`):

1.  Where bodies would go without contact gives the displacement d = d0 of a pair at each point.
2.  No overlap at the end: n . d >= b, where b is minus the gap, a share of an overlap that is there already (at most
    0.1 m/s times the substep, as bodies keep the speed with which they part), or what a rebound asks for. A contact
    presses with r max(0, b - n . d), r being so large that b is met to 1e-4 of an impact.
3.  A contact that slips by s sticks with -r s while that is at most mu_s times the normal force, else it slides with
    mu_k times the normal force against s.
4.  The displacements q of the free bodies that these forces make solve M q = sum J^T f(d0 + J q). All contacts of a
    scene are coupled through one linear system of six unknowns per body, so that stacks stand at once and need no
    warm start. Rounds choose which contacts press and which stick; sliding friction is taken as resistance
    mu_k p / |s| meanwhile, which cannot overshoot.
5.  A step with the exact gradient ends at the solution, as rounds may leave what slides a tenth of its friction away
    from it; it is taken where that leaves less to do, or next to nothing. One more gives q its derivative by the
    implicit function theorem. Forces are those of the contacts in the sets of the last round, none pulls and none rubs
    by more than Coulomb allows.
6.  Rounds may end too early where many edges hit at once. Forces that would add energy are dropped then, and contacts
    press in proportion to how fast they approach, as much as fits in the mean: safe, but they may overlap a little.

Every force acts on both bodies at the same point, so that momentum and angular momentum are exact. Of two bodies, the
coefficients are combined by their harmonic mean: 0 on one side means 0.

Limits: contact points and normals are those at the start of the substep; bodies that cross in one substep are missed.
Rebounds of points that press at the same time are simultaneous (Newton's law of impact). Spinning about the normal
of a single point and rolling have no friction of their own.

Stewart and Trinkle 1996, doi:10.1002/(SICI)1097-0207(19960815)39:15<2673::AID-NME972>3.0.CO;2-I (time stepping);
Hintermueller, Ito, Kunisch 2002, doi:10.1137/S1052623401383558 (which contacts press: primal-dual active sets).
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies import contact_op
from torchdlo.coupling.bodies.contact_op import FIT, HARD
from torchdlo.coupling.bodies.contact_points import deepest_points
from torchdlo.coupling.bodies.contact_solver import BodySystem, Links, assembled, gather, inertia
from torchdlo.coupling.bodies.dynamics import Body, PredictedBodyMotion
from torchdlo.coupling.common.coulomb_friction import overlap_recovery, rebound_separation, separation_needed
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, Effect, EffectKind, PredictedMotion, Values
from torchdlo.physics.linalg.numerics import dot, safe_norm
from torchdlo.physics.rod.kinematics import View


def _combined(x: Tensor, pairs: tuple[tuple[int, int], ...], counts: tuple[int, ...]) -> Tensor:
    """Return the harmonic mean of two bodies' coefficients, shape (..., C, 1)."""
    a, b = (gather(x, pairs, counts, side) for side in (0, 1))
    both = a + b
    return 2 * a * b / torch.where(both > 0, both, 1.0)


def _links(contact: BodyContact, motion: PredictedBodyMotion) -> Links:
    state, params, pairs = motion.state, motion.params, contact.chosen(motion.bodies)
    found, counts = deepest_points(motion, pairs, contact.points)
    near, far = (found.point - gather(state.pos, pairs, counts, side) for side in (0, 1))
    at = [tuple(gather(x, pairs, counts, side) for side in (0, 1)) for x in (motion.mobility, params.restitution)]
    like = found.gap
    links = Links(
        pairs,
        counts,
        motion.bodies,
        found.normal,
        (near, far),
        like,
        found.normal,
        _combined(params.mu_s, pairs, counts),
        _combined(params.mu_k, pairs, counts),
        (HARD / (at[0][0] + at[0][1])).detach(),
    )
    free = links.seen(motion.change, motion.turn)
    approach = -dot(found.normal, links.seen(state.vel, state.omega))
    # What parts in a step keeps the speed with which it does.
    wanted = separation_needed(found.gap, like.new_tensor(contact.shallow), contact.recovery)
    wanted = overlap_recovery(wanted, motion.dt)
    pressed = (dot(found.normal, free) < wanted).to(like.dtype)
    bouncing = _combined(params.restitution, pairs, counts)
    wanted = rebound_separation(wanted, pressed, approach, bouncing, contact.slowest, motion.dt)
    return dataclasses.replace(links, wanted=wanted, free=free)


@dataclass(frozen=True)
class _Sets:
    """Which contacts press and how they rub; without derivative."""

    press: Tensor
    """1 if a contact presses, else 0 [1], shape (..., C, 1)."""
    slides: Tensor
    """1 if it slides, 0 if it sticks [1], shape (..., C, 1)."""
    drag: Tensor
    """Friction over slip: that of sticking, or the mean resistance of sliding [N/m], shape (..., C, 1)."""
    slip: Tensor
    """Direction of the slip [1], shape (..., C, 3)."""


def _slip(links: Links, moved: Tensor) -> tuple[Tensor, Tensor]:
    """Return length [m] and direction of the part of motions (..., C, 3) along the surfaces."""
    # Contacts that stick slip by load over stiffness, less than what a length may be: it is measured as a force.
    force = links.stiff * (moved - dot(links.normal, moved) * links.normal)
    size = safe_norm(force)
    return size / links.stiff, force / torch.where(size > 0, size, 1.0)


def _choose(links: Links, sets: _Sets, moved: Tensor) -> _Sets:
    """Return which contacts press and slide, after those of the last round moved points by `moved` (..., C, 3).

    Of a pair that sticks, friction is shared among its points like the load, so that they begin to slide together.
    """
    over = links.wanted - dot(links.normal, moved)
    # What overlaps because nothing pressed there will press about as it would alone.
    load = links.stiff * over.clamp(min=0.0) * (sets.press + (1 - sets.press) / HARD)
    size, slip = _slip(links, moved)
    freely, _ = _slip(links, links.free)
    rubs, whole = links.summed(sets.drag * size), links.summed(load)
    firm_drag = links.stiff * load * links.summed(torch.ones_like(load)) / torch.where(whole > 0, whole, 1.0)
    # Without the others, the slip of a pair would fall from `freely` in proportion to its friction: at first by what
    # the bodies would move if they did not turn, then by what was seen.
    limit = links.mu_k * load
    most = links.summed(limit)
    share = most / torch.where(rubs > 0, rubs, 1.0)
    known = torch.maximum(freely, size) * (1 - share) + size * share
    aimed = torch.where(rubs > 0, known, size - most * HARD / links.stiff)
    sticks = torch.where(sets.slides > 0, aimed * firm_drag < limit, rubs <= links.mu_s * whole)
    drag = torch.where(sticks, firm_drag, limit / aimed.clamp(min=1e-30))
    # Where a pair was taken to stick but slides, that pulled or pressed too much: its points stay in.
    misled = (sets.press > 0) & (sets.slides == 0) & ~sticks
    return _Sets(((over > 0) | misled).to(over.dtype), (~sticks).to(over.dtype), drag, slip)


def _slopes(links: Links, sets: _Sets, load: Tensor | None, size: Tensor | None) -> Tensor:
    """Return by how much forces fall with the motion of points [N/m], shape (..., C, 3, 3).

    Args:
        links: the contacts.
        sets: which of them press and slide.
        load: normal forces [N], for the exact gradient of sliding friction; None for its mean resistance.
        size: slip [m], likewise.
    """
    n = links.normal.unsqueeze(-1)
    t = sets.slip.unsqueeze(-1)
    press, drag = (x.unsqueeze(-1) for x in (links.stiff * sets.press, sets.drag))
    across = torch.eye(3, dtype=n.dtype, device=n.device) - n @ n.mT
    gradient = press * (n @ n.mT) + drag * across
    if load is None or size is None:
        return gradient
    mu, slides = links.mu_k.unsqueeze(-1), sets.slides.unsqueeze(-1)
    turning = mu * load.unsqueeze(-1) / size.unsqueeze(-1).clamp(min=1e-30) * (across - t @ t.mT)
    return gradient + slides * (turning - drag * across - mu * press * (t @ n.mT))


def _forces(links: Links, sets: _Sets, moved: Tensor) -> Tensor:
    """Return forces on the first body of each pair at a motion of their points, within what Coulomb allows [N]."""
    load = (links.stiff * sets.press * (links.wanted - dot(links.normal, moved))).clamp(min=0.0)
    size, along = _slip(links, moved)
    # A contact that sticks may rub by mu_s of its load, one that slides by mu_k.
    limit = torch.where(sets.slides > 0, links.mu_k, links.mu_s) * load
    # What sticks is held along its slip, not along the direction of that: bodies at rest have none.
    sticks = (sets.slides <= 0) & (sets.drag * size <= limit)
    held = sets.drag * (moved - dot(links.normal, moved) * links.normal)
    return load * links.normal - torch.where(sticks, held, limit * along)


def _settled(system: BodySystem, dt: float, slowest: float, rounds: int) -> tuple[_Sets, Tensor]:
    """Return which contacts press and slide, and the displacements of the free bodies, shape (..., F, 6)."""
    links = system.links
    near = (links.wanted - dot(links.normal, links.free) > -slowest * dt).to(links.wanted.dtype)
    sets = _Sets(near, torch.ones_like(near), torch.zeros_like(near), torch.zeros_like(links.normal))
    for _ in range(rounds):
        gradients = _slopes(links, sets, None, None)
        stays = links.stiff * sets.press * links.wanted * links.normal - (gradients @ links.free.unsqueeze(-1)).squeeze(
            -1
        )
        q = system.solve(gradients, system.load(stays))
        sets = _choose(links, sets, system.moved(q))
    return sets, q


def _exact(system: BodySystem, sets: _Sets, q: Tensor) -> tuple[_Sets, Tensor]:
    """Return the sets with the slip, and the gradients (..., C, 3, 3) of forces, at displacements q (..., F, 6)."""
    links, moved = system.links, system.moved(q)
    load = (links.stiff * sets.press * (links.wanted - dot(links.normal, moved))).clamp(min=0.0)
    size, slip = _slip(links, moved)
    sets = dataclasses.replace(sets, slip=slip)
    return sets, _slopes(links, sets, load, size)


def _excess(system: BodySystem, sets: _Sets, q: Tensor) -> Tensor:
    """Return what contacts exert on the free bodies beyond what displaces them by q, shape (..., F, 6)."""
    force = _forces(system.links, sets, system.moved(q))
    return system.load(force) - (system.inertia @ q.unsqueeze(-1)).squeeze(-1)


def _detached(links: Links) -> Links:
    found = {f.name: getattr(links, f.name) for f in dataclasses.fields(links)}
    return Links(**{k: tree.detach(v) if isinstance(v, Tensor) or k == "arms" else v for k, v in found.items()})


def contact_forces(contact: BodyContact, motion: PredictedBodyMotion) -> tuple[Tensor, Tensor]:
    """Return forces [N] and torques about the centres of mass [N m] of contact on bodies, shape (..., K, 3) each."""
    force, torque = answer(contact, motion)
    return force, torque


def answer(contact: BodyContact, motion: PredictedBodyMotion, hold: bool = False) -> tuple[Tensor, ...]:
    """Return `contact_forces`, and if asked for how these fall with the displacement of each free body alone.

    The latter has shape (..., F, 6, 6) [N/m, N m/rad].
    """
    if contact_op.kernel_fits(motion):
        law = (contact.recovery, contact.shallow, contact.slowest)
        pairs = contact.chosen(motion.bodies)
        return contact_op.contact_wrench(motion, pairs, contact.points, contact.steps, law, hold)
    free = [k for k, b in enumerate(motion.bodies) if b.motion == "free"]
    links = _links(contact, motion)
    system = BodySystem(links, free, inertia(motion, free))
    with torch.no_grad():
        plain = BodySystem(_detached(links), free, system.inertia.detach())
        sets, q = _settled(plain, motion.dt, contact.slowest, contact.steps)
        sets, gradients = _exact(plain, sets, q)
        excess = _excess(plain, sets, q)
        ahead = q + plain.solve(gradients, excess)
        resisted = plain.inertia.diagonal(dim1=-2, dim2=-1)
        whole = plain.load(_forces(plain.links, sets, plain.moved(q)))
        off, left, most = (
            (x.square() / resisted).sum((-1, -2), keepdim=True) for x in (excess, _excess(plain, sets, ahead), whole)
        )
        # Where both are at rounding, it is taken too: else derivatives jump with the last bit of what is given.
        q = torch.where(left < off + torch.finfo(q.dtype).eps * most, ahead, q)
        sets, gradients = _exact(plain, sets, q)
    q = q + plain.solve(gradients, _excess(system, sets, q))
    force = _forces(links, sets, system.moved(q))
    # Where rounds ended before contacts were found, all press along their normals, by as much as fits at best.
    simple = (links.wanted - dot(links.normal, links.free)).clamp(min=0.0) * links.stiff / HARD * links.normal
    simple = simple * _fitting(links, motion, simple)
    found = _fitting(links, motion, force.detach()) > 1 - FIT
    wrench = links.exerted(torch.where(found, force, simple))
    if not hold:
        return wrench
    gradients = torch.where(found.unsqueeze(-1), _firmness(links, sets, system.moved(q)), 0.0)
    blocks = assembled(links, torch.zeros_like(system.inertia), gradients, free)[..., : 36 * len(free)]
    return *wrench, blocks.unflatten(-1, (len(free), 6, 6))


def _firmness(links: Links, sets: _Sets, moved: Tensor) -> Tensor:
    """Return by how much `_forces` fall with the motion of points [N/m], shape (..., C, 3, 3)."""
    load = (links.stiff * sets.press * (links.wanted - dot(links.normal, moved))).clamp(min=0.0)
    size, along = _slip(links, moved)
    mu = torch.where(sets.slides > 0, links.mu_k, links.mu_s)
    sticks = (sets.slides <= 0) & (sets.drag * size <= mu * load)
    drag = torch.where(sticks, sets.drag, mu * load / torch.maximum(size, mu * load / links.stiff).clamp(min=1e-30))
    press = links.stiff * sets.press * (load > 0)
    n, t = links.normal.unsqueeze(-1), torch.where(sticks, 0.0, along).unsqueeze(-1)
    press, drag, mu = (x.unsqueeze(-1) for x in (press, drag, mu))
    across = torch.eye(3, dtype=n.dtype, device=n.device) - n @ n.mT
    return press * (n @ n.mT) + drag * (across - t @ t.mT) - mu * press * (t @ n.mT)


def _fitting(links: Links, motion: PredictedBodyMotion, force: Tensor) -> Tensor:
    """Return the share of forces f at which f . (d0 + A f) = f . b n, shape (..., 1, 1).

    A f is by how much they make points move. The share is 1 for forces that solve contact without sliding, more for
    those that slide, and less for those that do too much and would add energy.
    """
    push, torque = links.exerted(force)
    answer = links.seen(motion.mobility * push, motion.turned(torque))
    asked = dot(force, links.wanted * links.normal - links.free).sum(-2, keepdim=True)
    done = dot(force, answer).sum(-2, keepdim=True)
    none = done <= 0
    return torch.where(none, 1.0, asked / torch.where(none, 1.0, done))


@dataclass(frozen=True)
class BodyContact(Effect):
    """Rigid bodies do not overlap, rebound, and rub with Coulomb friction; their numbers stand among theirs."""

    pairs: tuple[tuple[int, int], ...] | None = None
    """Bodies that may touch, by their places in the scene; None for all pairs of which one is free."""
    points: int = 8
    """Points per pair at most."""
    steps: int = 8
    """Choices of the contacts that press and stick, per substep."""
    recovery: float = 0.2
    """Share of a shallow overlap that a substep removes; a small one lets piles come to rest."""
    shallow: float = 1e-3
    """Overlap up to which only that share goes [m]."""
    slowest: float = 0.02
    """Approach below which nothing rebounds [m/s]."""

    name: ClassVar[str] = "body_contact"
    kind: ClassVar[EffectKind] = "force"
    is_contact: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name, least in (("points", 1), ("steps", 1), ("shallow", 0), ("slowest", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"BodyContact: {name} is {getattr(self, name)}; expected at least {least}")
        if not 0 < self.recovery <= 1:
            raise ValueError(f"BodyContact: recovery is {self.recovery}; expected a share above 0, up to 1")

    def check_pairs(self, bodies: tuple[Body, ...]) -> None:
        """Raise a `ValueError` if the pairs are not among the bodies of a scene."""
        for pair in self.pairs or ():
            there = len(set(pair)) == 2 and all(0 <= k < len(bodies) for k in pair)
            if not there or all(bodies[k].motion != "free" for k in pair):
                raise ValueError(f"BodyContact: pair {pair} is not two of the {len(bodies)} bodies, at least one free")
        flat = [b.name for b in bodies if b.shape == "mesh" and b.balls == 0]
        if flat:
            raise ValueError(f"BodyContact: meshes {flat} have no balls to touch others with; give Solid.balls")

    def chosen(self, bodies: tuple[Body, ...]) -> tuple[tuple[int, int], ...]:
        """Return the pairs that may touch."""
        if self.pairs is not None:
            return self.pairs
        every = itertools.combinations(range(len(bodies)), 2)
        return tuple(p for p in every if "free" in (bodies[p[0]].motion, bodies[p[1]].motion))

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> ContactForces:
        """Return the forces and torques on bodies."""
        return self.backing(motion.bodies)

    def backing(self, bodies: PredictedBodyMotion) -> ContactForces:
        """Return the forces and torques on bodies."""
        none = bodies.change.new_zeros(1, 3)
        if not self.backs(bodies):
            return ContactForces(none, none, none)
        return ContactForces(none, *contact_forces(self, bodies))

    def backs(self, bodies: PredictedBodyMotion) -> bool:
        """Return whether any may touch another one."""
        return bool(self.chosen(bodies.bodies))

    def backed(self, bodies: PredictedBodyMotion, push: ContactForces) -> PredictedBodyMotion:
        """Return where bodies would go under contact, and how it resists what moves them from there.

        Under the push bodies go by d1, and contact, to first order, exerts w - K (d - d1) where they go by d. That
        leads to (M + K) d = w + K d1 plus what is exerted, M their inertia.
        """
        free = [k for k, b in enumerate(bodies.bodies) if b.motion == "free"]
        force, torque, hold = answer(self, bodies.pushed(push), True)
        exerted, given = (
            torch.cat(pair, -1)[..., free, :].unsqueeze(-1)
            for pair in ((force, torque), (push.body_force, push.body_torque))
        )
        mass = inertia(bodies, free)
        under = torch.linalg.solve(mass, exerted + given)
        moved = torch.linalg.solve(mass + hold, exerted + hold @ under).squeeze(-1)
        there = moved.new_zeros(len(bodies.bodies), len(free))
        for j, k in enumerate(free):
            there[k, j] = 1.0
        change, turn = (there @ moved).split(3, -1)
        return dataclasses.replace(bodies, change=bodies.change + change, turn=bodies.turn + turn, hold=hold)
