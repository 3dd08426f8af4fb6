"""What policies see of an observation: places of points, relative to tools as well, and the share of the episode.

Velocities are left out, as sensors of a real cell do not have them. So are joint angles and orientations: tools hardly
turn. Where tools and free bodies were at the start is remembered: a rope that has moved does not tell any more where
it lay. All is a fixed linear map of the observation and some waves of the episode's share, so that gradients pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchdlo.envs import Task
from torchdlo.errors import InputError

__all__ = ["FeatureSpec", "Features", "task_features"]

_MOST = 30
"""Vertices that are seen at most."""
_FINEST = 1e-2
"""Spread below which a feature is not scaled up any more, in its own unit."""


@dataclass(frozen=True)
class FeatureSpec:
    """Which numbers of an observation are points, and how fine the episode's share is told."""

    size: int
    """Numbers of an observation."""
    points: tuple[int, ...] = ()
    """Where points of three numbers begin."""
    centers: tuple[tuple[float, float, float], ...] = ()
    """Where these points are in the usual start [m]."""
    tools: tuple[int, ...] = ()
    """Which of the points are tools."""
    memory: tuple[int, ...] = ()
    """Which of the points are remembered as they were at the start."""
    waves: int = 0
    """Sines and cosines of the episode's share, each twice as many as one more half turn; 0: no share at all."""

    @property
    def width(self) -> int:
        """How many features there are."""
        plain = 3 * (len(self.points) * (1 + len(self.tools)) + len(self.memory)) if self.points else self.size
        return plain + (1 + 2 * self.waves if self.waves else 0)

    @classmethod
    def of(cls, plain: dict[str, Any]) -> FeatureSpec:
        """Return the same from plain data."""
        return cls(
            plain["size"],
            tuple(plain["points"]),
            tuple(map(tuple, plain["centers"])),
            tuple(plain["tools"]),
            tuple(plain.get("memory", ())),
            plain["waves"],
        )


class Features(nn.Module):
    """Features (N, F) of observations (N, O) and shares of the episode that are over (N, 1)."""

    _at: Tensor
    _centers: Tensor
    _wave: Tensor

    def __init__(self, spec: FeatureSpec) -> None:
        """Make what `spec` says."""
        super().__init__()
        self.spec = spec
        self.register_buffer("_at", torch.tensor(spec.points, dtype=torch.long), persistent=False)
        self.register_buffer("_centers", torch.tensor(spec.centers).reshape(-1, 3), persistent=False)
        self.register_buffer("_wave", math.pi * torch.arange(1.0, spec.waves + 1), persistent=False)

    def _points(self, observation: Tensor) -> Tensor:
        index = (self._at[:, None] + torch.arange(3, device=observation.device)).flatten()
        return observation[..., index].unflatten(-1, (-1, 3))

    def _check(self, observation: Tensor) -> None:
        if observation.shape[-1] != self.spec.size:
            raise InputError(
                f"policy: it was made for observations of {self.spec.size} numbers, and these have "
                f"{observation.shape[-1]}; make the environment of the task that the policy names, with the ropes and "
                "bodies that it was trained with."
            )

    def forward(self, observation: Tensor, progress: Tensor, start: Tensor | None = None) -> Tensor:
        """Return features; `start` are observations at the start (N, O), where points of it are remembered.

        Raises:
            InputError: Observations have another size than those that this was made for.
        """
        self._check(observation)
        parts = [observation]
        if self.spec.points:
            points = self._points(observation)
            parts = [(points - self._centers).flatten(-2)]
            parts += [(points - points[..., k : k + 1, :]).flatten(-2) for k in self.spec.tools]
        if self.spec.memory:
            if start is None:
                raise ValueError("features: this policy remembers the start; give what was observed there, too")
            self._check(start)
            kept = list(self.spec.memory)
            remembered = (self._points(start)[..., kept, :] - self._centers[kept]).flatten(-2)
            if remembered.shape[:-1] != points.shape[:-2]:
                remembered = remembered.expand(*points.shape[:-2], -1)
            parts.append(remembered)
        if self.spec.waves:
            angle = progress * self._wave
            parts += [progress, angle.sin(), angle.cos()]
        return torch.cat(parts, -1)


class Normaliser(nn.Module):
    """Mean and spread of features, over all that it was shown."""

    count: Tensor
    mean: Tensor
    square: Tensor

    def __init__(self, width: int, *, finest: float = _FINEST) -> None:
        """Make one that changes nothing yet.

        Args:
            width: how many features.
            finest: least spread, so that what hardly varies is not blown up.
        """
        super().__init__()
        self.finest = finest
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(width, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(width, dtype=torch.float64))

    @torch.no_grad()
    def update(self, features: Tensor) -> None:
        """Take features (..., F) into account (Chan et al. 1979)."""
        x = features.detach().reshape(-1, features.shape[-1]).double()
        x = x[torch.isfinite(x).all(-1)]
        if not len(x):
            return
        total, shift = self.count + len(x), x.mean(0) - self.mean
        self.square += (x - x.mean(0)).square().sum(0) + shift.square() * (self.count * len(x) / total)
        self.mean += shift * (len(x) / total)
        self.count.copy_(total)

    def forward(self, features: Tensor) -> Tensor:
        """Return features scaled to mean 0 and spread 1, no further than 10 spreads from the mean."""
        if not bool(self.count > 1):
            return features
        spread = (self.square / self.count).sqrt().clamp(min=self.finest)
        return ((features - self.mean.to(features)) / spread.to(features)).clamp(-10, 10)


def task_features(task: Task, waves: int = 24, *, memory: bool = True) -> FeatureSpec:
    """Return what a policy for a task sees: rope, free bodies, the middle of matter and tools.

    Args:
        task: the task.
        waves: see `FeatureSpec`.
        memory: whether all but the rope is remembered as it was at the start.
    """
    from torchdlo.envs.core import episode

    made = episode.prepare(task, 1, execution="eager")
    world = made.start
    vertices = world.state.rods.pos.shape[-2]
    bodies = sum(body.motion == "free" for body in made.scene.bodies)
    counts = [vertices, vertices, bodies, bodies]
    counts += [1, 1] if world.state.material_points else [0, 0]
    begins = [3 * sum(counts[:k]) for k in range(len(counts) + 1)]
    step = -(-vertices // _MOST)
    points = list(range(begins[0], begins[1], 3 * step))
    points += range(begins[2], begins[3], 3)
    points += range(begins[4], begins[5], 3)
    tools = range(len(points), len(points) + task.arms.count)
    ropes = len(range(begins[0], begins[1], 3 * step))
    points += range(begins[6], begins[6] + 3 * task.arms.count, 3)
    seen = episode.observe(made, world)[0].tolist()
    centers = tuple((seen[k], seen[k + 1], seen[k + 2]) for k in points)
    kept = tuple(range(ropes, len(points))) if memory else ()
    return FeatureSpec(len(seen), tuple(points), centers, tuple(tools), kept, waves)
