"""Stages of tasks with re-grasps: which hand holds what, from which action on.

The schedule belongs to the task, so that actions are as wide as without stages. Before a stage begins, hands that are
to hold something else open and travel there by themselves, in a number of whole actions: over the rope, to where their
next vertex is at that time. Their actions count for nothing meanwhile. A hand closes if it has got there.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.coupling.common.pose import Pose
from torchdlo.errors import InputError
from torchdlo.physics.linalg.numerics import safe_norm

__all__ = ["Schedule", "Stage", "repeated"]

ARCH = 0.1
"""Height by which a hand on its way passes above the straight line [m]."""
NEAR = 0.01
"""Distance of a tool from a vertex at which its hand can close on it [m]: the radius of the ropes of tasks."""


@dataclass(frozen=True)
class Stage:
    """What hands hold from an action on, until the next stage."""

    first: int
    """Action with which it begins, counted from 0."""
    vertex: tuple[int | None, ...]
    """What each hand holds, slots on the vertex axis of the scene; None: it is open and follows its actions."""


def _travels(now: Stage, after: Stage) -> list[bool]:
    """Return which hands are to hold something else in the next stage."""
    return [b not in (None, a) for a, b in zip(now.vertex, after.vertex, strict=True)]


def repeated(tools: Pose, count: int) -> Pose:
    """Return poses (..., R, C) of arms for each of the `count` grips that a hand has room for, (..., R count, C)."""
    if count == 1:
        return tools
    return Pose(tools.pos.repeat_interleave(count, -2), tools.quat.repeat_interleave(count, -2))


@dataclass(frozen=True)
class Schedule:
    """The stages of a task. What a hand ever holds are its grips; all hands have room for equally many."""

    stages: tuple[Stage, ...]
    travel: int
    """Actions that hands take to what they hold next."""

    def __post_init__(self) -> None:
        if len({len(s.vertex) for s in self.stages}) > 1:
            hands = [len(s.vertex) for s in self.stages]
            raise InputError(f"stages: they say what {hands} hands hold; name one vertex for each arm.")
        if self.stages[0].first != 0 or self.travel < 1:
            raise InputError(
                f"stages: the first begins with action {self.stages[0].first}, and hands travel for {self.travel} "
                f"actions; expected 0, and 1 or more."
            )
        for now, after in itertools.pairwise(self.stages):
            least = self.travel if any(_travels(now, after)) else 1
            if after.first - now.first < least:
                raise InputError(
                    f"stages: one begins with action {now.first} and the next with {after.first}; the next has to "
                    f"begin {least} actions later or more, as hands travel for {self.travel}."
                )
        twice = sorted({v for v in self.held if self.held.count(v) > 1})
        if twice:
            raise InputError(f"stages: vertices {twice} are held by several hands; give each hand vertices of its own.")

    @functools.cached_property
    def grips(self) -> tuple[tuple[int, ...], ...]:
        """What each hand ever holds."""
        columns = zip(*(s.vertex for s in self.stages), strict=True)
        return tuple(tuple(dict.fromkeys(v for v in column if v is not None)) for column in columns)

    @property
    def room(self) -> int:
        """Grips that each hand has room for."""
        return max(1, *map(len, self.grips))

    @property
    def held(self) -> tuple[int, ...]:
        """All that is ever held, hand by hand."""
        return tuple(v for grips in self.grips for v in grips)

    @property
    def tools(self) -> tuple[int, ...]:
        """Which grip each of `held` is, counted over all hands."""
        return tuple(self.room * r + k for r, grips in enumerate(self.grips) for k in range(len(grips)))

    def actions(self, horizon: int) -> list[int]:
        """Return how many of a number of actions each stage has."""
        ends = [*(s.first for s in self.stages[1:]), horizon]
        return [end - s.first for s, end in zip(self.stages, ends, strict=True)]

    @functools.cached_property
    def _rows(self) -> tuple[list[list[float]], list[list[float]], list[list[int]]]:
        """Per action until the last stage: which grips are closed, travelling actions left, and vertices to go to."""
        closed, left, goal = [], [], []
        for k in range(self.stages[-1].first + 1):
            last = max(i for i, s in enumerate(self.stages) if s.first <= k)
            now, after = self.stages[last], self.stages[min(last + 1, len(self.stages) - 1)]
            wait = after.first - k
            goes = [away and wait <= self.travel for away in _travels(now, after)]
            holds = [None if away else v for v, away in zip(now.vertex, goes, strict=True)]
            room = [[*grips, *[-1] * (self.room - len(grips))] for grips in self.grips]
            closed.append([float(v == h) for h, grips in zip(holds, room, strict=True) for v in grips])
            left.append([float(wait * away) for away in goes])
            goal.append([v or 0 for v in after.vertex])
        return closed, left, goal

    def _at(self, rows: list, count: Tensor, like: Tensor) -> Tensor:
        """Return a table's rows for the actions that scenes are at, shape (B, n, 1)."""
        table = torch.tensor(rows, device=like.device)
        found = table[count.clamp(max=len(rows) - 1)].unsqueeze(-1)
        return found.to(like.dtype) if found.is_floating_point() else found

    def closed(self, count: Tensor, tools: Pose, x: Tensor, last: Tensor | None = None) -> Tensor:
        """Return how firmly grips hold in an action, shape (B, R room, 1).

        A grip that closes with the action does so if its tool is within `NEAR` of the vertex; one that has been
        closed holds on unless it was lost.

        Args:
            count: actions done, shape (B,).
            tools: where the tools are, shapes (B, R, .).
            x: all vertices [m], shape (B, V, 3).
            last: how firmly they held before; None at the start.
        """
        wanted = self._at(self._rows[0], count, x)
        if last is None:
            return wanted
        before = self._at(self._rows[0], (count - 1).clamp(min=0), x)
        place = [grips[min(k, len(grips) - 1)] if grips else 0 for grips in self.grips for k in range(self.room)]
        off = safe_norm(repeated(tools, self.room).pos - x[:, place])
        there = (off <= NEAR).to(x.dtype)
        return wanted * torch.where(before > 0, last, there)

    def steer(self, count: Tensor, now: Pose, target: Pose, x: Tensor) -> Pose:
        """Return the targets of the tools, with those of hands on their way in place of what actions ask for.

        Hands do not turn on their way.

        Args:
            count: actions done, shape (B,).
            now: targets until now, shapes (B, R, 3) and (B, R, 4).
            target: what the action asks for, in the same shapes.
            x: all vertices [m], shape (B, V, 3).
        """
        _, rows, vertices = self._rows
        left = self._at(rows, count, x)
        goal = torch.take_along_dim(x, self._at(vertices, count, x), -2)
        up = x.new_tensor([0.0, 0.0, ARCH])

        def rise(left: Tensor) -> Tensor:
            share = left / self.travel
            return 4 * share * (1 - share) * up

        line = now.pos - rise(left)
        there = line + (goal - line) / left.clamp(min=1) + rise(left - 1)
        pos, quat = torch.where(left > 0, there, target.pos), torch.where(left > 0, now.quat, target.quat)
        return Pose(pos, quat)
