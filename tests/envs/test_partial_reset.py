"""Some scenes that begin again cost as much as some, and come out as whole resets do."""

from __future__ import annotations

import pytest
import torch
from test_contract import small

from torchdlo import envs

pytest.importorskip("torchrl")

from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchdlo.envs.core import episode
from torchdlo.physics import tree

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def mask(*rows: int, count: int) -> TensorDict:
    again = torch.zeros(count, 1, dtype=torch.bool)
    again[list(rows)] = True
    return TensorDict({"_reset": again}, [count])


@pytest.mark.parametrize("name", ["wiring_post", "slingshot"])
def test_scenes_that_begin_again_are_where_their_start_says_and_others_go_on(name: str):
    env = envs.make(small(name), num_envs=3, execution="eager", seed=3)
    td = env.reset()
    env.step(td.set("action", torch.full((3, env.task.width), 0.002)))
    before, moved = env.world, env.moved
    env.reset(mask(1, count=3))
    assert (env.moved[1] - moved[1]).abs().max() > 1e-4
    assert torch.equal(env.moved[[0, 2]], moved[[0, 2]])
    fresh = episode.prepare_at(env.task, env.moved, execution="eager").start
    for old, new, start in zip(*(tree.leaves(w) for w in (before, env.world, fresh)), strict=True):
        assert torch.equal(old[[0, 2]], new[[0, 2]])
        torch.testing.assert_close(new[1], start[1], rtol=1e-5, atol=1e-5)


def test_only_scenes_that_begin_again_are_built(monkeypatch: pytest.MonkeyPatch):
    env = envs.make(small("wiring_post"), num_envs=8, execution="eager", seed=3)
    env.reset()
    sizes = []
    begin = episode.begin
    monkeypatch.setattr(episode, "begin", lambda made, state: sizes.append(len(state.rods.pos)) or begin(made, state))
    env.reset(mask(2, 5, count=8))
    env.reset()
    assert sizes == [2, 8]


def test_the_share_of_the_episode_is_told():
    env = envs.make(small("wiring_post", 2), num_envs=2, execution="eager")
    td = env.reset()
    assert (td["progress"] == 0).all()
    td = env.step(td.set("action", torch.zeros(2, env.task.width)))
    assert (td["next", "progress"] == 0.5).all()
    again = env.reset(step_mdp(td).update(mask(1, count=2)))
    assert again["progress"].flatten().tolist() == [0.5, 0.0]
