"""Policies: features, their normaliser and a network that says how an action is distributed."""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchdlo.agents.policies.features import Features, FeatureSpec, Normaliser

__all__ = ["Policy", "PolicySpec", "mlp"]

_LEAST, _MOST = -5.0, 1.0
"""Bounds of the logarithm of a deviation."""


@dataclass(frozen=True)
class PolicySpec:
    """What a policy is, as plain data."""

    features: FeatureSpec
    actions: int
    """Numbers of an action: in units of the greatest way of a tool."""
    hidden: tuple[int, ...] = (256, 128, 64)
    """Sizes of the layers between."""
    activation: str = "tanh"
    """"tanh", "relu", "elu" or "silu"."""
    layer_norm: bool = False
    state_sigma: bool = False
    """Whether deviations depend on the features."""
    squash: bool = True
    """Whether actions are the hyperbolic tangent of what is drawn."""
    sigma: float = 0.3
    """Deviation at first."""
    task: str = ""
    """The task it acts in; "" for others."""
    reach: float = 1.0
    """Greatest way of a tool [m], one unit of an action; 1 where actions are not ways."""
    turns: int = 0
    """Numbers of an environment's action behind the ways, which are 0."""

    def plain(self) -> dict[str, Any]:
        """Return the same as plain data."""
        return asdict(self)

    @classmethod
    def of(cls, plain: dict[str, Any]) -> PolicySpec:
        """Return the same from plain data."""
        made = cls(**{**plain, "features": FeatureSpec.of(plain["features"])})
        return replace(made, hidden=tuple(made.hidden))


def mlp(
    sizes: tuple[int, ...], activation: str = "tanh", *, layer_norm: bool = False, last: float = 1.0
) -> nn.Sequential:
    """Return a perceptron with orthogonal weights; those of the last layer are scaled by `last`."""
    kinds = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}
    layers: list[nn.Module] = []
    for k, (a, b) in enumerate(itertools.pairwise(sizes)):
        linear, ends = nn.Linear(a, b), k == len(sizes) - 2
        nn.init.orthogonal_(linear.weight, last if ends else math.sqrt(2))
        nn.init.zeros_(linear.bias)
        layers.append(linear)
        if not ends:
            layers += [nn.LayerNorm(b)] * layer_norm + [kinds[activation]()]
    return nn.Sequential(*layers)


class Policy(nn.Module):
    """A policy. It acts on observations and the share of the episode that is over; see `PolicySpec`."""

    normaliser: Normaliser
    features: Features

    def __init__(self, spec: PolicySpec) -> None:
        """Make one with random weights of torch's generator."""
        super().__init__()
        self.spec = spec
        self.features, self.normaliser = Features(spec.features), Normaliser(spec.features.width)
        outputs = spec.actions * (2 if spec.state_sigma else 1)
        sizes = (spec.features.width, *spec.hidden, outputs)
        self.net = mlp(sizes, spec.activation, layer_norm=spec.layer_norm, last=0.01)
        if spec.state_sigma:
            with torch.no_grad():
                self.net[-1].get_parameter("bias")[spec.actions :] = math.log(spec.sigma)
        else:
            self.log_sigma = nn.Parameter(torch.full((spec.actions,), math.log(spec.sigma)))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and deviation of actions before they are squashed, shape (..., A) each."""
        out = self.net(self.normaliser(features))
        if self.spec.state_sigma:
            loc, log_sigma = out.chunk(2, -1)
        else:
            loc, log_sigma = out, self.log_sigma.expand_as(out)
        return loc, log_sigma.clamp(_LEAST, _MOST).exp()

    def mean(self, features: Tensor) -> Tensor:
        """Return the action in the middle of what it draws, shape (..., A)."""
        loc, _ = self(features)
        return loc.tanh() if self.spec.squash else loc

    def draw(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return random actions, with gradients, and the logarithm of their density, shapes (..., A) and (...)."""
        loc, sigma = self(features)
        noise = torch.randn_like(loc)
        raw = loc + sigma * noise
        density = (-0.5 * noise.square() - sigma.log() - 0.5 * math.log(2 * math.pi)).sum(-1)
        if not self.spec.squash:
            return raw, density
        # log(1 - tanh^2) without loss of digits (Haarnoja et al. 2018).
        squashed = 2 * (math.log(2) - raw - nn.functional.softplus(-2 * raw))
        return raw.tanh(), density - squashed.sum(-1)

    def command(self, action: Tensor, *, scaled: bool = False) -> Tensor:
        """Return the environment's action, shape (..., A + turns), of a policy's.

        Args:
            action: in units of the greatest way of a tool, shape (..., A).
            scaled: whether the environment's actions are from -1 to 1 (`scaled_actions`), and not in metres.
        """
        return nn.functional.pad(action if scaled else self.spec.reach * action, (0, self.spec.turns))

    @torch.no_grad()
    def act(
        self,
        observation: Tensor,
        progress: Tensor,
        start: Tensor | None = None,
        *,
        random: bool = False,
        scaled: bool = False,
    ) -> Tensor:
        """Return the environment's actions for observations (N, O), now and at the start, and shares of the episode.

        Args:
            observation: now, shape (N, O).
            progress: share of the episode that is over, shape (N, 1).
            start: what was observed at the start, shape (N, O).
            random: whether to draw them, and not to take the middle.
            scaled: see `command`.
        """
        features = self.features(observation, progress, start)
        return self.command(self.draw(features)[0] if random else self.mean(features), scaled=scaled)
