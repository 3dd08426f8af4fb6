"""Policies out of trajectories: a path that is robust, a clone of who follows it, and careful training from there.

1. `robust`: trajectories that were found from the one start become paths that are followed in the world, see `expert`.
2. `clone`: a policy learns what a follower does, from what it sees itself, first in cheap steps, at last as published.
3. `tune`: PPO goes on from the clone in published steps, near to it, and gives back what made it worse.

Each stage leaves a file and begins with those of the stages before it. A budget of episodes or minutes that is used up
ends a stage with the best so far; what has to be there then is one comparison of paths and one round of cloning. All
that is judged on the way is judged from validation starts; those of `evaluate` are never played here.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from torchdlo.agents.policies import Policy, PolicySpec, load_policy, save_policy, task_features
from torchdlo.agents.rl.clone import Labels, fit_clone, label_batch
from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.expert import (
    Expert,
    candidate_experts,
    check_experts,
    expert_hash,
    improve_expert,
    load_expert,
    save_expert,
)
from torchdlo.agents.rl.ppo import Ppo
from torchdlo.agents.rl.rollout import collect_episodes
from torchdlo.agents.rl.settings import TrainingSettings, changed
from torchdlo.agents.rl.spending import Spending
from torchdlo.agents.torch_records import load_checkpoint, save_checkpoint
from torchdlo.envs import PUBLISHED, Fidelity, Task, with_fidelity
from torchdlo.errors import InputError
from torchdlo.journal import read_json, write_json

__all__ = ["STAGES", "Hybrid", "plan_of", "task_policy", "train_hybrid"]

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
    rounds: int = 2
    """Rounds of DAgger after the first, in cheap steps."""
    count: int = 128
    """Episodes of a round."""
    search_noise: float = 0.0015
    """Deviation of what is added to actions while a robust path is searched, and the most with which the last stage
    begins [m]."""
    search_sigma: float = 0.004
    """First deviation of the places of that search [m]."""
    noise: float = 0.001
    """Deviation of what is added to actions while labels are collected [m]."""
    updates: int = 3000
    """Steps of learning after each round."""
    final: int = 1
    """Rounds at the published fidelity."""
    validation: int = 64
    """Starts from which policies are compared."""
    enough: float = 0.985
    """Share of successes on validation starts from which there is nothing to tune."""
    tune_episodes: int = 1280
    """Budget of the last stage."""
    disturbed: float = 0.0
    """By how much friction and stiffness of ropes vary from episode to episode in all stages, as shares of their own;
    annealed from nothing in the first one."""


_COILING = {"search_noise": 5e-4, "search_sigma": 1e-3, "noise": 3e-4}
"""The hand goes round the cone at less than a millimetre from its surface: noise of 1 mm makes it touch."""
_PLANS: dict[str, dict[str, float]] = {
    "coiling": _COILING,
    "coiling_left": _COILING,
    "coiling_right": _COILING,
    # Its matter makes an episode cost several times what one of the surrogate does, in which the path is searched.
    "gathering": {"starts": 8, "count": 64, "rounds": 1, "validation": 16, "tune_episodes": 0},
    # Fingers hold the band by friction: it slips out where its halves pull unevenly, by 0.7 mm of way.
    "slingshot": {"search_noise": 2e-4, "search_sigma": 5e-4, "noise": 1e-4},
    "unknotting": {"search_noise": 1e-3, "search_sigma": 3e-3, "noise": 5e-4},
    # Without disturbances it fails with half the friction, and with ropes that are stiffer by half.
    "wiring_post": {"generations": 30, "disturbed": 0.5},
}
"""What differs by task: noise that the task itself takes, and what it has to be made robust against."""


def plan_of(task: str, **given: Any) -> Hybrid:
    """Return the plan for a task; what is given and not None wins."""
    wanted = {name: value for name, value in given.items() if value is not None}
    other = sorted(set(wanted) - {f.name for f in fields(Hybrid)})
    if other:
        raise InputError(f"plan: there is no {', '.join(other)}; expected fields of Hybrid, such as generations.")
    return Hybrid(**(_PLANS.get(task, {}) | wanted))


@dataclass(frozen=True)
class _Run:
    """What all stages of a run share."""

    task: Task
    settings: TrainingSettings
    plan: Hybrid
    folder: Path
    stages: Sequence[str]
    resume: bool
    told: Callback
    spending: Spending
    notes: dict[str, Any]
    """What stages came to."""


def task_policy(task: Task, settings: TrainingSettings, **choices: Any) -> Policy:
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
        reach=task.max_translation,
        turns=3 * arms,
    )
    return Policy(replace(spec, **choices))


def train_hybrid(
    task: Task,
    trajectories: Sequence[Path],
    settings: TrainingSettings,
    *,
    folder: Path,
    plan: Hybrid | None = None,
    stages: Sequence[str] = STAGES,
    expert: Path | None = None,
    search_notes: dict[str, Any] | None = None,
    resume: bool = False,
    callback: Callback | None = None,
) -> tuple[Policy, dict[str, Any]]:
    """Return a policy and what each stage came to; a stage whose files are there is not run again if `resume`.

    Args:
        task: in the published fidelity.
        trajectories: files of `torchdlo optimize`.
        settings: budgets, seed, sizes and settings of PPO.
        folder: gets expert.json, clone.pt, policy.pt and stages.json.
        plan: sizes of the stages.
        stages: which of `STAGES` to run; those left out are skipped, or taken from the files of an earlier run.
        expert: a file of an earlier first stage to begin with.
        search_notes: what the search of the trajectories has used, as notes of a stage; its time counts.
        resume: go on from what is there.
        callback: told (stage, done, all, message).
    """
    other = sorted(set(stages) - set(STAGES))
    if other:
        raise InputError(f"stages: there is no {', '.join(other)}; expected some of {', '.join(STAGES)}.")
    if not stages:
        raise InputError(f"stages: none is left; expected some of {', '.join(STAGES)}.")
    plan, told = plan or plan_of(task.name), callback or (lambda *_: None)
    experts = candidate_experts(task, list(trajectories))
    spending = Spending(settings.episodes, settings.minutes)
    run = _Run(task, settings, plan, folder, stages, resume, told, spending, _notes(folder) if resume else {})
    notes = _belonging(run, experts if trajectories else None, expert)
    if search_notes is not None:
        notes["search"] = search_notes
    spending.add_time(notes.get("search", {}))
    _check_budget(run, experts, expert)
    if not resume:
        _begin_afresh(run, experts, expert)
    _note(folder, notes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        chosen = _robust(run, experts, expert)
        _note(folder, notes)
        policy = _clone(run, chosen)
        _note(folder, notes)
        # Of the first stage alone comes a path, and no policy; one that was tuned before stays until it is tuned on.
        cloned = "clone" in stages or (folder / "clone.pt").is_file()
        if cloned and not ("tune" in stages and "tune" in notes):
            _finish(policy, folder, notes)
        if "tune" in stages:
            policy = _tune(run, policy)
            _finish(policy, folder, notes)
    return policy, notes


def _notes(folder: Path) -> dict[str, Any]:
    return read_json(folder / "stages.json") or {}


def _note(folder: Path, notes: dict[str, Any]) -> None:
    write_json(folder / "stages.json", {"generator": "torchdlo train", **notes})


def _finish(policy: Policy, folder: Path, notes: dict[str, Any]) -> None:
    save_policy(policy, folder / "policy.pt", {"algorithm": "hybrid", "episodes": _episodes(notes)})
    _note(folder, notes)


def _episodes(notes: dict[str, Any]) -> int:
    return sum(notes[name]["episodes"] for name in STAGES if name in notes)


def _belonging(run: _Run, experts: list[Expert] | None, given: Path | None) -> dict[str, Any]:
    """Return the notes of a run with what it belongs to; refuse what differs from that of a run to go on with.

    Budgets may change, and trajectories (None) need not be given again.
    """
    own: dict[str, Any] = {"task": run.task.name, "plan": asdict(run.plan), "settings": asdict(run.settings)}
    own |= {"coarse": run.task.coarse.plain()}
    if experts is not None:
        own["experts"] = [expert_hash(e) for e in experts]
    own["given"] = expert_hash(load_expert(given, run.task)) if given is not None and given.is_file() else None
    was, other = run.notes, changed(run.notes, own, ("plan", "settings", "experts", "given"))
    other += changed(was.get("plan", {}), own["plan"])
    other += changed(was.get("settings", {}), own["settings"], ("episodes", "minutes", "interval"))
    if changed(was, {"experts": own.get("experts")}) and experts is not None:
        other.append("other trajectories")
    if changed(was, {"given": own["given"]}):
        other.append("another expert")
    if other:
        said = f"it belongs to a run with {', '.join(other)}; give the same, or leave out --resume"
        raise InputError(f"{run.folder / 'stages.json'}: {said}.")
    run.notes.update(own)
    return run.notes


def _check_budget(run: _Run, experts: list[Expert], given: Path | None) -> None:
    """Refuse a budget of episodes that does not suffice for what has to be there."""
    plan, resume = run.plan, run.resume
    compared = 2 * plan.starts * len(experts) if _searches(run, given) else 0
    cloned = plan.count if "clone" in run.stages and not (resume and (run.folder / "clone.pt").is_file()) else 0
    if run.settings.episodes < compared + cloned:
        said = f"{compared} to compare paths and {cloned} for a round of cloning"
        raise InputError(f"episodes is {run.settings.episodes}; expected at least {compared + cloned}: {said}.")


def _begin_afresh(run: _Run, experts: list[Expert], given: Path | None) -> None:
    """Remove what an earlier run left of the stages that are to run, so that nothing goes on from it."""
    old = ["robust.json", "clone.part", "tune.part", "stages.json"]
    if _searches(run, given):
        check_experts(run.task, experts)
        old.append("expert.json")
    if "clone" in run.stages:
        old.append("clone.pt")
    for name in old:
        (run.folder / name).unlink(missing_ok=True)


def _searches(run: _Run, given: Path | None) -> bool:
    """Return whether the first stage makes an expert, instead of taking one that is there, or none."""
    if given is not None and given.is_file():
        return False
    if (run.resume or "robust" not in run.stages) and (run.folder / "expert.json").is_file():
        return False
    cloned = "clone" not in run.stages and (run.folder / "clone.pt").is_file()
    return "robust" in run.stages or not cloned


def _robust(run: _Run, experts: list[Expert], given: Path | None) -> Expert | None:
    task, plan, folder = run.task, run.plan, run.folder
    if not _searches(run, given):
        file = given or folder / "expert.json"
        run.spending.add(run.notes.get("robust", {}))
        if given is None and not file.is_file():
            return None
        if not run.resume:
            run.told("robust", 1, 1, f"the path is taken from {file}")
        return load_expert(file, task)
    began = run.spending.mark()
    generations = plan.generations if "robust" in run.stages else 0
    coarse = with_fidelity(task, task.coarse)
    surrogate = coarse.surrogate()
    run.spending.reserved = plan.count if "clone" in run.stages else 0
    found, log, _ = improve_expert(
        surrogate or coarse,
        experts,
        seed=run.settings.seed,
        starts=plan.starts,
        population=plan.population,
        generations=generations,
        sigma=plan.search_sigma,
        noise=plan.search_noise,
        spending=run.spending,
        judged=coarse if surrogate else None,
        disturbed=plan.disturbed,
        journal=folder / "robust.json",
        callback=run.told,
    )
    run.spending.reserved = 0
    ended = next((row for row in log if "ended" in row), {})
    run.notes["robust"] = run.spending.since(began) | ended | {"log": log}
    save_expert(found, folder / "expert.json", task, {"episodes": run.notes["robust"]["episodes"], "log": log})
    return found


def _clone(run: _Run, expert: Expert | None) -> Policy:
    task, settings, plan, folder = run.task, run.settings, run.plan, run.folder
    file = folder / "clone.pt"
    if file.is_file() and (run.resume or "clone" not in run.stages):
        run.spending.add(run.notes.get("clone", {}))
        return load_policy(file)
    policy = task_policy(task, settings, squash=False)
    if "clone" not in run.stages:
        return policy
    if expert is None:
        raise InputError(f"{folder / 'expert.json'}: there is no expert to clone; run the stage robust first.")
    began, labels, rng = run.spending.mark(), Labels(), torch.Generator().manual_seed(settings.seed)
    torch.manual_seed(settings.seed)

    def batches(fidelity: Fidelity, seed: int) -> TaskEpisodes:
        return TaskEpisodes(
            with_fidelity(task, fidelity), plan.count, seed=settings.seed + seed, disturbed=plan.disturbed
        )

    rounds = [batches(task.coarse, 11)] * (1 + plan.rounds)
    if plan.final:
        rounds += [batches(PUBLISHED, 12)] * plan.final
    parts = {"policy": policy, "labels": labels}
    keeper = _Keeper(folder / "clone.part", parts, [rng, *_generators(rounds)], run.spending)
    log = keeper.restore() if run.resume else []
    ended = {}
    for k, episodes in enumerate(rounds):
        if k >= max(1, len(log)) and (budget := run.spending.ended(episodes.count)):
            ended = {"ended": budget}
            run.told("clone", k, len(rounds), f"the budget of {budget} ends it")
            break
        run.spending.played += episodes.count
        if k < len(log):
            continue
        choices: dict[str, Any] = {"driven": k == 0, "noise": plan.noise, "generator": rng}
        success, failed = label_batch(labels, policy, expert, episodes, **choices)
        error = fit_clone(policy, labels, updates=plan.updates)
        fine = episodes.task.fidelity.text
        log.append({"round": k, "fidelity": fine, "success": success, "failed": failed, "error": error})
        keeper.keep(log)
        run.told("clone", k + 1, len(rounds), f"success {success:.0%} in the round, error {error:.2g}")
    run.notes["clone"] = run.spending.since(began) | ended | {"log": log}
    run.notes.pop("tune", None)
    save_policy(policy, file, {"stage": "clone", "log": log})
    keeper.remove()
    return policy


def _generators(rounds: Sequence[TaskEpisodes]) -> list[torch.Generator]:
    """Return those of different batches of episodes, once each."""
    return list({id(e): e.generator for e in rounds}.values())


class _Keeper:
    """What a stage needs to go on: parts with a `state_dict`, generators of random numbers, its log and its time."""

    def __init__(
        self, path: Path, parts: dict[str, Any], generators: list[torch.Generator], spending: Spending
    ) -> None:
        self.path, self.parts, self.generators = path, parts, generators
        self.spending, self.begun = spending, spending.mark()

    def keep(self, log: list[dict[str, Any]]) -> None:
        """Write all down."""
        states = {name: part.state_dict() for name, part in self.parts.items()}
        random = [torch.get_rng_state(), *(g.get_state() for g in self.generators)]
        spent = self.spending.since(self.begun)
        save_checkpoint(self.path, {"parts": states, "random": random, "log": log, "spent": spent})

    def restore(self) -> list[dict[str, Any]]:
        """Go back to what was written down, if anything was; return the log."""
        content = load_checkpoint(self.path)
        if content is None:
            return []
        for name, part in self.parts.items():
            part.load_state_dict(content["parts"][name])
        torch.set_rng_state(content["random"][0])
        for generator, state in zip(self.generators, content["random"][1:], strict=True):
            generator.set_state(state)
        self.spending.add_time(content.get("spent", {}))
        return content["log"]

    def remove(self) -> None:
        """Delete it."""
        self.path.unlink(missing_ok=True)


class _Judge:
    """Plays policies from the validation starts, always the same ones."""

    def __init__(self, run: _Run, task: Task) -> None:
        plan, seed = run.plan, run.settings.seed + _VALIDATION
        self.episodes = TaskEpisodes(task, plan.validation, seed=seed, disturbed=plan.disturbed)
        self.start, self.spending = self.episodes.generator.get_state(), run.spending

    def mark(self, policy: Policy) -> tuple[float, float]:
        """Return a policy's share of successes and its mean return."""
        self.episodes.generator.set_state(self.start)
        found = collect_episodes(policy, self.episodes, random=False)
        self.spending.played += self.episodes.count
        return float(found.success.float().mean()), float(self.episodes.returns.mean())


def _tuned(run: _Run) -> bool:
    """Return whether this run has finished its last stage before."""
    done = run.notes.get("tune", {"ended": "before it began"})
    return run.resume and (run.folder / "policy.pt").is_file() and "ended" not in done


def _tune(run: _Run, policy: Policy) -> Policy:
    settings, plan = run.settings, run.plan
    if _tuned(run):
        run.spending.add(run.notes["tune"])
        return load_policy(run.folder / "policy.pt")
    began = run.spending.mark()
    fine = with_fidelity(run.task, PUBLISHED)
    judge, best = _Judge(run, fine), copy.deepcopy(policy)
    choices: dict[str, Any] = {"bonus": settings.bonus, "disturbed": plan.disturbed}
    episodes = TaskEpisodes(fine, settings.count, seed=settings.seed + 13, **choices)
    ppo = Ppo(policy, settings, fixed=True)
    torch.manual_seed(settings.seed)
    parts = ppo.parts() | {"best": best}
    keeper = _Keeper(run.folder / "tune.part", parts, [episodes.generator], run.spending)
    log = keeper.restore() if run.resume else []
    if log:
        run.spending.played += log[-1]["episodes"] + plan.validation * max(1, len(log) - 1)
    elif not (ended := run.spending.ended(plan.validation)):
        mark = judge.mark(policy)
        log = [{"episodes": 0, "success": mark[0], "return": mark[1], "best": mark}]
        with torch.no_grad():
            # A policy that always fails under the noise learns from nothing.
            policy.log_sigma.fill_(math.log(min(settings.sigma, plan.search_noise / fine.max_translation)))
        keeper.keep(log)
    if log:
        episodes.scale = 10.0 / max(1e-6, abs(log[0]["return"]))
        ended = _tune_on(run, ppo, best, episodes, judge, keeper, log)
    if ended:
        run.told("tune", log[-1]["episodes"] if log else 0, plan.tune_episodes, f"the budget of {ended} ends it")
    else:
        keeper.remove()
    run.notes["tune"] = run.spending.since(began) | ({"ended": ended} if ended else {}) | {"log": log}
    return best


def _tune_on(
    run: _Run,
    ppo: Ppo,
    best: Policy,
    episodes: TaskEpisodes,
    judge: _Judge,
    keeper: _Keeper,
    log: list[dict[str, Any]],
) -> str:
    """Go on with PPO from what the log says last; return which budget ended it, if any did."""
    plan, count, policy = run.plan, run.settings.count, ppo.policy
    mark = tuple(log[-1]["best"])
    run.told("tune", log[-1]["episodes"], plan.tune_episodes, f"success {mark[0]:.0%}")
    while log[-1]["episodes"] + count <= plan.tune_episodes and mark[0] < plan.enough:
        first = len(log) == 1
        if ended := run.spending.ended(count + (0 if first else plan.validation)):
            return ended
        batch = collect_episodes(policy, episodes)
        run.spending.played += count
        ppo.learn(batch, freeze=first)
        # The first batch teaches the critic alone.
        now = mark if first else judge.mark(policy)
        share = float(batch.success.float().mean())
        if now > mark:
            mark = now
            best.load_state_dict(policy.state_dict())
        elif now[0] < mark[0] - 0.15:
            policy.load_state_dict(best.state_dict())
        done = log[-1]["episodes"] + count
        log.append({"episodes": done, "success": now[0], "return": now[1], "noisy": share, "best": mark})
        keeper.keep(log)
        run.told("tune", done, plan.tune_episodes, f"success {now[0]:.0%}, with noise {share:.0%}, best {mark[0]:.0%}")
    return ""
