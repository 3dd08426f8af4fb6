"""Ropes that start inside of bodies, of ropes, or of a table: moved out before the first step, without any speed.

A step that parted them would leave them the speed with which it did. Here ropes that nothing holds move as they are,
out of what they are deepest in, until nothing overlaps. Where that does not part them, vertices move, each by the mean
of what its points need, and edges get their lengths back, and so on. What cannot be parted like that, or would be bent
so much that it jumps, such as a rope that is held on both sides of a solid, is refused.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo import notices
from torchdlo.coupling.bodies import body_starts
from torchdlo.coupling.bodies.contact_effect import BodyContact
from torchdlo.coupling.bodies.dynamics import Body, BodyParams, BodyState, PredictedBodyMotion
from torchdlo.coupling.bodies.segment_distance import find_contact_points, points_per_edge
from torchdlo.coupling.rod_body.joints import Joints
from torchdlo.coupling.rod_body.rod_body_effect import RodBody
from torchdlo.coupling.rod_contact.broad_phase import near_pairs
from torchdlo.coupling.rod_contact.closest_points import closest_points
from torchdlo.coupling.rod_contact.rod_contact_effect import RodContact
from torchdlo.physics import tree
from torchdlo.physics.constraints.edge_lengths import Lengths, settle
from torchdlo.physics.effects.base import Effect, Values
from torchdlo.physics.integrators.rod_step import Settings
from torchdlo.physics.linalg.numerics import cross, safe_norm
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.kinematics import RodParams, RodState
from torchdlo.physics.rod.topology import Topology, following

SHALLOW = 0.1
"""Overlap over the radius up to which steps part things slowly by themselves: it is left as it is."""
_DONE = 1e-3
"""Overlap over the radius at which things have parted."""
_ROUNDS = 200
_SLIDES = 50
_PATIENCE = 20
"""Rounds without getting better after which a way is given up."""
_TABLE = 1 << 30
"""What stands for the table in the place of a body."""
_G = 9.81
"""Ropes may be bent by what lifts them by their radius at this acceleration [m/s^2], and no more."""


@dataclass(frozen=True)
class _Overlaps:
    """What is too deep: one entry for each end of each edge that has to move."""

    slot: Tensor
    """First vertices of the edges [1], shape (..., N)."""
    share: Tensor
    """Where along them, 0 to 1 [1], shape (..., N)."""
    depth: Tensor
    """By how much they overlap, 0 or less if they do not [m], shape (..., N)."""
    out: Tensor
    """In which direction they part [1], shape (..., N, 3)."""
    part: Tensor
    """Which share of it they have to go themselves [1], shape (..., N)."""
    other: Tensor
    """With which body they overlap, -1 - k for the rope of slot k, or `_TABLE` [1], shape (..., N)."""
    radius: Tensor
    """Radius of the edges [m], shape (..., N)."""


def _column(x: Tensor, slot: Tensor) -> Tensor:
    return torch.gather(x.expand(*slot.shape[:-1], x.shape[-1]), -1, slot)


def _among_bodies(view: rod.View, bodies: PredictedBodyMotion, touching: RodBody) -> _Overlaps:
    pieces = touching.pieces
    at = find_contact_points(view, bodies, pieces)
    shape = at.share.shape[:-1]
    radius = view.params.material.radius[..., 0].unsqueeze(-2).expand(shape)
    slots = torch.arange(shape[-1], device=radius.device).expand(shape)
    real = (view.params.rest.edge_mask[..., 0] > 0).expand(shape)
    depth = torch.where(real, radius - at.distance[..., 0], -1.0)
    which = [k for k, body in enumerate(bodies.bodies) for _ in range(points_per_edge(body, pieces))]
    other = torch.tensor(which, device=radius.device)[:, None].expand(shape)
    for edge, body in touching.left_out:
        depth = torch.where((slots == edge) & (other == body), -1.0, depth)
    flat = (x.flatten(-2) for x in (slots, at.share[..., 0], depth))
    part, other = torch.ones_like(depth).flatten(-2), other.flatten(-2)
    return _Overlaps(*[*flat, at.normal.flatten(-3, -2), part, other, radius.flatten(-2)])


def _among_ropes(view: rod.View, free: Tensor, touching: RodContact) -> _Overlaps:
    topology, pos = view.topology, view.state.pos
    reach = pos.new_zeros(*pos.shape[:-2], 1, 1)
    first, second, there, _ = near_pairs(topology, view.params, pos, reach, max(64, 8 * topology.size), 64)
    after = following(topology, pos)

    def points(x: Tensor, slot: Tensor) -> Tensor:
        return torch.gather(x, -2, slot.unsqueeze(-1).expand(*slot.shape, 3))

    a, b = (points(pos, first), points(after, first)), (points(pos, second), points(after, second))
    s, t = closest_points(a, b)
    between = a[0] + s * (a[1] - a[0]) - b[0] - t * (b[1] - b[0])
    distance = safe_norm(between)
    radius = view.params.material.radius[..., 0]
    thick = _column(radius, first) + _column(radius, second)
    across = cross(a[1] - a[0], b[1] - b[0])  # where centrelines meet
    out = torch.where(distance > 0.01 * thick.unsqueeze(-1), between, across)
    out = out / safe_norm(out).clamp(min=1e-30)
    kept = (there > 0) & touching.kept(topology.size, first, second)
    depth = torch.where(kept, thick - distance[..., 0], -1.0)
    mobile = torch.maximum(free, following(topology, free))[..., 0]
    one, two = _column(mobile, first), _column(mobile, second)
    share = one / (one + two).clamp(min=1e-9), two / (one + two).clamp(min=1e-9)
    both = (
        (first, second), (s[..., 0], t[..., 0]), (depth, depth), (out, -out), share, (-1 - second, -1 - first),
        (_column(radius, first), _column(radius, second)),
    )  # fmt: skip
    return _Overlaps(*(torch.cat(x, -2 if x[0].dim() > depth.dim() else -1) for x in both))


def _on_table(view: rod.View, free: Tensor, values: dict[str, Values]) -> _Overlaps:
    """Return how far vertices are below where they would rest on a table."""
    pos, surface = view.state.pos, values["table"]
    sunk = 0.0
    if "gravity" in values:
        sunk = values["gravity"]["acceleration"].norm(dim=-1, keepdim=True) / surface["hardness"].square()
    radius = view.params.material.radius
    depth = torch.where(free > 0, surface["height"] + radius - sunk - pos[..., 2:], -1.0)[..., 0].detach()
    slot = torch.arange(depth.shape[-1], device=depth.device).expand(depth.shape)
    up = torch.zeros(3, dtype=depth.dtype, device=depth.device)
    up[2] = 1.0
    none, other = torch.zeros_like(depth), torch.full_like(slot, _TABLE)
    out, part = up.expand(*depth.shape, 3), torch.ones_like(depth)
    return _Overlaps(slot, none, depth, out, part, other, radius[..., 0].detach().expand(depth.shape))


def _joined(parts: Sequence[_Overlaps]) -> _Overlaps:
    names = ("slot", "share", "depth", "out", "part", "other", "radius")
    joined = []
    for name in names:
        xs = [getattr(p, name) for p in parts]
        axes = 2 if name == "out" else 1
        batch = torch.broadcast_shapes(*(x.shape[:-axes] for x in xs))
        joined.append(torch.cat([x.expand(*batch, *x.shape[-axes:]) for x in xs], -axes))
    return _Overlaps(*joined)


def _shift(topology: Topology, found: _Overlaps) -> Tensor:
    """Return by how much vertices move out [m], shape (..., V, 3)."""
    after = torch.tensor(topology.successor(), device=found.slot.device)
    active = (found.depth > 0).to(found.depth.dtype)
    wish = (found.depth * found.part * active).unsqueeze(-1) * found.out
    weights = torch.cat([(1 - found.share) * active, found.share * active], -1)
    slots = torch.cat([found.slot, after[found.slot]], -1)
    whole = torch.zeros(*weights.shape[:-1], topology.size, 4, dtype=wish.dtype, device=wish.device)
    rows = torch.cat([weights.unsqueeze(-1) * torch.cat([wish, wish], -2), weights.unsqueeze(-1)], -1)
    whole = whole.scatter_add(-2, slots.unsqueeze(-1).expand(rows.shape), rows)
    return whole[..., :3] / whole[..., 3:].clamp(min=1e-12)


def _slide(topology: Topology, found: _Overlaps, free: Tensor) -> Tensor:
    """Return by how much ropes that nothing holds move out of what they are deepest in [m], shape (..., V, 3)."""
    parts = []
    for start, count in zip(topology.starts, topology.counts, strict=True):
        loose = bool((free[start : start + count] > 0).all())
        own = (found.slot >= start) & (found.slot < start + count)
        depth, at = torch.where(own, found.depth, -1.0).max(-1, keepdim=True)
        out = torch.take_along_dim(found.out, at.unsqueeze(-1), -2)
        # Where two ropes part, the one that is held does not.
        share = torch.take_along_dim(found.part, at, -1)
        way = (depth.clamp(min=0.0) * share).unsqueeze(-1) * out * float(loose)
        parts.append(way.expand(*way.shape[:-2], count, 3))
    return torch.cat(parts, -2)


def _bent(topology: Topology, rods: RodParams, state: RodState, pos: Tensor) -> bool:
    """Return whether a rope was bent by more energy than lifts it by its radius."""
    before, now = (rod.view(topology, rods, tree.replace(state, pos=x), 1.0) for x in (state.pos, pos))
    turned = (now.binormal() - before.binormal()).square().sum(-1, keepdim=True)
    work = 0.5 * rods.material.bend[..., :1] / now.hinge_length * turned * rods.rest.hinge_mask
    lift = _G * rods.material.mass * rods.material.radius
    batch = torch.broadcast_shapes(work.shape[:-2], lift.shape[:-2])
    work, lift = (x.expand(*batch, topology.size, 1) for x in (work, lift))
    return any(
        bool((work[..., k : k + n, 0].sum(-1) > lift[..., k : k + n, 0].sum(-1)).any())
        for k, n in zip(topology.starts, topology.counts, strict=True)
    )


def part(
    settings: Settings,
    rods: RodParams,
    values: dict[str, Values],
    state: RodState,
    bodies: tuple[tuple[Body, ...], BodyParams, BodyState] | None,
    joints: Joints | None = None,
) -> tuple[RodState, BodyState | tuple[()]]:
    """Return ropes and bodies moved out of what they start in, with a notice; the same if they start in nothing.

    Args:
        settings: ropes and effects of the scene; only what its contacts keep apart is parted.
        rods: rest shape and material, as effects alter them.
        values: numbers of the effects.
        state: the ropes.
        bodies: the bodies with their numbers and states, None if there are none.
        joints: what ropes are joined to; their vertices and bodies stay where they are.

    Raises:
        ValueError: names what overlaps, and by how much, where it could not be parted.
    """
    names = {e.name: e for e in settings.effects}
    touching = "rod_body" in names and bodies is not None, "rod_contact" in names, "table" in names
    placed: BodyState | tuple[()] = ()
    if bodies is not None:
        among = names.get("body_contact")
        tied = () if joints is None else joints.bodies
        placed = body_starts.part_bodies(among, bodies, tied) if isinstance(among, BodyContact) else bodies[2]
        bodies = (*bodies[:2], placed)
    if not any(touching):
        return state, placed
    held = (*settings.prescribed_vertices, *(() if joints is None else joints.slots))
    with torch.no_grad():
        moved = _part(settings.topology, (names, values), rods, state, bodies, held, settings.constrained)
    return moved, placed


def _part(topology, laws, rods, state, bodies, held, constrained) -> RodState:
    start = state.pos.detach()
    free = start.new_ones(topology.size, 1)
    free[list(held)] = 0.0

    def look(pos: Tensor) -> _Overlaps:
        return _look(rod.view(topology, rods, tree.replace(state, pos=pos), 1.0), laws, bodies, free)

    found = look(start)
    wrong = _over(found) > SHALLOW
    if not bool(wrong.any()):
        return state
    deepest, what = _deepest(topology, found, bodies)
    length = rods.rest.length.detach()
    active = rods.rest.edge_mask * (1 - (1 - free) * (1 - following(topology, free)))
    lengths = Lengths(topology, length, torch.zeros_like(length), active, rods.rest.edge_mask)
    answer = free / rods.material.mass.detach()

    def slide(pos: Tensor, found: _Overlaps) -> Tensor:
        return pos + _slide(topology, found, free)

    def bend(pos: Tensor, found: _Overlaps) -> Tensor:
        moved = pos + free * _shift(topology, found)
        return settle(lengths, moved, torch.zeros_like(moved), answer)[0] if constrained else moved

    pos, wrong = _moved(start, found, wrong, look, ((slide, _SLIDES), (bend, _ROUNDS)))
    edge = rod.edge_vectors(topology, pos, rods.rest.edge_mask).norm(dim=-1, keepdim=True)
    strained = bool(((edge / length - 1) * active).abs().amax() > 1e-4) if constrained else False
    if bool(wrong.any()) or strained or _bent(topology, rods, state, pos):
        raise ValueError(
            f"scene: {what} starts {1e3 * deepest:.3g} mm deep, and cannot be moved out along its normals; place it "
            "outside, or leave out the effect that keeps them apart"
        )
    most = float(safe_norm(pos - start).amax())
    notices.once(
        "start overlap",
        f"scene: {what} starts {1e3 * deepest:.3g} mm deep; it was moved out, without speed, by {1e3 * most:.3g} mm at "
        "most.",
    )
    there = state.pos + (pos - start)
    director, ref_twist = rod.advance_frames(topology, rods, rod.view(topology, rods, state, 1.0), there)
    return tree.replace(state, pos=tree.batch_innermost(there), director=director, ref_twist=ref_twist)


def _look(view: rod.View, laws: tuple[dict[str, Effect], Any], bodies: Any, free: Tensor) -> _Overlaps:
    """Return what overlaps, but for edges beside what is held, which is where it was put."""
    (names, values), parts = laws, []
    touching = names.get("rod_body")
    if isinstance(touching, RodBody) and bodies is not None:
        kinds, params, placed = bodies
        none = torch.zeros_like(placed.pos)
        motion = PredictedBodyMotion(kinds, params, placed, 1.0, none, none, none[..., :1], none)
        parts.append(_among_bodies(view, motion, touching))
    among = names.get("rod_contact")
    if isinstance(among, RodContact):
        parts.append(_among_ropes(view, free, among))
    if parts:
        found = _joined(parts)
        mobile = (free * view.next(free))[..., 0].expand(*found.slot.shape[:-1], -1) > 0
        parts = [dataclasses.replace(found, depth=torch.where(_column(mobile, found.slot), found.depth, -1.0))]
    if "table" in names:
        parts.append(_on_table(view, free, values))
    return _joined(parts)


def _over(found: _Overlaps) -> Tensor:
    """Return the deepest overlap over the radius [1], shape (..., 1, 1)."""
    return (found.depth / found.radius).amax(-1, keepdim=True).unsqueeze(-1)


def _moved(
    start: Tensor, first: _Overlaps, wrong: Tensor, look: Callable[[Tensor], _Overlaps], ways: Sequence[Any]
) -> tuple[Tensor, Tensor]:
    """Return positions after ways to move have been tried one after the other, and which scenes none has parted."""
    there = start
    for way, rounds in ways:
        found, there = first, torch.where(wrong, start, there)
        least, since = float("inf"), 0
        for _ in range(rounds):
            before, there = there, torch.where(wrong, way(there, found), there)
            if torch.equal(before, there):  # ropes that are held do not slide
                break
            found = look(there)
            if not bool((wrong & ~(_over(found) < _DONE)).any()):
                break
            left = float(torch.where(wrong, _over(found), 0.0).sum())
            least, since = (left, 0) if left < 0.99 * least else (least, since + 1)
            if since == _PATIENCE:
                break
        wrong = wrong & ~(_over(found) < SHALLOW)
        if not bool(wrong.any()):
            break
    return there, wrong


def _deepest(topology: Topology, found: _Overlaps, bodies) -> tuple[float, str]:
    """Return how deep the deepest overlap is [m], and what overlaps there."""
    at = int(found.depth.argmax())
    slot, other = (int(x.flatten()[at]) for x in (found.slot, found.other))
    ropes = [k for k, n in enumerate(topology.counts) for _ in range(n)]
    it = f"rope {ropes[-1 - other]}" if other < 0 else "the table" if other == _TABLE else ""
    it = it or f"body {bodies[0][other].name!r}"
    return float(found.depth.flatten()[at]), f"rope {ropes[slot]} in {it}"
