"""Starts keep the rope's length, whatever the markers say."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.physics.effects.elastic import Bend
from torchdlo.sysid.model.length_projection import agreeing_state, lay_rope

F64 = torch.float64
COUNT, EDGE = 41, 0.015


def arch(size=1.0, turn=2.0):
    """A planar arch whose edges are `size` times too long, in two scenes, shape (2, V, 3)."""
    angle = torch.linspace(-0.5 * turn, 0.5 * turn, COUNT - 1, dtype=F64)
    edges = EDGE * torch.stack([torch.cos(angle), 0 * angle, torch.sin(angle)], -1)
    return size * torch.cat([torch.zeros(1, 3, dtype=F64), edges.cumsum(0)]).expand(2, -1, -1).clone()


def started(pos, held):
    """A rope of the right length in a scene, and the state that was measured."""
    rope = scene.Rope(arch(), radius=0.005, mass=0.05, bend=1e-3)
    made, params, state = scene.make([rope], [Bend()], check=False, prescribed_vertices=held)
    state.rods.pos.copy_(pos)
    return made, params, state


def ratios(pos):
    return (pos[:, 1:] - pos[:, :-1]).norm(dim=-1) / EDGE


def stretched():
    """Held by a clamp, 5 % too long, most of it near the clamp, as of a rubber rope that hangs."""
    pos = arch(turn=1.0)
    more = 1 + 0.1 * torch.linspace(1, 0, COUNT - 1, dtype=F64)
    edges = (pos[:, 1:] - pos[:, :-1]) * more[:, None]
    return torch.cat([pos[:, :1], pos[:, :1] + edges.cumsum(1)], 1), (0, 1)


def late():
    """Held by two clamps that are 3 cm ahead of everything between them."""
    pos = arch()
    pos[:, :2] += pos.new_tensor([0.0, 0.03, 0.01])
    pos[:, -2:] += pos.new_tensor([0.01, 0.03, 0.0])
    return pos, (0, 1, COUNT - 2, COUNT - 1)


@pytest.mark.parametrize("size", [0.6, 0.7])
def test_free_ends_are_not_folded(size):
    """Of a rope that was measured too short by far, the nearest positions of the right length turn its end around."""
    pos, held = arch(size, turn=0.3), (0, 1)
    pos[:, 1] = pos[:, 0] + EDGE * (pos[:, 1] - pos[:, 0]) / (pos[:, 1] - pos[:, 0]).norm(dim=-1, keepdim=True)
    found = agreeing_state(*started(pos, held)).rods.pos
    torch.testing.assert_close(ratios(found), torch.ones(2, COUNT - 1, dtype=F64), rtol=0, atol=1e-6)
    edges, measured = (x[:, 1:] - x[:, :-1] for x in (found, arch(turn=0.3)))
    assert float(((edges * measured).sum(-1) / EDGE**2).min()) > 0.99


@pytest.mark.parametrize("case", [stretched, late])
def test_edges_get_their_lengths_and_what_is_held_stays(case):
    pos, held = case()
    made, params, state = started(pos, held)
    found = agreeing_state(made, params, state).rods.pos
    between = [k for k in range(COUNT - 1) if not {k, k + 1} <= set(held)]
    torch.testing.assert_close(ratios(found)[:, between], torch.ones(2, len(between), dtype=F64), rtol=0, atol=1e-6)
    assert float((found - pos)[:, list(held)].abs().max()) == 0
    assert float((found - pos).norm(dim=-1).max()) < 0.05


def test_a_start_does_not_depend_on_the_others_of_its_batch():
    torch.manual_seed(0)
    wrong, held = stretched()
    good = arch() + 1e-4 * torch.randn(2, COUNT, 3, dtype=F64)
    good[:, list(held)] = wrong[:, list(held)] = arch()[:, list(held)]
    found = [agreeing_state(*started(torch.stack([good[0], other]), held)).rods.pos[0] for other in (good[1], wrong[1])]
    assert float((found[0] - found[1]).abs().max()) == 0


def test_what_is_laid_keeps_directions_and_what_is_held():
    torch.manual_seed(0)
    pos = arch() + 1e-3 * torch.randn(2, COUNT, 3, dtype=F64)
    length = torch.full((COUNT, 1), EDGE, dtype=F64)
    found = lay_rope(pos, length, (10, 11), closed=False)
    torch.testing.assert_close(found[:, 10:12], pos[:, 10:12])
    outside = [k for k in range(COUNT - 1) if k != 10]
    edge, old = found[:, 1:] - found[:, :-1], pos[:, 1:] - pos[:, :-1]
    assert float((edge.norm(dim=-1)[:, outside] / EDGE - 1).abs().max()) < 1e-12
    assert float(torch.linalg.cross(edge, old)[:, outside].abs().max()) < 1e-15
    # Between two held vertices, and around a loop, nothing tears.
    angle = 2 * torch.pi * torch.arange(COUNT, dtype=F64) / COUNT
    ring = 0.1 * torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)[None]
    around = lay_rope(ring, 1.02 * (ring.roll(-1, 1) - ring).norm(dim=-1, keepdim=True)[0], (3, 20), closed=True)
    torch.testing.assert_close(around, ring, rtol=0, atol=3e-3)
    torch.testing.assert_close(around[:, [3, 20]], ring[:, [3, 20]])
