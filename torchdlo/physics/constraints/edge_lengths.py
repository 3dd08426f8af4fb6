"""Edges of given length: direct solution of the nonlinear system of one substep.

Both solvers look for positions and tensions at the end of the substep such that the momentum balance holds and every
edge has its length (or its strain times stiffness equals its tension). Newton's method runs without graph, in implicit
steps until each scene is solved; one more Newton step, taken with graph, puts the derivative of the implicit function
theorem on the result. That is the derivative of the step as computed where Newton's method has converged.

The tension acts along the edge as it was at the start (SHAKE: Ryckaert, Ciccotti, Berendsen 1977,
doi:10.1016/0021-9991(77)90098-5), so that linear and angular momentum are exact.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.execution import tracing
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg import banded
from torchdlo.physics.linalg.numerics import dot, safe_norm, total
from torchdlo.physics.rod.kinematics import edge_vectors
from torchdlo.physics.rod.topology import Topology, elimination_order, following, parse, preceding


@dataclass(frozen=True)
class Lengths:
    """What the lengths of the edges have to be."""

    topology: Topology
    rest: Tensor
    """Rest lengths [m], shape (..., V, 1)."""
    compliance: Tensor
    """Rest length over axial stiffness, 0 for inextensible edges [m/N], shape (..., V or 1, 1)."""
    active: Tensor
    """1 where the edge is real and one of its ends is free [1], shape (..., V, 1)."""
    edge_mask: Tensor
    """1 for real edges [1], shape (V, 1)."""
    give: Tensor | None = None
    """How far a unit of force moves an end of the edge within the substep [m/N], shape (..., V, 1)."""
    most: float = 0.25
    """Tension at which edges give way, over the one at which explicit steps are not stable."""
    least: float = 0.25
    """Compression from which on that of the last substep is no first guess, likewise."""

    @property
    def shift(self) -> float:
        """Relative shift of the systems [1], which matters only when a taut rope has no solution."""
        return 1e-10 if self.rest.dtype == torch.float64 else 1e-6

    def yielding(self, tension: Tensor) -> tuple[Tensor | float, Tensor | float]:
        """Return how much an edge lengthens beyond the tension that steps can follow [m], and the gradient of that
        [m/N].

        A tension T makes transverse waves of w dt = 2 sqrt(T give / length); beyond a share of the stable T edges
        give way, so that ropes pulled beyond their length stay finite.
        """
        if self.give is None:
            return 0.0, 0.0
        beyond = tension - self.most * self.rest / self.give
        return self.give * beyond.clamp(min=0.0), torch.where(beyond > 0, self.give, 0.0)

    def guess(self, tension: Tensor) -> Tensor:
        """Return a first guess for the tensions [N], shape (..., V, 1): those of the last substep.

        A straight rope pressed along its line has no tensions that keep its lengths, and leaves ones of any size. From
        there Newton's method goes astray for good; from none it finds the bent shape as soon as there is one.
        """
        if self.give is None:
            return tension * self.active
        return torch.where(tension < -self.least * self.rest / self.give, 0.0, tension) * self.active

    def error(self, pos: Tensor, tension: Tensor) -> tuple[Tensor, Tensor]:
        """Return how much too long each edge is [m], shape (..., V, 1), and its direction, (..., V, 3)."""
        edge = edge_vectors(self.topology, pos, self.edge_mask)
        length = safe_norm(edge)
        excess = length - self.rest - self.compliance * tension - self.yielding(tension)[0]
        return excess * self.active, edge / length.clamp(min=1e-12)


def _rows(*parts: Tensor) -> Tensor:
    """Stack (..., V, C) tensors as the rows of an (m, batch) matrix, component by component."""
    batch = torch.broadcast_shapes(*(p.shape[:-2] for p in parts))
    rows = []
    for part in parts:
        part = part.expand(batch + part.shape[-2:])
        n = part.dim()
        rows.append(part.permute(n - 1, n - 2, *range(n - 2)).reshape(part.shape[-1] * part.shape[-2], -1))
    return torch.cat(rows)


def _vertices(rows: Tensor, batch: tuple[int, ...], components: int) -> Tensor:
    """Turn (components V, batch) rows back into (..., V, components)."""
    stored = rows.reshape(components, -1, *batch)
    return stored.permute(*range(2, 2 + len(batch)), 1, 0)


def solve_slots(topology: Topology, diagonal: Tensor, to_next: Tensor, to_prev: Tensor, rhs: Tensor) -> Tensor:
    """Solve a system that couples neighbouring slots; arguments and result have shape (..., V, 1).

    Differentiable in `rhs` only, see `banded.solve`.
    """
    with torch.no_grad():
        entries = _rows(diagonal.expand_as(rhs), to_next.expand_as(rhs), to_prev.expand_as(rhs))
    solution = banded.solve(entries, _rows(rhs), f"tridiagonal:{topology.name}")
    return _vertices(solution, rhs.shape[:-2], 1)


def project(
    lengths: Lengths, moved: Tensor, answer: Tensor, direction: Tensor, tension: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Enforce lengths where every vertex moves by itself: a tridiagonal system for the tensions.

    Args:
        lengths: the constraint.
        moved: positions after the substep without tension [m], shape (..., V, 3).
        answer: how far a force moves a vertex along each axis [m/N], 0 if held, shape (..., V, 3).
        direction: unit vectors along which tension acts, shape (..., V, 3).
        tension: first guess [N], shape (..., V, 1).
        steps: Newton steps before the last one.

    Returns:
        Positions (..., V, 3) and tensions (..., V, 1).
    """
    topology = lengths.topology
    if lanes.ready(moved) and lengths.give is not None:
        edges = lengths.rest, lengths.compliance, lengths.active, lengths.edge_mask, lengths.give, tension
        numbers = lengths.most, lengths.least, lengths.shift, steps
        inputs = *edges, moved, answer, direction
        pos, tension = lanes.apply("project", topology.name, inputs, (3, 1), "tridiagonal", numbers)
        return pos, tension

    def place(tension: Tensor, moved: Tensor, answer: Tensor, direction: Tensor) -> Tensor:
        pull = tension * direction
        return moved + answer * (pull - preceding(topology, pull))

    def newton(tension: Tensor, along: Tensor, excess: Tensor) -> Tensor:
        both = answer + following(topology, answer)
        active, off = lengths.active, 1 - lengths.active
        soft = lengths.compliance + lengths.yielding(tension)[1]
        diagonal = active * ((1 + lengths.shift) * total(along * direction * both) + soft) + off
        to_next = -active * dot(along, following(topology, direction * answer))
        to_prev = -active * total(along * answer * preceding(topology, direction))
        return tension + solve_slots(topology, diagonal, to_next, to_prev, excess)

    with torch.no_grad():
        tension = lengths.guess(tension)
        for _ in range(steps):
            excess, along = lengths.error(place(tension, moved, answer, direction), tension)
            tension = newton(tension, along, excess)
    excess, along = lengths.error(place(tension, moved, answer, direction), tension)
    tension = newton(tension, along, excess)
    return place(tension, moved, answer, direction), tension


@dataclass(frozen=True)
class Inertia:
    """Resistance of positions to change within a substep: masses, and stiffness taken as inertia.

    Written for the change y of positions against unforced motion, it gives the impulse-like force
    `vertex` y + K y, K the stiffness of a straight chain of hinges against turning of its edges.
    """

    vertex: Tensor
    """Mass of the vertices along each axis [kg], shape (..., V, 3)."""
    hinge: Tensor
    """Weights of the hinges [kg m^2], shape (..., V, 1)."""
    edge: Tensor
    """Rest lengths of real edges, 1 for dummies [m], shape (..., V, 1)."""
    edge_mask: Tensor
    """1 for real edges [1], shape (V, 1)."""
    turning: Tensor | None = None
    """Inertia of edges against turning, beside that of their ends' masses [kg], shape (..., V, 1)."""

    def swing(self, topology: Topology, y: Tensor) -> Tensor | float:
        """Return the part of edges that resist turning, shape (..., V, 3); 0 if none do."""
        if self.turning is None:
            return 0.0
        push = self.turning * (following(topology, y) - y)
        return preceding(topology, push) - push

    def bending(self, topology: Topology, y: Tensor) -> Tensor:
        """Return K y, shape (..., V, 3)."""
        turn = (following(topology, y) - y) * self.edge_mask / self.edge
        moment = self.hinge * (turn - preceding(topology, turn))
        push = (moment - following(topology, moment)) * self.edge_mask / self.edge
        return preceding(topology, push) - push

    def bands(self, topology: Topology) -> tuple[Tensor, Tensor, Tensor]:
        """Return K's entries to the same, the next, and the next but one vertex, shape (..., V, 1) each."""
        after = self.edge_mask / self.edge
        before = preceding(topology, after)
        centre = after + before
        w = self.hinge
        next_w, prev_w = following(topology, w), preceding(topology, w)
        same = w * centre.square() + next_w * after.square() + prev_w * before.square()
        one = -w * centre * after - next_w * after * following(topology, centre)
        two = next_w * after * following(topology, after)
        if self.turning is not None:
            same, one = same + self.turning + preceding(topology, self.turning), one - self.turning
        return same, one, two


def balance(
    lengths: Lengths,
    inertia: Inertia,
    moved: Tensor,
    free: Tensor,
    force: Tensor,
    scale: Tensor,
    direction: Tensor,
    ahead: Tensor,
    tension: Tensor,
    turning: float,
    steps: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Enforce lengths where inertia couples the vertices: a banded saddle-point system for positions and tensions.

    Args:
        lengths: the constraint.
        inertia: resistance to change.
        moved: positions without any force, or where held vertices have to be [m], shape (..., V, 3).
        free: 1 for free, 0 for held vertices, between for loosely held ones [1], shape (V, 1) or (..., V, 1).
        force: force without tension [N], shape (..., V, 3).
        scale: what turns force into inertia times displacement [s^2], shape (..., 1, 1).
        direction: unit edges at the start, shape (..., V, 3).
        ahead: what pulled edges lean towards beyond that [1], shape (..., V, 3).
        tension: tension of the last substep [N], shape (..., V, 1).
        turning: how much a pulled edge's direction follows the change of the positions.
        steps: Newton steps before the last one, at most: a scene takes no more than it needs.

    Returns:
        Positions (..., V, 3), tensions (..., V, 1), and what moves vertices of given mass: force with tension and with
        the answer of the hinges [N], (..., V, 3).
    """
    if lanes.ready(force):
        return _balanced(lengths, inertia, (free, tension), (moved, force, direction, ahead, scale), turning, steps)
    system = LengthSystem(lengths, inertia, moved, free, force, scale, direction, ahead, turning)
    with torch.no_grad():
        pos, impulse = _found(system, tension, steps)
    pos = torch.where(free > 0, pos, moved)
    pos, impulse, _ = system.newton_step(pos, impulse)
    return pos, impulse / scale, system.residual(pos, impulse)[1] / scale


@dataclass(frozen=True)
class LengthSystem:
    """The equations of `balance`, whose arguments these are."""

    lengths: Lengths
    inertia: Inertia
    moved: Tensor
    """Positions with held vertices in their places [m], shape (..., V, 3)."""
    free: Tensor
    """1 for free vertices [1], shape (..., V, 1)."""
    force: Tensor
    """Force on vertices [N], shape (..., V, 3)."""
    scale: Tensor
    """What turns force into mass times displacement [s^2], shape (..., V, 1)."""
    direction: Tensor
    """Directions in which tensions act [1], shape (..., V, 3)."""
    ahead: Tensor
    """What pulled edges lean towards beyond that [1], shape (..., V, 3)."""
    turning: float

    def residual(self, pos: Tensor, impulse: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return displacements, what pushes, excess of lengths, and directions of edges at the end and of tensions."""
        lengths, inertia, topology = self.lengths, self.inertia, self.lengths.topology
        y = pos - self.moved
        start = self.direction + lengths.active * self.ahead
        along_start = start + self.lean * (following(topology, y) - y)
        pull = impulse * along_start
        given = self.scale * self.force + pull - preceding(topology, pull)
        push = given - inertia.bending(topology, y) - inertia.swing(topology, y)
        excess, along = lengths.error(pos, impulse / self.scale)
        return y, push, excess, along, along_start

    @property
    def lean(self) -> Tensor:
        """How much directions of tensions follow the change of positions [1/m]."""
        return self.turning * self.lengths.active / self.lengths.rest

    def inputs(self, tension: Tensor) -> tuple[list[Tensor], list[float]]:
        """Return what the kernel reads, in its order, and its numbers but for how many steps it takes."""
        lengths, inertia = self.lengths, self.inertia
        swing = inertia.vertex.new_zeros(1, 1) if inertia.turning is None else inertia.turning
        give = tree.part(lengths.give)
        edges = lengths.rest, lengths.compliance, lengths.active, lengths.edge_mask, give, inertia.hinge, swing
        vectors = inertia.vertex, self.moved, self.force, self.direction, self.ahead
        law = [self.turning, lengths.most, lengths.least, lengths.shift]
        return [*edges, self.free, tension, *vectors, self.scale], law

    def newton_step(self, pos: Tensor, impulse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions and impulses after a step of Newton's method, and what it changed [1], (..., 1, 1)."""
        lengths, inertia, free, scale, topology = (
            self.lengths,
            self.inertia,
            self.free,
            self.scale,
            self.lengths.topology,
        )
        y, push, excess, along, along_start = self.residual(pos, impulse)
        with torch.no_grad():
            same, one, two = inertia.bands(topology)
            string = impulse * self.lean
            after, active = following(topology, free), lengths.active
            soft = lengths.yielding(impulse / scale)[1] + lengths.shift * tree.part(lengths.give)
            entries = _rows(
                inertia.vertex + free * (same + string + preceding(topology, string)),
                free * (one - string),
                free * preceding(topology, one - string),
                free * two,
                free * preceding(topology, preceding(topology, two)),
                -free * active * along_start,
                after * active * along_start,
                -active * along,
                active * along,
                -active * (lengths.compliance + soft) / scale + (active - 1),
            )
        rhs = -_rows(inertia.vertex * y - free * push, excess)
        step = banded.solve(entries, rhs, f"saddle:{topology.name}")
        batch, v3 = pos.shape[:-2], 3 * pos.shape[-2]
        change, pull = _vertices(step[:v3], batch, 3), _vertices(step[v3:], batch, 1)
        with torch.no_grad():
            turn = lengths.active * (following(topology, change) - change) / lengths.rest
            most = total(turn.square()).amax(-2, keepdim=True).sqrt()
            # An edge may turn by about one radian; beyond that its linearisation means nothing.
            short = (1 / most.clamp(min=1e-9)).clamp(max=1.0)
            firm = inertia.vertex[..., :1] + string.abs()
            changed = torch.maximum(most, (pull * self.lean / firm).abs().amax(-2, keepdim=True))
        return pos + short * change, impulse + short * pull, changed


def _done(like: Tensor) -> float:
    """Return the change of directions and tensions below which one more step of Newton's method ends at rounding."""
    return 1e-6 if like.dtype == torch.float64 else 3e-4


def _found(system: LengthSystem, tension: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Return positions and impulses that Newton's method finds in so many steps at most, without gradient."""
    inputs, law = system.inputs(tension)
    found = torch.ops.torchdlo.balanced(inputs, system.lengths.topology.name, law, steps)
    return tree.logical(found[:3]), tree.logical(found[3:]) * system.scale


def _newton(inputs: list[Tensor], topology: str, law: list[float], steps: int) -> Tensor:
    """Return positions and tensions, stored as (4, V, ...); each scene until it is done."""
    if lanes.available(inputs[0]):
        numbers = [*law, steps, _done(inputs[0]), 0.0]
        found = lanes.run(inputs, "balance", topology, [3, 1, 3], "saddle", numbers)
        return torch.cat([tree.stored(x) for x in found[:2]])
    rest, compliance, active, mask, give, hinge, swing, free, tension, vertex, moved, *others, scale = inputs
    lengths = Lengths(parse(topology), rest, compliance, active, mask, give, *law[1:3])
    inertia = Inertia(vertex, hinge, rest, mask, swing)
    force, direction, ahead = others
    system = LengthSystem(lengths, inertia, moved, free, force, scale, direction, ahead, law[0])
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in inputs))
    pos, impulse = moved.expand(*batch, *moved.shape[-2:]), lengths.guess(tension) * scale
    impulse = impulse.expand(*batch, *impulse.shape[-2:])
    open = torch.ones_like(pos[..., :1, :1], dtype=torch.bool)
    for _ in range(steps):
        *better, changed = system.newton_step(pos, impulse)
        pos, impulse = (torch.where(open, new, old) for new, old in zip(better, (pos, impulse), strict=True))
        open = open & ~(changed < _done(pos))
        if not bool(open.any()):
            break
    return torch.cat([tree.stored(pos), tree.stored(impulse / scale)]).contiguous()


def _newton_meta(inputs: list[Tensor], topology: str, law: list[float], steps: int) -> Tensor:
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in inputs))
    return inputs[0].new_empty(4, max(x.shape[-2] for x in inputs), *batch)


_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define("balanced(Tensor[] inputs, str topology, float[] law, int steps) -> Tensor")
for _device in ("CPU", "CUDA"):
    _operators.impl("balanced", _newton, _device)
_operators.impl("balanced", _newton_meta, "Meta")


def _balanced(
    lengths: Lengths,
    inertia: Inertia,
    scalars: Sequence[Tensor],
    vectors: Sequence[Tensor],
    turning: float,
    steps: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `balance` does, by a kernel."""
    (free, tension), (moved, force, direction, ahead, scale) = scalars, vectors
    system = LengthSystem(lengths, inertia, moved, free, force, scale, direction, ahead, turning)
    inputs, law = system.inputs(tension)
    numbers = (*law, steps, _done(force), 1.0)
    pos, found, push = lanes.apply("balance", lengths.topology.name, inputs, (3, 1, 3), "saddle", numbers)
    return pos, found, push


def saddle_order(topology: Topology) -> list[int]:
    """Return the elimination order of x, y, z of all vertices, then tensions: along the ropes."""
    v, after = topology.size, topology.successor()
    order = elimination_order(topology)
    rank = {slot: k for k, slot in enumerate(order)}
    last = [max(rank[i], rank[after[i]]) if _is_edge(topology, i) else rank[i] for i in range(v)]
    unknowns: list[int] = []
    edges = sorted(range(v), key=last.__getitem__)
    for slot in order:
        unknowns += [slot, v + slot, 2 * v + slot]
        while edges and last[edges[0]] <= rank[slot]:
            unknowns.append(3 * v + edges.pop(0))
    return unknowns


def _saddle(name: str) -> banded.Pattern:
    """Pattern of `balance`: unknowns x, y, z of all vertices, then tensions; see its `entries` for the numbering."""
    topology = parse(name)
    v, after, unknowns = topology.size, topology.successor(), saddle_order(topology)
    places: list[tuple[int, int, int]] = []
    for i in range(v):
        near, far = after[i], after[after[i]]
        inside, further = _is_edge(topology, i), _is_edge(topology, i) and _is_edge(topology, near)
        for c in range(3):
            row = c * v
            places.append((row + i, row + i, row + i))
            if inside:
                places += [(row + i, row + near, 3 * v + i), (row + near, row + i, 4 * v + near)]
                places += [(row + i, 3 * v + i, 7 * v + row + i), (row + near, 3 * v + i, 10 * v + row + i)]
                places += [(3 * v + i, row + i, 13 * v + row + i), (3 * v + i, row + near, 16 * v + row + i)]
            if further:
                places += [(row + i, row + far, 5 * v + i), (row + far, row + i, 6 * v + far)]
        places.append((3 * v + i, 3 * v + i, 19 * v + i))
    return banded.make_pattern(4 * v, places, unknowns)


def _is_edge(topology: Topology, slot: int) -> bool:
    return topology.edge_mask()[slot] > 0


banded.register_pattern("saddle", functools.cache(_saddle))


_PARTS = 16
"""In how many parts lengths are put right that Newton's method does not reach at once, e.g. where measurements push
edges together by a tenth of their length. At once is better where it works: it leaves fewer kinks."""

_REACHED = 1e-6
"""Share of its length by which an edge may miss it then."""


@functools.lru_cache(64)
def _part(topology: Topology, steps: int, recorded: bool) -> Callable[..., tuple[Tensor]]:
    """Return what takes edges a part of the way to their lengths, in some steps of Newton's method before the last."""

    def reach(given: tuple[Tensor, Tensor, Tensor, Tensor], pos: Tensor, share: Tensor) -> tuple[Tensor]:
        mobility, rest, active, edge_mask = given
        none = torch.zeros_like(rest)
        edge = edge_vectors(topology, pos, edge_mask)
        length = safe_norm(edge).clamp(min=1e-12)
        aim = Lengths(topology, length + (rest - length) * share, none, active, edge_mask)
        found, _ = project(aim, pos, mobility.expand_as(pos), edge / length, torch.zeros_like(active), steps)
        return (found,)

    return tracing.RecordedStep(reach, most=16) if recorded else reach


def settle(
    lengths: Lengths, pos: Tensor, vel: Tensor, mobility: Tensor, *, recorded: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the nearest positions and velocities that agree with fixed lengths, both shape (..., V, 3).

    Args:
        lengths: the constraint.
        pos: positions that miss it a little, e.g. interpolated measurements [m].
        vel: velocities that may stretch edges [m/s].
        mobility: one over the mass of the vertices, 0 if held, shape (..., V, 1).
        recorded: whether to record Newton's steps where they have no gradient, for many batches of one size.
    """
    topology = lengths.topology
    answer = mobility.expand_as(pos)

    def reach(pos: Tensor, parts: int) -> Tensor:
        given = mobility, lengths.rest, lengths.active, lengths.edge_mask
        for left in range(parts, 0, -1):
            (pos,) = _part(topology, 6 if left == 1 else 1, recorded)(given, pos, lengths.rest.new_tensor(1 / left))
        return pos

    near = reach(pos, 1)
    missed = (safe_norm(edge_vectors(topology, near, lengths.edge_mask)) - lengths.rest).abs() * lengths.active
    there = (missed < _REACHED * lengths.rest).all(-2, keepdim=True)
    pos = near if bool(there.all()) else torch.where(there, near, reach(pos, _PARTS))
    edge = edge_vectors(topology, pos, lengths.edge_mask)
    along = edge / safe_norm(edge).clamp(min=1e-12)
    stretching = dot(following(topology, vel) - vel, along) * lengths.active
    both = answer + following(topology, answer)
    diagonal = lengths.active * total(along.square() * both) * (1 + 1e-10) + 1 - lengths.active
    coupling = -lengths.active * dot(along, following(topology, along * answer))
    back = -lengths.active * total(along * answer * preceding(topology, along))
    pull = solve_slots(topology, diagonal, coupling, back, stretching) * along
    return pos, vel + answer * (pull - preceding(topology, pull))
