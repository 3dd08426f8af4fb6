"""Polishing what a search found: the same way in less time, and straight on from some action to the end.

Searches move way-points a little at a time. What they find is often slower than tools can go, and ends where success
begins. Here the way up to some action is gone in less time, and from there on tools go straight and as fast as they
can, as the way itself goes there or along an axis of the world. The best by return less what is missing to success is
kept and polished again. Nothing has a gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.envs.core import episode
from torchdlo.envs.core.task import Task

__all__ = ["Polished", "hurried", "polish", "variants"]

_FASTEST = 0.6
"""Least share of the time that a way is gone in."""


@dataclass(frozen=True, eq=False)
class Polished:
    """What became of trajectories, best first found ones kept."""

    actions: Tensor
    """Shape (N, T, A) [m, degrees]."""
    returns: Tensor
    """Shape (N,)."""
    success: Tensor
    """Bool, shape (N,)."""
    episodes: int
    """Played in all."""


def hurried(way: Tensor, share: float) -> Tensor:
    """Return ways of tools (T, R, 3) of which all is gone in a share of the time; then tools stay."""
    horizon = len(way)
    places = torch.cat([torch.zeros_like(way[:1]), way.cumsum(0)])
    at = (torch.arange(horizon + 1, dtype=way.dtype) / share).clamp(max=horizon)
    low = at.long().clamp(max=horizon - 1)
    part = (at - low)[:, None, None]
    return ((1 - part) * places[low] + part * places[low + 1]).diff(dim=0)


def variants(way: Tensor, count: int, limit: float, rng: torch.Generator) -> Tensor:
    """Return as many ways (count, T, R, 3) like one (T, R, 3): the first is itself.

    Half of the others are hurried up to an action, and go on as before from there; half go straight on from an action,
    hurried up to it or not: up, along another axis of the world, or where tools go together then.
    """
    horizon, made = len(way), [way]
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(way)

    def draw() -> float:
        return float(torch.rand((), generator=rng))

    for k in range(1, count):
        at = round(horizon * (0.3 + 0.65 * draw()))
        share = 1.0 if k % 4 == 1 else _FASTEST + (1 - _FASTEST) * draw()
        first = hurried(way[:at], share)[: max(1, round(at * share))]
        if k % 2:
            kind = draw()
            ahead = axes[2] if kind < 0.5 else axes[int(6 * draw())]
            if kind > 0.75:
                mean = way[max(0, at - 5) : at + 5].mean((0, 1))
                ahead = mean / mean.norm().clamp(min=1e-9)
            rest = (limit * ahead).expand(horizon - len(first), *way.shape[1:])
        else:
            rest = torch.cat([way[at:], way[-1:].expand(horizon - len(first) - len(way[at:]), -1, -1)])
        made.append(torch.cat([first, rest]))
    return torch.stack(made)


@torch.no_grad()
def polish(
    task: Task,
    actions: Tensor,
    *,
    rounds: int = 3,
    count: int = 24,
    seed: int = 0,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> Polished:
    """Return trajectories that are polished, all of them in the same batches.

    Args:
        task: what they are of, in the fidelity in which to play.
        actions: shape (N, T, A) [m, degrees]; turns stay as they are.
        rounds: how often.
        count: variants of each trajectory in a round.
        seed: of the variants.
        callback: told (stage, rounds done, all, message).
    """
    ways = actions[..., : 3 * task.arms.count].unflatten(-1, (-1, 3))
    turns = actions[..., 3 * task.arms.count :]
    rng, number = torch.Generator().manual_seed(seed), len(actions)
    made = episode.prepare(task, number * count, execution=episode.quick_execution(task))
    returns, success = torch.zeros(number), torch.zeros(number, dtype=torch.bool)
    for k in range(rounds):
        tried = torch.stack([variants(way, count, task.max_translation, rng) for way in ways])
        given = torch.cat([tried.flatten(-2), turns[:, None].expand(-1, count, -1, -1)], -1)
        found = episode.play(task, given.flatten(0, 1), episode=made)
        value = torch.where(found.failed, -torch.inf, found.returns - found.terminal_cost).nan_to_num(-torch.inf)
        at = value.reshape(number, count).argmax(1)
        rows = torch.arange(number)
        ways = tried[rows, at]
        returns, success = (x.reshape(number, count)[rows, at] for x in (found.returns, found.success))
        if callback is not None:
            told = ", ".join(f"{r:.1f}{'' if s else ' (no success)'}" for r, s in zip(returns, success, strict=True))
            callback("polish", k + 1, rounds, told)
    return Polished(torch.cat([ways.flatten(-2), turns], -1), returns, success, rounds * number * count)
