"""Environments, `play` and trainers do one control step: what an action earns is the same to the bit."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from test_contract import small

pytest.importorskip("torchrl")

from tensordict import TensorDict

from torchdlo import envs
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.envs.core import episode

SAME = {"rtol": 0, "atol": 0}


@pytest.mark.parametrize("name", ["unknotting", "slingshot"])
def test_an_action_earns_the_same_however_it_is_done(name: str) -> None:
    # Slingshot opens its hands at the end, which a short task is to do as well.
    task, steps = small(name, 2), {"execution": "eager"}
    task = dataclasses.replace(task, release=task.release and 2)
    actions = 0.002 * torch.randn(2, 2, task.width, generator=torch.Generator().manual_seed(0))
    went = episode.play(task, actions, episode=episode.prepare(task, 2, **steps))
    env = envs.make(task, num_envs=2, seed=0, variation=False, **steps)
    env.reset()
    told = [env.step(TensorDict({"action": actions[:, k]}, [2]))["next"] for k in range(2)]
    episodes = TaskEpisodes(task, 2, variation=False)
    episodes.reset()
    learned = [episodes.step(actions[:, k]) for k in range(2)]
    for k in range(2):
        torch.testing.assert_close(told[k]["reward"][:, 0], went.rewards[k], **SAME)
        for term, x in went.terms.items():
            torch.testing.assert_close(told[k]["terms", term][:, 0], x[k].float(), **SAME)
        torch.testing.assert_close(learned[k].observation, told[k]["observation"], **SAME)
        torch.testing.assert_close(learned[k].failed, told[k]["terminated"][:, 0], **SAME)
    torch.testing.assert_close(told[1]["success"][:, 0], went.success, **SAME)
    torch.testing.assert_close(learned[1].success, went.success, **SAME)
    torch.testing.assert_close(learned[0].reward, went.rewards[0], **SAME)
    # A trainer is told what the end lacks with the last action.
    lacking = episode.terminal_costs(task, went.world)
    torch.testing.assert_close(learned[1].reward, went.rewards[1] - lacking, **SAME)
    torch.testing.assert_close(env.world.state.rods.pos, went.world.state.rods.pos, **SAME)


def test_scenes_that_end_open_their_hands_and_others_do_not() -> None:
    task = dataclasses.replace(small("slingshot", 2), release=2)
    made = episode.prepare(task, 2, execution="eager")
    still = torch.zeros(2, task.width)
    with torch.no_grad():
        step = episode.control_step(made, made.start, still, torch.tensor([True, False]))
        none = episode.control_step(made, made.start, still, last=False)
        both = episode.control_step(made, made.start, still, last=True)
    assert not step.world.grasp.closed[0].any() and (step.world.grasp.closed[1] == none.world.grasp.closed[1]).all()
    torch.testing.assert_close(step.world.state.rods.pos[0], both.world.state.rods.pos[0], **SAME)
    torch.testing.assert_close(step.world.state.rods.pos[1], none.world.state.rods.pos[1], **SAME)
