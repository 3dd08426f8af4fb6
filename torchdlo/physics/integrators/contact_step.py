"""One implicit substep of ropes that touch: positions, tensions, free bodies and forces of contact in one solve.

The equations are those of `edge_lengths.balance` with the forces of `contact_penalty` among them. Points on fixed and
driven surfaces fill blocks of 3 x 3 on and beside the diagonal, within the band that bending needs; free bodies add a
border of six unknowns each, which their Schur complement takes out; pairs of edges that touch add three each, which
`linalg.low_rank` takes out by Woodbury's formula. Newton's method runs without graph until each scene
is solved; scenes that are not are tried again with softer contact. Points that are joined to bodies or other ropes
(`joint_points`) add three unknowns each to the border. One more step, with graph, gives the derivative of
the implicit function theorem, and what is left of the equations is reported.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.constraints import contact_penalty as penalty
from torchdlo.physics.constraints import joint_points
from torchdlo.physics.constraints.contact_penalty import HARD, Pairs, Touch
from torchdlo.physics.constraints.edge_lengths import Inertia, Lengths, LengthSystem, saddle_order
from torchdlo.physics.constraints.joint_points import JointPoints
from torchdlo.physics.integrators import contact_kernel
from torchdlo.physics.integrators.observed_contact import SolvedContact, observing
from torchdlo.physics.linalg import banded, gather_scatter, low_rank
from torchdlo.physics.linalg.numerics import added, dot
from torchdlo.physics.rod.topology import Topology, following, parse, preceding

TRIES = ((HARD, 10), (0.1 * HARD, 24), (0.01 * HARD, 24))
"""How hard contact is, and Newton steps at most, of what is tried one after the other."""
STALLED = 0.9, 10.0
"""A scene counts as solved, too, if a step leaves more than this share of what was left before it, and less than so
many times what may be left: that is rounding, which neither more steps nor softer contact makes less."""
_FIELDS = tuple(field.name for field in dataclasses.fields(Touch))


def _solved(like: Tensor) -> float:
    """Return what may be left of the equations, as a share of the forces, before the last steps."""
    return 1e-6 if like.dtype == torch.float64 else 1e-3


@dataclass(frozen=True)
class Unknowns:
    """What Newton's method looks for."""

    pos: Tensor
    """Positions [m], shape (..., V, 3)."""
    impulse: Tensor
    """Tensions times `scale` [N s^2], shape (..., V, 1)."""
    bodies: Tensor
    """By how much contact and joints move and turn free bodies [m, rad], shape (..., J, 6)."""
    joints: Tensor
    """Forces of joints on the ropes times `scale` [N s^2], shape (..., A, 3)."""


@dataclass(frozen=True)
class Touching:
    """The equations."""

    system: LengthSystem
    touch: Touch
    origin: Tensor
    """Positions at the start of the substep [m], shape (..., V, 3)."""
    pairs: Pairs | None
    """Edges of ropes that may touch each other."""
    dt: float
    """Substep [s]."""
    joints: JointPoints | None = None
    """Points that are joined."""

    def firm(self, tension: Tensor, hard: Tensor) -> Tensor:
        """Return the stiffness of points times `scale` [kg], (..., 1, V, 1), for a hardness (..., 1, 1)."""
        system = self.system
        topology, inertia = system.lengths.topology, system.inertia
        pulled = (system.lengths.guess(tension) * system.scale).clamp(min=0.0) * system.lean
        mass = inertia.vertex.amin(-1, keepdim=True) + inertia.bands(topology)[0]
        mass = mass + pulled + preceding(topology, pulled)
        mobile = torch.where(system.free > 0, mass, torch.inf)
        least = torch.minimum(mobile, following(topology, mobile))
        least = torch.where(least < torch.inf, least, mass)
        return (hard * least).unsqueeze(-3)

    def feel_pairs(self, pos: Tensor, firm: Tensor) -> tuple[Tensor | float, penalty.PairsFelt | None]:
        """Return what pairs exert on vertices at positions, times `scale` [N s^2], (..., V, 3), and what they feel."""
        if self.pairs is None:
            return 0.0, None
        at, size = self.pairs.at, self.system.lengths.topology.size
        one, _, other, _ = gather_scatter.pick(firm.squeeze(-3), at)
        felt = penalty.feel_pairs(
            self.pairs, torch.minimum(one, other), gather_scatter.pick(pos - self.origin, at), self.dt
        )
        return gather_scatter.drop(felt.forces, at, size), felt

    def newton_step(
        self, now: Unknowns, firm: Tensor, linear: tuple[Tensor, ...], exact: bool
    ) -> tuple[Unknowns, Tensor]:
        """Return the unknowns after a step, and what was left of the equations before it [1], shape (..., 1, 1)."""
        system, lengths, inertia = self.system, self.system.lengths, self.system.inertia
        topology, free, scale, count = lengths.topology, system.free, system.scale, self.touch.of.shape[-1]
        y, push, excess, along, along_start = system.residual(now.pos, now.impulse)
        felt = penalty.feel(topology, self.touch, linear, firm, now.pos - self.origin, now.bodies, self.dt)
        between, pairs = self.feel_pairs(now.pos, firm)
        joined = 0.0 if self.joints is None else self.joints.pulls(now.joints)
        forces = inertia.vertex * y - free * (push + felt.force + between + joined)
        resist = self.touch.resist * scale.unsqueeze(-1)
        wrenches = (resist @ now.bodies.unsqueeze(-1)).squeeze(-1) - felt.wrench
        shapes = [forces.shape[:-2], excess.shape[:-2], resist.shape[:-3], firm.shape[:-3]]
        batch = torch.broadcast_shapes(*shapes, *([] if self.joints is None else [self.joints.batch]))
        end, gap = None, None
        if self.joints is not None:
            wrenches = wrenches - self.joints.wrench(now.joints)
            end = self.joints.orientation(now.bodies, self.dt)
            gap = self.joints.gap(now.pos, now.bodies, end)
        with torch.no_grad():
            gradient = penalty.gradients(topology, self.touch, linear, felt, exact)
            entries = self._entries(batch, now.impulse, gradient, along_start, along)
            rank = None if pairs is None else self._rank(batch, pairs, exact)
            border = self._border(batch, now, gradient, resist, end)
            answer, schur = _bordered(batch, entries, rank, border, topology)
        step = _solve(entries, rank, -_stacked(batch, forces, excess), topology)
        bodies, joints = now.bodies.expand(*batch, count, 6), now.joints.expand(*batch, *now.joints.shape[-2:])
        turned, tied = torch.zeros_like(bodies), torch.zeros_like(joints)
        if border.own.shape[-1]:
            rows = [x.expand(*batch, *x.shape[-2:]).flatten(-2) for x in (wrenches, gap) if x is not None]
            load = -torch.cat(rows, -1).reshape(-1, border.own.shape[-1], 1)
            load = load - border.row @ step[: 3 * topology.size].T.unsqueeze(-1)
            moved = torch.linalg.solve(schur, load)
            step = step - (answer @ moved).squeeze(-1).T
            moved = moved.reshape(*batch, -1)
            turned = moved[..., : 6 * count].reshape(*batch, count, 6)
            tied = moved[..., 6 * count :].reshape(joints.shape)
        cut = 3 * topology.size
        change, pull = _slots(step[:cut], batch, 3), _slots(step[cut:], batch, 1)
        with torch.no_grad():
            turn = lengths.active * (following(topology, change) - change) / lengths.rest
            most = dot(turn, turn).amax(-2, keepdim=True).sqrt()
            short = (1 / most.clamp(min=1e-9)).clamp(max=1.0)
            sizes = [inertia.vertex * y, scale * system.force, felt.force, now.impulse * along_start]
            sizes += [x for x in (between, joined) if isinstance(x, Tensor)]
            # Far from contact and loads, what is left is small beside the momentum.
            carried = 1e-3 * (system.moved - self.origin) + 1e-9 * lengths.rest
            sizes.append(inertia.vertex * carried)
            left = _left(forces, sizes, excess, lengths.rest).expand(*batch, 1, 1)
            if gap is not None:
                edge = torch.where(lengths.edge_mask > 0, lengths.rest, torch.inf).amin(-2, keepdim=True)
                left = torch.maximum(left, gap.abs().amax((-2, -1), keepdim=True) / edge)
        found = now.pos + short * change, now.impulse + short * pull, bodies + short * turned, joints + short * tied
        return Unknowns(*found), left

    def _border(
        self,
        batch: tuple[int, ...],
        now: Unknowns,
        gradient: penalty.ContactGradients,
        resist: Tensor,
        end: Tensor | None,
    ) -> _Border:
        """Return how equations of vertices, of bodies and of joints hang together; N scenes in a row."""
        joints, v, count = self.joints, self.system.lengths.topology.size, self.touch.of.shape[-1]
        free = self.system.free.unsqueeze(-1)
        columns, rows = [free * gradient.border] if count else [], [gradient.back] if count else []
        own = penalty.blocks(resist) + gradient.corner if count else resist.new_zeros(0, 0)
        if joints is not None:
            unit = torch.eye(3, dtype=free.dtype, device=free.device)
            held = (joints.weight.mT[:, None, :, None] * unit[:, None]).flatten(-2)
            columns.append(-free * held)
            rows.append(held.mT)
            none = own.new_zeros(3 * joints.count, 3 * joints.count)
            sides = own, joints.levers(), -joints.reach(now.bodies, tree.part(end), self.dt), none
            shape = torch.broadcast_shapes(*(x.shape[:-2] for x in sides))
            own, lever, reach, none = (x.expand(*shape, *x.shape[-2:]) for x in sides)
            own = torch.cat([torch.cat([own, lever], -1), torch.cat([reach, none], -1)], -2)
        size, axes = own.shape[-1], range(len(batch))
        if not size:
            return _Border(own, own, own)
        column = torch.cat([x.expand(*batch, v, 3, x.shape[-1]) for x in columns], -1)
        row = torch.cat([x.expand(*batch, v, x.shape[-2], 3) for x in rows], -2)
        column = column.permute(-2, -3, -1, *axes).reshape(3 * v, -1)
        return _Border(
            torch.cat([column, column.new_zeros(v, column.shape[1])]),
            row.permute(*axes, -2, -1, -3).reshape(-1, size, 3 * v),
            own.expand(*batch, size, size).reshape(-1, size, size),
        )

    def _entries(
        self,
        batch: tuple[int, ...],
        impulse: Tensor,
        gradient: penalty.ContactGradients,
        along_start: Tensor,
        along: Tensor,
    ) -> Tensor:
        """Return the entries of the banded matrix, see `_pattern`."""
        system, lengths, inertia = self.system, self.system.lengths, self.system.inertia
        topology, free, scale = lengths.topology, system.free, system.scale
        same, one, two = inertia.bands(topology)
        string = impulse * system.lean
        after, active = following(topology, free), lengths.active
        soft = lengths.yielding(impulse / scale)[1] + lengths.shift * tree.part(lengths.give)
        unit = torch.eye(3, dtype=along.dtype, device=along.device)
        own = (same + string + preceding(topology, string)).unsqueeze(-1) * unit + gradient.same
        beside = (one - string).unsqueeze(-1) * unit
        own = torch.diag_embed(inertia.vertex) + free.unsqueeze(-1) * own
        onward = free.unsqueeze(-1) * (beside + gradient.after)
        back = free.unsqueeze(-1) * penalty.moved(topology, beside + gradient.before)
        return _stacked(
            batch,
            own.flatten(-2),
            onward.flatten(-2),
            back.flatten(-2),
            free * two,
            free * preceding(topology, preceding(topology, two)),
            -free * active * along_start,
            after * active * along_start,
            -active * along,
            active * along,
            -active * (lengths.compliance + soft) / scale + (active - 1),
        )

    def _rank(self, batch: tuple[int, ...], felt: penalty.PairsFelt, exact: bool) -> low_rank.LowRank:
        """Return what pairs add to the matrix."""
        pairs = self.pairs
        assert pairs is not None
        gradient = penalty.pair_gradient(pairs, felt, exact)
        free = gather_scatter.pick(self.system.free, pairs.at)
        shape = (*batch, pairs.at.shape[-1])

        def flat(x: Tensor) -> Tensor:
            return tree.stored(x.flatten(-2).expand(*shape, 9)).reshape(3, 3, shape[-1], -1)

        at = tree.stored(pairs.at.expand(*batch, *pairs.at.shape[-2:])).transpose(0, 1)
        scenes = pairs.at.shape[:-2].numel()
        vertex = torch.div(at.reshape(4, shape[-1], -1), scenes, rounding_mode="floor")
        left = torch.stack([flat(f.unsqueeze(-1) * m.mT) for f, m in zip(free, pairs.linear, strict=True)])
        right = torch.stack([flat(gradient @ m) for m in pairs.linear])
        return low_rank.LowRank(vertex.contiguous(), left, right)

    def start(self, tension: Tensor) -> Unknowns:
        """Return the first guess: no forces but the last tensions."""
        system, count = self.system, self.touch.of.shape[-1]
        parts = [system.moved.shape[:-2], tension.shape[:-2], self.touch.wanted.shape[:-3]]
        parts += [] if self.joints is None else [self.joints.batch]
        batch = torch.broadcast_shapes(*parts, *([] if self.pairs is None else [self.pairs.at.shape[:-2]]))
        impulse = (system.lengths.guess(tension) * system.scale).detach()
        tied = system.moved.new_zeros(0, 3) if self.joints is None else (self.joints.force * system.scale).detach()
        return Unknowns(
            system.moved.detach().expand(*batch, *system.moved.shape[-2:]),
            impulse.expand(*batch, *impulse.shape[-2:]),
            system.moved.new_zeros(*batch, count, 6),
            tied.expand(*batch, *tied.shape[-2:]),
        )


def _left(forces: Tensor, sizes: Sequence[Tensor], excess: Tensor, rest: Tensor) -> Tensor:
    """Return what is left of the equations over what is in them, and of lengths over lengths [1], shape (..., 1, 1)."""
    size = added(x.abs() for x in sizes)
    left = forces.abs().amax((-2, -1), keepdim=True) / size.amax((-2, -1), keepdim=True).clamp(min=1e-30)
    return torch.maximum(left, (excess.abs() / rest).amax(-2, keepdim=True))


@dataclass(frozen=True)
class _Border:
    """What displacements of bodies and forces of joints add to the banded system, n unknowns in all."""

    column: Tensor
    """How equations of vertices and lengths feel them [-], shape (4 V, n N)."""
    row: Tensor
    """How their equations feel vertices [-], shape (N, n, 3 V)."""
    own: Tensor
    """How their equations feel them [-], shape (N, n, n)."""


def _bordered(
    batch: tuple[int, ...], entries: Tensor, rank: low_rank.LowRank | None, border: _Border, topology: Topology
) -> tuple[Tensor, Tensor]:
    """Return how vertices and tensions answer to the border (N, 4 V, n), and the border's own matrix (N, n, n)."""
    size, v = border.own.shape[-1], topology.size
    if not size:
        return border.own, border.own
    many = None if rank is None else rank.repeat(size)
    answer = _solve(entries.repeat(1, size), many, border.column, topology)
    answer = answer.reshape(4 * v, size, -1).permute(2, 0, 1)
    return answer, border.own - border.row @ answer[:, : 3 * v]


def _solve(entries: Tensor, rank: low_rank.LowRank | None, rhs: Tensor, topology: Topology) -> Tensor:
    name = f"touching:{topology.name}"
    return banded.solve(entries, rhs, name) if rank is None else low_rank.solve(entries, rank, rhs, name)


def _stacked(batch: tuple[int, ...], *parts: Tensor) -> Tensor:
    """Stack (..., V, C) tensors as the rows of an (m, batch) matrix, component by component."""
    n = len(batch) + 2
    wide = (x.expand(*batch, *x.shape[-2:]).permute(n - 1, n - 2, *range(n - 2)) for x in parts)
    return torch.cat([x.reshape(x.shape[0] * x.shape[1], -1) for x in wide])


def _slots(rows: Tensor, batch: tuple[int, ...], components: int) -> Tensor:
    return tree.logical(rows.reshape(components, -1, *batch))


def solve_contact_step(touching: Touching, tension: Tensor) -> tuple[Tensor, ...]:
    """Return positions, tensions, forces, forces of contact, wrenches on free bodies, and what is left unsolved.

    Args:
        touching: the equations.
        tension: those of the last substep [N], shape (..., V, 1).

    Returns:
        Positions (..., V, 3) [m], tensions (..., V, 1) [N], forces on vertices with tension, hinges and contact
        (..., V, 3) [N], those of contact alone (..., V, 3) [N], forces and torques on free bodies (..., J, 6), the
        share of the forces that is not in balance, shape (..., 1, 1), forces of joints on the ropes (..., A, 3) [N],
        and displacements and turns of free bodies, shape (..., J, 6).
    """
    system = touching.system
    if touching.joints is None and contact_kernel.available(system.force):
        *_, hard, pos, pulled, force, exerted, wrench, left = _searched(touching, tension, True)
        if (asked := observing()) is not None:
            turned = torch.linalg.solve(touching.touch.resist, wrench.unsqueeze(-1)).squeeze(-1)
            asked.solve(SolvedContact(touching, touching.firm(tension, hard), pos, turned))
        tension = pulled
        return pos, tension, force, exerted, wrench, left.detach(), wrench[..., :0, :3], wrench
    with torch.no_grad():
        pos, pulled, bodies, hard, tied, *after = _searched(touching, tension)
    if (asked := observing()) is not None:
        ends = (after[0], after[7]) if after else (pos, bodies)
        asked.solve(SolvedContact(touching, touching.firm(tension, hard), *ends))
    if after and not torch.is_grad_enabled():
        return tuple(after)
    firm = touching.firm(tension, hard)
    linear = penalty.maps(touching.touch)
    pos = torch.where(system.free > 0, pos, system.moved)
    before = Unknowns(pos, pulled * system.scale, bodies, tied * system.scale)
    now, _ = touching.newton_step(before, firm, linear, True)
    topology, scale = system.lengths.topology, system.scale
    felt = penalty.feel(topology, touching.touch, linear, firm, now.pos - touching.origin, now.bodies, touching.dt)
    exerted = felt.force + touching.feel_pairs(now.pos, firm)[0]
    push = system.residual(now.pos, now.impulse)[1]
    if touching.joints is not None:
        push = push + touching.joints.pulls(now.joints)
    with torch.no_grad():
        still = tree.detach((now.pos, now.impulse, now.bodies, now.joints))
        plain = tuple(x.detach() for x in linear)
        left = after[5] if after else touching.newton_step(Unknowns(*still), firm, plain, True)[1]
    wrench = (touching.touch.resist @ now.bodies.unsqueeze(-1)).squeeze(-1)
    whole, tied = (push + exerted) / scale, now.joints / scale
    found = now.pos, now.impulse / scale, whole, exerted / scale, wrench, left, tied, now.bodies
    # Replays, and steps without gradients, do the same to the last bit: the graph gives derivatives only.
    return tuple(y + (x - x.detach()) for x, y in zip(found, after, strict=True)) if after else found


def _searched(touching: Touching, tension: Tensor, whole: bool = False) -> tuple[Tensor, ...]:
    system = touching.system
    inputs, law = system.inputs(tension)
    parts = [getattr(touching.touch, name) for name in _FIELDS]
    pairs = [] if touching.pairs is None else tree.leaves(touching.pairs)
    law, name = [*law, touching.dt], system.lengths.topology.name
    if whole:
        return tuple(torch.ops.torchdlo.engaged_whole(inputs, parts, pairs, touching.origin, name, law))
    tied = [] if touching.joints is None else [getattr(touching.joints, field) for field in joint_points.FIELDS]
    return tuple(torch.ops.torchdlo.engaged(inputs, parts, pairs, tied, touching.origin, name, law))


def _equations(
    inputs: list[Tensor],
    parts: list[Tensor],
    pairs: list[Tensor],
    joints: list[Tensor],
    origin: Tensor,
    topology: str,
    law: list[float],
) -> tuple[Touching, Tensor]:
    rest, compliance, active, mask, give, hinge, swing, free, tension, vertex, moved, *others, scale = inputs
    lengths = Lengths(parse(topology), rest, compliance, active, mask, give, *law[1:3])
    inertia = Inertia(vertex, hinge, rest, mask, swing)
    force, direction, ahead = others
    system = LengthSystem(lengths, inertia, moved, free, force, scale, direction, ahead, law[0])
    between = None
    if pairs:
        at, real, normal, radius, wanted, mu, *linear = pairs
        between = Pairs(at, real, normal, radius, wanted, mu, tuple(linear))
    tied = JointPoints(*joints) if joints else None
    return Touching(system, Touch(*parts), origin, between, law[-1], tied), tension


def _by_kernel(inputs, parts, pairs, origin: Tensor, topology: str, law: list[float], joints=None) -> list[Tensor]:
    return contact_kernel.solve(inputs, parts, pairs, origin, topology, law, TRIES, _solved(origin), STALLED, joints)


def _whole(*given) -> tuple[Tensor, ...]:
    return tuple(x.contiguous() for x in _by_kernel(*given)[:10])


def _derived(
    inputs: list[Tensor],
    parts: list[Tensor],
    pairs: list[Tensor],
    origin: Tensor,
    found: list[Tensor],
    by: list[Tensor],
    topology: str,
    law: list[float],
) -> tuple[Tensor, ...]:
    call = inputs, parts, pairs, origin, topology, law, TRIES, _solved(origin), STALLED
    return contact_kernel.derive(call, found, by)


def _derived_meta(inputs, parts, pairs, origin: Tensor, found: list[Tensor], *others) -> tuple[Tensor, ...]:
    slots, scenes = found[0].shape[-2], found[3].numel()
    points, bodies, room = parts[0].shape[-3], found[2].shape[-2], pairs[0].shape[-1] if pairs else 0
    shapes = (28, slots, scenes), (scenes, points, slots, 18), (scenes, room, 43), (scenes, bodies, 36)
    return tuple(origin.new_empty(shape) for shape in shapes)


def _save(ctx, inputs, output) -> None:
    inputs, parts, pairs, origin, *ctx.static = inputs
    ctx.counts = [len(x) for x in (inputs, parts, pairs)]
    ctx.save_for_backward(*inputs, *parts, *pairs, origin, *output[:4])


def _backward(ctx, *by: Tensor):
    """Return derivatives by the arguments of `engaged_whole`: of those that no derivative is taken by, None."""
    (*tensors, origin), found = ctx.saved_tensors[:-4], list(ctx.saved_tensors[-4:])
    groups = []
    for count in ctx.counts:
        groups.append(tensors[:count])
        tensors = tensors[count:]
    inputs, parts, pairs = groups
    slots, points, between, bodies = torch.ops.torchdlo.engaged_back(
        inputs, parts, pairs, origin, found, [x.contiguous() for x in by[4:9]], *ctx.static
    )
    batch = found[3].shape[:-2]
    slots = slots.reshape(*slots.shape[:2], *batch)
    slots = slots.permute(*range(2, slots.dim()), 1, 0)
    by_slots = list(slots.split([x.shape[-1] for x in (*inputs, origin)], -1))
    points = points.reshape(*batch, *points.shape[1:])
    by_points = list(points.split([x.shape[-1] for x in parts[:-3]], -1))
    resist = bodies.reshape(*batch, -1, 6, 6)
    by_pairs: list[Tensor | None] = []
    if pairs:
        between = between.reshape(*batch, *between.shape[1:])
        widths = [x.shape[-1] * (x.shape[-2] if k > 4 else 1) for k, x in enumerate(pairs[1:])]
        split = between.split(widths, -1)
        by_pairs = [None, None, *(x if k < 4 else x.unflatten(-1, (3, 3)) for k, x in enumerate(split[1:]))]
        by_pairs = [None if g is None else g.sum_to_size(x.shape) for g, x in zip(by_pairs, pairs, strict=True)]
    found_slots = [g.sum_to_size(x.shape) for g, x in zip(by_slots, (*inputs, origin), strict=True)]
    found_parts = [g.sum_to_size(x.shape) for g, x in zip(by_points, parts, strict=False)]
    return (
        [None if k in _MASKS else g for k, g in enumerate(found_slots[:-1])],
        [None, *found_parts[1:], None, resist.sum_to_size(parts[-2].shape), None],
        by_pairs,
        found_slots[-1],
        None,
        None,
    )


def _refused(ctx, *by) -> None:
    """Refuse to differentiate a derivative."""
    raise RuntimeError("contact in implicit steps has no second derivative; do not ask for create_graph through it")


_MASKS = (2, 3, 4)
"""Of what `LengthSystem.inputs` returns, what no derivative is taken by: masks, and when edges yield."""


def _engaged(
    inputs: list[Tensor], parts: list[Tensor], pairs: list[Tensor], joints: list[Tensor], *law
) -> list[Tensor]:
    """Return positions, tensions, displacements of bodies, how hard contact was, and forces of joints.

    The kernel also tells what the exact step makes of them: what `solve_contact_step` returns.
    """
    origin, topology, numbers = law
    if joints and contact_kernel.available(origin):
        found = _by_kernel(inputs, parts, pairs, origin, topology, numbers, JointPoints(*joints))
        return [x.contiguous() for x in (*found[:4], found[10], *found[4:10], *found[11:])]
    return _by_tensors(*_equations(inputs, parts, pairs, joints, origin, topology, numbers))


def _by_tensors(touching: Touching, tension: Tensor) -> list[Tensor]:
    """Return what `_engaged` does, by tensor operations."""
    system = touching.system
    linear = penalty.maps(touching.touch)
    first = touching.start(tension)
    found = best = first
    open = first.pos.new_ones(*first.pos.shape[:-2], 1, 1) > 0
    chosen = kept = torch.full_like(open, HARD, dtype=first.pos.dtype)
    least = torch.full_like(chosen, torch.inf)
    for hard, steps in TRIES:
        # Scenes that are not solved begin again.
        chosen = torch.where(open, hard, chosen)
        firm, now = touching.firm(tension, chosen), _chosen(open, first, found)
        before, last = now, torch.full_like(least, torch.inf)
        for k in range(steps):
            new, left = touching.newton_step(now, firm, linear, k >= 2)
            if k >= 3:  # the step from the one before is the exact one, which is taken again with graph
                better = open & (left < least)
                best, kept = _chosen(better, before, best), torch.where(better, chosen, kept)
                least = torch.where(better, left, least)
            before, now = now, _chosen(open, new, now)
            stalled = (left > STALLED[0] * last) & (left < STALLED[1] * _solved(left))
            open, last = open & ~((left < _solved(left)) | (stalled & (k >= 3))), left
            if not bool(open.any()):
                break
        found = now
        if not bool(open.any()):
            break
    # What stays unsolved ends where least was left, not where the last step happened to go.
    lost = open & (least < torch.inf)
    found, chosen = _chosen(lost, best, found), torch.where(lost, kept, chosen)
    tied = found.joints / system.scale
    return [x.contiguous() for x in (found.pos, found.impulse / system.scale, found.bodies, chosen, tied)]


def _chosen(condition: Tensor, one: Unknowns, other: Unknowns) -> Unknowns:
    names = ("pos", "impulse", "bodies", "joints")
    return Unknowns(*(torch.where(condition, getattr(one, name), getattr(other, name)) for name in names))


def _engaged_meta(
    inputs: list[Tensor], parts: list[Tensor], pairs: list[Tensor], joints: list[Tensor], origin: Tensor, topology, law
) -> list[Tensor]:
    tension, moved, wanted, of = inputs[8], inputs[10], parts[_FIELDS.index("wanted")], parts[_FIELDS.index("of")]
    batches = [moved.shape[:-2], tension.shape[:-2], wanted.shape[:-3], *(x.shape[:-2] for x in pairs[:1])]
    batch = torch.broadcast_shapes(*batches, *([JointPoints(*joints).batch] if joints else []))
    like, v, points = moved.new_empty, parse(topology).size, joints[0].shape[0] if joints else 0
    shapes = [(v, 3), (v, 1), (of.shape[-1], 6), (1, 1), (points, 3)]
    if joints and contact_kernel.available(origin):
        shapes += [(v, 3), (v, 1), (v, 3), (v, 3), (of.shape[-1], 6), (1, 1), (points, 3), (of.shape[-1], 6)]
    return [like(*batch, *shape) for shape in shapes]


def _whole_meta(inputs, parts, pairs, *given) -> tuple[Tensor, ...]:
    pos, tension, bodies, hard, _ = _engaged_meta(inputs, parts, pairs, [], *given)
    later = (pos, tension, pos, pos, bodies, hard)
    return (pos, tension, bodies, hard, *(torch.empty_like(x) for x in later))


_TENSORS = "Tensor[] inputs, Tensor[] parts, Tensor[] pairs, Tensor origin"
_JOINED = "Tensor[] inputs, Tensor[] parts, Tensor[] pairs, Tensor[] joints, Tensor origin"
_STATIC = "str topology, float[] law"
_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define(f"engaged({_JOINED}, {_STATIC}) -> Tensor[]")
_operators.define(f"engaged_whole({_TENSORS}, {_STATIC}) -> ({', '.join(['Tensor'] * 10)})")
_operators.define(f"engaged_back({_TENSORS}, Tensor[] found, Tensor[] by, {_STATIC}) -> ({', '.join(['Tensor'] * 4)})")
for _device in ("CPU", "CUDA"):
    _operators.impl("engaged", _engaged, _device)
for _name, _run, _shapes in (("engaged_whole", _whole, _whole_meta), ("engaged_back", _derived, _derived_meta)):
    _operators.impl(_name, _run, "CPU")
    _operators.impl(_name, _shapes, "Meta")
_operators.impl("engaged", _engaged_meta, "Meta")
torch.library.register_autograd("torchdlo::engaged_whole", _backward, setup_context=_save, lib=_operators)
torch.library.register_autograd("torchdlo::engaged_back", _refused, lib=_operators)


def _pattern(name: str) -> banded.Pattern:
    """Pattern of `Touching.newton`: as that of `balance`, with blocks of 3 x 3; see its `entries` for
    the numbering."""
    topology = parse(name)
    v, after, mask = topology.size, topology.successor(), topology.edge_mask()
    places: list[tuple[int, int, int]] = []
    for i in range(v):
        near, far = after[i], after[after[i]]
        inside = mask[i] > 0
        further = inside and mask[near] > 0
        for a in range(3):
            for b in range(3):
                entry = (3 * a + b) * v
                places.append((a * v + i, b * v + i, entry + i))
                if inside:
                    places += [(a * v + i, b * v + near, 9 * v + entry + i)]
                    places += [(a * v + near, b * v + i, 18 * v + entry + near)]
            if further:
                places += [(a * v + i, a * v + far, 27 * v + i), (a * v + far, a * v + i, 28 * v + far)]
            if inside:
                places += [(a * v + i, 3 * v + i, (29 + a) * v + i), (a * v + near, 3 * v + i, (32 + a) * v + i)]
                places += [(3 * v + i, a * v + i, (35 + a) * v + i), (3 * v + i, a * v + near, (38 + a) * v + i)]
        places.append((3 * v + i, 3 * v + i, 41 * v + i))
    return banded.make_pattern(4 * v, places, saddle_order(topology))


banded.register_pattern("touching", functools.cache(_pattern))
