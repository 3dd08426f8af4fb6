"""Tasks are well-behaved Gymnasium environments, any number of them in a process, alone and in batches."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

pytest.importorskip("torchrl")
gymnasium = pytest.importorskip("gymnasium")

from test_contract import small  # noqa: E402

from torchdlo import envs  # noqa: E402
from torchdlo.envs.gymnasium_envs import GymnasiumEnv, GymnasiumVectorEnv, register  # noqa: E402
from torchdlo.errors import InputError  # noqa: E402

OPTIONS = {"execution": "eager"}


def test_the_checker_of_gymnasium_finds_nothing_wrong() -> None:
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(GymnasiumEnv(small("unknotting"), **OPTIONS), skip_render_check=True)
    # Places have no bounds.
    said = [str(w.message) for w in found if "gymnasium" in str(w.filename) or "WARN" in str(w.message)]
    assert all("infinity" in text or "spec" in text for text in said), said


def test_any_number_of_environments_live_in_a_process() -> None:
    names = register()
    assert register() == names and set(names) <= set(gymnasium.registry)
    one, two = (gymnasium.make("torchdlo/unknotting-v0", **OPTIONS) for _ in range(2))
    first, other = one.reset(seed=0)[0], two.reset(seed=1)[0]
    assert first.shape == one.observation_space.shape and not np.array_equal(first, other)
    assert np.array_equal(two.reset(seed=0)[0], first)


def test_rewards_and_flags_are_numbers_and_success_is_no_observation() -> None:
    env = GymnasiumEnv(small("unknotting"), **OPTIONS)
    seen, told = env.reset(seed=0)
    assert isinstance(seen, np.ndarray) and seen.ndim == 1 and type(told["success"]) is bool
    for last in (False, True):
        seen, reward, terminated, truncated, told = env.step(env.action_space.sample())
        assert type(reward) is float and type(terminated) is bool and truncated is last
    assert env.action_space.high.tolist() == [1.0] * 12


def test_a_batch_says_what_its_scenes_say_alone_and_goes_on_after_their_end() -> None:
    count, task = 2, small("unknotting")
    batch = GymnasiumVectorEnv(task, num_envs=count, variation=False, **OPTIONS)
    alone = GymnasiumEnv(task, variation=False, **OPTIONS)
    seen, _ = batch.reset(seed=0)
    first, _ = alone.reset(seed=0)
    np.testing.assert_allclose(seen, np.stack([first] * count), atol=1e-6)
    action = np.linspace(-1, 1, 12, dtype=np.float32)
    for _ in range(task.horizon):
        seen, reward, _, truncated, told = batch.step(np.stack([action, 0 * action]))
        here, value, *_ = alone.step(action)
        np.testing.assert_allclose(seen[0], here, atol=1e-5)
        assert reward.shape == (count,) and reward[0] == pytest.approx(value, abs=1e-5)
    assert truncated.all() and told["success"].shape == told["_success"].shape == (count,)
    seen, reward, terminated, truncated, _ = batch.step(np.ones((count, 12), np.float32))
    np.testing.assert_allclose(seen, np.stack([first] * count), atol=1e-6)
    assert not reward.any() and not terminated.any() and not truncated.any()


def test_make_vec_makes_one_batch() -> None:
    register()
    batch = gymnasium.make_vec("torchdlo/unknotting-v0", num_envs=3, **OPTIONS)
    assert isinstance(batch.unwrapped, GymnasiumVectorEnv)
    seen, _ = batch.reset(seed=0)
    assert seen.shape == (3, batch.single_observation_space.shape[0]) and batch.action_space.shape == (3, 12)


def test_actions_from_minus_one_to_one_are_shares_of_the_limits() -> None:
    task = small("unknotting")
    moved = []
    for scaled, action in ((False, torch.tensor(task.limit) * 0.5), (True, torch.full((12,), 0.5))):
        env = envs.make(task, variation=False, scaled_actions=scaled, **OPTIONS)
        moved.append(env.step(env.reset().set("action", action[None]))["next", "observation"])
    torch.testing.assert_close(moved[0], moved[1])
    assert env.action_spec.space.high.unique().tolist() == [1.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"render_mode": "human"}, "render_mode: it is 'human'; expected None"),
        ({"gradients": True}, "gradients: Gymnasium has no such option"),
        ({"device": "cuda"}, "device: it is cuda, but torch sees no GPU"),
        ({"device": "gpu"}, "device: it is 'gpu'; expected cpu, cuda"),
    ],
)
def test_what_cannot_be_is_refused(options: dict, words: str) -> None:
    if options.get("device") == "cuda" and torch.cuda.is_available():
        pytest.skip("there is one here")
    with pytest.raises(InputError, match=words):
        GymnasiumEnv("unknotting", **options, **OPTIONS)
