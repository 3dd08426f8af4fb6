"""What ropes that are about to tear cost in training: closed form, and a gradient that leads away from tearing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

pytest.importorskip("torchrl")

from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.settings import training_preset
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.errors import InputError
from torchdlo.scene import Params, Rope, Scene, State


@dataclass(frozen=True)
class Pull(Task):
    """Two hands at a short elastic rope, which fails from a tenth of stretch on."""

    horizon: int = 6
    frame_skip: int = 10
    name: ClassVar[str] = "pull"
    arms: ClassVar[Arms] = Arms(base=((-0.3, -0.4, 0.0), (0.4, -0.4, 0.0)), vertex=(1, 6))
    stretch: ClassVar[float] = 1.1

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """A straight rope."""
        x = straight((0.0, 0.1, 0.05), 8, moved[:, 0])
        return make(self, [Rope(x, RADIUS, mass=0.008, youngs=1e4, stretch=1e5 * math.pi * RADIUS**2)])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """How far the second hand is."""
        return {"far": seen.x[:, 6, 0]}

    def success(self, seen: TaskState) -> Tensor:
        """Never."""
        return torch.zeros(len(seen.x), dtype=torch.bool)


def pulled(barrier: float, ways: list[float], gradients: bool = False) -> tuple[TaskEpisodes, Tensor, list[Tensor]]:
    """Play ways of the second hand along the rope, all in a batch; return rewards of each action, too."""
    made = TaskEpisodes(
        Pull(), len(ways), variation=False, gradients=gradients, barrier=barrier, scale=2.0, execution="eager"
    )
    made.reset()
    action = torch.zeros(len(ways), 12)
    action[:, 3] = torch.tensor(ways)
    action.requires_grad_(gradients)
    return made, action, [made.step(action).reward for _ in range(2)]


def test_it_grows_from_half_of_the_stretch_that_is_allowed():
    ways = [0.0, 0.002, 0.004, 0.0045]  # in two actions: 0, 4, 8 and 9 % of 10 cm
    plain, _, without = pulled(0.0, ways)
    made, _, found = pulled(3.0, ways)
    x = made.env.world.state.rods.pos
    used = (curve_geometry.length(x[:, 1:7]) / 0.1 - 1) / 0.1
    assert used.tolist() == pytest.approx([0.0, 0.4, 0.8, 0.9], abs=0.02)
    cost = 3.0 * (2 * used - 1).clamp(min=0).square()
    torch.testing.assert_close(without[-1] - found[-1], cost, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(made.returns, plain.returns, rtol=0, atol=0)  # what the task pays is the same


def test_episodes_that_tore_pay_once_for_all_actions_that_are_left():
    made, action, found = pulled(3.0, [0.004, 0.008])
    assert made.env.world.failed.tolist() == [False, True]
    assert [float(reward[1]) for reward in found][1] == -3.0 * 5  # in the second of six actions
    assert made.step(action).reward[1] == 0


@pytest.mark.parametrize(("barrier", "sign"), [(0.0, 1), (3.0, -1)])
def test_its_gradient_leads_away_from_tearing(barrier: float, sign: int):
    _, action, rewards = pulled(barrier, [0.004], gradients=True)
    (gradient,) = torch.autograd.grad(rewards[-1].sum(), action)
    assert gradient[0, 3].sign() == sign


def test_published_tasks_begin_with_it_where_gradients_do_not_say_what_failing_costs():
    assert training_preset("unknotting", "shac").barrier == training_preset("unknotting", "sapo").barrier == 0.2
    assert training_preset("unknotting", "ppo").barrier == training_preset("unknotting", "hybrid").barrier == 0


def test_what_the_end_of_coiling_lacks_does_not_dwarf_what_it_earns():
    """It is up to 100, and the return of a success 12: critics do not reach -80 within hundreds of steps."""
    assert training_preset("coiling", "shac").ends == 0.1
    assert training_preset("coiling", "shac", ends=1.0).ends == training_preset("coiling", "hybrid").ends == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"ends": -1.0},
        {"ends": math.nan},
        {"ends": "abc"},
        {"barrier": -1.0},
        {"barrier": math.inf},
        {"auxiliary": -0.1},
        {"saturation": math.nan},
        {"temperature": "x"},
    ],
)
def test_what_cannot_be_paid_is_refused_in_a_sentence(wrong):
    (name,) = wrong
    with pytest.raises(InputError, match=f"{name} is .*expected a finite number"):
        training_preset("coiling", "shac", **wrong)


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "hybrid"])
def test_what_only_gradients_of_returns_feel_is_refused_elsewhere(algorithm: str):
    with pytest.raises(InputError, match=r"saturation is 0\.01; expected 0"):
        training_preset("coiling", algorithm, saturation=0.01)
    assert training_preset("coiling", "sapo", saturation=0.01).saturation == 0.01


@pytest.mark.parametrize("name", ["barrier", "auxiliary"])
def test_the_hybrid_refuses_what_its_stages_do_not_pay(name: str):
    with pytest.raises(InputError, match=name):
        training_preset("coiling", "hybrid", **{name: 0.2})
