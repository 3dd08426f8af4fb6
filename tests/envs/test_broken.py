"""Scenes that break leave the others of their batch alone."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from test_contract import F64, prepared, small, stage_waypoints

from torchdlo import envs
from torchdlo.envs.core import episode
from torchdlo.physics import tree

pytestmark = pytest.mark.quick

pytest.importorskip("torchrl")


def wild(world: episode.EpisodeState) -> episode.EpisodeState:
    """The world with so fast a rope in its second scene that squares overflow."""
    rods = world.state.rods
    fast = torch.tensor([0.0, torch.finfo(rods.vel.dtype).max ** 0.6], dtype=rods.vel.dtype).reshape(2, 1, 1)
    return tree.replace(world, state=tree.replace(world.state, rods=tree.replace(rods, vel=rods.vel + fast)))


@pytest.mark.parametrize("segment", [None, 1])
def test_a_broken_scene_leaves_the_slope_of_what_all_share(segment: int | None):
    slopes = []
    for breaks in (False, True):
        env = envs.make(
            small("unknotting"), num_envs=2, gradients=True, execution="eager", variation=False, segment=segment
        )
        shared = torch.full((12,), 0.002, requires_grad=True)
        tensordict = env.reset().set("action", shared.expand(2, -1))
        env.step(tensordict)
        if breaks:
            env.world = wild(env.world)
        seen = env.step(tensordict.set("action", shared.expand(2, -1)))
        reward = seen["next", "reward"].flatten()
        assert seen["next", "terminated"].flatten().tolist() == [False, breaks]
        slopes.append([torch.autograd.grad(part, shared, retain_graph=True)[0] for part in (reward[0], reward.sum())])
    (one, both), (beside, rest) = slopes
    assert torch.isfinite(both).all() and torch.equal(beside, one)
    torch.testing.assert_close(rest, one, rtol=0, atol=0)


def test_a_scene_that_breaks_when_hands_open_leaves_the_slope_of_what_all_share():
    made = dataclasses.replace(prepared("slingshot"), segment=1)
    slopes = []
    for breaks in (False, True):
        shared = stage_waypoints(made.task)[0, 0].requires_grad_()
        world = episode.act(made, made.start, shared.expand(2, -1))
        after = episode.finish(made, wild(world) if breaks else world)
        assert after.failed.tolist() == [False, breaks]
        slopes.append(torch.autograd.grad(episode.episode_reward(made, after)[2][0], shared)[0])
    assert slopes[0].dtype == F64 and slopes[0].any()
    torch.testing.assert_close(slopes[1], slopes[0], rtol=0, atol=0)
