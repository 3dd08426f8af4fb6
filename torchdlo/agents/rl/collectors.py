"""Episodes that TorchRL's collectors play, on the nodes of a Ray cluster.

Every worker has an equal share of the episodes, and plays all of them once per batch, with the policy as it is then.
Before a batch each gets a seed, drawn from torch's generator here: starts and actions come from it, so that a run that
was stopped goes on bit by bit, and a batch of which a node was lost is played again as it was.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdlo.agents.distributed.ray_executor import AGAIN, join_cluster
from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.episodes import Episodes
from torchdlo.agents.rl.rollout import Batch, collect_episodes
from torchdlo.errors import InputError

__all__ = ["ActingPolicy", "EpisodesEnv", "RayEpisodes", "batch_of", "collecting_policy", "played_batch"]

_SEEN = ("observation", "progress", "start")


class EpisodesEnv(EnvBase):
    """Episodes in step as a TorchRL environment; all end together, those that failed go on without earning."""

    episodes: Episodes
    _over: int

    def __init__(self, episodes: Episodes, actions: int) -> None:
        """Wrap episodes whose actions have so many numbers."""
        count = episodes.count
        super().__init__(device="cpu", batch_size=torch.Size([count]))
        self.episodes, self._over = episodes, 0
        size = episodes.reset().shape[-1]
        one, flag = Unbounded((count, 1)), Binary(1, (count, 1), dtype=torch.bool)
        seen = {"observation": Unbounded((count, size)), "start": Unbounded((count, size)), "progress": one.clone()}
        told = {"returned": one.clone(), "failed": flag.clone(), "success": flag.clone()}
        self.observation_spec = Composite(**seen, **told, shape=(count,))
        self.action_spec = Unbounded((count, actions))
        self.reward_spec = one.clone()
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(count,))

    def _set_seed(self, seed: int | None) -> None:
        # The process is a collector's own: actions come from the seed, too.
        torch.manual_seed(seed or 0)
        self.episodes.generator.manual_seed(seed or 0)

    def _told(self, observation: Tensor, failed: Tensor, success: Tensor) -> dict[str, Tensor]:
        count = self.batch_size[0]
        returned = getattr(self.episodes, "returns", torch.zeros(count))
        ended = torch.full((count, 1), self._over == self.episodes.horizon)
        return {
            "observation": observation.float(),
            "start": self.episodes.first.float(),
            "progress": torch.full((count, 1), self._over / self.episodes.horizon),
            "returned": returned.float()[:, None],
            "failed": failed[:, None],
            "success": success[:, None],
            "done": ended,
            "terminated": ended.clone(),
            "truncated": torch.zeros_like(ended),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        self._over, never = 0, torch.zeros(self.batch_size, dtype=torch.bool)
        return TensorDict(self._told(self.episodes.reset(), never, never.clone()), self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        with torch.no_grad():
            step = self.episodes.step(tensordict["action"])
        self._over += 1
        told = self._told(torch.nan_to_num(step.observation), step.failed, step.success)
        return TensorDict(told | {"reward": step.reward.float()[:, None]}, self.batch_size)


class ActingPolicy(nn.Module):
    """A policy as collectors call it: from what is seen to a command, what was drawn, and its density."""

    uniform: Tensor

    def __init__(self, policy: Policy) -> None:
        """Wrap a policy, which stays the same object."""
        super().__init__()
        self.policy = policy
        # Beside the weights, as it goes to the workers with them.
        self.register_buffer("uniform", torch.zeros((), dtype=torch.bool))

    @torch.no_grad()
    def forward(self, observation: Tensor, progress: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return commands (N, A + turns), actions (N, A) and logarithms of their densities (N, 1)."""
        action, density = self.policy.draw(self.policy.features(observation, progress, start))
        if bool(self.uniform):
            action, density = 2 * torch.rand_like(action) - 1, torch.zeros_like(density)
        return self.policy.command(action), action, density[..., None]


def collecting_policy(policy: Policy) -> TensorDictModule:
    """Return a policy as TorchRL's collectors take it."""
    return TensorDictModule(ActingPolicy(policy), in_keys=list(_SEEN), out_keys=["action", "drawn", "log_prob"])


def batch_of(policy: Policy, played: TensorDictBase) -> tuple[Batch, Tensor]:
    """Return whole episodes (workers, N, T) as a batch of workers x N, and what they earned without what is added."""
    rows = played.flatten(0, 1)
    after = rows["next"]
    seen = [torch.cat([rows[key][:, :1], after[key]], 1).transpose(0, 1) for key in _SEEN]
    with torch.no_grad():
        features = policy.features(*seen)
    step = {
        "action": rows["drawn"],
        "log_prob": rows["log_prob"][..., 0],
        "reward": after["reward"][..., 0],
        "failed": after["failed"][..., 0],
    }
    over = after[:, -1]
    success = (over["success"] & ~over["failed"])[:, 0]
    return Batch(features, **{k: x.transpose(0, 1) for k, x in step.items()}, success=success), over["returned"][:, 0]


def _made(make: Callable[[int], Episodes], count: int, actions: int) -> EpisodesEnv:
    torch.set_num_threads(1)
    return EpisodesEnv(make(count), actions)


class RayEpisodes:
    """A batch of episodes that processes of a Ray cluster play: `Ppo` and `Sac` take them as other episodes.

    A batch of which a node was lost is played again by the nodes that are left.
    """

    def __init__(
        self, make: Callable[[int], Episodes], policy: Policy, *, count: int, horizon: int, workers: int, address: str
    ) -> None:
        """Join a cluster and start its workers.

        Args:
            make: makes so many episodes; it is handed over by value.
            policy: who acts.
            count: episodes of a batch, N; a multiple of the workers.
            horizon: actions of an episode, T.
            workers: how many processes play.
            address: see `executors.make_executor`.
        """
        self.count, self.horizon, self.workers = count, horizon, workers
        self.generator = torch.Generator()
        self.first = self.returns = torch.zeros(count)
        self._ray, self._owned = join_cluster(address)
        self._acting = collecting_policy(policy)
        actions = policy.spec.actions + policy.spec.turns
        self._make = functools.partial(_made, make, count // workers, actions)
        self._collector: Any = None
        self._rows: Any = None

    def _begin(self) -> None:
        from torchrl.collectors.distributed import RayCollector

        self._collector = RayCollector(
            [self._make] * self.workers,
            self._acting,
            frames_per_batch=self.count * self.horizon,
            total_frames=self.count * self.horizon << 32,
            reset_at_each_iter=True,
            sync=True,
            remote_configs={"num_cpus": 1},
            collector_kwargs=[{"auto_register_policy_transforms": False} for _ in range(self.workers)],
        )
        self._rows = iter(self._collector)

    def _end(self) -> None:
        if self._collector is not None:
            self._collector.shutdown(shutdown_ray=False)
        self._collector = self._rows = None

    def collect(self, policy: Policy, *, uniform: bool = False) -> Batch:
        """Play a batch with the policy, as it is now; `uniform` draws from all actions."""
        seeds = torch.randint(2**31, (self.workers,)).tolist()
        self._acting.module.uniform.fill_(uniform)
        # Weights go to the workers through a process group of torch.
        lost = (self._ray.exceptions.RayActorError, self._ray.exceptions.NodeDiedError, torch.distributed.DistError)
        for _ in range(AGAIN):
            try:
                batch, self.returns = batch_of(policy, self._play(seeds))
                return batch
            except lost as error:
                said = str(error).strip().splitlines()[-1]
                self._end()
        raise InputError(f"--address: workers of the cluster were lost {AGAIN} times; the last one said: {said}")

    def _play(self, seeds: Sequence[int]) -> TensorDictBase:
        if self._collector is None:
            self._begin()
        self._collector.update_policy_weights_(self._acting)
        self._collector.map_fn("set_seed", [(seed,) for seed in seeds], [{"static_seed": True} for _ in seeds])
        found: TensorDictBase = next(self._rows)
        return found

    def reset(self) -> Tensor:
        """Not to be called: whole batches are collected."""
        raise RuntimeError("episodes of collectors are played as whole batches, see `collect`")

    def step(self, action: Tensor) -> Any:
        """Not to be called, as `reset`."""
        return self.reset()

    def detach(self) -> None:
        """Do nothing: what was played has no gradients."""

    def close(self) -> None:
        """End the workers, and leave the cluster if it was joined here."""
        self._end()
        if self._owned:
            self._ray.shutdown()

    def __enter__(self) -> RayEpisodes:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def played_batch(policy: Policy, episodes: Episodes) -> Batch:
    """Play a batch here, or let collectors play it."""
    return episodes.collect(policy) if isinstance(episodes, RayEpisodes) else collect_episodes(policy, episodes)
