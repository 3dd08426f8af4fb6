"""TorchRL's pendulum in batches with a generator of its own."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.envs import PendulumEnv

from torchdlo.agents.policies import FeatureSpec, Policy, PolicySpec
from torchdlo.agents.rl.episodes import EnvEpisodes
from torchdlo.agents.rl.rollout import collect_episodes

HORIZON = 100


class _Batch:
    """PendulumEnv is stateless: a batch is a tensordict with that many rows."""

    def __init__(self, count: int, seed: int) -> None:
        self.env, self.batch_size, self.device = PendulumEnv(), torch.Size([count]), torch.device("cpu")
        self.generator = torch.Generator().manual_seed(seed)

    def _seen(self, td: Any) -> Any:
        th = td["th"]
        td["observation"] = torch.stack([th.cos(), th.sin(), td["thdot"] / 8], -1)
        return td

    def reset(self) -> TensorDict:
        td = self.env.reset(self.env.gen_params(batch_size=self.batch_size))
        random = torch.rand(2, *self.batch_size, generator=self.generator)
        td["th"], td["thdot"] = (2 * random[0] - 1) * math.pi, 2 * random[1] - 1
        return self._seen(td)

    def step(self, td: TensorDict) -> TensorDict:
        td = self.env.step(td.set("action", 2 * td["action"]))
        self._seen(td["next"])
        return td


def pendulums(count: int, seed: int = 0) -> EnvEpisodes:
    return EnvEpisodes(_Batch(count, seed), HORIZON)


def swinger(**choices) -> Policy:
    return Policy(PolicySpec(FeatureSpec(3, waves=1), actions=1, **({"hidden": (64, 64)} | choices)))


def swung(policy: Policy) -> float:
    """Mean return from 64 starts that are new."""
    return float(collect_episodes(policy, pendulums(64, 99), random=False).reward.sum(0).mean())
