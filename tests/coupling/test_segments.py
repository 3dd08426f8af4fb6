"""Closest points of segments, against an exact solution by cases."""

from __future__ import annotations

import pytest
import torch
from touching import F64, distances

from torchdlo.coupling.rod_contact.closest_points import PULL, closest_points

pytestmark = pytest.mark.quick


def apart(x: torch.Tensor) -> torch.Tensor:
    """Distances that `closest_points` finds for segments (n, 4, 3)."""
    a, b, c, d = x.unbind(-2)
    s, t = closest_points((a, b), (c, d))
    return (a + s * (b - a) - c - t * (d - c)).norm(dim=-1)


def exact(x: torch.Tensor) -> torch.Tensor:
    flat = x.reshape(-1, 3)
    first = 4 * torch.arange(len(x))
    return distances(flat, first, first + 2)


@pytest.mark.parametrize("flat", [1.0, 1e-2, 1e-4, 0.0], ids=["skew", "nearly parallel", "almost parallel", "parallel"])
def test_distances_are_exact_up_to_the_pull_to_the_middle(flat):
    # d'^2 - d^2 <= PULL ((s - 1/2)^2 + (t - 1/2)^2) (uu + vv) / 2 <= PULL (uu + vv) / 4, see the module.
    g = torch.Generator().manual_seed(3)
    x = torch.randn(4000, 4, 3, generator=g, dtype=F64)
    x[:, 3] = x[:, 2] + (x[:, 1] - x[:, 0]) * torch.rand(4000, 1, generator=g, dtype=F64) + flat * x[:, 3]
    found, wanted = apart(x), exact(x)
    uu = (x[:, 1] - x[:, 0]).square().sum(-1) + (x[:, 3] - x[:, 2]).square().sum(-1)
    assert float((wanted - found).max()) < 1e-9
    assert float((found**2 - wanted**2 - PULL * uu / 4).max()) < 1e-12


def test_points_of_a_crossing_are_its_own():
    # At a right angle and through both middles the pull moves nothing.
    x = torch.tensor([[[-1.0, 0, 0], [1, 0, 0], [0, -1, 0.3], [0, 1, 0.3]]], dtype=F64)
    s, t = closest_points((x[:, 0], x[:, 1]), (x[:, 2], x[:, 3]))
    assert float((torch.cat([s, t]) - 0.5).abs().max()) < 1e-15


DEGENERATE = {
    "both are points": [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]],
    "one point, all four": [[0, 0, 0]] * 4,
    "one is a point": [[0, 0, 0], [1, 0, 0], [0.3, 1, 0], [0.3, 1, 0]],
    "the same segment": [[0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]],
    "on one line": [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]],
    "crossing": [[0, 0, 0], [1, 0, 0], [0.5, -1, 0], [0.5, 1, 0]],
}


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["float32", "float64"])
@pytest.mark.parametrize("case", DEGENERATE)
def test_shares_and_their_derivatives_are_finite_in_degenerate_cases(case, dtype):
    x = torch.tensor([DEGENERATE[case]], dtype=dtype, requires_grad=True)
    a, b, c, d = x.unbind(-2)
    s, t = closest_points((a, b), (c, d))
    assert bool(((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)).all())
    (g,) = torch.autograd.grad((s + 2 * t).sum(), x)
    assert bool(torch.isfinite(g).all())


def test_shares_have_their_exact_derivative():
    g = torch.Generator().manual_seed(5)
    x = torch.randn(20, 4, 3, generator=g, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: closest_points((x[:, 0], x[:, 1]), (x[:, 2], x[:, 3])), (x,), atol=1e-6)


def test_shares_do_not_jump_where_segments_become_parallel():
    # The derivative by the angle is below 1 / PULL; without the pull the share jumps from one end to the other.
    angles = torch.tensor([-1e-6, 1e-6], dtype=F64)
    a, b = torch.zeros(2, 3, dtype=F64), torch.tensor([1.0, 0, 0], dtype=F64).expand(2, 3)
    c = torch.tensor([0.0, 0, 0.1], dtype=F64).expand(2, 3)
    d = c + torch.stack([torch.cos(angles), torch.zeros(2, dtype=F64), torch.sin(angles)], -1)
    s, _ = closest_points((a, b), (c, d))
    assert float((s[1] - s[0]).abs()) < 2e-6 / PULL
