"""Joints: points of ropes that are welded or ball-jointed to free bodies, or to points of other ropes.

A weld to a body carries the neighbouring vertices as well, so that the rope leaves the body in the direction that it
had at the start, and the material frame of the edge between them. A weld of two ropes keeps the directions of their two
edges against each other. See `physics.constraints.joint_points` for how the forces are found.

Where a body carries the frame of an edge, it feels the moment of the rope about it; the inertia of that edge about its
own axis, which is much smaller than that of a body, is left out.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.contact_solver import inertia
from torchdlo.coupling.bodies.dynamics import Body, BodyParams, BodyState, PredictedBodyMotion, conjugate
from torchdlo.coupling.rod_body.joint_ranks import check_repeats
from torchdlo.coupling.rod_body.rod_body_effect import RodBody
from torchdlo.coupling.rod_contact.broad_phase import APART
from torchdlo.coupling.rod_contact.rod_contact_effect import RodContact
from torchdlo.field_docs import with_field_docs
from torchdlo.physics import tree
from torchdlo.physics.constraints.joint_points import JointPoints
from torchdlo.physics.effects.base import ContactForces, Effect, Values
from torchdlo.physics.integrators.carried_mass import Load
from torchdlo.physics.linalg.free_rotation import matrix
from torchdlo.physics.linalg.numerics import added, cross, normalize, safe_norm
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.kinematics import RodParams, RodState, View
from torchdlo.physics.rod.topology import Topology

Vector = tuple[float, float, float]


@with_field_docs
@dataclass(frozen=True)
class RopeJoint:
    """A point of a rope that is joined to a free body, or to a vertex of another rope."""

    rope: int = 0
    """Number of the rope."""
    vertex: int | None = None
    """Number of a vertex along it; -1, the last, if neither it nor `at` is given."""
    at: float | None = None
    """Share of its length where the point is, 0 to 1, in place of `vertex`."""
    body: int | str | None = None
    """Number or name of a free body."""
    other_rope: int | None = None
    """Number of a rope, in place of a body."""
    other_vertex: int = 0
    """Number of the vertex along that rope; -1 is the last."""
    kind: Literal["weld", "ball"] = "weld"
    """Whether the direction and the frame of the rope are kept, too, or its place only."""
    anchor: Vector | None = None
    """Where the joint sits, from the body's centre of mass and in its axes [m]; where the rope is if not given. The
    rope has to start there to within its radius; where it is counts."""


@tree.struct
class JointParams:
    """Where joints sit in bodies."""

    local: Tensor
    """Joined points in the frames of their bodies, 0 for those of two ropes [m], shape (..., A, 3)."""
    director: Tensor
    """First material directors of carried edges in the frames of their bodies [1], shape (..., W, 3)."""


@tree.struct
class JointState:
    """What joints did in the last substep."""

    force: Tensor
    """Forces of joined points on the ropes [N], shape (..., A, 3)."""
    couple: Tensor
    """Torques on carried edges about their axes [N m], shape (..., W, 1)."""


@dataclass(frozen=True)
class Joints:
    """The static side of the joints of a scene: A points, W edges whose frames are carried."""

    points: tuple[tuple[tuple[int, float], ...], ...] = ()
    """Slots and weights of each point; those of ropes that are joined add up to nothing."""
    bodies: tuple[int, ...] = ()
    """The body of each point, -1 for those of two ropes."""
    first: tuple[int, ...] = ()
    """The first point of each joint."""
    spots: tuple[tuple[tuple[int, float], ...], ...] = ()
    """Where each joint sits on its rope: slots and weights."""
    ropes: tuple[int, ...] = ()
    """The rope that each joint is counted for."""
    edges: tuple[int, ...] = ()
    """Edges of which joints carry both ends."""
    frames: tuple[int, ...] = ()
    """Edges whose material frames bodies carry."""
    frame_bodies: tuple[int, ...] = ()
    """These bodies."""

    @property
    def slots(self) -> tuple[int, ...]:
        """All vertices that are joined."""
        return tuple(sorted({slot for point in self.points for slot, _ in point}))

    def load(self, bodies: BodyParams | tuple[()]) -> Load:
        """Return what is joined, with the masses of all bodies of the scene."""
        links: list[tuple[int, int]] = []
        for first, spot in zip(self.first, self.spots, strict=True):
            body, own = self.bodies[first], {slot for slot, _ in spot}
            there = (slot for slot, weight in self.points[first] if weight < 0 and slot not in own)
            other = -1 - body if body >= 0 else next(there)
            links += [(slot, other) for slot in own]
        return Load(tuple(links), () if isinstance(bodies, tuple) else bodies.mass.detach())

    def weights(self, size: int, like: Tensor) -> Tensor:
        """Return how vertices count in the points [1], shape (A, V)."""
        rows = [[dict(point).get(slot, 0.0) for slot in range(size)] for point in self.points]
        return like.new_tensor(rows).reshape(len(self.points), size)


@dataclass(frozen=True)
class Joining:
    """Joints within a substep."""

    joints: Joints
    kinds: tuple[Body, ...]
    """Static sides of the bodies."""
    params: JointParams
    state: JointState
    """What joints did in the last substep."""
    dt: float
    """Substep [s]."""

    @property
    def _free(self) -> list[int]:
        return [k for k, body in enumerate(self.kinds) if body.motion == "free"]

    def _on(self, bodies: Sequence[int], like: Tensor) -> Tensor:
        rows = [[float(k == body) for k in self._free] for body in bodies]
        return like.new_tensor(rows).reshape(len(bodies), len(self._free))

    @property
    def place(self) -> Tensor:
        """Return 1 where a body of the scene is a free one [1], shape (K, J)."""
        free, count = self._free, max(1, len(self.kinds))
        rows = [[float(k == j) for j in free] for k in range(count)]
        return self.params.local.new_tensor(rows).reshape(count, len(free))

    def spread(self, wrench: Tensor) -> tuple[Tensor, Tensor]:
        """Return forces and torques on the bodies of the scene, (..., K, 3) each, of those on the free ones."""
        return (self.place @ wrench).split(3, -1)

    def points(self, pos: Tensor, bodies: PredictedBodyMotion | None) -> JointPoints:
        """Return what is joined.

        Args:
            pos: vertices at the start of the substep [m], shape (..., V, 3).
            bodies: where bodies would go without joints.
        """
        weight, on = self.joints.weights(pos.shape[-2], pos), self._on(self.joints.bodies, pos)
        free = self._free
        if bodies is None:
            none = pos.new_zeros(0, 3)
            centre, quat, moments, omega, resist = none, pos.new_zeros(0, 4), none, none, pos.new_zeros(0, 6, 6)
            start = none
        else:
            state = bodies.state
            start, quat, moments = (x[..., free, :] for x in (state.pos, state.quat, bodies.params.inertia))
            centre, omega = start + bodies.change[..., free, :], bodies.turn[..., free, :] / self.dt
            resist = inertia(bodies, free)
        arm = (weight @ pos - on @ start) * on.sum(-1, keepdim=True)
        parts = self.params.local, arm, centre, quat, moments, omega, resist, self.state.force
        return JointPoints(weight, on, *parts, self._on(self.joints.frame_bodies, pos), self.params.director)

    def twist(self, now: View, loads: Values) -> ContactForces | None:
        """Return the torques of ropes on bodies that carry frames of their edges, about these edges."""
        edges = self.joints.frames
        if not edges or "torque" not in loads:
            return None
        torque = tree.take_vertices(loads["torque"] * now.tangent, edges)
        none = torque.new_zeros(1, 3)
        return ContactForces(none, none, self.place @ (self._on(self.joints.frame_bodies, torque).mT @ torque))


def reading(joints: Joints, topology: Topology, state: RodState, found: JointState) -> tuple[Tensor, Tensor]:
    """Return force [N] and torque about its point [N m] of each joint on its rope, shape (..., N, 3) each."""
    size, pos = topology.size, state.pos
    ropes = pos.new_tensor([k for k, count in enumerate(topology.counts) for _ in range(count)])
    weight = joints.weights(size, pos)
    ends = (*joints.first[1:], len(joints.points))
    forces, torques = [], []
    tangent = normalize(rod.edge_vectors(topology, pos, pos.new_tensor(topology.edge_mask())[:, None]))
    for start, end, rope, spot in zip(joints.first, ends, joints.ropes, joints.spots, strict=True):
        own = (ropes == rope).to(pos.dtype)[:, None]
        pull = weight[start:end].mT @ found.force[..., start:end, :] * own
        at = added(w * pos[..., slot : slot + 1, :] for slot, w in spot)
        torque = cross(pos - at, pull.expand(torch.broadcast_shapes(pos.shape, pull.shape))).sum(-2)
        carried = {slot for point in joints.points[start:end] for slot, _ in point}
        for k, edge in enumerate(joints.frames):
            if edge in carried and joints.bodies[start] == joints.frame_bodies[k]:
                torque = torque + found.couple[..., k, :] * tangent[..., edge, :]
        forces.append(pull.sum(-2))
        torques.append(torque)
    return torch.stack(forces, -2), torch.stack(torques, -2)


@dataclass(frozen=True)
class _Place:
    """What joints are made from."""

    topology: Topology
    params: RodParams
    state: RodState
    bodies: tuple[tuple[Body, ...], BodyParams, BodyState] | None
    held: tuple[int, ...]
    twisting: bool

    def slot(self, rope: Any, vertex: Any, where: str) -> int:
        """Return the slot of a vertex of a rope."""
        counts = self.topology.counts
        _need(rope in range(len(counts)), f"{where}: expected a rope, 0 to {len(counts) - 1}, given {rope!r}")
        count = counts[rope]
        _need(vertex in range(-count, count), f"{where}: expected a vertex, {-count} to {count - 1}, given {vertex!r}")
        return self.topology.starts[rope] + vertex % count

    def around(self, slot: int) -> tuple[int | None, int | None]:
        """Return the slots before and after one along its rope, None beyond its ends."""
        after, mask = self.topology.successor(), self.topology.edge_mask()
        before = after.index(slot)
        return before if mask[before] else None, after[slot] if mask[slot] else None

    def along(self, rope: int, share: float) -> tuple[int, float]:
        """Return the edge that has a share of the length of a rope before it, and where along it that is."""
        start, count = self.topology.starts[rope], self.topology.counts[rope]
        length = (self.params.rest.length * self.params.rest.edge_mask).detach()
        length = length.reshape(-1, self.topology.size)[0, start : start + count]
        way, done = share * float(length.sum()), length.cumsum(0)
        edge = min(int(torch.searchsorted(done, way)), count - 1 if self.topology.closed[rope] else count - 2)
        return start + edge, min(1.0, max(0.0, 1 - (float(done[edge]) - way) / float(length[edge])))


def _need(ok: bool, sentence: str) -> None:
    if not ok:
        raise ValueError(sentence)


@dataclass
class _Found:
    """Joints as they are collected."""

    points: list[tuple[tuple[int, float], ...]] = dataclasses.field(default_factory=list)
    bodies: list[int] = dataclasses.field(default_factory=list)
    first: list[int] = dataclasses.field(default_factory=list)
    spots: list[tuple[tuple[int, float], ...]] = dataclasses.field(default_factory=list)
    ropes: list[int] = dataclasses.field(default_factory=list)
    edges: list[int] = dataclasses.field(default_factory=list)
    frames: list[int] = dataclasses.field(default_factory=list)
    frame_bodies: list[int] = dataclasses.field(default_factory=list)
    welded: list[int] = dataclasses.field(default_factory=list)
    balls: list[int] = dataclasses.field(default_factory=list)

    def add(self, body: int, *points: tuple[tuple[int, float], ...]) -> None:
        """Add points of one body."""
        self.points += points
        self.bodies += [body] * len(points)


def place_joints(
    specs: Sequence[RopeJoint],
    topology: Topology,
    params: RodParams,
    state: RodState,
    bodies: tuple[tuple[Body, ...], BodyParams, BodyState] | None,
    *,
    held: Sequence[int] = (),
    twisting: bool = False,
) -> tuple[Joints, JointParams, JointState]:
    """Return the static side, the numbers and the first state of joints.

    Args:
        specs: the joints.
        topology: the ropes.
        params: their rest shape and material.
        state: where they are.
        bodies: rigid bodies with their numbers and states, None if there are none.
        held: prescribed vertices.
        twisting: whether ropes have material frames.

    Raises:
        ValueError: says what a joint lacks.
    """
    place, found = _Place(topology, params, state, bodies, tuple(held), twisting), _Found()
    for k, spec in enumerate(specs):
        _add(place, found, spec, f"joints[{k}]")
    names = [f.name for f in dataclasses.fields(Joints)]
    joints = Joints(**{name: tuple(getattr(found, name)) for name in names})
    pos = state.pos
    local = pos.new_zeros(*pos.shape[:-2], len(joints.points), 3)
    director = pos.new_zeros(*pos.shape[:-2], len(joints.frames), 3)
    if bodies is not None:
        at, placed = joints.weights(topology.size, pos) @ pos, bodies[2]
        own = [max(0, k) for k in joints.bodies]
        there = rotate(conjugate(placed.quat[..., own, :]), at - placed.pos[..., own, :])
        on = pos.new_tensor([[float(k >= 0)] for k in joints.bodies]).reshape(-1, 1)
        local = on * there
        if joints.frames:
            outward = rod.directors(topology, state, joints.frames)
            director = rotate(conjugate(placed.quat[..., list(joints.frame_bodies), :]), outward)
    check_repeats(joints, local, float(params.material.radius.detach().amax()))
    batch = torch.broadcast_shapes(local.shape[:-2], pos.shape[:-2])
    couple = pos.new_zeros(*batch, len(joints.frames), 1)
    params_, force = JointParams(local, director), pos.new_zeros(*batch, len(joints.points), 3)
    return joints, params_, JointState(force, couple)


def _add(place: _Place, found: _Found, spec: RopeJoint, where: str) -> None:
    _need(spec.kind in ("weld", "ball"), f"{where}.kind: expected 'weld' or 'ball', given {spec.kind!r}")
    given = "none" if spec.body is None else "both"
    _need(
        (spec.body is None) != (spec.other_rope is None),
        f"{where}: expected either a body or other_rope to join the rope to, given {given}",
    )
    _need(spec.vertex is None or spec.at is None, f"{where}: expected either vertex or at, given both")
    found.first.append(len(found.points))
    if spec.at is None:
        slot = place.slot(spec.rope, -1 if spec.vertex is None else spec.vertex, f"{where}.vertex")
        spot: tuple[tuple[int, float], ...] = ((slot, 1.0),)
        beside = [x for x in place.around(slot) if x is not None]
    else:
        place.slot(spec.rope, 0, f"{where}.rope")
        _need(0 <= spec.at <= 1, f"{where}.at: expected a share of the rope's length, 0 to 1, given {spec.at:g}")
        edge, share = place.along(spec.rope, spec.at)
        slot, end = edge, place.topology.successor()[edge]
        spot, beside = ((edge, 1 - share), (end, share)), [end]
        if min(share, 1 - share) < 1e-6:
            slot = edge if share < 0.5 else end
            spot, beside = ((slot, 1.0),), [x for x in place.around(slot) if x is not None]
    found.ropes.append(spec.rope)
    found.spots.append(spot)
    if spec.other_rope is not None:
        _join_ropes(place, found, spec, spot, where)
    else:
        _join_body(place, found, spec, (spot, slot, beside), where)
    _check_slots(place, found, spec, where)


def _join_body(place: _Place, found: _Found, spec: RopeJoint, at: tuple[Any, int, list[int]], where: str) -> None:
    spot, slot, beside = at
    body = _body(place, spec, where)
    _check_anchor(place, spec, spot, body, where)
    found.add(body, spot)
    if spec.kind == "ball":
        return
    # With the point itself, a weld within an edge would say where that edge is twice.
    ends = [slot, *beside] if len(spot) > 1 else beside
    if len(spot) > 1:
        del found.points[-1], found.bodies[-1]
    found.add(body, *(((k, 1.0),) for k in ends))
    after = place.topology.successor()
    edges = [slot if after[slot] == k else k for k in beside]
    found.edges += edges
    if place.twisting:
        found.frames += edges
        found.frame_bodies += [body] * len(edges)


def _join_ropes(place: _Place, found: _Found, spec: RopeJoint, spot: tuple[tuple[int, float], ...], where: str) -> None:
    other = place.slot(spec.other_rope, spec.other_vertex, f"{where}.other_vertex")
    _need(
        spec.anchor is None, f"{where}.anchor: belongs to a body; two ropes are joined where they start, leave it out"
    )
    _need(spec.other_rope != spec.rope, f"{where}.other_rope: expected another rope than {spec.rope}")
    pos = place.state.pos.detach()
    here = sum(w * pos[..., k, :] for k, w in spot)
    far = float(safe_norm(here - pos[..., other, :]).amax())
    radius = float(place.params.material.radius.detach().amax())
    _need(
        far <= 0.1 * radius,
        f"{where}: the two ropes start {1e3 * far:.3g} mm apart; let them start at the same point, to within a tenth "
        f"of their radius",
    )
    found.add(-1, (*spot, (other, -1.0)))
    if spec.kind == "ball":
        return
    _need(
        not place.twisting,
        f"{where}: a weld of two ropes keeps their directions but not their twist; join them by a small free body that "
        "both are welded to, take kind 'ball', or twist 'none'",
    )
    own, theirs = place.around(spot[0][0]), place.around(other)
    _need(
        len(spot) == 1 and None in own and None in theirs,
        f"{where}: a weld joins the ends of two ropes; take the first or the last vertex of each, or kind 'ball'",
    )
    slot, near, next_ = spot[0][0], *(next(x for x in pair if x is not None) for pair in (own, theirs))
    length = place.params.rest.length.detach()
    after = place.topology.successor()
    mine, edge = (a if after[a] == b else b for a, b in ((slot, near), (other, next_)))
    ratio = length[..., edge, 0] / length[..., mine, 0]
    _need(bool((ratio == ratio.reshape(-1)[0]).all()), f"{where}: lengths of edges differ from scene to scene")
    share = float(ratio.reshape(-1)[0])
    found.add(-1, ((next_, 1.0), (other, -1.0), (slot, -share), (near, share)))
    found.edges.append(edge)


def _body(place: _Place, spec: RopeJoint, where: str) -> int:
    kinds = () if place.bodies is None else place.bodies[0]
    names = [b.name for b in kinds]
    body = names.index(spec.body) if isinstance(spec.body, str) and spec.body in names else spec.body
    known = f"0 to {len(kinds) - 1}, or one of {names}" if kinds else "but the scene has none"
    _need(
        not isinstance(body, str) and body in range(len(kinds)),
        f"{where}.body: expected a body, {known}, given {body!r}",
    )
    assert isinstance(body, int)
    kind = kinds[body]
    _need(
        kind.motion == "free",
        f"{where}.body: {kind.name!r} is {kind.motion}, and joints are for free bodies; make it free, or hold the rope "
        "by prescribed vertices instead",
    )
    return body


def _check_anchor(place: _Place, spec: RopeJoint, spot: tuple[tuple[int, float], ...], body: int, where: str) -> None:
    assert place.bodies is not None
    kinds, params, placed = place.bodies
    params, placed = tree.detach(params), tree.detach(placed)
    here = sum(w * place.state.pos.detach()[..., k, :] for k, w in spot)
    local = rotate(conjugate(placed.quat[..., body, :]), here - placed.pos[..., body, :])
    radius = float(place.params.material.radius.detach().amax())
    name = kinds[body].name
    if spec.anchor is not None:
        far = float(safe_norm(local - local.new_tensor(spec.anchor)).amax())
        _need(
            far <= radius,
            f"{where}.anchor: the rope starts {1e3 * far:.3g} mm from it; move the rope or body {name!r} so that they "
            "meet, or leave the anchor out",
        )
        return
    size, grid = params.size[..., body : body + 1, :], params.grid[..., body : body + 1, :]
    probed = shape_sdf.probe(kinds[body].shape, size, local.unsqueeze(-2), grid, kinds[body].cells)[0]
    far = float(probed.amax())
    _need(
        far <= 2 * radius,
        f"{where}: the rope starts {1e3 * far:.3g} mm off the surface of body {name!r}; move one to the other, or give "
        "the anchor in the frame of the body if they are to be joined at that distance",
    )


def _check_slots(place: _Place, found: _Found, spec: RopeJoint, where: str) -> None:
    """Refuse joints that hold what is held already."""
    start, rope = found.first[-1], spec.rope
    slots = {slot for point in found.points[start:] for slot, _ in point}
    first = place.topology.starts
    fixed = sorted(slots & set(place.held))
    _need(
        not fixed,
        f"{where}: it would move vertex {fixed[0] - first[rope] if fixed else 0}, which is prescribed; let one of the "
        "two go, or join another vertex",
    )
    twice = sorted(slots & set(found.welded))
    if spec.kind == "weld":
        twice = sorted(slots & {*found.welded, *found.balls})
        found.welded += slots
    else:
        found.balls += slots
    _need(
        not twice,
        f"{where}: vertex {twice[0] - first[rope] if twice else 0} belongs to a weld already, with its neighbours; "
        "join vertices further apart, or weld the bodies into one",
    )


def apart(
    effects: Sequence[Effect],
    joints: Joints,
    topology: Topology,
    params: RodParams,
    state: RodState,
    bodies: tuple[tuple[Body, ...], BodyParams, BodyState] | None,
) -> tuple[Effect, ...]:
    """Return effects of which contacts leave out what is joined.

    `RodBody` leaves out edges that start in a body, from its joint on; `RodContact` pairs of edges of two ropes that
    are as near to each other along them as those of one rope that it leaves out.
    """
    near = _beside(joints, topology, params)
    effects = [dataclasses.replace(e, left_out=near) if isinstance(e, RodContact) and near else e for e in effects]
    if bodies is None:
        return tuple(effects)
    kinds, solid, placed = bodies
    pos, radius = state.pos.detach(), params.material.radius.detach().expand(*state.pos.shape[:-1], 1)
    after, mask = topology.successor(), topology.edge_mask()
    before = [after.index(k) for k in range(topology.size)]
    left_out: set[tuple[int, int]] = set()
    for first, spot in zip(joints.first, joints.spots, strict=True):
        body = joints.bodies[first]
        if body < 0:
            continue
        quat, centre = placed.quat.detach()[..., body : body + 1, :], placed.pos.detach()[..., body : body + 1, :]
        size, grid = (x.detach()[..., body : body + 1, :] for x in (solid.size, solid.grid))
        local = rotate(conjugate(quat).expand(*pos.shape[:-1], 4), pos - centre)
        within = shape_sdf.probe(kinds[body].shape, size, local, grid, kinds[body].cells)[0] < 1.05 * radius
        inside = within.reshape(-1, topology.size).any(0).tolist()
        for slot, _ in spot:
            for onward in (after, before):
                here = slot
                while True:
                    edge = here if onward is after else onward[here]
                    if not mask[edge] or ((edge, body) in left_out and here != slot):
                        break
                    left_out.add((edge, body))
                    here = onward[here]
                    if not inside[here] or here == slot:
                        break
    pairs = tuple(sorted(left_out))
    return tuple(dataclasses.replace(e, left_out=pairs) if isinstance(e, RodBody) else e for e in effects)


def _beside(joints: Joints, topology: Topology, params: RodParams) -> tuple[tuple[int, int], ...]:
    """Return the edges of two ropes that are beside their joint."""
    after, mask = topology.successor(), topology.edge_mask()
    length = params.rest.length.detach().reshape(-1, topology.size).amin(0).tolist()
    radius = float(params.material.radius.detach().amax())

    def along(slot: int) -> list[tuple[int, int, float]]:
        """Edges on both sides of a vertex: how many others, and what length [m], lie between."""
        found = []
        for onward in (True, False):
            here, way = slot, 0.0
            for steps in range(topology.size):
                edge = here if onward else after.index(here)
                if not mask[edge] or (way > math.pi * radius and steps >= APART):
                    break
                found.append((edge, steps, way))
                here, way = (after[edge] if onward else edge), way + length[edge]
        return found

    pairs = set()
    for point, first, body in zip(joints.points, range(len(joints.points)), joints.bodies, strict=True):
        if body >= 0 or first not in joints.first:
            continue
        one, other = (next(slot for slot, w in point if sign * w > 0) for sign in (1, -1))
        for a, steps, way in along(one):
            for b, more, further in along(other):
                if steps + more + 1 < APART or way + further < math.pi * radius:
                    pairs.add((a, b))
    return tuple(sorted(pairs))


def directors_now(joints: Joints, params: JointParams, placed: BodyState) -> Tensor:
    """Return the first material directors of carried edges as bodies are [1], shape (..., W, 3)."""
    if not joints.frames:
        return params.director
    return (matrix(placed.quat[..., list(joints.frame_bodies), :]) @ params.director.unsqueeze(-1)).squeeze(-1)
