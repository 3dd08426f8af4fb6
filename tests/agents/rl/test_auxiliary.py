"""What tasks declare beside their reward for gradients to descend, as trainers are paid for it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

pytest.importorskip("torchrl")

from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.envs import find
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.errors import InputError
from torchdlo.scene import Params, Rope, Scene, State

F64 = torch.float64


@dataclass(frozen=True)
class Lead(Task):
    """A hand leads a short rope to a place, of which the reward tells little."""

    horizon: int = 4
    frame_skip: int = 10
    name: ClassVar[str] = "lead"
    arms: ClassVar[Arms] = Arms(base=((-0.3, -0.4, 0.0),), vertex=(1,))

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """A straight rope."""
        x = straight((0.0, 0.1, 0.05), 6, moved[:, 0])
        return make(self, [Rope(x, RADIUS, mass=0.006, youngs=1e4, stretch=1e5 * math.pi * RADIUS**2)])

    def _away(self, seen: TaskState) -> Tensor:
        return (seen.x[:, 1] - seen.x.new_tensor([0.05, 0.1, 0.2])).square().sum(-1)

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Hardly anything far off."""
        return {"there": torch.exp(-400 * self._away(seen))}

    def auxiliary_loss(self, seen: TaskState) -> dict[str, Tensor]:
        """The exponent, and the height of the other end."""
        return {"away": 400 * self._away(seen), "end": seen.x[:, -1, 2]}

    def success(self, seen: TaskState) -> Tensor:
        """Close to it."""
        return self._away(seen) < 1e-4


def led(auxiliary: float, actions: Tensor, scale: float = 1.0) -> tuple[TaskEpisodes, Tensor]:
    made = TaskEpisodes(
        Lead(),
        len(actions),
        variation=False,
        gradients=True,
        execution="eager",
        dtype=F64,
        ends=0.0,
        scale=scale,
        auxiliary=auxiliary,
    )
    made.reset()
    return made, torch.stack([made.step(action).reward for action in actions.unbind(1)], 1)


def ways() -> Tensor:
    drawn = torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(2), dtype=F64)
    return (0.003 * drawn * drawn.new_tensor([1, 1, 1, 0, 0, 0])).requires_grad_()


def test_its_gradient_is_that_of_the_loss_which_searches_descend():
    actions = ways()
    _, rewards = led(1.0, actions)
    (found,) = torch.autograd.grad(-rewards.sum(), actions)
    (plain,) = torch.autograd.grad(episode.play(Lead(), actions, execution="eager").loss.sum(), actions)
    assert float(plain.abs().max()) > 1
    torch.testing.assert_close(found, plain, rtol=1e-5, atol=1e-5 * float(plain.abs().max()))


def test_what_is_paid_is_the_share_of_what_it_has_fallen_by_since_the_start():
    actions = ways()
    plain, without = led(0.0, actions, scale=2.0)
    made, rewards = led(0.25, actions, scale=2.0)
    torch.testing.assert_close(made.returns, plain.returns, rtol=0, atol=0)  # what the task pays is the same
    now = sum(Lead().auxiliary_loss(made.env.world.seen(1)).values())
    made.reset()
    first = sum(Lead().auxiliary_loss(made.env.world.seen(1)).values())
    fallen = (rewards - without)[:, -1].double()
    torch.testing.assert_close(fallen, 0.25 * 2 * (first - now), rtol=1e-4, atol=1e-5)


def test_an_episode_that_fails_pays_the_worst_so_far_for_each_action_that_is_left(monkeypatch):
    away = torch.zeros(2, 4, 6, dtype=F64)
    away[..., 2] = -0.003
    made, _ = led(0.25, away)
    made.reset()
    first = made.step(away[:, 0]).reward
    assert first[1] == first[0] < 0
    advance = made.env.advance

    def failing(action: Tensor):
        step = advance(action)
        failed = torch.tensor([False, True])
        return dataclasses.replace(step, world=dataclasses.replace(step.world, failed=failed))

    monkeypatch.setattr(made.env, "advance", failing)
    second = made.step(away[:, 1]).reward
    assert float(second[1]) == pytest.approx(3 * float(first[1]), rel=1e-3)
    assert first[0] > second[0] > second[1]


def test_tasks_without_one_are_refused():
    with pytest.raises(InputError, match="separation declares no auxiliary loss"):
        TaskEpisodes(find("separation"), 1, execution="eager", auxiliary=0.25).reset()


def test_episodes_that_failed_are_paid_nothing():
    actions = ways()
    made, _ = led(0.25, actions.detach())
    made.reset()
    made.env.world.failed[1] = True
    step = made.step(actions.detach()[:, 0])
    assert step.reward[1] == 0 != step.reward[0]
