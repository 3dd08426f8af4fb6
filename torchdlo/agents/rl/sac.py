"""Soft actor-critic (Haarnoja et al. 2018) with TorchRL's losses, replay buffer and target networks."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.collectors import RayEpisodes
from torchdlo.agents.rl.episodes import Episodes, Transition
from torchdlo.agents.rl.ppo import Critic, torchrl_actor
from torchdlo.agents.rl.rollout import Batch, policy_features
from torchdlo.agents.rl.settings import TrainingSettings

__all__ = ["Sac"]


class Sac:
    """The trainer: an iteration plays one batch of episodes, and learns after every action of them."""

    def __init__(self, policy: Policy, settings: TrainingSettings) -> None:
        """Make critics, target networks, temperature and buffer for a policy."""
        self.policy, self.settings, self.done = policy, settings, 0
        self.played: dict[str, Tensor] | None = None
        critic = ValueOperator(Critic(policy, settings, actions=policy.spec.actions), in_keys=["features", "action"])
        self.loss = SACLoss(
            torchrl_actor(policy), critic, num_qvalue_nets=2, target_entropy=-0.5 * policy.spec.actions, alpha_init=0.1
        )
        self.loss.make_value_estimator(gamma=settings.gamma)
        # Both critics begin as one network; they are drawn anew.
        with torch.no_grad():
            for name, value in self.loss.qvalue_network_params.items(True, True):
                if name[-1] == "weight":
                    for part in value.data:
                        nn.init.orthogonal_(part, 2**0.5)
            for target, value in zip(
                self.loss.target_qvalue_network_params.values(True, True),
                self.loss.qvalue_network_params.values(True, True),
                strict=True,
            ):
                target.data.copy_(value.data)
        self.soft = SoftUpdate(self.loss, eps=settings.polyak)
        self.critics = [p for p in self.loss.qvalue_network_params.values(True, True) if isinstance(p, nn.Parameter)]
        self.optimizer = torch.optim.Adam(
            [
                {"params": list(policy.parameters()), "lr": settings.rate},
                {"params": self.critics, "lr": settings.critic_rate},
                {"params": [self.loss.log_alpha], "lr": settings.rate},
            ]
        )
        storage = LazyTensorStorage(settings.replay, device=settings.device)
        self.buffer = TensorDictReplayBuffer(storage=storage, batch_size=settings.batch)

    def parts(self) -> dict[str, Any]:
        """Return what a checkpoint has to hold, by name."""
        return {"policy": self.policy, "loss": self.loss, "optimizer": self.optimizer, "memory": self}

    def state_dict(self) -> dict[str, Any]:
        """Return what is remembered, as plain tensors."""
        count = len(self.buffer)
        kept = self.buffer[:].items(True, True) if count else ()
        flat = {"/".join(k if isinstance(k, tuple) else (k,)): v for k, v in kept}
        return {"done": self.done, "cursor": int(self.buffer._writer._cursor), "rows": flat}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Remember what `state_dict` returned."""
        self.done, rows = state["done"], state["rows"]
        self.buffer.empty()
        if rows:
            count = len(rows["features"])
            found = TensorDict({}, batch_size=[count])
            for name, value in rows.items():
                found[tuple(name.split("/"))] = value.to(self.settings.device)
            self.buffer.extend(found)
        # Where the next one goes: over the oldest one, once all room is taken.
        self.buffer._writer._cursor = state["cursor"]

    def iterate(self, episodes: Episodes) -> tuple[Batch, dict[str, float]]:
        """Play and learn; return what was played and how learning went."""
        s, policy = self.settings, self.policy
        self.played = copy.deepcopy(policy.state_dict()) if self.done >= s.warm else None
        if isinstance(episodes, RayEpisodes):
            return self._learn_from(episodes.collect(policy, uniform=self.done < s.warm))
        seen = episodes.reset()
        features = [policy_features(policy, episodes, 0, seen)]
        rows: list[dict[str, Tensor]] = []
        told: list[dict[str, Tensor]] = []
        step: Any = None
        alive = torch.ones(episodes.count, dtype=torch.bool, device=seen.device)
        for k in range(episodes.horizon):
            with torch.no_grad():
                if self.done < s.warm:
                    action = 2 * torch.rand(episodes.count, policy.spec.actions, device=seen.device) - 1
                    density = torch.zeros_like(action[:, 0])
                else:
                    action, density = policy.draw(features[-1])
                step = episodes.step(policy.command(action))
                finite = torch.nan_to_num(step.observation)
                features.append(policy_features(policy, episodes, k + 1, finite))
            self._remember(features[-2:], action, step, alive, last=k + 1 == episodes.horizon)
            alive = ~step.failed
            rows.append({"action": action, "log_prob": density, "reward": step.reward, "failed": step.failed})
            if self.done >= s.warm:
                told += [self._learn() for _ in range(s.updates)]
        kept = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        return self._ended(Batch(torch.stack(features), **kept, success=step.success & ~step.failed), told)

    def _learn_from(self, batch: Batch) -> tuple[Batch, dict[str, float]]:
        """Learn from what collectors played: as often as beside playing, but after the whole batch."""
        s, horizon = self.settings, len(batch.action)
        for k in range(horizon):
            step = Transition(batch.features[k + 1], batch.reward[k], batch.failed[k], batch.success)
            pair = [batch.features[k], batch.features[k + 1]]
            self._remember(pair, batch.action[k], step, batch.alive[k], last=k + 1 == horizon)
        told = [self._learn() for _ in range(s.updates * horizon)] if self.done >= s.warm else []
        return self._ended(batch, told)

    def _ended(self, batch: Batch, told: list[dict[str, Tensor]]) -> tuple[Batch, dict[str, float]]:
        self.done += 1
        if self.done <= self.settings.warm:
            self.policy.normaliser.update(batch.features)
        return batch, {k: float(torch.stack([t[k] for t in told]).mean()) for k in (told[0] if told else {})}

    def _remember(self, features: list[Tensor], action: Tensor, step: Any, alive: Tensor, *, last: bool) -> None:
        before, after = features
        terminal = step.failed | last
        if not bool(alive.any()):
            return
        rows = TensorDict(
            {
                "features": before,
                "action": action,
                "next": TensorDict(
                    {
                        "features": after,
                        "reward": step.reward.unsqueeze(-1),
                        "done": terminal.unsqueeze(-1),
                        "terminated": terminal.unsqueeze(-1),
                    },
                    batch_size=[len(action)],
                ),
            },
            batch_size=[len(action)],
        )
        self.buffer.extend(rows[alive])

    def _learn(self) -> dict[str, Tensor]:
        part = self.loss(self.buffer.sample())
        self.optimizer.zero_grad()
        (part["loss_actor"] + part["loss_qvalue"] + part["loss_alpha"]).backward()
        nn.utils.clip_grad_norm_(self.policy.parameters(), self.settings.clip_norm)
        nn.utils.clip_grad_norm_(self.critics, self.settings.clip_norm)
        self.optimizer.step()
        self.soft.step()
        return {k: part[k].detach() for k in ("loss_actor", "loss_qvalue", "alpha", "entropy")}
