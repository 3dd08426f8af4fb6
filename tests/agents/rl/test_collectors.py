"""TorchRL's collectors play what a process plays by itself, bit by bit, on Ray too, and when a worker is lost."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from springs import HORIZON, pusher, springs
from torchrl.collectors import Collector

from torchdlo.agents.rl.collectors import EpisodesEnv, RayEpisodes, batch_of, collecting_policy
from torchdlo.agents.rl.ppo import Ppo
from torchdlo.agents.rl.rollout import Batch, collect_episodes
from torchdlo.agents.rl.sac import Sac
from torchdlo.agents.rl.settings import TrainingSettings, training_preset
from torchdlo.agents.rl.training import train
from torchdlo.errors import InputError


def alone(policy, count: int, seed: int) -> Batch:
    """What a process plays by itself after a seed."""
    episodes = springs(count)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        episodes.generator.manual_seed(seed)
        return collect_episodes(policy, episodes)


def assert_same(a: Batch, b: Batch) -> None:
    for name, value in vars(a).items():
        assert torch.equal(value, getattr(b, name)), name


def test_a_collector_plays_what_a_process_plays_by_itself() -> None:
    policy = pusher()
    env = EpisodesEnv(springs(4), 1)
    frames = 4 * HORIZON
    options = {"reset_at_each_iter": True, "auto_register_policy_transforms": False}
    collector = Collector(env, collecting_policy(policy), frames_per_batch=frames, total_frames=8 * frames, **options)
    rows = iter(collector)
    for seed in (5, 6, 5):
        collector.set_seed(seed, static_seed=True)
        assert_same(batch_of(policy, next(rows)[None])[0], alone(policy, 4, seed))
    collector.shutdown()


def test_what_cannot_be_collected_is_refused() -> None:
    with pytest.raises(InputError, match="collectors is 2; expected 0, as shac needs gradients"):
        training_preset("coiling", "shac", collectors=2)
    with pytest.raises(InputError, match="collectors is 3; expected a number that divides the 100 episodes"):
        training_preset("coiling", "ppo", collectors=3)


@pytest.fixture(scope="module")
def cluster():
    """Ray on this machine, whose workers know the springs."""
    ray = pytest.importorskip("ray", reason="needs the extra ray")
    here = Path(__file__).parent
    paths = os.pathsep.join(map(str, (here.parents[2], here)))
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    size = {"num_cpus": 2, "object_store_memory": 100 * 2**20, "include_dashboard": False}
    ray.init(log_to_driver=False, runtime_env={"env_vars": {"PYTHONPATH": paths}}, **size)
    yield ray
    ray.shutdown()


@pytest.mark.slow
def test_workers_of_ray_play_the_same_and_a_lost_one_is_replaced(cluster) -> None:
    policy = pusher()
    with RayEpisodes(springs, policy, count=6, horizon=HORIZON, workers=2, address="local") as episodes:
        for lose in (False, True):
            state = torch.get_rng_state()
            seeds = torch.randint(2**31, (2,)).tolist()
            torch.set_rng_state(state)
            if lose:
                cluster.kill(episodes._collector.remote_collectors[1])
            found = episodes.collect(policy)
            parts = [alone(policy, 3, seed) for seed in seeds]
            for name, value in vars(found).items():
                assert torch.equal(value, torch.cat([getattr(p, name) for p in parts], int(value.dim() > 1))), name
            with torch.no_grad():  # workers take the weights as they are now
                policy.log_sigma.add_(0.3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Ppo, Sac])
def test_training_with_workers_goes_on_bit_by_bit(cluster, tmp_path: Path, kind) -> None:
    name = kind.__name__.lower()

    def run(folder: str, budget: int, resume: bool = False) -> dict[str, torch.Tensor]:
        settings = TrainingSettings(
            algorithm=name, episodes=budget, count=4, collectors=2, batch=16, warm=1, interval=0.0
        )
        torch.manual_seed(1)
        trainer = kind(pusher(state_sigma=kind is Sac), settings)
        with RayEpisodes(springs, trainer.policy, count=4, horizon=HORIZON, workers=2, address="local") as episodes:
            (tmp_path / folder).mkdir(exist_ok=True)
            train(trainer, episodes, settings, folder=tmp_path / folder, resume=resume)
        return trainer.policy.state_dict()

    whole = run("whole", 16)
    run("parts", 8)
    parts = run("parts", 16, resume=True)
    assert all(torch.equal(whole[key], parts[key]) for key in whole)
