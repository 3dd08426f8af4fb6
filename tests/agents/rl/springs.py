"""A point on a spring, as a TorchRL environment with gradients: push it to rest in the middle."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchdlo.agents.policies import FeatureSpec, Policy, PolicySpec
from torchdlo.agents.rl.episodes import EnvEpisodes

HORIZON = 20


def move(x: Tensor, v: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """A step of 0.1 s of a point on a spring of 1 1/s^2 that is pushed by at most 3 m/s^2."""
    v = v + 0.1 * (3 * u - x)
    return x + 0.1 * v, v


class Spring(EnvBase):
    """N points; a reward is minus the square of the distance from the middle."""

    def __init__(self, count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([count]))
        self.generator, self.kind = torch.Generator().manual_seed(seed), dtype
        one = torch.ones(count, 1)
        self.action_spec = Bounded(-one, one, (count, 1))
        self.observation_spec = Composite(observation=Unbounded((count, 2), dtype=dtype), shape=(count,))
        self.reward_spec = Unbounded((count, 1), dtype=dtype)
        flag = Binary(1, (count, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), shape=(count,))

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDict:
        count = self.batch_size[0]
        self.state = (2 * torch.rand(count, 2, generator=self.generator, dtype=torch.float64) - 1).to(self.kind)
        flags = {name: torch.zeros(count, 1, dtype=torch.bool) for name in ("done", "terminated")}
        return TensorDict({"observation": self.state, **flags}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        x, v = self.state.unbind(-1)
        x, v = move(x, v, tensordict["action"][:, 0].clamp(-1, 1))
        self.state = torch.stack([x, v], -1)
        flags = {name: torch.zeros(len(x), 1, dtype=torch.bool) for name in ("done", "terminated")}
        reward = -(x.square() + 0.1 * v.square()).unsqueeze(-1)
        return TensorDict({"observation": self.state, "reward": reward, **flags}, self.batch_size)

    def detach(self) -> None:
        self.state = self.state.detach()


def springs(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> EnvEpisodes:
    return EnvEpisodes(Spring(count, seed, dtype), HORIZON)


def pusher(**choices) -> Policy:
    return Policy(PolicySpec(FeatureSpec(2, waves=2), actions=1, **({"hidden": (32, 32)} | choices)))


def solved(policy: Policy) -> tuple[float, float, float]:
    """Mean return of a policy, of doing nothing, and of the best linear feedback, from 256 starts that are new."""
    from torchdlo.agents.rl.rollout import collect_episodes

    found = collect_episodes(policy, springs(256, 99), random=False).reward.sum(0).mean()
    values = []
    for gain in ((0.0, 0.0), (-0.6, -0.8)):
        env = Spring(256, 99)
        td = env.reset()
        total = torch.zeros(256)
        for _ in range(HORIZON):
            u = (td["observation"] @ torch.tensor(gain)).unsqueeze(-1)
            td = env.step(td.set("action", u))["next"]
            total = total + td["reward"][:, 0]
        values.append(float(total.mean()))
    return float(found), *values
