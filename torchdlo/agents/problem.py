"""What a trajectory optimiser needs to know of a task: its size, its limits, and how to play it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdlo.physics import numerics, tree

__all__ = ["Encoding", "Outcome", "Problem"]


@tree.struct
class Outcome:
    """How trajectories went, one entry per trajectory."""

    returns: Tensor
    """Sum of the rewards, to be maximised [-], shape (P,)."""
    loss: Tensor
    """What gradients are taken of, to be minimised [-], shape (P,)."""
    success: Tensor
    """Whether the task was done, bool [-], shape (P,)."""
    failed: Tensor
    """Whether the episode broke down, bool [-], shape (P,)."""


class Problem(Protocol):
    """A task for trajectory optimisation; `evaluate` is differentiable in the actions where these ask for it."""

    name: str
    horizon: int
    """Actions of an episode, T."""
    width: int
    """Numbers of an action, A: one group after the other."""
    group: int
    """Numbers of a group, e.g. 3 for how far a tool moves."""
    limit: float
    """Largest length of a group in one action [m]."""
    choices: dict[str, Any]
    """What else its results depend on, as plain data."""

    def evaluate(self, actions: Tensor) -> Outcome:
        """Play actions, shape (P, T, A), float64 on the CPU, one episode each."""
        ...

    def varied(self, copies: int, scale: float, seed: int) -> Problem:
        """Return the problem that plays each trajectory in `copies` perturbed worlds, and gives the means.

        Args:
            copies: perturbed worlds, the same for all trajectories.
            scale: size of the perturbations, 0 for none to 1 for all of it.
            seed: chooses them.
        """
        ...

    def record(self, actions: Tensor) -> tuple[Outcome, dict[str, Any]]:
        """Play one trajectory alone, shape (T, A).

        Returns:
            How it went, and what is to be kept of it besides its actions, as plain data.
        """
        ...


@dataclass(frozen=True)
class Encoding:
    """Trajectories as way-points: each is a displacement that is spread evenly over `hold` actions."""

    horizon: int
    width: int
    group: int
    limit: float
    hold: int

    @property
    def knots(self) -> int:
        """Number of way-points."""
        return -(-self.horizon // self.hold)

    @property
    def size(self) -> int:
        """Numbers of a trajectory."""
        return self.knots * self.width

    @property
    def reach(self) -> float:
        """Longest displacement of a way-point [m]."""
        return self.hold * self.limit

    def decode(self, points: Tensor) -> Tensor:
        """Return actions (P, T, A) within the limits from displacements [m], shape (P, size)."""
        moves = points.reshape(len(points), self.knots, self.width // self.group, self.group) / self.hold
        length = numerics.safe_norm(moves)
        moves = moves * (self.limit / length.clamp(min=self.limit))
        return moves.flatten(2).repeat_interleave(self.hold, 1)[:, : self.horizon]

    def project(self, points: Tensor) -> Tensor:
        """Return the points with displacements cut to what can be reached, shape (P, size)."""
        moves = points.reshape(len(points), self.knots, self.width // self.group, self.group)
        length = torch.linalg.vector_norm(moves, dim=-1, keepdim=True)
        return (moves * (self.reach / length.clamp(min=self.reach))).reshape(points.shape)
