"""Playing a policy, and what may be bootstrapped: nothing at failures and at the end of the time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.episodes import Episodes

__all__ = [
    "Batch",
    "collect_episodes",
    "episode_progress",
    "generalised_advantages",
    "policy_features",
    "td_lambda_targets",
]


@dataclass(frozen=True, eq=False)
class Batch:
    """Whole episodes, time first."""

    features: Tensor
    """Shape (T + 1, N, F)."""
    action: Tensor
    """Of the policy, shape (T, N, A)."""
    log_prob: Tensor
    """Logarithms of the density of what was drawn, shape (T, N)."""
    reward: Tensor
    """Shape (T, N)."""
    failed: Tensor
    """Whether episodes have failed after an action, bool, shape (T, N)."""
    success: Tensor
    """Whether the goal is reached at the end, bool, shape (N,)."""

    @property
    def alive(self) -> Tensor:
        """Whether episodes had not failed before an action, bool, shape (T, N)."""
        return torch.cat([torch.zeros_like(self.failed[:1]), self.failed[:-1]]).logical_not()

    @property
    def terminal(self) -> Tensor:
        """Whether there is nothing after an action, bool, shape (T, N): failures, and the end of the time."""
        ends = self.failed.clone()
        ends[-1] = True
        return ends


def episode_progress(episodes: Episodes, done: int, like: Tensor) -> Tensor:
    """Return the share of the episode that is over, shape (N, 1)."""
    return like.new_full((episodes.count, 1), done / episodes.horizon)


def policy_features(policy: Policy, episodes: Episodes, done: int, seen: Tensor) -> Tensor:
    """Return a policy's features (N, F) of what is seen (N, O) after so many actions."""
    return policy.features(seen, episode_progress(episodes, done, seen), episodes.first)


@torch.no_grad()
def collect_episodes(policy: Policy, episodes: Episodes, *, random: bool = True) -> Batch:
    """Play whole episodes without gradients; `random` draws actions, else they are the middle of what could be."""
    seen = episodes.reset()
    rows: list[dict[str, Tensor]] = []
    features = [policy_features(policy, episodes, 0, seen)]
    step: Any = None
    for k in range(episodes.horizon):
        if random:
            action, density = policy.draw(features[-1])
        else:
            action = policy.mean(features[-1])
            density = torch.zeros_like(action[:, 0])
        step = episodes.step(policy.command(action))
        finite = torch.nan_to_num(step.observation)
        features.append(policy_features(policy, episodes, k + 1, finite))
        rows.append({"action": action, "log_prob": density, "reward": step.reward, "failed": step.failed})
    kept = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
    return Batch(torch.stack(features), **kept, success=step.success & ~step.failed)


def generalised_advantages(
    value: Tensor, reward: Tensor, terminal: Tensor, *, gamma: float, lmbda: float, over: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return generalised advantages and returns, shape (T, N) each (Schulman et al. 2016).

    Args:
        value: of the states before each action and after the last one, shape (T + 1, N).
        reward: shape (T, N).
        terminal: whether nothing comes after an action, bool, shape (T, N).
        gamma: discount.
        lmbda: how far to trust rewards rather than values.
        over: whether a stretch ends after an action, with what comes later to be bootstrapped, bool, shape (T, N).
    """
    from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

    done = terminal if over is None else terminal | over
    parts = (value[:-1], value[1:], reward, done, terminal)
    found = vec_generalized_advantage_estimate(gamma, lmbda, *(p.T.unsqueeze(-1) for p in parts))
    return found[0].squeeze(-1).T, found[1].squeeze(-1).T


def td_lambda_targets(value: Tensor, reward: Tensor, terminal: Tensor, *, gamma: float, lmbda: float) -> Tensor:
    """Return TD(lambda) returns of a window, bootstrapped at its end, shape (T, N).

    Args:
        value: of the states after each action, shape (T, N).
        reward: shape (T, N).
        terminal: whether nothing comes after an action, bool, shape (T, N).
        gamma: discount.
        lmbda: how far to trust rewards rather than values.
    """
    from torchrl.objectives.value.functional import td_lambda_return_estimate

    done = terminal.clone()
    done[-1] = True
    parts = (value, reward, done, terminal)
    return td_lambda_return_estimate(gamma, lmbda, *(p.T.unsqueeze(-1) for p in parts)).squeeze(-1).T
