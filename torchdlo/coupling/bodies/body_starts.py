"""Free bodies that start inside of others: moved out before the first step, without any speed.

Each moves along the normal of what it is deepest in, all the way out of what cannot move, and by its share of the
masses out of what can, until nothing overlaps. What cannot be parted like that, or only by more than bodies are large,
is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo import notices
from torchdlo.coupling.bodies.contact_effect import BodyContact
from torchdlo.coupling.bodies.contact_points import deepest_points
from torchdlo.coupling.bodies.dynamics import Body, BodyParams, BodyState, PredictedBodyMotion, conjugate
from torchdlo.coupling.bodies.shape_sdf import SIZES
from torchdlo.physics import tree
from torchdlo.physics.linalg.rotation import rotate

_SHALLOW = 0.1
"""Overlap over how large the smaller body is up to which, if it is shallow for contact too, it is left as it is."""
_DONE = 1e-3
"""Share of that at which bodies have parted."""
_ROUNDS = 200

Bodies = tuple[tuple[Body, ...], BodyParams, BodyState]


def _bounds(kinds: Sequence[Body], size: Tensor) -> Tensor:
    """Return radii about their centres of mass in which bodies are, 0 for planes [m], shape (..., K, 1)."""
    found = []
    for k, body in enumerate(kinds):
        own = size[..., k : k + 1, : len([word for word in SIZES[body.shape] if "angle" not in word])]
        round_ = body.shape in ("capsule", "torus", "ring")
        # Centres of mass of rings and meshes are anywhere within.
        wide = 2.0 if body.shape in ("ring", "mesh") else 1.0
        found.append(wide * (own.sum(-1, keepdim=True) if round_ else own.norm(dim=-1, keepdim=True)))
    return torch.cat(found, -2)


def _near(bodies: Bodies, pos: Tensor, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return which pairs may overlap in any scene."""
    kinds, params, placed = bodies
    bound, chosen = _bounds(kinds, params.size)[..., 0], []
    for p, (one, other) in enumerate(pairs):
        between = pos[..., other, :] - pos[..., one, :]
        away = between.norm(dim=-1)
        for flat, sign in ((one, 1.0), (other, -1.0)):
            if kinds[flat].shape == "plane":
                away = rotate(conjugate(placed.quat[..., flat, :]), sign * between)[..., 2]
        if bool((away < bound[..., one] + bound[..., other]).any()):
            chosen.append(p)
    return chosen


def _deepest(bodies: Bodies, pos: Tensor, pairs: Sequence[tuple[int, int]], points: int) -> tuple[Tensor, Tensor]:
    """Return how deep pairs overlap at most [m], shape (..., P), and from the second to the first, (..., P, 3).

    Depths are -1 where bodies are too far from each other to overlap.
    """
    kinds, params, placed = bodies
    near = _near(bodies, pos, pairs)
    deepest = pos.new_full((*pos.shape[:-2], len(pairs)), -1.0)
    out = pos.new_zeros(*pos.shape[:-2], len(pairs), 3)
    if not near:
        return deepest, out
    none = torch.zeros_like(pos)
    there = tree.replace(placed, pos=pos)
    motion = PredictedBodyMotion(kinds, params, there, 1.0, none, none, none[..., :1], none)
    found, counts = deepest_points(motion, tuple(pairs[p] for p in near), points)
    start = 0
    for p, count in zip(near, counts, strict=True):
        part = slice(start, start + count)
        depth, at = (-found.gap[..., part, 0]).max(-1, keepdim=True)
        deepest[..., p] = depth[..., 0]
        out[..., p, :] = torch.take_along_dim(found.normal[..., part, :], at.unsqueeze(-1), -2)[..., 0, :]
        start += count
    return deepest, out


def _ways(depth: Tensor, out: Tensor, pairs: Sequence[tuple[int, int]], mobility: Tensor) -> Tensor:
    """Return by how much bodies move out of what each is deepest in [m], shape (..., K, 3)."""
    moves = []
    for k in range(mobility.shape[-2]):
        own = [(p, sign) for p, pair in enumerate(pairs) for sign, body in zip((1, -1), pair, strict=True) if body == k]
        if not own:
            moves.append(torch.zeros_like(out[..., 0, :]))
            continue
        sides = depth.new_tensor([float(sign) for _, sign in own])
        mine = depth[..., [p for p, _ in own]]
        one, two = (mobility[..., [pairs[p][side] for p, _ in own], 0] for side in (0, 1))
        share = mobility[..., k : k + 1, 0] / (one + two).clamp(min=1e-30)
        most, at = mine.max(-1, keepdim=True)
        way = (most.clamp(min=0.0) * torch.take_along_dim(share.expand_as(mine), at, -1)).unsqueeze(-1)
        along = out[..., [p for p, _ in own], :] * sides.unsqueeze(-1)
        moves.append((way * torch.take_along_dim(along, at.unsqueeze(-1), -2))[..., 0, :])
    return torch.stack(moves, -2)


def part_bodies(contact: BodyContact, bodies: Bodies, joined: Sequence[int] = ()) -> BodyState:
    """Return the bodies moved out of what they start in, with one notice; the same if they start in nothing.

    Args:
        contact: which of them may touch, and which overlaps are shallow.
        bodies: static choices, numbers, and states.
        joined: bodies that ropes are joined to: they stay where they are.

    Raises:
        ValueError: names what overlaps, and by how much, where it could not be parted.
    """
    kinds, params, placed = bodies
    pairs = contact.chosen(kinds)
    if not pairs:
        return placed
    with torch.no_grad():
        return _parted(contact, (kinds, tree.detach(params), placed), pairs, joined)


def _parted(contact: BodyContact, bodies: Bodies, pairs: Sequence[tuple[int, int]], joined: Sequence[int]) -> BodyState:
    kinds, params, placed = bodies
    batch = torch.broadcast_shapes(placed.pos.shape[:-2], *(x.shape[:-2] for x in tree.leaves(params)))
    start = placed.pos.detach().expand(*batch, *placed.pos.shape[-2:])
    free = start.new_tensor([[float(b.motion == "free" and k not in joined)] for k, b in enumerate(kinds)])
    # Balls are as large as this; a plane has no size.
    large = (5 / 6 * params.inertia.sum(-1, keepdim=True) / params.mass).sqrt()
    real = start.new_tensor([[b.motion == "free"] for b in kinds]) > 0
    own = torch.where(real, large, torch.inf)[..., 0]
    least = torch.minimum(own[..., [a for a, _ in pairs]], own[..., [b for _, b in pairs]])
    most = (_SHALLOW * least).clamp(max=max(contact.shallow, 1e-9))
    depth, out = _deepest(bodies, start, pairs, contact.points)
    over = (depth / most).amax(-1)
    wrong = (over > 1)[..., None, None]
    if not bool(wrong.any()):
        return placed
    worst = int((depth / most).argmax()) % len(pairs)
    deep = float(depth.reshape(-1, len(pairs))[:, worst].amax())
    first, second = (kinds[k] for k in sorted(pairs[worst], key=lambda k: kinds[k].motion != "free"))
    what = f"scene: body {first.name!r} in body {second.name!r} starts {1e3 * deep:.3g} mm deep"
    pos = start
    for _ in range(_ROUNDS):
        pos = pos + torch.where(wrong, _ways(depth, out, pairs, free / params.mass), 0.0)
        depth, out = _deepest(bodies, pos, pairs, contact.points)
        if not bool((wrong[..., 0, 0] & ((depth / most).amax(-1) > _DONE)).any()):
            break
    went = (pos - start).norm(dim=-1)
    if bool(((depth > most).any(-1) & wrong[..., 0, 0]).any()) or bool((went > large[..., 0]).any()):
        tied = "; what ropes are joined to stays where it is" if set(pairs[worst]) & set(joined) else ""
        raise ValueError(
            f"{what}, and cannot be moved out along its normals{tied}; place it outside, or leave the pair out of "
            "BodyContact"
        )
    notices.once(
        "start overlap of bodies",
        f"{what}; it was moved out, without speed, by {1e3 * float(went.max()):.3g} mm at most.",
    )
    return tree.replace(placed, pos=tree.batch_innermost(placed.pos + (pos - start)))
