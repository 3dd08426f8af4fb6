"""Policy gradients by back-propagation through short windows of the simulation, with a critic for what comes after.

SHAC: Xu et al. 2022 (arXiv:2204.07137). SAPO: Xing et al. 2025 (arXiv:2412.12089), the same with the entropy of the
policy in returns and targets, two critics and a learned temperature. Gradients go through everything between action and
reward: the policy's input, arms, contact and the critic. Those of a scene that are not finite, or far greater than
those of others, are cut with respect to each action, before scenes are averaged.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.episodes import Episodes
from torchdlo.agents.rl.ppo import Critic
from torchdlo.agents.rl.rollout import Batch, policy_features, td_lambda_targets
from torchdlo.agents.rl.settings import TrainingSettings

__all__ = ["Sapo", "Shac", "Window", "actor_loss", "saturation_loss"]

EDGE = 1.5
"""Means up to which nothing is paid before they are squashed; a fifth of a gradient is left there."""


@dataclass(frozen=True, eq=False)
class Window:
    """Some actions in a row, with the graph from policy to rewards; time first."""

    features: Tensor
    """Before each action and after the last one, shape (h + 1, N, F)."""
    action: Tensor
    """Shape (h, N, A)."""
    log_prob: Tensor
    """Shape (h, N)."""
    reward: Tensor
    """Shape (h, N)."""
    failed: Tensor
    """Whether episodes have failed after an action, bool, shape (h, N)."""
    begun: Tensor
    """Whether episodes had not failed before the window, bool, shape (N,)."""
    success: Tensor
    """Shape (N,)."""
    ends: bool
    """Whether the time is over after the window."""

    @property
    def terminal(self) -> Tensor:
        """Whether there is nothing after an action, bool, shape (h, N)."""
        found = self.failed.clone()
        if self.ends:
            found[-1] = True
        return found

    @property
    def alive(self) -> Tensor:
        """Whether episodes had not failed before an action, bool, shape (h, N)."""
        return torch.cat([self.begun[None], ~self.failed[:-1]])


def actor_loss(window: Window, value: Tensor, *, gamma: float, temperature: Tensor | float = 0.0) -> Tensor:
    """Return -(sum of gamma^k (r_k - temperature log p_k) + gamma^h V) / (h N); V counts where something comes after.

    Args:
        window: what was played.
        value: of the states after the window, shape (N,).
        gamma: discount.
        temperature: what entropy earns.
    """
    steps, count = window.reward.shape
    power = gamma ** torch.arange(steps, dtype=window.reward.dtype, device=window.reward.device)[:, None]
    gain = window.reward - temperature * window.log_prob
    earned = (power * torch.where(window.alive, gain, 0.0)).sum(0)
    after = torch.where(window.terminal[-1] | ~window.begun, 0.0, value)
    return -(earned + gamma**steps * after).sum() / (steps * count)


def saturation_loss(policy: Policy, window: Window) -> Tensor:
    """Return the mean square of what means exceed `EDGE` by before they are squashed, of episodes that go on, shape ().

    Its gradient reaches the policy alone: not through the simulation, where what led to such means is long gone.
    """
    loc, _ = policy(window.features[:-1].detach())
    over = (loc.abs() - EDGE).clamp(min=0).square().mean(-1)
    return torch.where(window.alive, over, 0.0).mean()


def _tamed(limit: float, lost: list[Tensor]) -> Callable[[Tensor], Tensor]:
    def hook(gradient: Tensor) -> Tensor:
        good = torch.isfinite(gradient).all(-1, keepdim=True)
        gradient = torch.where(good, gradient, 0.0)
        norm = gradient.norm(dim=-1, keepdim=True)
        lost.append((~good | (norm > limit)).float().mean() if limit else (~good).float().mean())
        return gradient * (limit / norm.clamp(min=limit)) if limit else gradient

    return hook


def _look_first(policy: Policy, episodes: Episodes, seen: Tensor) -> None:
    """Show the normaliser of a new policy the starts of a batch, at all times of the episode.

    How far the episode is does not differ among starts: what tells it would be scaled up to the bounds, where it tells
    nothing. All weighs as much as the starts alone.
    """
    times = range(episodes.horizon + 1)
    policy.normaliser.update(torch.cat([policy_features(policy, episodes, k, seen) for k in times]))
    policy.normaliser.square /= len(times)
    policy.normaliser.count /= len(times)


def _bounded(observation: Tensor) -> Tensor:
    """Return observations whose numbers are finite; others have no gradient."""
    return torch.where(torch.isfinite(observation), observation, 0.0)


class Shac:
    """The trainer: an iteration plays one batch of episodes, window by window, and learns after each."""

    critics = 1
    soft = False

    def __init__(self, policy: Policy, settings: TrainingSettings) -> None:
        """Make critics and optimisers for a policy."""
        self.policy, self.settings = policy, settings
        self.played: dict[str, Tensor] | None = None
        self.critic = nn.ModuleList(Critic(policy, settings) for _ in range(self.critics))
        self.target = nn.ModuleList(Critic(policy, settings) for _ in range(self.critics))
        self.target.load_state_dict(self.critic.state_dict())
        self.log_temperature = nn.Parameter(torch.tensor(math.log(settings.temperature)))
        betas = (0.7, 0.95)
        self.optimizer = torch.optim.Adam(policy.parameters(), lr=settings.rate, betas=betas)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), lr=settings.critic_rate, betas=betas)
        self.heat_optimizer = torch.optim.Adam([self.log_temperature], lr=settings.entropy_rate, betas=betas)
        self.lost: list[Tensor] = []

    def parts(self) -> dict[str, Any]:
        """Return what a checkpoint has to hold, by name."""
        return {
            "policy": self.policy,
            "critic": self.critic,
            "target": self.target,
            "optimizer": self.optimizer,
            "critic_optimizer": self.critic_optimizer,
            "heat_optimizer": self.heat_optimizer,
            "heat": nn.ParameterList([self.log_temperature]),
        }

    @property
    def temperature(self) -> Tensor | float:
        """What entropy earns."""
        return self.log_temperature.exp().detach() if self.soft else 0.0

    def play(self, episodes: Episodes, seen: Tensor, done: int, failed: Tensor) -> tuple[Window, Tensor]:
        """Play a window with its graph; return it and what is seen at its end.

        Args:
            episodes: where.
            seen: observations now, shape (N, O).
            done: actions before the window.
            failed: which episodes have failed, shape (N,).
        """
        s, policy = self.settings, self.policy
        count = min(s.window, episodes.horizon - done)
        limit = s.tame / (count * episodes.count) if s.tame else 0.0
        features = [policy_features(policy, episodes, done, _bounded(seen))]
        rows: list[dict[str, Tensor]] = []
        step: Any = None
        for k in range(count):
            action, density = policy.draw(features[-1])
            if action.requires_grad:
                action.register_hook(_tamed(limit, self.lost))
            step = episodes.step(policy.command(action))
            seen = _bounded(step.observation)
            features.append(policy_features(policy, episodes, done + k + 1, seen))
            rows.append({"action": action, "log_prob": density, "reward": step.reward, "failed": step.failed})
        kept = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        ends = done + count == episodes.horizon
        return Window(torch.stack(features), **kept, begun=~failed, success=step.success, ends=ends), seen

    def bootstrap(self, features: Tensor) -> Tensor:
        """Return what comes after states is worth to the actor, shape (...)."""
        return self.target[0](features).squeeze(-1)

    def aims(self, features: Tensor) -> Tensor:
        """Return what comes after states is worth in targets of critics, shape (...)."""
        return self.target[0](features).squeeze(-1)

    def iterate(self, episodes: Episodes) -> tuple[Batch, dict[str, float]]:
        """Play and learn; return what was played and how learning went."""
        seen, done = episodes.reset(), 0
        failed = torch.zeros(episodes.count, dtype=torch.bool, device=seen.device)
        windows: list[Window] = []
        told: list[dict[str, Tensor]] = []
        if not bool(self.policy.normaliser.count > 0):
            _look_first(self.policy, episodes, seen)
        self.played = copy.deepcopy(self.policy.state_dict())
        self.lost.clear()
        while done < episodes.horizon:
            window, seen = self.play(episodes, seen, done, failed)
            told.append(self._learn(window))
            episodes.detach()
            seen, failed = seen.detach(), window.failed[-1]
            done += len(window.reward)
            windows.append(_detached(window))
        batch = _joined(windows)
        self.policy.normaliser.update(batch.features)
        names = dict.fromkeys(k for t in told for k in t)
        found = {k: float(torch.stack([t[k] for t in told if k in t]).mean()) for k in names}
        found["cut"] = float(torch.stack(self.lost).mean()) if self.lost else 0.0
        return batch, found

    def _learn(self, window: Window) -> dict[str, Tensor]:
        """Improve the policy by the window's gradient, then the critics by its targets."""
        s = self.settings
        value = self.bootstrap(window.features[-1])
        loss = actor_loss(window, value, gamma=s.gamma, temperature=self.temperature)
        whole = loss + s.saturation * saturation_loss(self.policy, window) if s.saturation else loss
        self.optimizer.zero_grad()
        whole.backward()
        for p in self.policy.parameters():
            if p.grad is not None:
                p.grad.nan_to_num_(0.0, 0.0, 0.0)
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), s.clip_norm)
        self.optimizer.step()
        told = {"loss_actor": loss.detach(), "gradient_norm": norm.detach()}
        window = _detached(window)
        if self.soft:
            told |= self._heat(window)
        return told | {"loss_critic": self._teach(window)}

    def _heat(self, window: Window) -> dict[str, Tensor]:
        """Move the temperature so that the entropy becomes half of minus the number of an action's components.

        What is drawn in episodes that have failed leads nowhere, and is not of them.
        """
        drawn = window.log_prob[window.alive]
        if not len(drawn):
            return {"temperature": self.log_temperature.detach().exp()}
        wanted = -0.5 * self.policy.spec.actions
        entropy = -drawn.mean()
        loss = self.log_temperature.exp() * (entropy - wanted)
        self.heat_optimizer.zero_grad()
        loss.backward()
        self.heat_optimizer.step()
        return {"temperature": self.log_temperature.detach().exp(), "entropy": entropy}

    def _teach(self, window: Window) -> Tensor:
        """Teach the critics TD(lambda) returns; return the last loss."""
        s = self.settings
        with torch.no_grad():
            value = self.aims(window.features[1:])
            gain = window.reward - self.temperature * window.log_prob
            aim = td_lambda_targets(value, gain, window.terminal, gamma=s.gamma, lmbda=s.lmbda)
        use = window.alive
        features, aim = window.features[:-1][use], aim[use]
        if not len(aim):
            return aim.new_zeros(())
        losses = []
        for _ in range(s.critic_passes):
            for rows in torch.randperm(len(aim), device=aim.device).chunk(s.parts):
                loss = sum((c(features[rows]).squeeze(-1) - aim[rows]).square().mean() for c in self.critic)
                self.critic_optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self.critic.parameters(), s.clip_norm)
                self.critic_optimizer.step()
                losses.append(loss.detach())
        with torch.no_grad():
            keep = 0.0 if self.soft else s.polyak
            for p, q in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                p.lerp_(q, 1 - keep)
        return torch.stack(losses).mean()


class Sapo(Shac):
    """SHAC with entropy and two critics, whose mean the policy climbs and whose minimum they learn from."""

    critics = 2
    soft = True

    def bootstrap(self, features: Tensor) -> Tensor:
        """Return the mean of both."""
        return torch.stack([c(features).squeeze(-1) for c in self.target]).mean(0)

    def aims(self, features: Tensor) -> Tensor:
        """Return the smaller one of both."""
        return torch.stack([c(features).squeeze(-1) for c in self.target]).amin(0)


def _detached(window: Window) -> Window:
    names = ("features", "action", "log_prob", "reward", "failed", "begun", "success")
    return replace(window, **{name: getattr(window, name).detach() for name in names})


def _joined(windows: list[Window]) -> Batch:
    features = torch.cat([*(w.features[:-1] for w in windows), windows[-1].features[-1:]])
    names = ("action", "log_prob", "reward", "failed")
    kept = {name: torch.cat([getattr(w, name) for w in windows]) for name in names}
    return Batch(features, **kept, success=windows[-1].success & ~windows[-1].failed[-1])
