"""Policies out of trajectories: a path that is robust, a clone of who follows it, and careful training from there.

1. `robust`: trajectories that were found from the one start become paths that are followed in the world, see `expert`.
2. `clone`: a policy learns what a follower does, from what it sees itself, first in cheap steps, at last as published.
3. `tune`: PPO goes on from the clone in published steps, near to it, and gives back what made it worse.

Each stage leaves a file and begins with those of the stages before it. All that is judged on the way is judged from
validation starts; those of `evaluate` are never played here.
"""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchdlo.agents.policies import Policy, PolicySpec, load, save, task_features
from torchdlo.agents.rl.clone import Labels, fit, labelled
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.expert import Expert, candidates, improve, load_expert, save_expert
from torchdlo.agents.rl.ppo import Ppo
from torchdlo.agents.rl.rollout import collect
from torchdlo.agents.rl.settings import Settings
from torchdlo.envs import PUBLISHED, Task, simulated
from torchdlo.errors import InputError
from torchdlo.files import write_atomically

__all__ = ["STAGES", "Hybrid", "hybrid", "task_policy"]

Callback = Callable[[str, int, int, str], None]
STAGES = ("robust", "clone", "tune")
"""Names of the stages in their order."""
_VALIDATION = 1_000_003
"""Added to seeds for validation starts."""


@dataclass(frozen=True)
class Hybrid:
    """How to make a policy out of trajectories."""

    generations: int = 12
    """Of the search for a robust path, at most; 0 takes the best of the given ones."""
    population: int = 12
    starts: int = 16
    rounds: int = 3
    """Rounds of DAgger after the first, in cheap steps."""
    count: int = 64
    """Episodes of a round."""
    noise: float = 0.001
    """Deviation of what is added to actions while labels are collected [m]."""
    updates: int = 3000
    """Steps of learning after each round."""
    final: int = 2
    """Rounds at the published fidelity."""
    validation: int = 64
    """Starts from which policies are compared."""
    enough: float = 0.985
    """Share of successes on validation starts from which there is nothing to tune."""
    tune_episodes: int = 1280
    """Budget of the last stage."""


def task_policy(task: Task, settings: Settings, **choices: Any) -> Policy:
    """Return a new policy for a task; `choices` are fields of `PolicySpec`."""
    arms = task.arms.count
    spec = PolicySpec(
        task_features(task),
        3 * arms,
        hidden=settings.hidden,
        activation=settings.activation,
        layer_norm=settings.layer_norm,
        sigma=settings.sigma,
        task=task.name,
        reach=task.reach,
        turns=3 * arms,
    )
    return Policy(replace(spec, **choices))


def hybrid(
    task: Task,
    trajectories: Sequence[Path],
    settings: Settings,
    *,
    folder: Path,
    plan: Hybrid | None = None,
    stages: Sequence[str] = STAGES,
    expert: Path | None = None,
    resume: bool = False,
    callback: Callback | None = None,
) -> tuple[Policy, dict[str, Any]]:
    """Return a policy and what each stage came to; a stage whose files are there is not run again if `resume`.

    Args:
        task: in the published fidelity.
        trajectories: files of `torchdlo optimize`.
        settings: seed, sizes and settings of PPO.
        folder: gets expert.json, clone.pt, policy.pt and stages.json.
        plan: sizes of the stages.
        stages: which of `STAGES` to run; those left out are skipped, or taken from the files of an earlier run.
        expert: a file of an earlier first stage to begin with.
        resume: go on from what is there.
        callback: told (stage, done, all, message).
    """
    other = sorted(set(stages) - set(STAGES))
    if other:
        raise InputError(f"stages: there is no {', '.join(other)}; expected some of {', '.join(STAGES)}.")
    plan, told = plan or Hybrid(), callback or (lambda *_: None)
    notes: dict[str, Any] = _notes(folder) if resume else {}
    notes |= {"plan": asdict(plan), "settings": asdict(settings), "coarse": task.coarse.plain()}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        chosen = _robust(task, trajectories, settings, plan, folder, stages, expert, resume, notes, told)
        policy = _clone(task, chosen, settings, plan, folder, stages, resume, notes, told)
        if "tune" in stages:
            policy = _tune(task, policy, settings, plan, folder, notes, told)
    _finish(policy, folder, notes)
    return policy, notes


def _notes(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / "stages.json").read_text(encoding="utf-8"))
    except OSError:
        return {}


def _finish(policy: Policy, folder: Path, notes: dict[str, Any]) -> None:
    write_atomically(folder / "stages.json", json.dumps({"generator": "torchdlo train", **notes}, indent=1) + "\n")
    save(policy, folder / "policy.pt", {"algorithm": "hybrid", "episodes": _episodes(notes)})


def _episodes(notes: dict[str, Any]) -> int:
    return sum(notes[name]["episodes"] for name in STAGES if name in notes)


def _robust(
    task: Task,
    trajectories: Sequence[Path],
    settings: Settings,
    plan: Hybrid,
    folder: Path,
    stages: Sequence[str],
    given: Path | None,
    resume: bool,
    notes: dict[str, Any],
    told: Callback,
) -> Expert | None:
    file = given or folder / "expert.json"
    if (given is not None or resume) and file.is_file():
        return load_expert(file, task)
    if "robust" not in stages and (folder / "clone.pt").is_file():
        return None
    began = time.process_time()
    generations = plan.generations if "robust" in stages else 0
    found, log, played = improve(
        simulated(task, task.coarse),
        candidates(task, list(trajectories)),
        seed=settings.seed,
        starts=plan.starts,
        population=plan.population,
        generations=generations,
        callback=told,
    )
    notes["robust"] = {"episodes": played, "cpu_seconds": round(time.process_time() - began, 1), "log": log}
    save_expert(found, folder / "expert.json", task, {"episodes": played, "log": log})
    return found


def _clone(
    task: Task,
    expert: Expert | None,
    settings: Settings,
    plan: Hybrid,
    folder: Path,
    stages: Sequence[str],
    resume: bool,
    notes: dict[str, Any],
    told: Callback,
) -> Policy:
    file = folder / "clone.pt"
    if file.is_file() and (resume or "clone" not in stages):
        return load(file)
    policy = task_policy(task, settings, squash=False)
    if "clone" not in stages:
        return policy
    if expert is None:
        raise InputError(f"{folder / 'expert.json'}: there is no expert to clone; run the stage robust first.")
    began, labels, rng = time.process_time(), Labels(), torch.Generator().manual_seed(settings.seed)
    coarse = TaskEpisodes(simulated(task, task.coarse), plan.count, seed=settings.seed + 11)
    rounds = [(coarse, k == 0) for k in range(1 + plan.rounds)]
    fine = None
    if plan.final:
        fine = TaskEpisodes(simulated(task, PUBLISHED), plan.count, seed=settings.seed + 12)
        rounds += [(fine, False)] * plan.final
    log, played = [], 0
    for k, (episodes, driven) in enumerate(rounds):
        success, failed = labelled(labels, policy, expert, episodes, driven=driven, noise=plan.noise, generator=rng)
        played += episodes.count
        error = fit(policy, labels, updates=plan.updates)
        log.append({"round": k, "fine": episodes is fine, "success": success, "failed": failed, "error": error})
        told("clone", k + 1, len(rounds), f"success {success:.0%} in the round, error {error:.2g}")
    notes["clone"] = {"episodes": played, "cpu_seconds": round(time.process_time() - began, 1), "log": log}
    save(policy, file, {"stage": "clone", "log": log})
    return policy


def _tune(
    task: Task,
    policy: Policy,
    settings: Settings,
    plan: Hybrid,
    folder: Path,
    notes: dict[str, Any],
    told: Callback,
) -> Policy:
    began = time.process_time()
    fine = simulated(task, PUBLISHED)
    judge = TaskEpisodes(fine, plan.validation, seed=settings.seed + _VALIDATION)
    start = judge.generator.get_state()

    def success(policy: Policy) -> tuple[float, float]:
        judge.generator.set_state(start)
        found = collect(policy, judge, random=False)
        return float(found.success.float().mean()), float(judge.returns.mean())

    mark = success(policy)
    best, log, played = copy.deepcopy(policy), [{"episodes": 0, "success": mark[0], "return": mark[1]}], judge.count
    told("tune", 0, plan.tune_episodes, f"success {mark[0]:.0%} before")
    if mark[0] < plan.enough and plan.tune_episodes >= settings.count:
        scale = 10.0 / max(1e-6, abs(mark[1]))
        episodes = TaskEpisodes(fine, settings.count, seed=settings.seed + 13, scale=scale, bonus=settings.bonus)
        with torch.no_grad():
            policy.log_sigma.fill_(math.log(settings.sigma))
        ppo = Ppo(policy, settings, fixed=True)
        done = 0
        while done + settings.count <= plan.tune_episodes and mark[0] < plan.enough:
            batch = collect(policy, episodes)
            ppo.learn(batch, freeze=done == 0)
            done += settings.count
            if done == settings.count:
                continue
            now = success(policy)
            played += judge.count
            share = float(batch.success.float().mean())
            log.append({"episodes": done, "success": now[0], "return": now[1], "noisy": share})
            told("tune", done, plan.tune_episodes, f"success {now[0]:.0%}, with noise {share:.0%}, best {mark[0]:.0%}")
            if now > mark:
                mark, best = now, copy.deepcopy(policy)
            elif now[0] < mark[0] - 0.15:
                policy.load_state_dict(best.state_dict())
        played += done
    notes["tune"] = {"episodes": played, "cpu_seconds": round(time.process_time() - began, 1), "log": log}
    return best
