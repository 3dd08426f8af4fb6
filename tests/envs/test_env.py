"""Tasks as TorchRL environments: specs, seeds, resets, gradients, and what TorchRL offers around them."""

from __future__ import annotations

import dataclasses
import functools
import multiprocessing
import subprocess
import sys

import pytest
import torch
from test_contract import F64, small

from torchdlo import envs
from torchdlo.envs import TASKS
from torchdlo.envs.core import episode

pytest.importorskip("torchrl")

from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def made(name: str = "unknotting", horizon: int = 2, **choices):
    choices = {"num_envs": 2, "execution": "eager", "seed": 0} | choices
    return envs.make(small(name, horizon), **choices)


@pytest.mark.parametrize("name", TASKS)
def test_specs_say_what_environments_return(name: str):
    check_env_specs(made(name, variation=False))


def _begun_elsewhere(seed: int | None) -> list[list[float]]:
    """How far things are off their places in three processes that are forked off this one."""
    reader, writer = multiprocessing.get_context("fork").SimpleQueue(), []

    def begin() -> None:
        env.set_seed(seed)
        reader.put(env.task.moved(2, generator=env.generator).flatten().tolist())

    env = made()
    for _ in range(3):
        writer.append(multiprocessing.get_context("fork").Process(target=begin))
        writer[-1].start()
    found = [reader.get() for _ in writer]
    for process in writer:
        process.join()
    return found


def test_environments_of_other_processes_begin_differently_without_a_seed():
    one, other, third = _begun_elsewhere(None)
    assert one != other and other != third and one != third
    assert _begun_elsewhere(3) == [made(seed=3).task.moved(2, generator=made(seed=3).generator).flatten().tolist()] * 3
    # Here it is torch's generator that decides.
    seeds = []
    for _ in range(2):
        torch.manual_seed(5)
        env = made()
        env.set_seed(None)
        seeds.append(env.generator.initial_seed())
    assert seeds[0] == seeds[1]


def test_the_seed_decides_starts_and_what_follows():
    def played(seed: int) -> torch.Tensor:
        env = made(seed=seed)
        actions = torch.full((2, 12), 0.002)
        return env.rollout(2, lambda td: td.set("action", actions))["next", "observation"]

    torch.testing.assert_close(played(1), played(1), rtol=0, atol=0)
    # Starts differ by centimetres.
    assert (played(1) - played(2)).abs().max() > 1e-3


def test_without_a_seed_torch_decides_starts():
    def starts() -> list[torch.Tensor]:
        torch.manual_seed(5)
        return [made(seed=None).reset()["observation"] for _ in range(2)]

    with torch.random.fork_rng():
        first, again = starts(), starts()
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert (first[0] - first[1]).abs().max() > 1e-3


def test_scenes_are_reset_one_by_one():
    env = made(horizon=3)
    td = env.reset()
    td = env.step(td.set("action", torch.zeros(2, 12)))
    before = td["next", "observation"]
    mask = torch.tensor([[True], [False]])
    again = env.reset(step_mdp(td).set("_reset", mask))
    torch.testing.assert_close(again["observation"][1], before[1], rtol=0, atol=0)
    assert (again["observation"][0] - before[0]).abs().max() > 1e-3
    td = env.step(again.set("action", torch.zeros(2, 12)))
    td = env.step(step_mdp(td).set("action", torch.zeros(2, 12)))
    assert td["next", "truncated"].flatten().tolist() == [False, True]


def test_rollouts_carry_gradients_to_actions():
    task = small("unknotting")
    env = made(gradients=True, dtype=F64, variation=False)
    actions = torch.full((2, 12), 0.002, requires_grad=True)
    found = env.rollout(2, lambda td: td.set("action", actions))["next", "reward"]
    (gradient,) = torch.autograd.grad(found.sum(), actions)
    made_ = episode.prepare(task, 2, like=torch.zeros((), dtype=F64), execution="eager")
    other = actions.detach().double().requires_grad_()
    outcome = episode.play(task, other[:, None].expand(-1, 2, -1), episode=made_)
    (wanted,) = torch.autograd.grad(outcome.returns.sum(), other)
    # Rewards and actions pass the border in single precision.
    torch.testing.assert_close(gradient.double(), wanted, rtol=1e-5, atol=1e-7)


def test_scenes_that_go_on_keep_their_gradients_when_others_begin_again():
    env = made(horizon=4, gradients=True, variation=False)
    actions = torch.full((2, 12), 0.002, requires_grad=True)
    td = env.step(env.reset().set("action", actions))
    again = env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    reward = env.step(again.set("action", torch.zeros(2, 12)))["next", "reward"].flatten()
    assert td["next", "reward"].requires_grad
    slopes = [torch.autograd.grad(r, actions, retain_graph=True)[0] for r in reward]
    assert float(slopes[0].abs().max()) == 0 < float(slopes[1].abs().max())
    # Where all begin again, nothing is left of what was.
    assert not env.reset()["observation"].requires_grad


def test_windows_are_cut_where_one_asks_for_it():
    env = made(horizon=4, gradients=True)
    actions = torch.full((2, 12), 0.002, requires_grad=True)
    td = env.rollout(2, lambda td: td.set("action", actions), break_when_any_done=False)
    env.detach()
    after = env.rollout(
        2, lambda td: td.set("action", torch.zeros(2, 12)), auto_reset=False, tensordict=step_mdp(td[..., -1]).detach()
    )
    assert td["next", "reward"].requires_grad and not after["next", "reward"].requires_grad


def test_without_gradients_nothing_is_recorded():
    actions = torch.zeros(2, 12, requires_grad=True)
    td = made().rollout(1, lambda td: td.set("action", actions))
    assert not td["next", "reward"].requires_grad


def test_random_numbers_of_effects_stay_in_their_declared_range():
    env = made(randomize={"rod_contact.mu_k": 0.2, "damping.rate": 1.0}, num_envs=64, seed=3)
    env.reset()
    numbers = env.episode.params.effects
    mu, rate = numbers["rod_contact"]["mu_k"].flatten(), numbers["damping"]["rate"].flatten()
    # A fifth of 0 to 2 about 0.25; the whole of 1e-3 to 50 about 30, by factors, cut off at 50.
    assert 0.05 <= float(mu.min()) < 0.12 and 0.38 < float(mu.max()) <= 0.45
    assert float(rate.max()) == pytest.approx(50) and float(rate.min()) < 5
    # What slides rubs less than what sticks.
    torch.testing.assert_close(numbers["rod_contact"]["mu_s"].flatten(), mu.clamp(min=0.3), rtol=0, atol=0)
    with pytest.raises(ValueError, match=r"there is no number 'rod_contact\.mu'"):
        made(randomize={"rod_contact.mu": 0.1})
    with pytest.raises(ValueError, match="a share of its declared range"):
        made(randomize={"rod_contact.mu_k": 2.0})


def test_scenes_settle_with_the_numbers_that_are_drawn_for_them():
    task = dataclasses.replace(small("slingshot"), settle_steps=5)
    choices = {"num_envs": 2, "execution": "eager", "variation": False, "dtype": F64, "seed": 0}
    env = envs.make(task, randomize={"gravity.acceleration": 0.5}, **choices)
    env.reset()
    fall = env.episode.params.effects["gravity"]["acceleration"][..., 2].flatten()
    usual = env.episode.start.state.rods.vel[0, 3, 2] / env._usual.effects["gravity"]["acceleration"][..., 2].flatten()
    # The band hardly resists yet: free vertices fall as fast as gravity has it.
    torch.testing.assert_close(env.world.state.rods.vel[:, 3, 2], usual * fall, rtol=1e-2, atol=0)
    assert (fall[0] - fall[1]).abs() > 0.1


def test_transforms_and_collectors_work():
    env = TransformedEnv(made(horizon=2), RewardSum())
    env.append_transform(StepCounter())
    collector = Collector(
        env, env.rand_action, frames_per_batch=8, total_frames=8, auto_register_policy_transforms=False
    )
    (batch,) = list(collector)
    collector.shutdown()
    assert batch.shape == (2, 4) and batch["next", "done"].sum() == 4
    assert batch["next", "step_count"].max() == 2
    whole = batch["next", "reward"][:, :2].sum(1)
    torch.testing.assert_close(batch["next", "episode_reward"][:, 1], whole)


def test_other_words_for_a_task_are_refused():
    with pytest.raises(envs.InputError, match="there is no task 'knot'; expected one of coiling"):
        envs.make("knot")


def test_environments_stay_on_their_device_and_in_their_precision():
    env = made()
    assert env.to("cpu") is env and env.to(torch.device("cpu")) is env and env.to(torch.float32) is env
    with pytest.raises(envs.InputError, match=r"made with device cpu and cannot go to meta; give device= to"):
        env.to("meta")
    with pytest.raises(envs.InputError, match=r"made with device cpu and cannot go to meta"):
        TransformedEnv(env, RewardSum()).to("meta")
    with pytest.raises(envs.InputError, match=r"made with dtype torch.float32 and cannot go to torch.float64"):
        env.to(F64)


def test_a_missing_extra_is_named():
    code = (
        "import sys\nsys.modules['torchrl'] = None\nfrom torchdlo import envs\n"
        "try:\n    envs.make('coiling')\nexcept envs.InputError as e:\n    print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install 'torchdlo[rl,robots]'" in done.stdout, done.stderr


def test_tasks_are_listed_without_torchrl():
    code = "import sys\nfrom torchdlo import envs\nenvs.find('coiling')\nassert 'torchrl' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_processes_hold_environments_of_their_own():
    env = ParallelEnv(2, functools.partial(made, num_envs=1, horizon=2))
    try:
        td = env.rollout(2)
        assert td.shape[:2] == (2, 1) and torch.isfinite(td["next", "reward"]).all()
    finally:
        env.close()


def test_arms_stand_still_without_a_way_by_hand():
    @dataclasses.dataclass(frozen=True)
    class Still(type(TASKS["gathering"]())):
        """Without a way."""

        def waypoints(self):
            """Return no way."""
            return ()

    assert not Still(horizon=7).demonstration().any() and Still(horizon=7).demonstration().shape == (7, 12)


def test_tasks_can_be_changed_field_by_field():
    short = dataclasses.replace(TASKS["coiling"](), horizon=7, frame_skip=1)
    assert envs.make(short, execution="eager").task.horizon == 7
    with pytest.raises(ValueError, match=r"take 96 actions of 0\.01 m; expected at most 7"):
        short.demonstration()
