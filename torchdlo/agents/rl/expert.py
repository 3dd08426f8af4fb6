"""Experts: paths of the tools that are followed in the world, with feedback on where the tools are.

A path is an affine function of how far the things of a task are off their places at the start: a rope that starts
elsewhere is led to the same posts, a ball that lies elsewhere is aimed at. Paths begin as those of trajectories that
were found from the one start. CMA-ES then moves them, played from many starts at once with noise on the actions, so
that they keep clear of what they must not touch.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.agents.rl.spending import Spending
from torchdlo.agents.torch_records import tensors_hash
from torchdlo.agents.trajopt.search_journal import code_versions
from torchdlo.agents.trajopt.search_result import check_scene, read_trajectory
from torchdlo.envs import Task
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.journal import read_json, write_json
from torchdlo.untrusted import one_line, read_entry

__all__ = [
    "Expert",
    "ExpertScore",
    "candidate_experts",
    "check_experts",
    "expert_hash",
    "follow_experts",
    "improve_expert",
    "load_expert",
    "save_expert",
]

Callback = Callable[[str, int, int, str], None]
_KNOTS = 8
"""Points in time between which changes of a path are linear."""


@dataclass(frozen=True, eq=False)
class Expert:
    """A path for the tools of a task."""

    path: Tensor
    """Where tools should be after each action from the usual start [m], shape (T, R, 3)."""
    gain: Tensor
    """How these places move with the things of the task [1], shape (T, R, 3, things, 2)."""
    source: str = ""
    """Where it comes from."""

    def target(self, done: int, moved: Tensor) -> Tensor:
        """Return where tools should be after the next action [m], shape (N, R, 3); `moved` is (N, things, 3)."""
        gain = self.gain[done].to(moved)
        return self.path[done].to(moved) + torch.einsum("rcts,nts->nrc", gain, moved[..., :2])

    def act(self, done: int, moved: Tensor, tool: Tensor, reach: float) -> Tensor:
        """Return actions in units of the greatest way, no longer than 1, shape (N, 3 R); `tool` is (N, R, 3)."""
        way = (self.target(done, moved) - tool) / reach
        return (way / way.norm(dim=-1, keepdim=True).clamp(min=1)).flatten(1).float()


@dataclass(frozen=True)
class ExpertScore:
    """How an expert or a policy did."""

    success: float
    failed: float
    returns: float
    missing: float
    """Mean of what the ends lack to success."""

    def value(self, scale: float) -> float:
        """Return one number to climb: success, then the return and what is missing, in units of `scale`."""
        missing = min(1.0, self.missing / scale)
        return self.success + 0.3 * min(2.0, self.returns / scale) - 0.3 * missing - 0.3 * self.failed


def save_expert(expert: Expert, path: Path, task: Task, notes: dict[str, Any]) -> None:
    """Write an expert as JSON."""
    content = {
        "generator": "torchdlo train",
        "task": task.name,
        "source": expert.source,
        **notes,
        "path": expert.path.double().tolist(),
        "gain": expert.gain.double().tolist(),
    }
    write_atomically(path, json.dumps(content) + "\n")


def load_expert(path: Path, task: Task) -> Expert:
    """Return the expert of a file that `save_expert` wrote."""
    content = read_entry(path, "an expert of torchdlo train")
    if content["task"].text() != task.name:
        raise InputError(
            f"{path}: expected an expert for {task.name}, found one for {one_line(content['task'].value)}."
        )
    shape = (task.horizon, task.arms.count, 3)
    places = torch.tensor(content["path"].numbers(*shape, most=1e6))
    gain = torch.tensor(content["gain"].numbers(*shape, len(task.reset_noise), 2, most=1e6))
    return Expert(places, gain, content["source"].text())


def candidate_experts(task: Task, trajectories: list[Path]) -> list[Expert]:
    """Return the paths of found trajectories that succeeded: at the same places, and moved with the first thing."""
    found = []
    shape = (task.horizon, task.arms.count, 3, len(task.reset_noise), 2)
    still = torch.zeros(shape)
    along = still.clone()
    for axis in range(2):
        along[:, :, axis, 0, axis] = 1.0
    for file in trajectories:
        content = read_trajectory(file)
        path = torch.tensor(content["tool"].numbers(None, None, 3, most=1e6), dtype=torch.float32)
        if content["task"].value != task.name or path.shape != shape[:3]:
            raise InputError(
                f"{file}: it is a trajectory of {one_line(content['task'].value)} with {len(path)} actions; expected "
                f"one of {task.name}, with {task.horizon}."
            )
        if content["success"].flag():
            check_scene(file)
            found.append(Expert(path, still, f"{file.parent.name}, same places"))
            found.append(Expert(path, along, f"{file.parent.name}, moved along"))
    return found


def expert_hash(expert: Expert) -> str:
    """Return what tells the path and the gains of an expert from those of others."""
    return tensors_hash(expert.path, expert.gain)


def check_experts(task: Task, experts: list[Expert]) -> None:
    """Refuse to begin with nothing."""
    if not experts:
        raise InputError(f"{task.name}: there is no trajectory that succeeds; search one with torchdlo optimize first.")


class _Journal:
    """A file of scores, batch after batch: a search asks for the same ones again when it is run again."""

    def __init__(self, path: Path | None, choices: list[Any], spending: Spending) -> None:
        self.path, self.choices, self.rows = path, choices, list[Any]()
        self.spending, self.begun = spending, spending.mark()
        self.ahead: list[list[list[float]]] = []
        found = None if path is None else read_json(path)
        if found is not None and found.get("choices") == choices:
            self.ahead = found["rows"]
            spending.add_time(found.get("spent", {}))

    def recall(self, count: int) -> list[ExpertScore] | None:
        """Return how the next batch of so many candidates went, if that is known."""
        if self.ahead and len(self.ahead[0]) != count:  # a budget ended that search elsewhere
            self.ahead = []
        return [ExpertScore(*row) for row in self.ahead.pop(0)] if self.ahead else None

    def keep(self, scores: list[ExpertScore]) -> None:
        """Write down how a batch went."""
        self.rows.append([list(vars(s).values()) for s in scores])
        if self.path is not None and not self.ahead:
            content = {"generator": "torchdlo train", "choices": self.choices, "rows": self.rows}
            write_json(self.path, content | {"spent": self.spending.since(self.begun)}, indent=None)


@torch.no_grad()
def follow_experts(
    experts: list[Expert], episodes: TaskEpisodes, *, noise: float, generator: torch.Generator
) -> list[ExpertScore]:
    """Play experts, each in an equal share of the batch and from the same starts; return how they did.

    Args:
        experts: of the task.
        episodes: their count is a multiple of that of the experts.
        noise: deviation of what is added to actions [m].
        generator: of the noise, the same for all experts.
    """
    each, reach = episodes.count // len(experts), episodes.task.max_translation
    episodes.reset()
    share_starts(episodes, each)
    env = episodes.env
    moved = env.moved[:each]
    for k in range(episodes.horizon):
        tools = env.world.tool.pos.float().split(each)
        action = torch.cat([e.act(k, moved, t, reach) for e, t in zip(experts, tools, strict=True)])
        random = torch.randn(each, action.shape[-1], generator=generator) * (noise / reach)
        stage_waypoints = reach * (action + random.repeat(len(experts), 1))
        step = episodes.step(torch.cat([stage_waypoints, torch.zeros_like(stage_waypoints)], -1))
    world = env.world
    missing = episodes.task.terminal_cost(world.seen(episodes.task.arms.count)).float().nan_to_num(1e3)
    rows = zip(
        (step.success & ~step.failed).float().split(each),
        step.failed.float().split(each),
        episodes.returns.split(each),
        missing.split(each),
        strict=True,
    )
    return [ExpertScore(*(float(x.mean()) for x in row)) for row in rows]


def share_starts(episodes: TaskEpisodes, each: int) -> None:
    """Let all shares of a batch begin from the starts of its first share."""
    from torchdlo.physics import tree

    env, copies = episodes.env, episodes.count // each
    env.world = tree.map(lambda x: x[:each].repeat(copies, *[1] * (x.dim() - 1)), env.world)
    env.moved = env.moved[:each].repeat(copies, 1, 1)
    if episodes.random is not None:
        episodes.disturb(episodes.random[:each].repeat(copies, 1))


def _spread(knots: Tensor, horizon: int) -> Tensor:
    """Return numbers between knots (K, ...) in time, 0 at the start, shape (T, ...)."""
    flat = torch.cat([torch.zeros_like(knots[:1]), knots]).flatten(1)
    at = torch.arange(1, horizon + 1, dtype=flat.dtype) / horizon * (len(flat) - 1)
    low = at.long().clamp(max=len(flat) - 2)
    share = (at - low)[:, None]
    return ((1 - share) * flat[low] + share * flat[low + 1]).reshape(horizon, *knots.shape[1:])


def _moving(task: Task) -> list[tuple[int, int]]:
    """Return which things of a task are moved at the start, and along which axis."""
    return [(k, axis) for k, pair in enumerate(task.reset_noise) for axis in range(2) if pair[axis] > 0]


def _changed(expert: Expert, numbers: Tensor, task: Task) -> Expert:
    """Return an expert with changes of its path [m] and of its gains, which act per unit of the things' spread."""
    horizon, arms = expert.path.shape[:2]
    moving = _moving(task)
    parts = numbers.reshape(1 + len(moving), _KNOTS, arms, 3)
    path = expert.path + _spread(parts[0], horizon).to(expert.path)
    gain = expert.gain.clone()
    for part, (thing, axis) in zip(parts[1:], moving, strict=True):
        gain[..., thing, axis] += _spread(part, horizon).to(gain) / task.reset_noise[thing][axis]
    return replace(expert, path=path, gain=gain)


def improve_expert(
    task: Task,
    experts: list[Expert],
    *,
    seed: int,
    starts: int = 16,
    population: int = 12,
    generations: int = 12,
    sigma: float = 0.004,
    noise: float = 0.0015,
    enough: float = 0.99,
    spending: Spending | None = None,
    judged: Task | None = None,
    disturbed: float = 0.0,
    journal: Path | None = None,
    callback: Callback | None = None,
) -> tuple[Expert, list[dict[str, Any]], int]:
    """Return the best expert after a search, a log of it and how many episodes it took.

    Candidates are first compared, all from the same starts; CMA-ES then moves the best one. It ends early when three
    generations in a row have their mean path succeed in a share `enough` of the starts.

    Args:
        task: in the fidelity in which to search.
        experts: where to begin.
        seed: of starts, noise and search.
        starts: different ones for each trajectory, new in each generation.
        population: trajectories of a generation, beside the mean one.
        generations: at most.
        sigma: first deviation of a place [m].
        noise: of actions [m].
        enough: see above.
        spending: counts what it uses, also in earlier processes where there is a journal, and ends it with the best so
            far when a budget does not allow another generation; the log says which.
        judged: the task itself where `task` is its surrogate: what the search found has to be better there.
        disturbed: by how much friction and stiffness vary from episode to episode, as shares of their own; in
            the search it grows from nothing over the first half of the generations.
        journal: file that keeps how candidates did; a search of the same choices, experts and versions goes on from
            there.
        callback: told (stage, generations done, all, message).
    """
    spending, told = spending or Spending(), callback or (lambda *_: None)
    check_experts(task, experts)
    choices = [task.name, task.fidelity.text, seed, starts, population, sigma, noise]
    choices += [] if judged is None else [judged.fidelity.text]
    choices += [disturbed, generations] if disturbed else []
    choices += [*map(expert_hash, experts), code_versions()]
    kept = _Journal(journal, choices, spending)
    arena = _Arena(task, seed, noise, kept)
    final = arena if judged is None else _Arena(judged, seed, noise, kept)
    scores = arena.scores(experts, 2 * starts, 0, disturbed)
    scale = max(abs(s.returns) for s in scores) or 1.0
    best = max(range(len(experts)), key=lambda k: scores[k].value(scale))
    log: list[dict[str, Any]] = [{"source": e.source, **vars(s)} for e, s in zip(experts, scores, strict=True)]
    base, good, ended = experts[best], 0, ""
    mean = base
    told("robust", 0, generations, f"{base.source}: success {scores[best].success:.0%}")
    if not generations:
        return base, log, arena.played
    search = _strategy(task, population, sigma, seed)
    for k in range(generations):
        # What is known costs nothing more, and what is found has to be compared with what was there.
        ended = "" if kept.ahead else spending.ended((1 + population) * starts + 8 * starts)
        if ended or good >= 3:
            break
        asked = search.ask()
        mean = _changed(base, torch.tensor(search.mean), task)
        candidates = [mean, *(_changed(base, torch.tensor(x), task) for x in asked)]
        strength = min(1.0, 2 * (k + 1) / generations)
        scores = arena.scores(candidates, starts, 1 + k, disturbed * strength)
        search.tell(asked, [-s.value(scale) for s in scores[1:]])
        log.append({"generation": k, **vars(scores[0]), "best": max(s.success for s in scores[1:])})
        good = good + 1 if scores[0].success >= enough and (strength == 1.0 or not disturbed) else 0
        told("robust", k + 1, generations, f"success {scores[0].success:.0%}, best {log[-1]['best']:.0%}")
    if ended:
        told("robust", len(log) - len(experts), generations, f"the budget of {ended} ends it")
        log.append({"ended": ended})
    if mean is base:
        return base, log, arena.played
    if good < 3:
        mean = _changed(base, torch.tensor(search.mean), task)
    # A search may lose its way: the path that it began with is the one to beat, from starts that neither has seen.
    scores = final.scores([base, mean], 4 * starts, 100_000, disturbed)
    log += [{"playoff": name, **vars(s)} for name, s in zip(("before", "after"), scores, strict=True)]
    played = arena.played + (0 if final is arena else final.played)
    return (mean if scores[1].value(scale) >= scores[0].value(scale) else base), log, played


class _Arena:
    """Plays candidates from starts that only the number of a batch decides, or reads how they did."""

    def __init__(self, task: Task, seed: int, noise: float, journal: _Journal) -> None:
        # The seeds of judgements begin where those of a seed of 777 would.
        self.seed = 1_000_003 * seed + (2**60 if seed >= 700 else 0)
        self.task, self.noise, self.journal = task, noise, journal
        self.played = 0
        self._made: TaskEpisodes | None = None

    def scores(self, experts: list[Expert], starts: int, number: int, disturbed: float) -> list[ExpertScore]:
        """Return how each candidate did from as many starts, which are the same for all, and so are disturbances."""
        count = starts * len(experts)
        self.played += count
        self.journal.spending.played += count
        found = self.journal.recall(len(experts))
        if found is None:
            if self._made is None or self._made.count != count:
                self._made = TaskEpisodes(self.task, count)
            self._made.disturbed = disturbed
            self._made.generator.manual_seed(self.seed + number)
            random = torch.Generator().manual_seed(self.seed + 500_000 + number)
            found = follow_experts(experts, self._made, noise=self.noise, generator=random)
        self.journal.keep(found)
        return found


def _strategy(task: Task, population: int, sigma: float, seed: int) -> Any:
    try:
        import cma
    except ImportError:
        raise InputError("robust paths need the package cma; install it with pip install 'torchdlo[cmaes]'.") from None
    size = (1 + len(_moving(task))) * _KNOTS * task.arms.count * 3
    options = {"popsize": population, "seed": seed + 1, "CMA_diagonal": True, "verbose": -9}
    return cma.CMAEvolutionStrategy([0.0] * size, sigma, options)
