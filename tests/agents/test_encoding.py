"""Way-points become actions within the limits, with exact gradients."""

from __future__ import annotations

import torch

from torchdlo.agents.problem import Encoding

TWO_TOOLS = Encoding(horizon=7, width=6, group=3, limit=0.01, hold=3)


def test_a_way_point_is_spread_evenly_over_its_actions() -> None:
    points = torch.zeros(1, TWO_TOOLS.size, dtype=torch.float64)
    points[0, :6] = torch.tensor([0.006, 0.0, 0.003, 0.0, -0.009, 0.0])
    actions = TWO_TOOLS.decode(points)
    assert actions.shape == (1, 7, 6) and TWO_TOOLS.knots == 3
    wanted = torch.tensor([0.002, 0.0, 0.001, 0.0, -0.003, 0.0], dtype=torch.float64)
    torch.testing.assert_close(actions[0, :3], wanted.expand(3, 6))
    assert (actions[0, 3:] == 0).all()


def test_no_tool_goes_further_than_its_limit_and_directions_stay() -> None:
    points = torch.randn(50, TWO_TOOLS.size, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.05
    moves = TWO_TOOLS.decode(points).reshape(50, 7, 2, 3)
    # One rounding in the ratio, one in each product and sum: a few units in the last place.
    assert moves.norm(dim=-1).max() <= 0.01 * (1 + 8 * torch.finfo(torch.float64).eps)
    asked = points.reshape(50, 3, 2, 3).repeat_interleave(3, 1)[:, :7]
    torch.testing.assert_close(torch.cosine_similarity(moves, asked, -1), torch.ones(50, 7, 2, dtype=torch.float64))


def test_projected_points_decode_to_the_same_actions() -> None:
    points = torch.randn(20, TWO_TOOLS.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.05
    torch.testing.assert_close(TWO_TOOLS.decode(TWO_TOOLS.project(points)), TWO_TOOLS.decode(points))


def test_gradients_are_those_of_finite_differences_on_both_sides_of_the_limit() -> None:
    points = torch.tensor([[0.001, 0.002, 0.0, 0.05, 0.0, 0.01]], dtype=torch.float64)
    encoding = Encoding(horizon=4, width=3, group=3, limit=0.01, hold=2)
    assert torch.autograd.gradcheck(encoding.decode, points.requires_grad_(), eps=1e-7)
    still = torch.zeros_like(points).requires_grad_()
    (slope,) = torch.autograd.grad(encoding.decode(still).sum(), still)
    assert (slope == 1).all()
