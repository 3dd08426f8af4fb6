"""From what a person knows of a rope (shape, radius, weight, stiffness) to the tensors of the rods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from torchdlo.field_docs import with_field_docs
from torchdlo.physics import tree
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import cross, dot, normalize
from torchdlo.physics.rod import validation
from torchdlo.physics.rod.kinematics import Material, RodParams, RodRest, RodState, edge_vectors
from torchdlo.physics.rod.topology import Topology, preceding

Number = float | Tensor


@with_field_docs
@dataclass(frozen=True, eq=False)
class Rope:
    """One rope. Numbers are floats, or tensors (..., n) per edge or hinge, or (...,) or (..., 1) per scene.

    A rope that is given once, with numbers for B scenes, (B, 1) or (B, n) or (B, n, 1), is a rope in each of them.
    """

    positions: Tensor
    """Where its vertices are at the start [m], shape (..., n, 3)."""
    radius: Number = 0.005
    """Radius [m]."""
    mass: Number | None = None
    """Mass of the whole rope [kg], spread evenly over its length; or give `density`."""
    density: Number | None = None
    """Density [kg/m^3]."""
    youngs: Number | None = None
    """Young's modulus E [Pa]; sets `bend` = E pi r^4/4."""
    shear: Number | None = None
    """Shear modulus G [Pa]; sets `twist` = G pi r^4/2."""
    bend: Number | None = None
    """Bending stiffness [N m^2], in place of `youngs`; (..., 2) in a tuple of two for two directions."""
    twist: Number | None = None
    """Twisting stiffness [N m^2], in place of `shear`."""
    stretch: Number = float("inf")
    """Axial stiffness EA [N]; infinite: inextensible.

    Of ropes that hands or bodies pull taut, give the true stiffness, or one that keeps strains small. An inextensible
    rope snaps: what follows depends on where the hands are to within 1e-4 of its length, so that gradients are steep
    and soon of either sign. They are right in explicit steps if `Scene.constraint_iterations` is 8; with 3, the one of
    a rope of four edges was off by a fifth. In implicit steps it shakes without end, and its gradients mean nothing.
    With a finite EA of 1 kN they agreed with differences to four digits in both.
    """
    closed: bool = False
    """Whether the last vertex is joined to the first."""
    rest: Literal["straight", "as_placed"] | Tensor = "straight"
    """Undeformed shape: straight, as placed, or vertex positions (..., n, 3) of it [m]."""
    rest_curvature: Tensor | None = None
    """Natural curvature towards the two material directors, in place of `rest`'s [1/m], shape (..., n, 2)."""
    rest_twist: Number | None = None
    """Natural twist, in place of `rest`'s [rad/m]."""
    velocities: Tensor | None = None
    """Initial velocities [m/s], shape (..., n, 3); at rest if not given."""
    director: Tensor | None = None
    """First material director of the first edge [1], shape (..., 3); made normal to it. Any if not given."""
    rest_director: Tensor | None = None
    """The same in the rest shape [1], shape (..., 3); `director` if not given."""
    bend2: Number | None = None
    """Bending stiffness [N m^2] against bending towards the second material director if it differs from `bend`."""


def clamp_at_vertices(topology: Topology, rods: RodParams, held: Sequence[int]) -> RodParams:
    """Return rods that are clamped at the last held vertex of a run of them, not in the middle of its edge.

    The hinge there stands for half of the free edge only. The tip of a beam of n edges then sags as in beam theory to
    within 1 / (2 n^2).

    Args:
        topology: the rods.
        rods: their parameters.
        held: held vertices.
    """
    after, mask = topology.successor(), topology.edge_mask()
    length, both = rods.rest.length, rods.rest.length + preceding(topology, rods.rest.length)
    share = rods.rest.share.expand(*rods.rest.share.shape[:-2], topology.size, 1)
    for before, k in enumerate(after):
        onward = k in held and mask[before] > 0 and mask[k] > 0
        if not onward or (before in held) == (after[k] in held):
            continue
        free = length[..., k, :] if before in held else length[..., before, :]
        there = torch.arange(topology.size, device=share.device).unsqueeze(-1) == k
        share = torch.where(there, (free / both[..., k, :]).unsqueeze(-2), share)
    return tree.replace(rods, rest=tree.replace(rods.rest, share=share))


def bishop(topology: Topology, pos: Tensor, edge_mask: Tensor, first: Sequence[Tensor | None]) -> Tensor:
    """Return directors without twist along each rod, shape (..., V, 3); the holonomy of loops is spread evenly.

    Args:
        topology: the rods.
        pos: vertex positions [m], shape (..., V, 3).
        edge_mask: 1 for real edges, shape (V, 1).
        first: director of each rod's first edge, or None for any.
    """
    tangent = normalize(edge_vectors(topology, pos, edge_mask))
    out: list[Tensor] = []
    for start, count, loop, given in zip(topology.starts, topology.counts, topology.closed, first, strict=True):
        t = [tangent[..., start + k, :] for k in range(count)]
        if given is None:
            d = rotation.any_normal(t[0])
        else:
            d = normalize(given - t[0] * dot(given, t[0]))
        carried = [d]
        for k in range(1, count):
            carried.append(rotation.transport(carried[-1], t[k - 1], t[k]))
        directors = torch.stack(torch.broadcast_tensors(*carried), -2)
        if loop:
            back = rotation.transport(carried[-1], t[-1], t[0])
            holonomy = rotation.signed_angle(d, back, t[0]).unsqueeze(-2)
            share = torch.arange(count, dtype=pos.dtype, device=pos.device).unsqueeze(-1) / count
            directors = rotation.about(torch.stack(t, -2), -holonomy * share, directors)
        out.append(directors)
    return tree.batch_innermost(torch.cat(out, -2))


def frame_curvature(
    topology: Topology, pos: Tensor, director: Tensor, edge_mask: Tensor, hinge_mask: Tensor
) -> tuple[Tensor, Tensor]:
    """Return integrated curvatures (..., V, 2) and twists (..., V, 1) of a shape in given material frames."""
    t = normalize(edge_vectors(topology, pos, edge_mask))
    tp = preceding(topology, t)
    kb = 2 * cross(tp, t) / (1 + dot(tp, t)).clamp(min=1e-6)
    m1, m2 = director, cross(t, director)
    kappa = torch.cat([dot(kb, preceding(topology, m2) + m2), -dot(kb, preceding(topology, m1) + m1)], -1) / 2
    carried = rotation.transport(preceding(topology, director), tp, t)
    return kappa * hinge_mask, rotation.signed_angle(carried, director, t) * hinge_mask


def _columns(value: Number, positions: Tensor) -> Number:
    """Return a number; those that are columns (..., n, 1) already, with more axes than scenes have, as (..., n)."""
    if not isinstance(value, Tensor) or value.shape[-2:] != (positions.shape[-2], 1):
        return value
    # (n, 1) is n scenes that share a number along the rope.
    return value.squeeze(-1) if value.dim() >= max(positions.dim(), 3) else value


def _flat(rope: Rope) -> Rope:
    """Return a rope whose numbers along it have its vertices as their last axis."""
    given: dict[str, Any] = {
        name: getattr(rope, name) for name in validation.NUMBERS if getattr(rope, name) is not None
    }
    columns: dict[str, Any] = {name: _columns(value, rope.positions) for name, value in given.items()}
    return replace(rope, **columns)


def _scenes(rope: Rope) -> torch.Size:
    """Return the batch axes of a rope: those of its positions and of its numbers."""
    n, batches = rope.positions.shape[-2], [rope.positions.shape[:-2]]
    for name in validation.NUMBERS:
        value = getattr(rope, name)
        if isinstance(value, Tensor):
            batches.append(_column(value, n, rope.positions, name).shape[:-2])
    return torch.broadcast_shapes(*batches)


def _column(value: Number | None, count: int, like: Tensor, what: str, default: float | None = None) -> Tensor:
    """Return a number as (..., count, 1)."""
    if value is None:
        if default is None:
            raise ValueError(f"rope: {what} is missing")
        value = default
    if not isinstance(value, Tensor):
        return like.new_full((count, 1), float(value))
    if value.dim() and value.shape[-1] == count:
        return value.to(like).unsqueeze(-1)
    if value.dim() and value.shape[-1] == 1:
        return value.to(like).unsqueeze(-1).expand(*value.shape[:-1], count, 1)
    return value.to(like)[..., None, None].expand(*value.shape, count, 1)


def assemble(ropes: Sequence[Rope]) -> tuple[Topology, RodParams, RodState]:
    """Pack ropes on one vertex axis.

    Returns:
        The topology, and parameters and state with the batch axes of the ropes.
    """
    validation.check_sequence(ropes, Rope, "ropes")
    if not ropes:
        raise ValueError("no rope given; a scene needs at least one")
    for index, rope in enumerate(ropes):
        validation.check_rope(index, rope)
    ropes = [_flat(rope) for rope in ropes]
    validation.check_ropes(ropes)
    topology = Topology(tuple(r.positions.shape[-2] for r in ropes), tuple(r.closed for r in ropes))
    batch = torch.broadcast_shapes(*(_scenes(r) for r in ropes))
    like = ropes[0].positions

    def pack(parts: Sequence[Tensor]) -> Tensor:
        lead = torch.broadcast_shapes(*(p.shape[:-2] for p in parts))
        return tree.batch_innermost(torch.cat([p.expand(lead + p.shape[-2:]) for p in parts], -2))

    edge_mask = like.new_tensor(topology.edge_mask()).unsqueeze(-1)
    hinge_mask = like.new_tensor(topology.hinge_mask()).unsqueeze(-1)
    pos = pack([r.positions.to(like).expand(batch + r.positions.shape[-2:]) for r in ropes])
    shapes = pack([(r.rest if isinstance(r.rest, Tensor) else r.positions).to(like) for r in ropes])
    given = [None if r.director is None else r.director.to(like) for r in ropes]

    given_rest = [g if r.rest_director is None else r.rest_director.to(like) for g, r in zip(given, ropes, strict=True)]
    rest_director = bishop(topology, shapes, edge_mask, given_rest)
    length = edge_vectors(topology, shapes, edge_mask).norm(dim=-1, keepdim=True)
    length = torch.where(edge_mask > 0, length, 1.0)
    kappa, twist = frame_curvature(topology, shapes, rest_director, edge_mask, hinge_mask)
    curved = pack(
        [
            like.new_full((r.positions.shape[-2], 1), float(r.rest != "straight" if isinstance(r.rest, str) else 1))
            for r in ropes
        ]
    )
    kappa, twist = _given_strains(topology, ropes, length, hinge_mask, kappa * curved, twist * curved)
    rest = RodRest(length, kappa, twist, like.new_ones(1, 1), edge_mask, hinge_mask)

    director = bishop(topology, pos, edge_mask, given)
    _, reference = frame_curvature(topology, pos, director, edge_mask, hinge_mask)
    reference = tree.batch_innermost(reference)
    zero = torch.zeros_like(pos[..., :1])
    velocities = pack(
        [(torch.zeros_like(r.positions) if r.velocities is None else r.velocities).to(like) for r in ropes]
    )
    state = RodState(
        pos, velocities.expand_as(pos), zero, zero, director, reference, torch.zeros_like(pos[..., :2]), zero
    )
    return topology, RodParams(rest, _material(topology, ropes, rest, pack, like)), state


def _given_strains(
    topology: Topology, ropes: Sequence[Rope], length: Tensor, hinge_mask: Tensor, kappa: Tensor, twist: Tensor
) -> tuple[Tensor, Tensor]:
    """Return integrated curvatures and twists with those that ropes give themselves put in."""
    span = 0.5 * (length + preceding(topology, length)) * hinge_mask
    for start, rope in zip(topology.starts, ropes, strict=True):
        n = rope.positions.shape[-2]
        here = slice(start, start + n)
        if rope.rest_curvature is not None:
            if rope.rest_curvature.shape[-2:] != (n, 2):
                given = tuple(rope.rest_curvature.shape)
                raise ValueError(
                    f"rope: rest_curvature is {given}; expected (..., {n}, 2), two curvatures [1/m] per vertex"
                )
            kappa = _put(kappa, here, rope.rest_curvature.to(kappa) * span[..., here, :])
        if rope.rest_twist is not None:
            twist = _put(twist, here, _column(rope.rest_twist, n, twist, "rest_twist") * span[..., here, :])
    return kappa, twist


def _put(whole: Tensor, here: slice, part: Tensor) -> Tensor:
    lead = torch.broadcast_shapes(whole.shape[:-2], part.shape[:-2])
    pieces = [whole[..., : here.start, :], part, whole[..., here.stop :, :]]
    return tree.batch_innermost(torch.cat([p.expand(lead + p.shape[-2:]) for p in pieces], -2))


def _material(topology: Topology, ropes: Sequence[Rope], rest: RodRest, pack, like: Tensor) -> Material:
    columns: dict[str, list[Tensor]] = {name: [] for name in ("stretch", "bend", "twist", "radius", "line")}
    for start, rope in zip(topology.starts, ropes, strict=True):
        n = rope.positions.shape[-2]
        r = _column(rope.radius, n, like, "radius")
        if rope.mass is not None:
            real = (rest.length * rest.edge_mask)[..., start : start + n, :]
            line = _column(rope.mass, n, like, "mass") / real.sum(-2, keepdim=True)
        else:
            line = _column(rope.density, n, like, "density") * torch.pi * r.square()
        bend = (
            _column(rope.bend, n, like, "bend")
            if rope.bend is not None
            else (_column(rope.youngs, n, like, "youngs", 0.0) * torch.pi * r.pow(4) / 4)
        )
        second = bend if rope.bend2 is None else _column(rope.bend2, n, like, "bend2")
        both = any(other.bend2 is not None for other in ropes)
        columns["bend"].append(torch.cat(torch.broadcast_tensors(bend, second), -1) if both else bend)
        columns["twist"].append(
            _column(rope.twist, n, like, "twist")
            if rope.twist is not None
            else (_column(rope.shear, n, like, "shear", 0.0) * torch.pi * r.pow(4) / 2)
        )
        columns["stretch"].append(_column(rope.stretch, n, like, "stretch"))
        columns["radius"].append(r)
        columns["line"].append(line)
    packed = {name: pack(parts) for name, parts in columns.items()}
    edge_mass = packed.pop("line") * rest.length * rest.edge_mask
    mass = 0.5 * (edge_mass + preceding(topology, edge_mass))
    inertia = torch.where(rest.edge_mask > 0, 0.5 * edge_mass * packed["radius"].square(), 1.0)
    return Material(packed["stretch"], packed["bend"], packed["twist"], mass, inertia, packed["radius"])
