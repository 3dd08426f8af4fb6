"""Proximal policy optimisation (Schulman et al. 2017) with TorchRL's loss and advantages."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchdlo.agents.policies import Policy, mlp
from torchdlo.agents.rl.collectors import played_batch
from torchdlo.agents.rl.episodes import Episodes
from torchdlo.agents.rl.rollout import Batch, generalised_advantages
from torchdlo.agents.rl.settings import TrainingSettings

__all__ = ["Critic", "Ppo", "torchrl_actor"]


class Critic(nn.Module):
    """Values of states, or of states and actions, in the normaliser of a policy; shape (..., 1)."""

    def __init__(self, policy: Policy, settings: TrainingSettings, *, actions: int = 0) -> None:
        """Make one with random weights."""
        super().__init__()
        self._normaliser = [policy.normaliser]  # in a list, so that it is not a part of this module
        width = policy.spec.features.width + actions
        sizes = (width, *settings.critic, 1)
        self.net = mlp(sizes, settings.activation, layer_norm=settings.layer_norm, last=1.0)

    def forward(self, features: Tensor, action: Tensor | None = None) -> Tensor:
        """Return values of states, or of actions in them."""
        x = self._normaliser[0](features)
        return self.net(x if action is None else torch.cat([x, action], -1))


def torchrl_actor(policy: Policy) -> ProbabilisticActor:
    """Return a policy as TorchRL's actor from "features" to "action"."""
    net = TensorDictModule(policy, in_keys=["features"], out_keys=["loc", "scale"])
    kind = TanhNormal if policy.spec.squash else IndependentNormal
    return ProbabilisticActor(net, in_keys=["loc", "scale"], distribution_class=kind, return_log_prob=True)


class Ppo:
    """The trainer: an iteration plays one batch of episodes and goes over it some times."""

    def __init__(self, policy: Policy, settings: TrainingSettings, *, fixed: bool = False) -> None:
        """Make critic and optimisers for a policy; `fixed` leaves its normaliser as it is."""
        self.policy, self.settings, self.fixed = policy, settings, fixed
        self.played: dict[str, Tensor] | None = None
        self.critic = Critic(policy, settings)
        value = ValueOperator(self.critic, in_keys=["features"])
        self.loss = ClipPPOLoss(
            torchrl_actor(policy),
            value,
            clip_epsilon=settings.clip,
            entropy_coeff=settings.entropy,
            critic_coeff=1.0,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.optimizer = torch.optim.Adam(
            [
                {"params": list(policy.parameters()), "lr": settings.rate},
                {"params": list(self.critic.parameters()), "lr": settings.critic_rate},
            ]
        )

    def parts(self) -> dict[str, Any]:
        """Return what a checkpoint has to hold, by name."""
        return {"policy": self.policy, "critic": self.critic, "optimizer": self.optimizer}

    def iterate(self, episodes: Episodes) -> tuple[Batch, dict[str, float]]:
        """Play and learn; return what was played and how learning went."""
        self.played = copy.deepcopy(self.policy.state_dict())
        batch = played_batch(self.policy, episodes)
        if not bool(self.policy.normaliser.count > 0):
            self.policy.normaliser.update(batch.features)
            # Densities are those of the policy as it is now.
            with torch.no_grad():
                batch = _again(self.policy, batch)
            return batch, self.learn(batch)
        told = self.learn(batch)
        if not self.fixed:
            self.policy.normaliser.update(batch.features)
        return batch, told

    def learn(self, batch: Batch, *, freeze: bool = False) -> dict[str, float]:
        """Go over a batch; `freeze` leaves the policy as it is and teaches the critic alone."""
        s = self.settings
        with torch.no_grad():
            value = self.critic(batch.features).squeeze(-1)
            advantage, returns = generalised_advantages(
                value, batch.reward, batch.terminal, gamma=s.gamma, lmbda=s.lmbda
            )
        use = batch.alive
        data = TensorDict(
            {
                "features": batch.features[:-1][use],
                "action": batch.action[use],
                "action_log_prob": batch.log_prob[use],
                "advantage": advantage[use].unsqueeze(-1),
                "value_target": returns[use].unsqueeze(-1),
            },
            batch_size=[int(use.sum())],
        )
        if not len(data):
            return {}
        rows: list[dict[str, Tensor]] = []
        for _ in range(s.passes):
            for sample in torch.randperm(len(data), device=batch.features.device).split(s.batch):
                part = self.loss(data[sample])
                own = 0.0 if freeze else part["loss_objective"] + part["loss_entropy"]
                loss = part["loss_critic"] + own
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.policy.parameters(), s.clip_norm)
                nn.utils.clip_grad_norm_(self.critic.parameters(), s.clip_norm)
                self.optimizer.step()
                rows.append({k: part[k].detach() for k in ("loss_critic", "kl_approx", "clip_fraction", "entropy")})
        return {k: float(torch.stack([r[k] for r in rows]).mean()) for k in rows[0]}


def _again(policy: Policy, batch: Batch) -> Batch:
    """Return a batch with the densities of a policy whose normaliser has changed."""
    td = TensorDict({"features": batch.features[:-1]}, batch_size=batch.log_prob.shape)
    return replace(batch, log_prob=torchrl_actor(policy).get_dist(td).log_prob(batch.action))
