"""What is bootstrapped and what is not, each against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("torchrl")

from torchdlo.agents.rl.rollout import Batch, generalised_advantages, td_lambda_targets
from torchdlo.agents.rl.shac import Window, actor_loss

G = 0.5


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def flags(*values: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)[:, None]


def batch(failed: torch.Tensor) -> Batch:
    none = torch.zeros(*failed.shape, dtype=torch.float64)
    return Batch(torch.zeros(len(failed) + 1, 1, 1), none[..., None], none, none, failed, flags(0)[0])


def test_the_end_of_the_time_is_an_end():
    """With lambda 1, returns are sums of discounted rewards: 1 + 2/2 + 4/4, 2 + 4/2, 4; the value 100 is not seen."""
    terminal = batch(flags(0, 0, 0)).terminal
    value = column(0, 0, 0, 100)
    _, returns = generalised_advantages(value, column(1, 2, 4), terminal, gamma=G, lmbda=1.0)
    torch.testing.assert_close(returns, column(3, 4, 4))


def test_a_failure_is_an_end_and_what_comes_after_is_not_learned_from():
    """It fails with the second action: 1 + 2/2, then 2; values after it are not seen."""
    played = batch(flags(0, 1, 1))
    _, returns = generalised_advantages(column(0, 0, 50, 100), column(1, 2, 0), played.terminal, gamma=G, lmbda=1.0)
    torch.testing.assert_close(returns[:2], column(2, 2))
    assert played.alive.flatten().tolist() == [True, True, False]


def test_advantages_mix_values_and_rewards():
    """delta_1 = 2 + 0 - 4 = -2; delta_0 = 1 + 4/2 - 3 = 0; A_0 = 0 + (1/2)(1/2)(-2)."""
    advantage, _ = generalised_advantages(column(3, 4, 9), column(1, 2), flags(0, 1), gamma=G, lmbda=0.5)
    torch.testing.assert_close(advantage, column(-0.5, -2))


def test_windows_are_bootstrapped_at_their_end():
    """lambda 1: 1 + (2 + 8/2)/2 = 4, 2 + 8/2 = 6. lambda 0: 1 + 6/2 = 4, 6.

    lambda 1/2, with the first value 10: 1 + (10 + 6) / 2 / 2 = 5.
    """
    rewards, ends = column(1, 2), flags(0, 0)
    torch.testing.assert_close(td_lambda_targets(column(6, 8), rewards, ends, gamma=G, lmbda=1.0), column(4, 6))
    torch.testing.assert_close(td_lambda_targets(column(6, 8), rewards, ends, gamma=G, lmbda=0.0), column(4, 6))
    torch.testing.assert_close(td_lambda_targets(column(10, 8), rewards, ends, gamma=G, lmbda=0.5), column(5, 6))


def test_failures_in_windows_are_not_bootstrapped():
    """It fails with the second action: 1 + 2/2 and 2, whatever values say."""
    torch.testing.assert_close(
        td_lambda_targets(column(6, 8), column(1, 2), flags(0, 1), gamma=G, lmbda=1.0), column(2, 2)
    )


def window(failed: torch.Tensor, *, begun: int = 1, ends: bool = False, log_prob: float = 0.0) -> Window:
    reward = column(1, 2)
    none = torch.zeros(2, 1, 1)
    started = torch.tensor([bool(begun)])
    return Window(none, none, torch.full_like(reward, log_prob), reward, failed, started, flags(0)[0], ends)


@pytest.mark.parametrize(
    ("played", "loss"),
    [
        # -(1 + 2/2 + 8/4) / 2
        (window(flags(0, 0)), -2.0),
        # The time is over: -(1 + 2/2) / 2
        (window(flags(0, 0), ends=True), -1.0),
        # It fails with the last action: as above.
        (window(flags(0, 1)), -1.0),
        # It fails with the first one: -1/2
        (window(flags(1, 1)), -0.5),
        # It had failed before.
        (window(flags(1, 1), begun=0), 0.0),
    ],
)
def test_the_actor_is_paid_for_what_comes_after_where_something_does(played: Window, loss: float):
    value = torch.tensor([8.0], dtype=torch.float64)
    assert float(actor_loss(played, value, gamma=G)) == pytest.approx(loss)


def test_entropy_is_paid_with_every_reward():
    """-((1 + 3) + (2 + 3)/2 + 8/4) / 2 with temperature 3 and log p = -1."""
    value = torch.tensor([8.0], dtype=torch.float64)
    found = actor_loss(window(flags(0, 0), log_prob=-1.0), value, gamma=G, temperature=3.0)
    assert float(found) == pytest.approx(-(4 + 2.5 + 2) / 2)


def test_values_without_numbers_at_a_failure_do_no_harm():
    value = torch.tensor([math.inf], dtype=torch.float64)
    assert math.isfinite(float(actor_loss(window(flags(0, 1)), value, gamma=G)))
