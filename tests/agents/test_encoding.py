"""Way-points become actions within the limits, with exact gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchdlo.agents.trajopt.problem import Encoding

pytestmark = pytest.mark.quick

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


@pytest.mark.parametrize("apart", [None, 0.2])
def test_tools_go_together_or_each_for_itself(apart: float | None) -> None:
    encoding = replace(TWO_TOOLS, apart=apart)
    moves = 0.01 * torch.randn(5, 3, 2, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    points = encoding.encode(moves)
    torch.testing.assert_close(encoding.decode(points), TWO_TOOLS.decode(moves.flatten(1)))
    torch.testing.assert_close(
        encoding.decode(encoding.project(5 * points)), encoding.decode(5 * points), rtol=1e-5, atol=0
    )
    if apart is not None:
        # By halves of two tools: a number of 1 moves them 0.2 each from their mean.
        one = points.reshape(5, 3, 2, 3)[:, :, 1]
        torch.testing.assert_close(one, (moves[:, :, 1] - moves[:, :, 0]) / 2 / apart)


def test_slopes_by_actions_become_slopes_by_points() -> None:
    encoding = replace(TWO_TOOLS, apart=0.2)
    points = 0.01 * torch.randn(4, encoding.size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weights = torch.linspace(-1, 1, 42, dtype=torch.float64).expand(4, 42)

    def loss(x: torch.Tensor) -> torch.Tensor:
        return (encoding.decode(x).flatten(1) * weights).sum()

    gradient = torch.stack([(loss(points + 1e-7 * e) - loss(points - 1e-7 * e)) / 2e-7 for e in torch.eye(18).double()])
    torch.testing.assert_close(encoding.pull(points, weights).sum(0), gradient, rtol=1e-6, atol=1e-7)


def test_tools_at_their_limit_can_brake() -> None:
    points = torch.tensor([[0.05, 0.02, 0.0]], dtype=torch.float64)
    encoding = Encoding(horizon=2, width=3, group=3, limit=0.01, hold=2)
    at = encoding.project(points).requires_grad_()
    (gradient,) = torch.autograd.grad(encoding.decode(at).norm(dim=-1).sum(), at)
    assert float((gradient @ at[0] / at.norm()).detach()) == pytest.approx(1, rel=1e-6)


def test_gradients_are_those_of_finite_differences_on_both_sides_of_the_limit() -> None:
    points = torch.tensor([[0.001, 0.002, 0.0, 0.05, 0.0, 0.01]], dtype=torch.float64)
    encoding = Encoding(horizon=4, width=3, group=3, limit=0.01, hold=2)
    assert torch.autograd.gradcheck(encoding.decode, points.requires_grad_(), eps=1e-7)
    still = torch.zeros_like(points).requires_grad_()
    (gradient,) = torch.autograd.grad(encoding.decode(still).sum(), still)
    assert (gradient == 1).all()


@pytest.mark.parametrize("apart", [None, 0.2])
def test_ways_inward_are_what_projection_leaves_of_them(apart: float | None) -> None:
    encoding = Encoding(horizon=6, width=6, group=3, limit=0.01, hold=2, apart=apart)
    rng = torch.Generator().manual_seed(0)
    points = encoding.project(torch.randn(20, encoding.size, generator=rng, dtype=torch.float64) * 0.02)
    stage_waypoints = torch.randn(20, encoding.size, generator=rng, dtype=torch.float64)
    left = encoding.inward(points, stage_waypoints)
    step = 1e-9
    assert torch.allclose((encoding.project(points + step * stage_waypoints) - points) / step, left, atol=1e-6)
    assert not torch.allclose(left, stage_waypoints)
    inside = encoding.project(0.1 * points)
    assert torch.allclose(encoding.inward(inside, stage_waypoints), stage_waypoints)
