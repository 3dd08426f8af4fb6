"""Failing is not better in training than not finishing, whatever a task's ends lack to success."""

from __future__ import annotations

import dataclasses

import pytest
import torch

pytest.importorskip("torchrl")

from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.envs import find
from torchdlo.envs.core import episode


def short(name: str, count: int, **choices) -> TaskEpisodes:
    task = dataclasses.replace(find(name), horizon=3, frame_skip=2)
    return TaskEpisodes(task, count, variation=False, execution="eager", **choices)


@pytest.mark.filterwarnings("ignore:.*not finite")
@pytest.mark.parametrize("name", ["coiling", "lifting", "wiring_post", "wrapping"])
def test_an_episode_that_fails_earns_no_more_than_one_that_does_nothing(name: str):
    made = short(name, 3, scale=0.5)
    made.reset()
    start = episode.terminal_costs(made.task, made.env.world)
    earned = torch.zeros(3)
    for k in range(3):
        action = torch.zeros(3, made.task.width)
        if k < 2:
            action[k] = torch.nan  # the first scene fails at once, the second one later
        step = made.step(action)
        earned += step.reward
    assert step.failed.tolist() == [True, True, False]
    assert float(start[0]) > 0
    assert float(earned[0]) == pytest.approx(-0.5 * float(start[0]), rel=1e-5)
    assert earned[0] <= earned[2] and earned[1] <= earned[2]
    # What the task itself pays is told without it.
    assert (made.returns >= 0).all()


@pytest.mark.filterwarnings("ignore:.*not finite")
def test_what_failing_costs_has_no_gradient_and_leaves_those_of_others_alone():
    def gradient(fails: bool) -> torch.Tensor:
        made = short("coiling", 2, gradients=True)
        made.reset()
        action = torch.full((2, made.task.width), 1e-3).requires_grad_()
        total = 0.0
        for k in range(3):
            given = action.clone()
            if fails and k == 1:
                given[1] = torch.nan
            total = total + made.step(given).reward[0]
        return torch.autograd.grad(total, action)[0][0]

    found = gradient(True)
    assert torch.isfinite(found).all() and found.abs().max() > 0
    torch.testing.assert_close(found, gradient(False))


def test_the_worst_moment_is_that_of_the_same_episode():
    made = short("coiling", 1)
    made.begin(torch.zeros(1, len(made.task.reset_noise), 3))
    first = float(made._most)
    made._note_costs(torch.tensor([1e6]))
    made._note_costs(torch.tensor([torch.nan]))
    assert float(made._most) == 1e6
    made.reset()
    assert float(made._most) == pytest.approx(first)
