"""Judging policies: from the one start and from starts that no training has seen, at the published fidelity."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.rollout import episode_progress
from torchdlo.envs import PUBLISHED, Task, with_fidelity
from torchdlo.envs.core import episode as episodes_of
from torchdlo.envs.observations.state import observe
from torchdlo.physics import tree
from torchdlo.physics.execution import Execution

__all__ = ["PROTOCOLS", "UNSEEN", "evaluate_policies", "judge_policies", "judged_episode", "wilson_interval"]

UNSEEN = 777_000_000
"""Seed of the starts of the judgement; trainers add less than this to theirs."""
PROTOCOLS: dict[str, dict[str, Any]] = {
    "one": {"variation": False},
    "varied": {"variation": True},
    "disturbed": {"variation": True, "noise": 0.002, "randomize": 0.2},
}
"""From the one start; from unseen starts; from unseen starts with other friction and damping, and noise on actions [m].
Numbers of effects are drawn from that share of their declared range."""
_RANDOM = ("rod_contact.mu_k", "table_friction.mu", "damping.rate")


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    z, p = 1.959964, successes / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return max(0.0, middle - half), min(1.0, middle + half)


@torch.no_grad()
def judge_policies(
    policies: Sequence[Policy],
    task: Task,
    *,
    starts: int = 15,
    protocols: Sequence[str] = ("one", "varied"),
    seed: int = 0,
    callback: Callable[[str, int, int, str], None] | None = None,
    execution: Execution | None = None,
) -> dict[str, dict[str, Any]]:
    """Return how policies do, all in one batch: by protocol what became of all episodes, (policies, starts, ...).

    With "actions", "moved" and "effects" of it, the numbers of effects where they were drawn, `judged_episode` makes an
    episode again.

    Policies take the middle of what they could do. From the one start, each has one episode: others would be the same.

    Args:
        policies: of one task.
        task: played at the published fidelity whatever it says.
        starts: how many episodes of each policy, the same starts for all.
        protocols: "disturbed" alone, or of the others.
        seed: of starts and noise.
        callback: told (stage, actions done, all, message).
        execution: see `TaskEpisodes`.
    """
    how = PROTOCOLS[protocols[-1]]
    fine = with_fidelity(task, PUBLISHED)
    many = starts if how["variation"] else 0
    one, drawn = int("one" in protocols), _randomized(fine, how.get("randomize", 0.0))
    episodes = TaskEpisodes(
        fine,
        len(policies) * (many + one),
        seed=UNSEEN + 1000 * seed,
        execution=execution,
        randomize=drawn,
    )
    rng = torch.Generator().manual_seed(UNSEEN + 1000 * seed + 1)
    seen = _shared(episodes, len(policies), many, one)
    actions: list[Tensor] = []
    step: Any = None
    for k in range(episodes.horizon):
        rows = zip(policies, seen.chunk(len(policies)), strict=True)
        share, first = episode_progress(episodes, k, seen)[: many + one], episodes.first[: many + one]
        stage_waypoints = torch.stack([p.mean(p.features(part, share, first)) for p, part in rows])
        if how.get("noise"):
            stage_waypoints = stage_waypoints + torch.randn(stage_waypoints.shape[1:], generator=rng) * (
                how["noise"] / task.max_translation
            )
        actions.append(policies[0].command(stage_waypoints.flatten(0, 1)))
        step = episodes.step(actions[-1])
        seen = torch.nan_to_num(step.observation)
        if callback is not None:
            callback("evaluate", k + 1, episodes.horizon, ", ".join(protocols))
    found = {
        "success": step.success & ~step.failed,
        "failed": step.failed,
        "returns": episodes.returns,
        "actions": torch.stack(actions, 1),
        "moved": episodes.env.moved,
        "effects": episodes.env.episode.params.effects if drawn else {},
    }
    parts = tree.map(lambda x: x.unflatten(0, (len(policies), many + one)), found)
    plays = {protocols[-1]: tree.map(lambda x: x[:, :many], parts)} if many else {}
    return plays | ({"one": tree.map(lambda x: x[:, many:], parts)} if one else {})


def judged_episode(
    task: Task, plays: dict[str, Any], number: int, *, execution: Execution = "recorded"
) -> tuple[episodes_of.Episode, Tensor]:
    """Return one of the episodes that were judged, in the scene that it had, and its actions (T, A).

    Args:
        task: the task.
        plays: of one protocol, see `judge_policies`.
        number: of the episode, policy after policy.
        execution: how its steps run.
    """

    def own(x: Tensor) -> Tensor:
        return x.flatten(0, 1)[number : number + 1]

    fine, moved = with_fidelity(task, PUBLISHED), own(plays["moved"])
    made = episodes_of.prepare_at(fine, moved, execution=execution)
    if plays["effects"]:
        # A scene settles with its own numbers.
        params = tree.replace(made.params, effects=tree.map(own, plays["effects"]))
        made = replace(made, params=params)
        made = replace(made, start=episodes_of.begin(made, episodes_of.laid_down(fine, moved)[2]))
    return made, own(plays["actions"])[0]


def _randomized(task: Task, share: float) -> dict[str, float] | None:
    """Return which numbers are drawn anew, of those that the task has."""
    if not share:
        return None
    scene = task.start(1)[0]
    known = {f"{e.name}.{number}" for e in scene.effects for number in e.params}
    return {name: share for name in _RANDOM if name in known}


def _shared(episodes: TaskEpisodes, policies: int, starts: int, one: int) -> Tensor:
    """Begin so that all policies have the same starts, and the one start at last; return what is seen."""
    episodes.reset()
    env = episodes.env
    usual = tree.map(torch.clone, env.episode.start)
    index = torch.arange(starts + one).clamp(max=max(0, starts - 1)).repeat(policies)
    last = (torch.arange(starts + one) >= starts).repeat(policies)
    env.world = tree.where(last, usual, tree.map(lambda x: x[index], env.world))
    env.moved = torch.where(last[:, None, None], 0.0, env.moved[index])
    count = env.batch_size[0]
    effects = tree.map(lambda x: x[index] if len(x) == count else x, env.episode.params.effects)
    env.episode = replace(env.episode, params=tree.replace(env.episode.params, effects=effects))
    episodes.first = observe(env.episode, env.world)
    return episodes.first


def evaluate_policies(
    policies: Sequence[Policy],
    task: Task,
    *,
    starts: int = 15,
    protocols: Sequence[str] = ("one", "varied"),
    seed: int = 0,
    callback: Callable[[str, int, int, str], None] | None = None,
    execution: Execution | None = None,
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return results as plain data, and what became of all episodes by protocol, see `judge_policies`.

    Args:
        policies: of one task, one for each seed of training; all are judged from the same starts.
        task: theirs.
        starts: episodes of each policy in each protocol.
        protocols: of `PROTOCOLS`.
        seed: of starts and noise; another one is for starts that no earlier judgement has seen.
        callback: told (stage, actions done, all, message).
        execution: see `TaskEpisodes`.
    """
    found: dict[str, Any] = {}
    plays: dict[str, dict[str, Any]] = {}
    calm = [name for name in ("one", "varied") if name in protocols]
    for names in (calm, ["disturbed"] if "disturbed" in protocols else []):
        if names:
            plays |= judge_policies(
                policies, task, starts=starts, protocols=names, seed=seed, callback=callback, execution=execution
            )
    for name, rows in plays.items():
        success, returns = rows["success"], rows["returns"]
        low, high = wilson_interval(int(success.sum()), success.numel())
        found[name] = {
            "episodes": success.numel(),
            "success": float(success.float().mean()),
            "interval": [low, high],
            "success_by_policy": success.float().mean(1).tolist(),
            "return": float(returns.mean()),
            "return_by_policy": returns.mean(1).tolist(),
            "failed": float(rows["failed"].float().mean()),
        }
    about = {"task": task.name, "fidelity": PUBLISHED.text, "starts": starts, "reset_seed": seed}
    return about | {"policies": len(policies)} | found, plays
