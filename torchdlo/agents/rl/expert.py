"""Experts: paths of the tools that are followed in the world, with feedback on where the tools are.

A path is an affine function of how far the things of a task are off their places at the start: a rope that starts
elsewhere is led to the same posts, a ball that lies elsewhere is aimed at. Paths begin as those of trajectories that
were found from the one start. CMA-ES then moves them, played from many starts at once with noise on the actions, so
that they keep clear of what they must not touch.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.rl.episodes import TaskEpisodes
from torchdlo.envs import Task
from torchdlo.errors import InputError
from torchdlo.files import write_atomically

__all__ = ["Expert", "Score", "candidates", "follow", "improve", "load_expert", "save_expert"]

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
class Score:
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
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = Expert(torch.tensor(content["path"]), torch.tensor(content["gain"]), content["source"])
        fits = content["task"] == task.name and found.path.shape == (task.horizon, task.arms.count, 3)
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: expected an expert of torchdlo train, found something else.") from None
    if not fits:
        raise InputError(f"{path}: expected an expert for {task.name}, found one for {content['task']}.")
    return found


def candidates(task: Task, trajectories: list[Path]) -> list[Expert]:
    """Return the paths of found trajectories that succeeded: at the same places, and moved with the first thing."""
    found = []
    shape = (task.horizon, task.arms.count, 3, len(task.spread), 2)
    still = torch.zeros(shape)
    along = still.clone()
    for axis in range(2):
        along[:, :, axis, 0, axis] = 1.0
    for file in trajectories:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            path = torch.tensor(content["tool"], dtype=torch.float32)
            good = content["success"] and content["task"] == task.name and path.shape == shape[:3]
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError(f"{file}: expected a trajectory of torchdlo optimize, found something else.") from None
        if good:
            found.append(Expert(path, still, f"{file.parent.name}, same places"))
            found.append(Expert(path, along, f"{file.parent.name}, moved along"))
    return found


@torch.no_grad()
def follow(experts: list[Expert], episodes: TaskEpisodes, *, noise: float, generator: torch.Generator) -> list[Score]:
    """Play experts, each in an equal share of the batch and from the same starts; return how they did.

    Args:
        experts: of the task.
        episodes: their count is a multiple of that of the experts.
        noise: deviation of what is added to actions [m].
        generator: of the noise, the same for all experts.
    """
    each, reach = episodes.count // len(experts), episodes.task.reach
    episodes.reset()
    same(episodes, each)
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
    return [Score(*(float(x.mean()) for x in row)) for row in rows]


def same(episodes: TaskEpisodes, each: int) -> None:
    """Let all shares of a batch begin from the starts of its first share."""
    from torchdlo.physics import tree

    env, copies = episodes.env, episodes.count // each
    env.world = tree.map(lambda x: x[:each].repeat(copies, *[1] * (x.dim() - 1)), env.world)
    env.moved = env.moved[:each].repeat(copies, 1, 1)


def _spread(knots: Tensor, horizon: int) -> Tensor:
    """Return numbers between knots (K, ...) in time, 0 at the start, shape (T, ...)."""
    flat = torch.cat([torch.zeros_like(knots[:1]), knots]).flatten(1)
    at = torch.arange(1, horizon + 1, dtype=flat.dtype) / horizon * (len(flat) - 1)
    low = at.long().clamp(max=len(flat) - 2)
    share = (at - low)[:, None]
    return ((1 - share) * flat[low] + share * flat[low + 1]).reshape(horizon, *knots.shape[1:])


def _changed(expert: Expert, numbers: Tensor, moving: list[tuple[int, int]], scale: Tensor) -> Expert:
    """Return an expert with changes of its path [m] and of its gains, which act per unit of the things' spread."""
    horizon, arms = expert.path.shape[:2]
    parts = numbers.reshape(1 + len(moving), _KNOTS, arms, 3)
    path = expert.path + _spread(parts[0], horizon).to(expert.path)
    gain = expert.gain.clone()
    for k, (thing, axis) in enumerate(moving):
        gain[..., thing, axis] += _spread(parts[1 + k], horizon).to(gain) / float(scale[thing, axis])
    return replace(expert, path=path, gain=gain)


def improve(
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
    minutes: float = math.inf,
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
        minutes: budget of the clock.
        callback: told (stage, generations done, all, message).
    """
    try:
        import cma
    except ImportError:
        raise InputError("robust paths need the package cma; install it with pip install 'torchdlo[cmaes]'.") from None

    began, told = time.monotonic(), callback or (lambda *_: None)
    if not experts:
        raise InputError(f"{task.name}: there is no trajectory that succeeds; search one with torchdlo optimize first.")
    rng = torch.Generator().manual_seed(seed)
    log: list[dict[str, Any]] = []
    first = TaskEpisodes(task, len(experts) * 2 * starts, seed=seed)
    scores = follow(experts, first, noise=noise, generator=rng)
    played = first.count
    scale = max(abs(s.returns) for s in scores) or 1.0
    best = max(range(len(experts)), key=lambda k: scores[k].value(scale))
    log += [{"source": e.source, **vars(s)} for e, s in zip(experts, scores, strict=True)]
    base, mark = experts[best], scores[best]
    told("robust", 0, generations, f"{base.source}: success {mark.success:.0%}")
    del first
    spread = torch.tensor(task.spread)
    moving = [(int(t), int(a)) for t, a in (spread > 0).nonzero().tolist()]
    size = (1 + len(moving)) * _KNOTS * task.arms.count * 3
    options = {"popsize": population, "seed": seed + 1, "CMA_diagonal": True, "verbose": -9}
    search = cma.CMAEvolutionStrategy([0.0] * size, sigma, options)
    episodes = TaskEpisodes(task, (population + 1) * starts, seed=seed + 1)
    good, mean = 0, base
    for k in range(generations):
        if time.monotonic() - began > 60 * minutes:
            break
        asked = search.ask()
        mean = _changed(base, torch.tensor(search.mean), moving, spread)
        tried = [mean, *(_changed(base, torch.tensor(x), moving, spread) for x in asked)]
        scores = follow(tried, episodes, noise=noise, generator=rng)
        played += episodes.count
        search.tell(asked, [-s.value(scale) for s in scores[1:]])
        log.append({"generation": k, **vars(scores[0]), "best": max(s.success for s in scores[1:])})
        good = good + 1 if scores[0].success >= enough else 0
        told("robust", k + 1, generations, f"success {scores[0].success:.0%}, best {log[-1]['best']:.0%}")
        if good >= 3:
            break
    else:
        mean = _changed(base, torch.tensor(search.mean), moving, spread)
    if mean is base:
        return base, log, played
    # A search may lose its way: the path that it began with is the one to beat, from starts that neither has seen.
    last = TaskEpisodes(task, 2 * 4 * starts, seed=seed + 2)
    scores = follow([base, mean], last, noise=noise, generator=rng)
    log += [{"playoff": name, **vars(s)} for name, s in zip(("before", "after"), scores, strict=True)]
    return (mean if scores[1].value(scale) >= scores[0].value(scale) else base), log, played + last.count
