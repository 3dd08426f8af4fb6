"""Where rewards are negative it does not pay to fail early."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import ClassVar

import pytest
import torch

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

sys.path.insert(0, str(Path(__file__).parents[1] / "agents" / "rl"))

from lead import Lead

from torchdlo import envs
from torchdlo.envs import Task
from torchdlo.envs.core import episode
from torchdlo.envs.core.subtask import with_reward
from torchdlo.reward_language import reward


class Minus(Lead):
    """Earns minus a distance, and fails where the end is too far to the front."""

    def rewards(self, seen):
        """Minus the distance from the line."""
        return {"far": -(seen.x[:, 1, 1] - 0.125).abs()}

    def failed(self, seen):
        """Whether it is 1 cm in front of the start."""
        return seen.x[:, 1, 1] < 0.09


class Unpunished(Minus):
    """The same as published tasks are."""

    forfeits: ClassVar[bool] = False


def played(task: Task) -> episode.EpisodeResult:
    """Wait in the first scene, and go away from the line in the second."""
    actions = torch.zeros(2, 6, 6)
    actions[1, :, 1] = -0.006
    return episode.play(task, actions, execution="eager")


def test_what_is_left_of_an_episode_is_charged_at_the_least_that_an_action_earned() -> None:
    went, free = played(Minus()), played(Unpunished())
    assert went.failed.tolist() == free.failed.tolist() == [False, True]
    when = int((free.rewards[:, 1] != 0).sum())  # actions before the one that failed
    assert 0 < when < 5 and bool((free.rewards[when:, 1] == 0).all())
    end = float(went.terms["far"][when, 1])
    assert end < float(went.rewards[:when, 1].min()) < 0
    assert float(went.rewards[when, 1]) == pytest.approx((6 - when) * end) and bool(
        (went.rewards[when + 1 :, 1] == 0).all()
    )
    # To fail is no better than to wait any more.
    assert float(went.returns[1]) < float(went.returns[0]) < float(free.returns[1])
    assert torch.equal(went.rewards[:, 0], free.rewards[:, 0])
    assert float(went.loss[1]) == pytest.approx(-float(went.returns[1]))


def test_environments_charge_the_same() -> None:
    env = envs.make(Minus(), num_envs=2, execution="eager", variation=False)
    went, td, total = played(Minus()), env.reset(), torch.zeros(2)
    for _ in range(6):
        action = torch.zeros(2, 6)
        action[1, 1] = -0.006
        td = env.step(td.set("action", action))["next"]
        total += td["reward"][:, 0]
    assert torch.allclose(total, went.returns.float(), atol=1e-6)


def test_rewards_of_expressions_charge_it_too() -> None:
    task = with_reward(Unpunished(), reward({"far": "-(y(rope[1]) - 0.125) ** 2"}))
    assert task.forfeits
    assert float(played(task).returns[1]) < float(played(task).returns[0])


def test_published_tasks_that_may_earn_less_than_nothing_are_as_published() -> None:
    assert not envs.find("lifting").forfeits and not envs.find("wrapping").forfeits
