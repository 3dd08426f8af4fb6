"""Contact among ropes, of a rope with itself and of ropes with each other.

An edge is a capsule: the points within a radius of a segment. Per substep, on a fixed list of pairs of edges:

1.  Closest points of the segments at the start of the substep, unit normal n from one to the other, gap g.
2.  Where vertices would go without contact: inertia, loads, and the tension of the last substep. With the shares w of
    the four corners in the closest points (negative on the second edge), the pair would move apart by n . sum w d.
3.  No overlap at the end: n . sum w d >= -g. It is the predicted gap that decides, and the sign of n comes from the
    start. Of an overlap that is there already, a share is removed, and all that is deeper than a tenth of the radius.
    Pairs that collide part with the coefficient of restitution.
4.  Friction: the slip of a pair is stopped if that takes no more than mu_s times the normal force, else the pair
    slides with mu_k times it, against the slip.
5.  Forces that do so are found by projected Jacobi sweeps. A pair answers with the inverse mass sum w_i W_i / m_i,
    W_i the sum of the shares of all pairs that press vertex i: the row sum of the matrix of the problem, so that sweeps
    converge for every pile and treat all pairs alike. Held vertices count as heavy ones, see `PredictedMotion.give`.
6.  The forces join the other loads; then the lengths of the edges are solved for as ever.

Implicit steps find these forces together with the lengths, by the stiff law of `physics.constraints.contact_penalty`
with the same points, directions and couples; `sweeps`, `rounds` and the kernel of forces belong to explicit ones.

Contact comes before the lengths and not after them: lengths stay exact, and the tension that presses ropes together is
in the prediction of the next substep, so a knot at rest has no overlap and does not creep. Nothing about a pair is
kept from one substep to the next.

Momentum is exact: normal forces act along the line between the points at which they act. Friction acts at the
surface, r n off the centreline; the couple that this makes is exerted by the corners, as the turn of the two edges that
takes the least energy, and the slip is measured without such a turn, so that ropes which turn together do not rub.
Ropes are not spun by friction: they slide and do not roll, and parallel ropes rub along but not across each other.

The derivative is the one of the step as computed: of normals, closest points, friction and inverse masses. It is
finite everywhere, and one-sided where a pair starts to touch or to slide.

C++ kernels do what the tensor operations below say, on the CPU and on CUDA devices, see `broad_phase_op` and
`rod_contact_op`.

Stewart and Trinkle 1996, doi:10.1002/(SICI)1097-0207(19960815)39:15<2673::AID-NME972>3.0.CO;2-I (velocity-level time
stepping); Tonge, Benevolenski, Voroshilov 2012, doi:10.1145/2185520.2185601 (Jacobi sweeps with split masses).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.common.coulomb_friction import (
    compared,
    friction_force,
    overlap_recovery,
    rebound_separation,
    separation_needed,
)
from torchdlo.coupling.rod_contact import broad_phase_op, rod_touch_op
from torchdlo.coupling.rod_contact import rod_contact_op as rod_pairs
from torchdlo.coupling.rod_contact.broad_phase import near_pairs
from torchdlo.coupling.rod_contact.closest_points import closest_points
from torchdlo.coupling.rod_contact.rod_contact_op import WEAK
from torchdlo.physics import tree
from torchdlo.physics.constraints.contact_penalty import Pairs
from torchdlo.physics.effects.base import Effect, EffectKind, Param, PredictedMotion, Values
from torchdlo.physics.linalg.gather_scatter import Four, columns, corners, drop, pick
from torchdlo.physics.linalg.numerics import added, cross, dot, safe_norm
from torchdlo.physics.rod.kinematics import View


@tree.struct
class Contacts:
    """Pairs of edges at the start of a substep."""

    real: Tensor
    """1 for pairs, 0 where the list has room left [1], shape (..., K, 1)."""
    weight: Four
    """Shares of the corners in the closest points, negative on the second edge [1], shape (..., K, 1) each."""
    normal: Tensor
    """Unit vectors from the second edge to the first; zero where the centrelines meet [1], shape (..., K, 3)."""
    distance: Tensor
    """Distance of the closest points [m], shape (..., K, 1)."""
    gap: Tensor
    """Distance of the surfaces, negative if they overlap [m], shape (..., K, 1)."""


@tree.struct
class Forces:
    """What pairs exert."""

    normal: Tensor
    """Force that keeps surfaces apart [N], shape (..., K, 1)."""
    friction: Tensor
    """Friction on the first edge [N], shape (..., K, 3)."""


def _sum(a: Four, b: Four) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]


def find_contacts(found: Values, pos: Four, radius: Four) -> Contacts:
    """Return the geometry of pairs.

    Args:
        found: what `RodContact.broad_phase` returned.
        pos: positions of the corners [m], shape (..., K, 3) each.
        radius: radii of the edges that start at the corners [m], shape (..., K, 1) each.
    """
    s, t = closest_points((pos[0], pos[1]), (pos[2], pos[3]))
    weight = (1 - s, s, t - 1, -t)
    between = _sum(weight, pos)
    distance = safe_norm(between)
    apart = distance > 0
    normal = between / torch.where(apart, distance, 1.0)
    return Contacts(found["real"] * apart, weight, normal, distance, distance - radius[0] - radius[2])


@dataclass(frozen=True)
class _Couple:
    """How the corners of a pair exert the couple of its friction: as a rigid turn of each edge about its own centre.

    Edges cannot exert a couple about their own direction, so none along both of parallel ones: there, and only there,
    an opposite motion of the two edges balances the couple, and with it the friction across them.
    """

    arm: Four
    """Mass times lever of the corners, up to a factor, shape (..., K, 3) each."""
    inverse: tuple[Tensor, Tensor, Tensor]
    """Rows of the inverse of the moments of inertia, shape (..., K, 3) each."""

    def turn(self, couple: Tensor) -> Tensor:
        """Return the rigid turn that a couple makes, shape (..., K, 3)."""
        return columns([dot(row, couple) for row in self.inverse])

    def forces(self, couple: Tensor) -> Four:
        """Return forces on the corners, of no sum, that exert a couple [N], shape (..., K, 3) each."""
        turn = self.turn(couple)
        return tuple(cross(turn, arm) for arm in self.arm)

    def seen(self, change: Four) -> Tensor:
        """Return the rigid turn in displacements of the corners [rad], shape (..., K, 3)."""
        return self.turn(added(cross(arm, d) for arm, d in zip(self.arm, change, strict=True)))

    def softness(self, contacts: Contacts) -> Tensor:
        """Return by how much the couple adds to the slip under one newton at most [m/N], shape (..., K, 1)."""
        x, y, z = self.inverse
        n = contacts.normal
        whole = x[..., :1] + y[..., 1:2] + z[..., 2:]
        return contacts.distance.square() * (whole - dot(n, self.turn(n)))


def _couple(pos: Four, mass: Four) -> _Couple:
    """Return how corners at `pos` [m] with masses up to a factor exert couples."""
    first = (mass[0] * pos[0] + mass[1] * pos[1]) / (mass[0] + mass[1])
    second = (mass[2] * pos[2] + mass[3] * pos[3]) / (mass[2] + mass[3])
    share = (mass[0] + mass[1]) / (mass[0] + mass[1] + mass[2] + mass[3])
    own = (pos[0] - first, pos[1] - first, pos[2] - second, pos[3] - second)
    ahead, behind = (1 - share) * (first - second), -share * (first - second)
    apart = (ahead, ahead, behind, behind)
    # I = sum m (r.r 1 - r r^T), inverted by its cofactors. Corners on one line have no inertia about it.
    lever = tuple(o + WEAK**0.5 * a for o, a in zip(own, apart, strict=True))
    xx, yy, zz, xy, xz, yz = (
        sum(m * r[..., i : i + 1] * r[..., j : j + 1] for m, r in zip(mass, lever, strict=True))
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    little = (1e-14 if xx.dtype == torch.float64 else 1e-6) * (xx + yy + zz) + torch.finfo(xx.dtype).tiny ** 0.25
    a, b, c, d, e, f = yy + zz + little, xx + zz + little, xx + yy + little, -xy, -xz, -yz
    aa, ab, ac = b * c - f * f, e * f - d * c, d * f - b * e
    bb, bc, cc = a * c - e * e, d * e - a * f, a * b - d * d
    whole = a * aa + d * ab + e * ac
    rows = (columns([aa, ab, ac]), columns([ab, bb, bc]), columns([ac, bc, cc]))
    arm = tuple(m * (o + WEAK * a) for m, o, a in zip(mass, own, apart, strict=True))
    return _Couple(arm, tuple(row / whole for row in rows))


@dataclass(frozen=True)
class RodContact(Effect):
    """Ropes do not pass through each other or themselves, rebound, and rub with Coulomb friction.

    Pairs of edges of one rope with fewer than three steps between them are left out, and those that the rope, bent to
    its own radius, could not bring together.
    """

    sweeps: int = 3
    """Sweeps per round; more of them make piles harder and sticking ropes creep less."""
    rounds: int = 1
    """Rounds of contact and lengths per substep; more of them for impacts of a radius per substep and faster."""
    friction: bool = True
    """Whether ropes rub; False is cheaper than coefficients of 0."""
    room: int = 0
    """Pairs of edges per scene that there is room for; 0: two per slot and at least 64."""
    row: int = 64
    """Edges per row of three cells that tensor operations have room for, in scenes with many edges."""
    recovery: float = 0.2
    """Share of a shallow overlap that a substep removes; a small one lets piles come to rest."""
    burst: float | None = None
    """By how much vertices may speed up within a step, beside half their speed [m/s]; `State.diagnostics` tells if
    more. None: 1 m/s, and no more than half a radius in a step, so that thin ropes have room for their pairs."""
    slowest: float = 0.02
    """Approach below which nothing rebounds [m/s]; see `RodBody.slowest`."""
    left_out: tuple[tuple[int, int], ...] = ()
    """Pairs of edges, by their places in the scene, that overlap: those of two ropes next to their joint."""

    name: ClassVar[str] = "rod_contact"
    kind: ClassVar[EffectKind] = "force"
    is_contact: ClassVar[bool] = True
    engages: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "mu_s": Param(0.3, 0.0, 2.0, "1", "linear", 0.0, "Coefficient of static friction among ropes."),
        "mu_k": Param(0.3, 0.0, 2.0, "1", "linear", 0.0, "Coefficient of sliding friction among ropes."),
        "restitution": Param(0.0, 0.0, 1.0, "1", "linear", 0.0, "Speed of parting over speed of approach.", most=1.0),
    }

    def __post_init__(self) -> None:
        for name, least in (("sweeps", 1), ("rounds", 1), ("room", 0), ("row", 1), ("burst", 0), ("slowest", 0)):
            if getattr(self, name) is not None and not getattr(self, name) >= least:
                raise ValueError(f"RodContact: {name} is {getattr(self, name)}; expected at least {least}")
        if not 0 < self.recovery <= 1:
            raise ValueError(f"RodContact: recovery is {self.recovery}; expected a share above 0, up to 1")

    def broad_phase(self, view: View, carried: Tensor) -> Values:
        """Return the pairs that can touch within the step, and how far vertices may move until they miss some.

        Args:
            view: the rods when the step begins; its dt is the whole step.
            carried: how far held vertices are moved in it [m], shape (..., H, 3).
        """
        found = self._near(view, carried)
        if not self.left_out:
            return found
        at = torch.div(found["corners"], found["corners"].shape[:-2].numel(), rounding_mode="floor")
        kept = self.kept(view.topology.size, at[..., 0, :], at[..., 2, :]).to(found["real"])
        return found | {"real": tree.batch_innermost(found["real"] * kept.unsqueeze(-1))}

    def kept(self, size: int, first: Tensor, second: Tensor) -> Tensor:
        """Return whether pairs of edges are not left out, bool, shape (..., K); the scene has V = `size` slots."""
        table = torch.ones(size, size, dtype=torch.bool)
        for one, other in self.left_out:
            table[one, other] = table[other, one] = False
        return table.to(first.device)[first, second]

    def _near(self, view: View, carried: Tensor) -> Values:
        topology, pos, params = view.topology, view.state.pos, view.params
        room = self.room or max(64, 2 * topology.size)
        if broad_phase_op.ready(pos.device.type, pos.dtype):
            return broad_phase_op.find_candidates(view, carried, room, -1.0 if self.burst is None else self.burst)
        mean = view.state.vel.mean(-2, keepdim=True)
        fastest = safe_norm(view.state.vel - mean).amax(-2, keepdim=True)
        if carried.shape[-2]:
            fastest = torch.maximum(fastest, safe_norm(carried / view.dt - mean).amax(-2, keepdim=True))
        sudden: Tensor | float = view.dt * (1.0 if self.burst is None else self.burst)
        if self.burst is None:
            sudden = (0.5 * params.material.radius.amin(-2, keepdim=True)).clamp(max=view.dt)
        reach = (1.5 * view.dt * fastest + sudden).expand(*pos.shape[:-2], 1, 1)
        first, second, there, lost = near_pairs(topology, params, pos, reach, room, self.row)
        after = torch.tensor(topology.successor(), device=pos.device)
        at = corners(torch.stack([first, after[first], second, after[second]], -2))
        return {
            "corners": at,
            "real": tree.batch_innermost(there.to(pos.dtype).unsqueeze(-1)),
            "origin": pos,
            "reach": reach,
            "lost": lost.to(pos.dtype).unsqueeze(-1),
        }

    def capacity_overflow(self, pos: Tensor, values: Values) -> Tensor:
        """Return how many pairs found no room, and by how much vertices outran the broad phase [m], (..., 1, 2)."""
        if broad_phase_op.ready(pos.device.type, pos.dtype):
            return torch.cat([values["lost"], broad_phase_op.outrun_distance(pos, values)], -1).detach()
        moved = pos - values["origin"]
        far = safe_norm(moved - moved.mean(-2, keepdim=True)).amax(-2, keepdim=True)
        return torch.cat([values["lost"], (far - values["reach"]).clamp(min=0.0)], -1).detach()

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> Tensor:
        """Return the forces on vertices that keep ropes apart and rub [N], shape (..., V, 3)."""
        like = view.state.pos
        if rod_pairs.ready(like.device.type, like.dtype):
            law = (self.recovery, self.slowest)
            return rod_pairs.contact_forces(view, motion, values, sweeps=self.sweeps, friction=self.friction, law=law)
        _, forces, spread = self.solve(view, motion, values)
        return drop(spread(forces), values["corners"], view.topology.size)

    def engage(self, view: View, motion: PredictedMotion, values: Values) -> Pairs:
        """Return the pairs of edges that may touch in an implicit substep."""
        at, like = values["corners"], view.state.pos
        if rod_touch_op.ready(like.device.type, like.dtype):
            law = (self.recovery, self.slowest)
            return rod_touch_op.find_touches(view, motion, values, friction=self.friction, law=law)
        batch, size = at.shape[:-2], view.topology.size
        mass = 1 / motion.mobility.amax(-1, keepdim=True)
        parts = [like, motion.change, view.state.vel, view.params.material.radius, mass]
        widths = [p.shape[-1] for p in parts]
        picked = pick(columns([p.expand(*batch, size, p.shape[-1]) for p in parts]), at)
        pos, change, vel, radius, mass4 = zip(*(p.split(widths, -1) for p in picked), strict=True)
        contacts = find_contacts(values, pos, radius)
        wanted, _ = self._target(contacts, change, vel, values, view.dt, calm=True)
        n = contacts.normal
        unit = torch.eye(3, dtype=n.dtype, device=n.device)
        along = n.unsqueeze(-1) * n.unsqueeze(-2)
        linear = [w.unsqueeze(-1) * unit for w in contacts.weight]
        mu = torch.zeros_like(contacts.gap)
        if self.friction:
            couple = _couple(pos, mass4)
            # Couples of friction are exerted by the corners, and slip is measured without the turn of both edges.
            turn = (unit - along) @ _skew(contacts.distance * n) @ torch.stack(couple.inverse, -2)
            linear = [m + turn @ _skew(arm) for m, arm in zip(linear, couple.arm, strict=True)]
            slip = _sum(contacts.weight, vel)
            slip = slip - cross(couple.seen(vel), contacts.distance * n)
            slides = safe_norm(slip - n * dot(n, slip)).detach() > compared(self.slowest, 0.5 * (radius[0] + radius[2]))
            mu = torch.where(slides, values["mu_k"], values["mu_s"])
        return Pairs(at, contacts.real, n, 0.5 * (radius[0] + radius[2]), wanted, mu, tuple(linear))

    def solve(self, view: View, motion: PredictedMotion, values: Values):
        """Return the contacts, their forces, and a function that turns forces into those on the four corners."""
        at, size = values["corners"], view.topology.size
        batch = at.shape[:-2]
        like = view.state.pos
        mass = 1 / motion.mobility.amax(-1, keepdim=True)
        parts = [like, motion.change, view.state.vel, view.params.material.radius, mass]
        widths = [p.shape[-1] for p in parts]
        picked = pick(columns([p.expand(*batch, size, p.shape[-1]) for p in parts]), at)
        pos, change, vel, radius, mass4 = zip(*(p.split(widths, -1) for p in picked), strict=True)
        contacts = find_contacts(values, pos, radius)
        couple = _couple(pos, mass4) if self.friction else None

        def spread(forces: Forces) -> Four:
            if couple is None:
                return tuple(w * forces.normal * contacts.normal for w in contacts.weight)
            whole = forces.normal * contacts.normal + forces.friction
            back = couple.forces(cross(contacts.distance * contacts.normal, forces.friction))
            return tuple(w * whole - b for w, b in zip(contacts.weight, back, strict=True))

        wanted, pressed = self._target(contacts, change, vel, values, view.dt)
        softness = _softness(contacts, pressed, motion.give, 1 / mass, at, size)
        if couple is not None:
            softness = (softness[0], softness[1] + couple.softness(contacts))
        forces = Forces(torch.zeros_like(contacts.gap), torch.zeros_like(contacts.normal))
        for sweep in range(self.sweeps):
            if sweep:
                answered = motion.answer * drop(spread(forces), at, size)
                change = pick(motion.change + answered, at)
            forces = self._sweep(contacts, couple, forces, change, wanted, softness, values)
        return contacts, forces, spread

    def _target(
        self, contacts: Contacts, change: Four, vel: Four, values: Values, dt: float, calm: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Return by how much pairs have to part at least [m], and which of them would touch, shape (..., K, 1) each.

        Slowly, if that is asked for.
        """
        # Overlaps are shallow up to a tenth of the radius.
        wanted = separation_needed(contacts.gap, 0.05 * (contacts.distance - contacts.gap), self.recovery)
        wanted = overlap_recovery(wanted, dt) if calm else wanted
        pressed = contacts.real * (dot(contacts.normal, _sum(contacts.weight, change)) < wanted)
        approach = -dot(contacts.normal, _sum(contacts.weight, vel))
        slowest = compared(self.slowest, 0.5 * (contacts.distance - contacts.gap)) if calm else self.slowest
        return rebound_separation(wanted, pressed, approach, values["restitution"], slowest, dt), pressed

    def _sweep(
        self,
        contacts: Contacts,
        couple: _Couple | None,
        forces: Forces,
        change: Four,
        wanted: Tensor,
        softness: tuple[Tensor, Tensor],
        values: Values,
    ) -> Forces:
        """Return the forces after one projected Jacobi sweep."""
        apart = _sum(contacts.weight, change)
        along = dot(contacts.normal, apart)
        mobile = contacts.real * (softness[0] > 0)
        give = torch.where(mobile > 0, softness[0], 1.0)
        normal = (forces.normal + mobile * (wanted - along) / give).clamp(min=0.0)
        if couple is None:
            return Forces(normal, forces.friction)
        slip = apart - cross(couple.seen(change), contacts.distance * contacts.normal)
        slip = slip - contacts.normal * dot(contacts.normal, slip)
        trial = forces.friction - contacts.real * slip / torch.where(contacts.real > 0, softness[1], 1.0)
        return Forces(normal, friction_force(trial, normal, values["mu_s"], values["mu_k"]))


def _skew(r: Tensor) -> Tensor:
    """Return the matrices of r x, shape (..., 3, 3)."""
    x, y, z = r.unbind(-1)
    none = torch.zeros_like(x)
    return torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))


def _softness(
    contacts: Contacts, pressed: Tensor, give: Tensor, free: Tensor, at: Tensor, size: int
) -> tuple[Tensor, Tensor]:
    """Return how far pairs part or slip at most under one newton on every pressed pair [m/N], shape (..., K, 1) each.

    Args:
        contacts: the pairs.
        pressed: 1 where a pair would touch, shape (..., K, 1).
        give: that of `PredictedMotion`.
        free: the same as if none were held.
        at: corners of the pairs.
        size: number of vertices.
    """
    weight = tuple(w.abs() for w in contacts.weight)
    load = drop(tuple(w * pressed for w in weight), at, size)
    four = pick(columns([load * give, load * free, give.expand_as(load), free.expand_as(load)]), at)
    mine = 1 - pressed
    normal = added(w * (c[..., :1] + mine * w * c[..., 2:3]) for w, c in zip(weight, four, strict=True))
    slip = added(w * (c[..., 1:2] + mine * w * c[..., 3:]) for w, c in zip(weight, four, strict=True))
    return normal, slip
