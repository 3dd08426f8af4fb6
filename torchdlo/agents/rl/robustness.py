"""How much success is left under disturbances: other friction, stiffness and starts, and noise on what is commanded.

Policies are compared with what they were made from: a trajectory that is replayed, its path that is followed in the
world, and the expert that was made robust. All see the same starts and the same noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.agents.rl.disturbances import Disturbance, disturbed_params
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.evaluate import UNSEEN, wilson_interval
from torchdlo.agents.rl.expert import Expert
from torchdlo.agents.rl.rollout import policy_features
from torchdlo.envs import PUBLISHED, Task, with_fidelity

__all__ = ["PERTURBATIONS", "Actor", "following", "perturbed", "policy_acting", "replaying", "table"]

Actor = Callable[[int, TaskEpisodes, Tensor, slice], Tensor]
"""Says what to do after so many actions in the episodes of a slice, in units of the greatest way of a tool (N, 3 R)."""


PERTURBATIONS = {
    "none": Disturbance(),
    "friction x 0.5": Disturbance(friction=0.5),
    "friction x 1.5": Disturbance(friction=1.5),
    "stiffness x 0.5": Disturbance(stiffness=0.5),
    "stiffness x 1.5": Disturbance(stiffness=1.5),
    "starts x 1.5": Disturbance(start=1.5),
    "noise 1 mm": Disturbance(noise=0.001),
    "noise 2 mm": Disturbance(noise=0.002),
    "noise 4 mm": Disturbance(noise=0.004),
}
"""What policies are tried under."""


def policy_acting(policy: Policy) -> Actor:
    """Return what a policy does, in the middle of what it could."""

    def act(done: int, episodes: TaskEpisodes, seen: Tensor, rows: slice) -> Tensor:
        return policy.mean(policy_features(policy, episodes, done, seen)[rows])

    return act


def following(expert: Expert) -> Actor:
    """Return what following a path in the world does."""

    def act(done: int, episodes: TaskEpisodes, seen: Tensor, rows: slice) -> Tensor:
        env = episodes.env
        return expert.act(done, env.moved[rows], env.world.tool.pos[rows].float(), episodes.task.max_translation)

    return act


def replaying(actions: Tensor) -> Actor:
    """Return what the actions (T, A) of a trajectory do, whatever happens."""

    def act(done: int, episodes: TaskEpisodes, seen: Tensor, rows: slice) -> Tensor:
        way = actions[done, : 3 * episodes.task.arms.count] / episodes.task.max_translation
        return way.float().expand(rows.stop - rows.start, -1)

    return act


@torch.no_grad()
def perturbed(
    actors: Mapping[str, Actor],
    task: Task,
    *,
    starts: int = 15,
    perturbations: Mapping[str, Disturbance] = PERTURBATIONS,
    seed: int = 0,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Return how often each actor succeeds under each perturbation, at the published fidelity, as plain data.

    Args:
        actors: by name.
        task: theirs.
        starts: episodes of each actor under each perturbation; no training has seen them.
        perturbations: by name.
        seed: of starts and noise, as in `evaluate`.
        callback: told (stage, actions done, all, message).
    """
    fine = with_fidelity(task, PUBLISHED)
    groups: dict[tuple[float, float], list[str]] = {}
    for name, p in perturbations.items():
        groups.setdefault((p.friction, p.stiffness), []).append(name)
    found: dict[str, dict[str, Any]] = {actor: {} for actor in actors}
    done = 0
    for names in groups.values():
        chosen = {name: perturbations[name] for name in names}

        def told(k: int, before: int = done, names: list[str] = names) -> None:
            if callback is not None:
                callback("perturb", before + k, len(groups) * fine.horizon, ", ".join(names))

        played = _played(actors, fine, starts, chosen, seed, told)
        for actor, rows in played.items():
            found[actor] |= rows
        done += fine.horizon
    return {
        "task": task.name,
        "fidelity": PUBLISHED.text,
        "starts": starts,
        "reset_seed": seed,
        "perturbations": {name: asdict(p) for name, p in perturbations.items()},
        "actors": {actor: {name: found[actor][name] for name in perturbations} for actor in actors},
    }


def _played(
    actors: Mapping[str, Actor],
    task: Task,
    starts: int,
    chosen: Mapping[str, Disturbance],
    seed: int,
    told: Callable[[int], None],
) -> dict[str, dict[str, Any]]:
    """Return how actors did under perturbations that share friction and stiffness, all in one batch."""
    each = starts * len(chosen)
    episodes = TaskEpisodes(task, each * len(actors), seed=UNSEEN + 1000 * seed)
    first = next(iter(chosen.values()))
    env = episodes.env
    env.episode = replace(env.episode, params=disturbed_params(env.episode.params, first, env.episode.scene, task))
    drawn = task.moved(starts, generator=torch.Generator().manual_seed(UNSEEN + 1000 * seed))
    moved = torch.cat([drawn * p.start for p in chosen.values()]).repeat(len(actors), 1, 1)
    seen = episodes.begin(moved)
    rng = torch.Generator().manual_seed(UNSEEN + 1000 * seed + 1)
    sizes = torch.tensor([p.noise for p in chosen.values()]).repeat_interleave(starts)[:, None] / task.max_translation
    step: Any = None
    for k in range(episodes.horizon):
        rows = [slice(n * each, (n + 1) * each) for n in range(len(actors))]
        ways = torch.stack([act(k, episodes, seen, r) for act, r in zip(actors.values(), rows, strict=True)])
        random = torch.randn(starts, ways.shape[-1], generator=rng).repeat(len(chosen), 1)
        commanded = task.max_translation * (ways + sizes * random).flatten(0, 1)
        step = episodes.step(torch.cat([commanded, torch.zeros_like(commanded)], -1))
        seen = torch.nan_to_num(step.observation)
        told(k + 1)
    good = (step.success & ~step.failed).reshape(len(actors), len(chosen), starts)
    returns, failed = (x.reshape(good.shape) for x in (episodes.returns, step.failed))
    return {
        actor: {name: _row(good[a, c], returns[a, c], failed[a, c]) for c, name in enumerate(chosen)}
        for a, actor in enumerate(actors)
    }


def _row(good: Tensor, returns: Tensor, failed: Tensor) -> dict[str, Any]:
    return {
        "success": float(good.float().mean()),
        "interval": list(wilson_interval(int(good.sum()), len(good))),
        "return": float(returns.mean()),
        "failed": float(failed.float().mean()),
    }


def table(results: Mapping[str, Any]) -> str:
    """Return results of `perturbed` as a table of Markdown: a row for each perturbation, a column for each actor."""
    actors = results["actors"]
    lines = [f"| perturbation | {' | '.join(actors)} |", "|---" * (1 + len(actors)) + "|"]
    for name in results["perturbations"]:
        shares = [f"{actors[actor][name]['success']:.0%}" for actor in actors]
        lines.append(f"| {name} | {' | '.join(shares)} |")
    return "\n".join(lines)
