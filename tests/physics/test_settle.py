"""Positions that miss the lengths of their edges are moved to the nearest that do not."""

from __future__ import annotations

import torch

from torchdlo.physics.constraints.edge_lengths import Lengths, settle
from torchdlo.physics.rod.topology import Topology


def test_edges_that_are_far_too_short_get_their_lengths() -> None:
    # A sagging rope whose first edges are pushed together by a sixth, as by grippers that were seen too early.
    count, step, early = 43, 0.0143, 10e-3
    angle = torch.linspace(-1.0, 1.0, count - 1, dtype=torch.float64)
    edges = step * torch.stack([torch.cos(angle), 0 * angle, torch.sin(angle)], -1)
    arc = torch.cat([torch.zeros(1, 3, dtype=torch.float64), edges.cumsum(0)])
    share = (1 - torch.linspace(0, 6, count, dtype=torch.float64)).clamp(min=0).unsqueeze(-1)
    pos = arc + early * share * edges[0] / step
    topology = Topology((count,), (False,))
    mask = pos.new_tensor(topology.edge_mask()).reshape(-1, 1)
    free = torch.ones(count, 1, dtype=torch.float64)
    free[0] = 0.0
    rest = torch.full((count, 1), step, dtype=torch.float64)
    lengths = Lengths(topology, rest, torch.zeros_like(rest), mask, mask)
    vel = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * free
    found, velocities = settle(lengths, pos, vel, free)
    again = settle(lengths, pos, vel, free, recorded=True)
    torch.testing.assert_close(again, (found, velocities), rtol=0, atol=1e-12)
    learned = pos.clone().requires_grad_()
    moved, _ = settle(lengths, learned, vel, free, recorded=True)
    assert torch.autograd.grad(moved[5].sum(), learned)[0].abs().max() > 0
    edge = found[1:] - found[:-1]
    torch.testing.assert_close(edge.norm(dim=-1), rest[:-1, 0], rtol=1e-9, atol=0)
    assert float((found[0] - pos[0]).abs().max()) == 0
    # Nothing is moved further than what was pushed together.
    assert float((found - pos).norm(dim=-1).max()) < 2 * early
    stretching = ((velocities[1:] - velocities[:-1]) * edge).sum(-1) / step
    assert float(stretching.abs().max()) < 1e-8
