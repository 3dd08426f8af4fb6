"""Cloning experts: DAgger (Ross et al. 2011). A policy plays, the expert says what it would have done."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.expert import Expert
from torchdlo.agents.rl.rollout import policy_features

__all__ = ["Labels", "fit_clone", "label_batch"]


@dataclass(eq=False)
class Labels:
    """What the expert would have done where it was asked."""

    features: list[Tensor] = field(default_factory=list)
    actions: list[Tensor] = field(default_factory=list)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all of it."""
        return {"features": torch.cat(self.features), "actions": torch.cat(self.actions)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` returned."""
        self.features, self.actions = [state["features"]], [state["actions"]]

    def __len__(self) -> int:
        return sum(map(len, self.features))


@torch.no_grad()
def label_batch(
    labels: Labels,
    policy: Policy,
    expert: Expert,
    episodes: TaskEpisodes,
    *,
    driven: bool,
    noise: float,
    generator: torch.Generator,
) -> tuple[float, float]:
    """Play a batch, add its labels, and return the shares of successes and failures.

    Args:
        labels: gets what the expert says; nothing of episodes after they have failed.
        policy: whose features are kept.
        expert: who is asked.
        episodes: where.
        driven: whether the expert acts itself.
        noise: deviation of what is added to actions [m].
        generator: of the noise.
    """
    seen, env, reach = episodes.reset(), episodes.env, episodes.task.max_translation
    alive = torch.ones(episodes.count, dtype=torch.bool)
    for k in range(episodes.horizon):
        features = policy_features(policy, episodes, k, seen)
        right = expert.act(k, env.moved, env.world.tool.pos.float(), reach)
        labels.features.append(features[alive])
        labels.actions.append(right[alive])
        done = right if driven else policy.mean(features)
        random = torch.randn(done.shape, generator=generator) * (noise / reach)
        step = episodes.step(policy.command(done + random))
        seen, alive = torch.nan_to_num(step.observation), ~step.failed
    good = step.success & ~step.failed
    return float(good.float().mean()), float(step.failed.float().mean())


def fit_clone(
    policy: Policy, labels: Labels, *, updates: int = 3000, batch: int = 512, rate: float = 1e-3, noise: float = 0.0
) -> float:
    """Let a policy's means be what the expert said, from what it is now; return the last mean squared error.

    Args:
        policy: what learns; its normaliser takes part in the first fit only.
        labels: what it learns from.
        updates: steps of Adam, whose size falls to nothing along a cosine.
        batch: labels of a step.
        rate: first step.
        noise: deviation of what is added to features [m or their own unit].
    """
    features, actions = torch.cat(labels.features), torch.cat(labels.actions)
    if not bool(policy.normaliser.count > 0):
        policy.normaliser.update(features)
    optimizer = torch.optim.Adam(policy.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    error = torch.zeros(())
    for _ in range(updates):
        rows = torch.randint(len(features), (min(batch, len(features)),))
        x = features[rows]
        if noise:
            x = x + noise * torch.randn_like(x)
        loss = (policy.mean(x) - actions[rows]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        error = 0.99 * error + 0.01 * loss.detach()
    return float(error)
