"""Starts that keep a rope's length: what is interpolated between markers is a little too long or too short.

Where it is so by far, as of a rope that stretches, of markers that lag behind the grippers, or of a marker taken for
another one, Newton's method for the nearest positions leads astray: it does not come to an end, or it folds a free end
back. It starts then from edges of the right length in the measured directions, laid one behind the other from what is
held.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.constraints import edge_lengths
from torchdlo.physics.linalg.numerics import normalize, safe_norm

_MISSED = 1e-3
"""Share of its length by which an edge may miss it where Newton's method is trusted."""


def agreeing_state(scene: scenes.Scene, params: scenes.Params, state: scenes.State) -> scenes.State:
    """Return the state with positions and velocities that keep the rope's length.

    Args:
        scene: one rope.
        params: its numbers.
        state: where it was measured to be; held vertices stay there.
    """
    rest, rods = params.rods.rest, state.rods
    free = torch.ones(scene.topology.size, 1)
    free[list(scene.prescribed_vertices)] = 0.0
    free = free.to(rods.pos)
    active = rest.edge_mask * (1 - (1 - free) * (1 - torch.roll(free, -1, -2)))
    lengths = edge_lengths.Lengths(scene.topology, rest.length, torch.zeros_like(rest.length), active, rest.edge_mask)

    measured = torch.roll(rods.pos, -1, -2) - rods.pos

    def settled(pos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mobility = free / params.rods.material.mass
        pos, vel = edge_lengths.settle(lengths, pos, rods.vel, mobility, recorded=True)
        edge = torch.roll(pos, -1, -2) - pos
        missed = ((safe_norm(edge) / rest.length - 1).abs() * active).amax(-2, keepdim=True)
        folded = ((edge * measured).sum(-1, keepdim=True) < 0) & (active > 0)
        astray = folded.any(-2, keepdim=True) | missed.isnan()
        return pos, vel, torch.where(astray, torch.inf, missed)

    pos, vel, missed = settled(rods.pos)
    diverged = missed > _MISSED
    if bool(diverged.any()):
        other = settled(lay_rope(rods.pos, rest.length, scene.prescribed_vertices or (0,), scene.topology.closed[0]))
        # Only there: elsewhere both agree with the lengths, but they are not the same.
        better = diverged & (other[2] < missed)
        pos, vel, missed = (torch.where(better, b, a) for a, b in zip((pos, vel, missed), other, strict=True))
    lost = ~torch.isfinite(pos).all(-1).all(-1)[:, None, None]
    pos, vel = torch.where(lost, rods.pos, pos), torch.where(lost, rods.vel, vel)
    return tree.replace(state, rods=tree.replace(rods, pos=tree.batch_innermost(pos), vel=tree.batch_innermost(vel)))


def lay_rope(pos: Tensor, length: Tensor, held: Sequence[int], closed: bool) -> Tensor:
    """Return a rope whose edges have the directions of others, and lengths that are right up to what held parts leave.

    Ends are exactly as long as they are. Between held vertices all edges share in what is left over.

    Args:
        pos: vertices [m], shape (N, V, 3).
        length: of the edges [m], shape (..., V, 1), the last one that of the gap between the ends, if the rope is open.
        held: vertices that stay where they are, rising.
        closed: whether the last vertex is next to the first.
    """
    count = pos.shape[-2]
    step = length * normalize(torch.roll(pos, -1, -2) - pos)
    # Runs of edges from a held vertex to the next one; around a closed rope, through its seam.
    runs = [*pairwise(held), *([(held[-1], held[0] + count)] if closed else [])]
    out = pos.clone()
    for first, last in runs:
        edges = torch.arange(first, last) % count
        way = step[..., edges, :].cumsum(-2)
        share = length[..., edges, :].cumsum(-2) / length[..., edges, :].sum(-2, keepdim=True)
        left = pos[..., last % count, None, :] - pos[..., first, None, :] - way[..., -1:, :]
        out[..., (edges + 1) % count, :] = pos[..., first, None, :] + way + share * left
    if not closed:
        first, last = held[0], held[-1]
        out[..., last + 1 :, :] = pos[..., last, None, :] + step[..., last:-1, :].cumsum(-2)
        back = step[..., :first, :].flip(-2).cumsum(-2).flip(-2)
        out[..., :first, :] = pos[..., first, None, :] - back
    return out
