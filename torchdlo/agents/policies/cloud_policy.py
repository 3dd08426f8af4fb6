"""Policies that see rope and fixtures as points, as a depth camera reports them, and know where their tools are.

Each point goes through the same small network; the largest and the mean of what it says are what is known of the cloud
(PointNet: Qi et al. 2017, arXiv:1612.00593; Deep Sets: Zaheer et al. 2017, arXiv:1703.06114), whatever the order of its
points. Tools are known from joint angles, now and at the start, and so is the share of the episode that is over.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchdlo.agents.policies.policy import mlp

__all__ = ["CloudPolicy", "CloudSpec"]

_UNIT = 0.1
"""What becomes 1 in the network [m]."""


@dataclass(frozen=True)
class CloudSpec:
    """What a policy of clouds is, as plain data."""

    center: tuple[float, float, float]
    """What points and tools are relative to: the middle of the rope in the usual start [m]."""
    tools: tuple[tuple[float, float, float], ...]
    """Where tools are in the usual start [m]."""
    points: tuple[int, ...] = (64, 128)
    """Layers of the network of points."""
    hidden: tuple[int, ...] = (256, 128)
    """Layers of the network of all."""
    waves: int = 24
    """Sines and cosines of the episode's share."""
    task: str = ""
    reach: float = 0.01
    """Greatest way of a tool [m], one unit of an action."""
    fixtures: bool = False
    """Whether clouds have points of fixtures, and a fourth number that tells them from those of the rope."""

    @property
    def actions(self) -> int:
        """Numbers of an action: in units of the greatest way of a tool."""
        return 3 * len(self.tools)

    def plain(self) -> dict[str, Any]:
        """Return the same as plain data."""
        return asdict(self)

    @classmethod
    def of(cls, plain: dict[str, Any]) -> CloudSpec:
        """Return the same from plain data."""
        lists = {name: tuple(plain[name]) for name in ("center", "points", "hidden")}
        return cls(**(plain | lists | {"tools": tuple(map(tuple, plain["tools"]))}))


class CloudPolicy(nn.Module):
    """A policy of clouds; see `CloudSpec`."""

    _center: Tensor
    _tools: Tensor
    _wave: Tensor

    def __init__(self, spec: CloudSpec) -> None:
        """Make one with random weights of torch's generator."""
        super().__init__()
        self.spec = spec
        arms = len(spec.tools)
        sizes = (3 * (1 + arms) + spec.fixtures, *spec.points)
        layers = [(nn.Linear(a, b), nn.SiLU()) for a, b in itertools.pairwise(sizes)]
        self.point = nn.Sequential(*itertools.chain(*layers))
        width = 2 * sizes[-1] + 6 * arms + 1 + 2 * spec.waves
        self.all = mlp((width, *spec.hidden, spec.actions), "silu", last=0.01)
        self.register_buffer("_center", torch.tensor(spec.center), persistent=False)
        self.register_buffer("_tools", torch.tensor(spec.tools), persistent=False)
        self.register_buffer("_wave", math.pi * torch.arange(1.0, spec.waves + 1), persistent=False)

    def forward(self, cloud: Tensor, tool: Tensor, start: Tensor, progress: Tensor) -> Tensor:
        """Return actions, shape (N, A).

        Args:
            cloud: points [m], shape (N, P, 3); of policies that see fixtures (N, P, 4), the last number being 1 for
                points of these and 0 for those of the rope.
            tool: where tools are [m], shape (N, R, 3).
            start: where they were at the start [m], shape (N, R, 3).
            progress: share of the episode that is over, shape (N, 1).
        """
        at, kind = cloud[..., :3], cloud[..., 3:]
        relative = [at - self._center, *(at - tool[:, k : k + 1] for k in range(tool.shape[1]))]
        each = self.point(torch.cat([*(x / _UNIT for x in relative), kind], -1))
        known = [each.amax(1), each.mean(1)]
        known += [((x - self._tools) / _UNIT).flatten(1) for x in (tool, start)]
        angle = progress * self._wave
        return self.all(torch.cat([*known, progress, angle.sin(), angle.cos()], -1))

    def command(self, action: Tensor) -> Tensor:
        """Return the environment's action, shape (N, 2 A), of a policy's: no tool turns."""
        return torch.cat([self.spec.reach * action, torch.zeros_like(action)], -1)
