"""Judging policies: from the one start and from starts that no training has seen, at the published fidelity."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.rollout import progress
from torchdlo.envs import PUBLISHED, Task, simulated

__all__ = ["PROTOCOLS", "evaluate", "judged", "wilson"]

_UNSEEN = 777_000_000
"""Seed of the starts of the judgement; trainers add less than this to theirs."""
PROTOCOLS = {
    "one": {"variation": False},
    "varied": {"variation": True},
    "disturbed": {"variation": True, "noise": 0.002, "randomize": 0.2},
}
"""From the one start; from unseen starts; from unseen starts with other friction and damping, and noise on actions [m].
Numbers of effects are drawn from that share of their declared range."""
_RANDOM = ("rod_contact.mu_k", "table_friction.mu", "damping.rate")


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    z, p = 1.959964, successes / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)


@torch.no_grad()
def judged(
    policy: Policy,
    task: Task,
    *,
    starts: int = 15,
    protocol: str = "varied",
    seed: int = 0,
    callback: Callable[[str, int, int, str], None] | None = None,
    compiled: bool = False,
) -> dict[str, Any]:
    """Return how a policy does: success, failure and return of every episode, and its actions.

    Args:
        policy: it takes the middle of what it could do.
        task: played at the published fidelity whatever it says.
        starts: how many episodes.
        protocol: of `PROTOCOLS`.
        seed: of starts and noise.
        callback: told (stage, actions done, all, message).
        compiled: whether steps are compiled.
    """
    how = PROTOCOLS[protocol]
    fine = simulated(task, PUBLISHED)
    share = how.get("randomize", 0.0)
    randomize = None
    if share:
        scene = fine.start(1)[0]
        known = {f"{e.name}.{number}" for e in scene.effects for number in e.params}
        randomize = {name: share for name in _RANDOM if name in known}
    episodes = TaskEpisodes(
        fine, starts, seed=_UNSEEN + seed, variation=how["variation"], compiled=compiled, randomize=randomize
    )
    rng = torch.Generator().manual_seed(_UNSEEN + seed + 1)
    seen = episodes.reset()
    actions: list[Tensor] = []
    step: Any = None
    for k in range(episodes.horizon):
        action = policy.mean(policy.features(seen, progress(episodes, k, seen)))
        if how.get("noise"):
            action = action + torch.randn(action.shape, generator=rng) * (how["noise"] / policy.spec.reach)
        command = policy.command(action)
        actions.append(command)
        step = episodes.step(command)
        seen = torch.nan_to_num(step.observation)
        if callback is not None:
            callback("evaluate", k + 1, episodes.horizon, protocol)
    return {
        "success": step.success & ~step.failed,
        "failed": step.failed,
        "returns": episodes.returns,
        "actions": torch.stack(actions, 1),
        "moved": episodes.env.moved,
    }


def evaluate(
    policies: Sequence[Policy],
    task: Task,
    *,
    starts: int = 15,
    protocols: Sequence[str] = ("one", "varied"),
    callback: Callable[[str, int, int, str], None] | None = None,
    compiled: bool = False,
) -> tuple[dict[str, Any], dict[str, list[dict[str, Any]]]]:
    """Return results as plain data, and all episodes by protocol and policy.

    Args:
        policies: of one task, one for each seed of training; all are judged from the same starts.
        task: theirs.
        starts: episodes of each policy in each protocol.
        protocols: of `PROTOCOLS`.
        callback: told (stage, actions done, all, message).
        compiled: whether steps are compiled.
    """
    found: dict[str, Any] = {}
    plays: dict[str, list[dict[str, Any]]] = {}
    for name in protocols:
        rows = [judged(p, task, starts=starts, protocol=name, callback=callback, compiled=compiled) for p in policies]
        plays[name] = rows
        success = torch.stack([r["success"] for r in rows])
        low, high = wilson(int(success.sum()), success.numel())
        found[name] = {
            "episodes": success.numel(),
            "success": float(success.float().mean()),
            "interval": [low, high],
            "success_by_policy": success.float().mean(1).tolist(),
            "return": float(torch.stack([r["returns"] for r in rows]).mean()),
            "return_by_policy": [float(r["returns"].mean()) for r in rows],
            "failed": float(torch.stack([r["failed"] for r in rows]).float().mean()),
        }
    return {"task": task.name, "fidelity": PUBLISHED.text, "starts": starts, "policies": len(policies)} | found, plays
