"""What a trajectory optimiser needs to know of a task: its size, its limits, and how to play it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.linalg import numerics

__all__ = ["Encoding", "Evaluation", "Problem"]


@tree.struct
class Evaluation:
    """How trajectories went, one entry per trajectory."""

    returns: Tensor
    """Sum of the rewards, to be maximised [-], shape (P,)."""
    loss: Tensor
    """What gradients are taken of, to be minimised [-], shape (P,)."""
    terminal_cost: Tensor
    """How far the ends are from what counts as success, in the units of the return [-], shape (P,)."""
    success: Tensor
    """Whether the task was done, bool [-], shape (P,)."""
    failed: Tensor
    """Whether the episode broke down, bool [-], shape (P,)."""


class Playable(Protocol):
    """What plays actions."""

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Play actions, shape (P, T, A), float64 on the CPU, one episode each."""
        ...


class Problem(Playable, Protocol):
    """A task for trajectory optimisation; `evaluate` is differentiable in the actions where these ask for it."""

    @property
    def name(self) -> str: ...

    @property
    def horizon(self) -> int:
        """Actions of an episode, T."""
        ...

    @property
    def width(self) -> int:
        """Numbers of an action, A: one group after the other."""
        ...

    @property
    def group(self) -> int:
        """Numbers of a group, e.g. 3 for how far a tool moves."""
        ...

    @property
    def limit(self) -> float:
        """Largest length of a group in one action [m]."""
        ...

    @property
    def touch(self) -> tuple[tuple[float, float, float], ...]:
        """Where bodies are, from the middle of all tools at the start [m]; () if there are none, or groups are no
        ways."""
        ...

    @property
    def tools(self) -> tuple[tuple[float, float, float], ...]:
        """Where tools are at the start, from the middle of them all [m]; () if groups are no ways."""
        ...

    @property
    def choices(self) -> dict[str, Any]:
        """What else its results depend on, as plain data."""
        ...

    def surrogate(self) -> Problem | None:
        """Return a problem of the same size that is much like this one and quicker to play, if there is one."""
        ...

    def varied(self, copies: int, scale: float, seed: int) -> Playable:
        """Return the problem that plays each trajectory in `copies` perturbed worlds, and gives the means.

        Args:
            copies: perturbed worlds, the same for all trajectories.
            scale: size of the perturbations, 0 for none to 1 for all of it.
            seed: chooses them.
        """
        ...

    def record(self, actions: Tensor) -> tuple[Evaluation, dict[str, Any]]:
        """Play one trajectory alone, shape (T, A).

        Returns:
            How it went, and what is to be kept of it besides its actions, as plain data.
        """
        ...


_WITHIN = 1 - 1e-6
"""Share of the limit that projected ways reach: a way of just the limit, cut by rounding, has no gradient along
itself."""


@dataclass(frozen=True)
class Encoding:
    """Trajectories as way-points: each is a displacement that is spread evenly over `hold` actions."""

    horizon: int
    width: int
    group: int
    limit: float
    hold: int
    apart: float | None = None
    """If given, the numbers of a way-point are the mean displacement of all groups, then how far each but the first is
    from it, over `apart`; else those of each group."""

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
        """Return actions (P, T, A) within the limits from the numbers of points, shape (P, size)."""
        moves = self._moves(points) / self.hold
        length = numerics.safe_norm(moves)
        moves = moves * (self.limit / length.clamp(min=self.limit))
        return moves.flatten(2).repeat_interleave(self.hold, 1)[:, : self.horizon]

    def encode(self, moves: Tensor) -> Tensor:
        """Return the points (P, size) of displacements [m], shape (P, knots, A / group, group)."""
        if self.apart is not None:
            mean = moves.mean(-2, keepdim=True)
            moves = torch.cat([mean, (moves[..., 1:, :] - mean) / self.apart], -2)
        return moves.flatten(1)

    def project(self, points: Tensor) -> Tensor:
        """Return the points with displacements cut to what can be reached, shape (P, size)."""
        moves, most = self._moves(points), _WITHIN * self.reach
        length = torch.linalg.vector_norm(moves, dim=-1, keepdim=True)
        return self.encode(moves * (most / length.clamp(min=most)))

    def inward(self, points: Tensor, stage_waypoints: Tensor) -> Tensor:
        """Return ways from points without what leads out of what can be reached, (P, size): projection undoes that."""
        moves, ahead = self._moves(points), self._moves(stage_waypoints)
        length = torch.linalg.vector_norm(moves, dim=-1, keepdim=True)
        out = moves / length.clamp(min=1e-300)
        beyond = (ahead * out).sum(-1, keepdim=True).clamp(min=0)
        ends = length > _WITHIN**2 * self.reach
        return self.encode(torch.where(ends, ahead - beyond * out, ahead))

    def pull(self, points: Tensor, gradient: Tensor) -> Tensor:
        """Return gradients by the numbers of points from gradients by their actions, shape (P, T A)."""
        x = points.detach().requires_grad_()
        return torch.autograd.grad(self.decode(x).flatten(1), x, gradient)[0]

    def _moves(self, points: Tensor) -> Tensor:
        """Return displacements [m], shape (P, knots, A / group, group)."""
        x = points.reshape(len(points), self.knots, self.width // self.group, self.group)
        if self.apart is None:
            return x
        own = self.apart * x[..., 1:, :]
        return x[..., :1, :] + torch.cat([-own.sum(-2, keepdim=True), own], -2)
