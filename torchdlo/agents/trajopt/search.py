"""Trajectory optimisation: plays what an optimiser asks for, keeps the best, and can go on where it was stopped."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo import work_budget
from torchdlo.agents.trajopt.cmaes import cmaes, import_cma
from torchdlo.agents.trajopt.gradient_descent import descent
from torchdlo.agents.trajopt.hybrid import hybrid
from torchdlo.agents.trajopt.problem import Encoding, Evaluation, Playable, Problem
from torchdlo.agents.trajopt.proposals import Ask, Search, SearchPlan, Told, search_surrogate
from torchdlo.agents.trajopt.search_journal import SearchJournal
from torchdlo.errors import InputError
from torchdlo.physics import tree

__all__ = ["METHODS", "NothingFoundError", "Robust", "SearchResult", "SearchSettings", "optimize"]

METHODS: dict[str, Callable[[SearchPlan, torch.Generator], Search]] = {"cmaes": cmaes, "gd": descent, "hybrid": hybrid}
"""Optimisers by name."""

SURROGATE_ROUND = ("hybrid",)
"""Those that see to it themselves that what did well in a surrogate task is played in the problem itself."""

Callback = Callable[[str, int, int, str], None]

_FINALISTS = 8
"""Best trajectories that may be played alone in the end."""
_ALIKE = 0.01
"""Share of a return by which rounding may change it."""


class NothingFoundError(InputError):
    """No episode of a search had a return."""


@dataclass(frozen=True)
class Robust:
    """Trajectories that are to work in perturbed worlds, too; every copy counts as an episode."""

    copies: int = 8
    """Perturbed worlds in which each trajectory is played."""
    warm: float = 0.5
    """Share of the iterations over which the perturbations grow to their full size."""
    finalists: int = 4
    """Best trajectories that are judged once more in the end."""
    trials: int = 16
    """Perturbed worlds of that judgement, which no search has seen."""

    @property
    def final(self) -> int:
        """Episodes of the judgement in the end."""
        return self.finalists * self.trials

    def scale(self, share: float) -> float:
        """Return the size of the perturbations after a share of the iterations."""
        return min(1.0, share / self.warm) if self.warm > 0 else 1.0


@dataclass(frozen=True)
class SearchSettings:
    """How to search; what is None follows from the problem, see `SearchPlan`."""

    method: str = "cmaes"
    episodes: int = 20_000
    """Budget; an episode counts once, whether its gradient is had or not."""
    population: int = 400
    seed: int = 0
    hold: int | None = None
    sigma: float | None = None
    rate: float | None = None
    steps: int | None = None
    chunk: int = 100
    """Most episodes that are played as one batch."""
    robust: Robust | None = None
    surrogate_share: float = 0.0
    """Share of the iterations that are played in the problem's surrogate task."""

    def plan(self, problem: Problem) -> SearchPlan:
        """Return the plan for a problem; says so if the settings make none."""

        def need(ok: bool, name: str, expected: str) -> None:
            if not ok:
                raise InputError(f"{name} is {getattr(self, name)!r}; expected {expected}.")

        need(self.method in METHODS, "method", f"one of {', '.join(METHODS)}")
        if self.method != "gd":
            import_cma()
        least = 1 if self.method == "gd" else 4
        need(self.population >= least, "population", f"at least {least} for {self.method}")
        numbers = self.population * problem.horizon * problem.width
        work, cure = f"{self.population:.4g} trajectories at once", "give a smaller population"
        work_budget.check("population", work, memory=64.0 * numbers, cure=cure)
        need(0 <= self.seed < 2**32, "seed", "a whole number from 0 to 2^32 - 1")
        need(self.chunk >= 1, "chunk", "at least 1")
        need(self.hold is None or 1 <= self.hold <= problem.horizon, "hold", f"1 to {problem.horizon} actions")
        for name in ("sigma", "rate", "steps"):
            value = getattr(self, name)
            need(value is None or (math.isfinite(value) and value > 0), name, "a positive number")
        need(0 <= self.surrogate_share < 1, "surrogate_share", "a share of the iterations from 0 up, less than 1")
        need(self.surrogate_share == 0 or self.robust is None, "surrogate_share", "0 with robust")
        per, spare = (self.robust.copies, self.robust.final) if self.robust else (1, 0)
        least = self.population * per + spare
        judged = f" and {spare} for the last judgement" if spare else ""
        need(self.episodes >= least, "episodes", f"at least {least}: {least - spare} for an iteration{judged}")
        given = {k: getattr(self, k) for k in ("hold", "sigma", "rate", "steps") if getattr(self, k) is not None}
        iterations = (self.episodes - spare) // (self.population * per)
        given["drifts"] = self.robust.warm if self.robust else 0.0
        given["surrogates"] = min(int(self.surrogate_share * iterations), iterations - 1)
        return SearchPlan.of(problem, self.population, iterations, **given)


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What an optimisation found."""

    actions: Tensor
    """Best trajectory, shape (T, A)."""
    outcome: Evaluation
    """How it went when it was played alone, one entry."""
    kept: dict[str, Any]
    """What `Problem.record` keeps of it."""
    search_return: float
    """Its return as the search saw it, in a batch and, if robust, in perturbed worlds."""
    max_return: float
    """Largest return that the search saw, whether that trajectory succeeded or not."""
    episodes: int
    """Episodes played, without those that play the best alone."""
    seconds: float
    """Time spent on playing them [s]."""
    curve: list[dict[str, Any]]
    """One entry per iteration, see `_point`."""
    interrupted: bool = False


def optimize(
    problem: Problem,
    settings: SearchSettings,
    *,
    journal: Path | None = None,
    resume: bool = False,
    callback: Callback | None = None,
    first: Tensor | None = None,
    until_success: bool = False,
) -> SearchResult:
    """Search the trajectory with the largest return, if it can be had one that succeeds.

    A `KeyboardInterrupt` that `callback` raises ends the search; the best so far is returned.

    Args:
        problem: what to solve.
        settings: how, and with which budget.
        journal: folder that keeps the results of all batches; `journal.remove` deletes it, when what was found is
            written down.
        resume: go on from what is in the journal.
        callback: told (stage, episodes done, all episodes, message) after every batch.
        first: trajectories to begin with, shape (K, T, A).
        until_success: whether the first iteration in which a trajectory succeeds is the last one.
    """
    plan, robust = settings.plan(problem), settings.robust
    options = _options(problem, settings)
    if first is not None:
        plan, options["first"] = _begun(plan, settings, first)
    stand_in = problem.surrogate() if plan.surrogates else None
    if plan.surrogates and stand_in is None:
        raise InputError(f"{problem.name}: it has no surrogate task; set surrogate_share to 0.")
    player = _Player(problem, settings, SearchJournal(journal, options, resume=resume), callback)
    search = METHODS[settings.method](plan, torch.Generator().manual_seed(settings.seed))
    if settings.method not in SURROGATE_ROUND:
        search = search_surrogate(search, plan)
    curve: list[dict[str, Any]] = []
    told: Told | None = None
    interrupted = False
    best = _Best(robust.finalists if robust else _FINALISTS)
    try:
        for k in range(plan.iterations):
            ask = next(search) if told is None else search.send(told)
            scale = robust.scale((k + 1) / plan.iterations) if robust else 0.0
            on_surrogate = k < plan.surrogates
            last = k + 1 == plan.iterations  # nothing is told of it
            told = player.batch(ask, scale, tree.part(stand_in) if on_surrogate else problem, gradients=not last)
            if k == plan.surrogates > 0:
                best.clear()  # what did well in a surrogate task has to do so in earnest
                player.max_return = float(told.returns.max())
            if robust and scale == 1 and curve and curve[-1]["scale"] < 1:
                best.clear()  # what did well in milder worlds has to do so in these
            best.offer(ask, told)
            curve.append(_point(player, told, best.max_return, scale, on_surrogate))
            if until_success and not on_surrogate and bool((told.success & ~told.failed).any()):
                break
        finalists = player.judge(best.kept)
    except KeyboardInterrupt:
        if not best.kept:
            raise
        interrupted, finalists = True, best.kept
    finally:
        player.journal.close()
    if not math.isfinite(finalists[0].returns):
        raise NothingFoundError(
            f"{problem.name}: none of {player.done} episodes had a finite return; nothing was found."
        )
    chosen, outcome, kept = _alone(problem, finalists, robust is not None)
    surrogate = curve[-1]["surrogate"]  # what it promised there, it does not promise here
    return SearchResult(
        chosen.actions,
        outcome,
        kept,
        -math.inf if surrogate else chosen.returns,
        -math.inf if surrogate else best.max_return,
        player.done,
        player.seconds,
        curve,
        interrupted,
    )


def _begun(plan: SearchPlan, settings: SearchSettings, first: Tensor) -> tuple[SearchPlan, str]:
    """Return the plan of a search that begins with trajectories (K, T, A), and their hash."""
    if settings.method == "gd":
        raise InputError("gd begins with nothing that is given; use cmaes or hybrid.")
    first = first.to(torch.float64).contiguous()
    return replace(plan, first=first.flatten(1)), hashlib.sha256(first.numpy().tobytes()).hexdigest()


def _alone(
    problem: Problem, finalists: Sequence[_Finalist], robust: bool
) -> tuple[_Finalist, Evaluation, dict[str, Any]]:
    """Return the one that does best alone, of those that promise more than any before them did there.

    What rests on a narrow escape does not do alone what it did in a batch, where numbers are rounded otherwise. Returns
    in several worlds do not compare with those in one: robust ones promise no more than success.
    """
    best: _Finalist | None = None
    found: tuple[_Finalist, Evaluation, dict[str, Any]] | None = None
    for each in finalists:
        slack = math.inf if robust else _ALIKE * abs(each.returns)
        if best is not None and best.rank >= (each.success, each.returns - slack):
            break
        with torch.no_grad():
            outcome, kept = problem.record(each.actions)
        value = float(outcome.returns[0])
        went = _Finalist(bool(outcome.success[0]), value if math.isfinite(value) else -math.inf, each.actions)
        if best is None or went.rank > best.rank:
            best, found = went, (each, outcome, kept)
    return tree.part(found)


def _options(problem: Problem, settings: SearchSettings) -> dict[str, Any]:
    sizes = {k: getattr(problem, k) for k in ("name", "horizon", "width", "group", "limit")}
    return sizes | problem.choices | asdict(settings)


def _point(player: _Player, told: Told, best: float, scale: float, surrogate: bool) -> dict[str, Any]:
    """Return what a learning curve has about an iteration; of a surrogate task, it tells nothing of the problem
    itself."""
    if surrogate:
        told, best = replace(told, returns=told.returns[:0], success=torch.zeros_like(told.success)), -math.inf
    good = told.returns[torch.isfinite(told.returns)]
    return {
        "episodes": player.done,
        "best": best,
        "median": float(good.median()) if len(good) else None,
        "success": float(told.success.double().mean()),
        "failed": float(told.failed.double().mean()),
        "without_gradient": player.blind,
        "scale": scale,
        "surrogate": surrogate,
    }


@dataclass(frozen=True, eq=False)
class _Finalist:
    """A trajectory as a search saw it."""

    success: bool
    returns: float
    actions: Tensor

    @property
    def rank(self) -> tuple[bool, float]:
        """The larger, the better: success first."""
        return self.success, self.returns


class _Best:
    """The best trajectories so far."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.kept: list[_Finalist] = []
        self.max_return = -math.inf

    def offer(self, ask: Ask, told: Told) -> None:
        """Keep what is better than what there is; the earlier of equals stays."""
        self.max_return = max(self.max_return, float(told.returns.max()))
        order = sorted(range(len(told.returns)), key=lambda k: (not told.success[k], -float(told.returns[k])))
        for k in order[: self.room]:
            actions = ask.encoding.decode(ask.points[k : k + 1])[0]
            self.kept.append(_Finalist(bool(told.success[k]), float(told.returns[k]), actions))
        self.kept = sorted(self.kept, key=lambda f: f.rank, reverse=True)[: self.room]


class _Player:
    """Plays batches, or reads how they went."""

    def __init__(
        self, problem: Problem, settings: SearchSettings, journal: SearchJournal, callback: Callback | None
    ) -> None:
        self.problem, self.settings, self.journal = problem, settings, journal
        self.callback = callback or (lambda *_: None)
        self.done, self.seconds, self.blind, self.max_return = 0, 0.0, 0, -math.inf
        self._copies = settings.robust.copies if settings.robust else 1

    def _worlds(self, copies: int, scale: float, number: int) -> Playable:
        return self.problem.varied(copies, scale, self.settings.seed * 1_000_003 + number)

    def batch(self, ask: Ask, scale: float, problem: Playable, gradients: bool) -> Told:
        """Play what is asked for in a problem or its surrogate task, and what needs gradients once more if not all
        do."""
        if self.settings.robust:
            problem = self._worlds(self._copies, scale, 1)
        if not gradients or not 0 < ask.with_gradient < len(ask.points):
            return self._told(problem, ask, gradients and ask.with_gradient > 0)
        told = self._told(problem, ask, False)
        rows, gradient = ask.pick(told, ask.with_gradient), torch.zeros_like(ask.points)
        gradient[rows] = self._told(problem, replace(ask, points=ask.points[rows]), True, again=True).gradient
        return replace(told, gradient=gradient)

    def _told(self, problem: Playable, ask: Ask, with_gradient: bool, again: bool = False) -> Told:
        """Play trajectories in chunks."""
        room = max(1, self.settings.chunk // self._copies)
        parts = [self._chunk(problem, ask.encoding, x, with_gradient, again) for x in ask.points.split(room)]
        columns = zip(*parts, strict=True)
        returns, loss, short, success, failed, gradient = (torch.cat(column) for column in columns)
        good = torch.isfinite(gradient).all(-1)
        self.blind = int((~good).sum())
        returns = torch.where(torch.isfinite(returns), returns, -math.inf)
        # An episode that broke down may have a small loss, as nothing is added up from then on.
        loss = torch.where(torch.isfinite(loss) & ~failed, loss, math.inf)
        return Told(returns, loss, short.nan_to_num(), success, failed, torch.where(good[:, None], gradient, 0.0))

    def _chunk(
        self, problem: Playable, encoding: Encoding, points: Tensor, with_gradient: bool, again: bool
    ) -> tuple[Tensor, ...]:
        names = ("returns", "loss", "terminal_cost", "success", "failed", "slope")
        kept = self.journal.recall(points)
        if kept is None:
            began = time.perf_counter()
            kept = dict(zip(names, _play(problem, encoding, points, with_gradient), strict=True))
            kept["seconds"] = time.perf_counter() - began
            self.journal.keep(points, kept)
        self.done += 0 if again else len(points) * self._copies
        self.seconds += kept["seconds"]
        self.max_return = max([self.max_return, *kept["returns"][torch.isfinite(kept["returns"])].tolist()])
        self.callback("optimize", self.done, self.settings.episodes, f"best {self.max_return:.4g}")
        return tuple(kept[name] for name in names)

    def judge(self, kept: Sequence[_Finalist]) -> Sequence[_Finalist]:
        """Return the best first; those of a robust search as they do in worlds that it has not seen."""
        robust = self.settings.robust
        if robust is None:
            return kept
        with torch.no_grad():
            worlds = self._worlds(robust.trials, 1.0, 0)
            went = [worlds.evaluate(each.actions[None]) for each in kept]
        self.done += robust.trials * len(kept)
        seen = [
            _Finalist(bool(w.success[0]), r if math.isfinite(r := float(w.returns[0])) else -math.inf, each.actions)
            for each, w in zip(kept, went, strict=True)
        ]
        return sorted(seen, key=lambda f: f.rank, reverse=True)


def _play(problem: Playable, encoding: Encoding, points: Tensor, with_gradient: bool) -> tuple[Tensor, ...]:
    """Return returns, losses, successes, failures and gradients, on the CPU."""
    x = points.detach().clone().requires_grad_(with_gradient)
    with torch.set_grad_enabled(with_gradient):
        outcome = problem.evaluate(encoding.decode(x))
        gradient = x.new_zeros(len(x), 0)
        if with_gradient:
            # Trajectories do not touch each other, so that the gradient of the sum is that of each.
            (gradient,) = torch.autograd.grad(outcome.loss.sum(), x, allow_unused=True, materialize_grads=True)
    numbers = (x.double() for x in (outcome.returns, outcome.loss, outcome.terminal_cost))
    parts = (*numbers, outcome.success, outcome.failed)
    return *(p.detach().cpu() for p in parts), gradient
