"""Find where a model and measurements disagree, name the effect that is missing, add it, and see the gap shrink.

The baseline is calibrated; doses of every effect of the library are held against what it leaves over; the leading ones
are fitted jointly with the baseline's numbers; the best is kept if it closes enough of the gap on every trial, and the
search goes on from there. Test trials are used at the end only: to confirm, or to refuse, what the train trials said.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid import floor as floors
from torchdlo.sysid import health, library
from torchdlo.sysid import start as starts
from torchdlo.sysid.floor import Floor
from torchdlo.sysid.health import Fault
from torchdlo.sysid.journal import Journal
from torchdlo.sysid.model import RopeModel
from torchdlo.sysid.motion import Start
from torchdlo.sysid.pool import Fit, Fitted, Pool, Simulation
from torchdlo.sysid.recording import Recording
from torchdlo.sysid.saved import Saved
from torchdlo.sysid.screen import Score, screen

Callback = Callable[[str, int, int, str], None]
"""Called with stage, steps done, steps in all, and a word on how it goes."""

GRID = "link_chain"
"""What a coarse chain does that a rope does not: candidate number 0, fitted before any effect is considered."""


@dataclass(frozen=True)
class Budget:
    """How much work to do."""

    starts: int
    """Starts of the baseline fit."""
    candidates: int
    """Effects that are fitted in each round."""
    iterations: int
    """Iterations of each fit."""
    rounds: int
    """Most effects that are added one after the other."""


BUDGETS = {"fast": Budget(12, 4, 6, 2), "full": Budget(32, 8, 15, 3)}

PAYS = 0.15
"""Share of the excess gap that an effect has to close, on the train and on the test trials."""

TIE = 0.05
"""Fits whose gaps differ by less than this share of the excess, or of the floor, are not told apart."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """What became of one effect in one round."""

    name: str
    """The effect."""
    score: float
    """Share of the residual that its doses explain."""
    gain: float | None
    """Share of the train trials' excess gap that it closes after the fit; None if it was not fitted."""
    heldout_gain: float | None
    """The same on the test trials."""
    reason: str
    """Why it was taken or left."""


@dataclass(eq=False)
class Diagnosis:
    """What was found."""

    verdict: str
    """"none", "effects", "partial" or "unknown"."""
    effects: list[str]
    """Names of the missing effects, in the order in which they were found."""
    ties: dict[str, list[str]]
    """By effect: others that the data cannot tell from it."""
    shares: dict[str, float]
    """By effect: share of the gap above the floor that it closed on the test trials."""
    baseline: Fitted
    """The calibrated baseline."""
    final: Fitted
    """The model with the effects."""
    floor: Floor
    """What no effect explains, on the test trials."""
    before: np.ndarray
    """Gap of each test trial with the baseline [m]."""
    after: np.ndarray
    """Gap of each test trial with the effects [m]."""
    candidates: list[list[Candidate]]
    """By round."""
    predictions: dict[str, dict[str, np.ndarray]]
    """Simulated markers [m] of "before" and "after", by trial name, shape (F, M, 3)."""
    model: RopeModel
    """The model with the effects."""
    seconds: float = 0.0
    """Time that it took."""
    notes: list[str] = field(default_factory=list)
    """Sentences that a reader should know."""
    health: list[Fault] = field(default_factory=list)
    """What is wrong with the data."""
    options: dict[str, Any] = field(default_factory=dict)
    """What was asked for."""


def rms(gaps: np.ndarray) -> float:
    """Return the root mean square of the gaps of trials."""
    return float(np.sqrt(np.mean(np.square(gaps))))


def diagnose(
    recording: Recording,
    *,
    budget: str = "fast",
    seed: int = 0,
    vertices: int | None = None,
    workers: int | None = None,
    callback: Callback | None = None,
    journal: Path | None = None,
    resume: bool = False,
    given: Saved | None = None,
) -> Diagnosis:
    """Name what a recording shows that the baseline model lacks.

    Args:
        recording: what was measured.
        budget: "fast" or "full".
        seed: of the random starts.
        vertices: vertices of the rope; from the spacing of the markers if not given.
        workers: processes; one per core if not given.
        callback: see `Callback`.
        journal: folder that keeps what is done, so that a search which was stopped can go on.
        resume: go on from it.
        given: model to take as the baseline, with its effects, in place of many starts.
    """
    if budget not in BUDGETS:
        raise InputError(f"budget is {budget!r}; expected one of {', '.join(BUDGETS)}.")
    begun, report = time.perf_counter(), callback or (lambda *_: None)
    recording, faults = health.check(recording)
    options = {"vertices": vertices or _vertices(recording), "ahead": 0.0, "grip": 0.0, "compiled": False}
    if given is not None:
        options |= given.options if vertices is None else given.options | {"vertices": vertices}
    asked = {"budget": BUDGETS[budget], "seed": seed, "options": options, "first": given and given.values}
    kept = None if journal is None else Journal(journal, recording, asked, resume=resume)
    with Pool(recording, options, workers, kept) as pool:
        search = _Search(pool, BUDGETS[budget], np.random.default_rng(seed), report)
        found = search.run(given)
    found.health, found.options = faults, {"budget": budget, "seed": seed, "vertices": options["vertices"]}
    found.seconds = time.perf_counter() - begun
    return found


def _vertices(recording: Recording) -> int:
    """Return how many vertices suit the closest free or gripped neighbours among the markers, 40 to 80."""
    nearest = float(np.diff(recording.train[0].marker_arclength).min())
    return int(np.clip(round(recording.length / nearest) + 1, 41, 81))


class _Search:
    """One diagnosis."""

    def __init__(self, pool: Pool, budget: Budget, rng: np.random.Generator, report: Callback) -> None:
        self.pool, self.budget, self.rng, self.report = pool, budget, rng, report
        self.recording = pool.recording
        self.trials = {"train": self.recording.train, "test": self.recording.test}
        self.starts: dict[str, Start] = {}
        self.notes: list[str] = []
        self._known: dict[tuple[str, tuple[str, ...], bytes], np.ndarray] = {}

    def run(self, given: Saved | None = None) -> Diagnosis:
        """Go through all stages."""
        base = self._calibrate() if given is None else self._go_on(given)
        baseline = base
        floor, test_floor = self._floor(base, "train"), self._floor(base, "test")
        effects: list[str] = []
        rounds: list[list[Candidate]] = []
        ties: dict[str, list[str]] = {}
        shares: dict[str, float] = {}
        whole = max(rms(self._gaps(baseline, "test")) ** 2 - test_floor.noise**2, 1e-12)
        while len(effects) < self.budget.rounds:
            names = [n for n in self._possible() if n not in base.effects]
            best, candidates, rivals = self._round(base, names, floor, test_floor, f"round {len(effects) + 1}")
            rounds.append(candidates)
            if best is None:
                break
            name = best.effects[-1]
            gained = rms(self._gaps(base, "test")) ** 2 - rms(self._gaps(best, "test")) ** 2
            shares[name], ties[name] = float(gained / whole), rivals
            effects.append(name)
            base = best
        return self._conclude(baseline, base, effects, ties, shares, rounds, test_floor)

    def _possible(self) -> list[str]:
        return [n for n in library.LIBRARY if library.applicable(n, self.recording, self.pool.local.model(()).mesh)]

    def _begin(self, base: np.ndarray, effects: Sequence[str]) -> None:
        """Estimate where trials begin with these numbers."""
        model = self.pool.local.model(effects)
        for split, trials in self.trials.items():
            first = starts.begin(model, trials)
            self.starts[split] = starts.refine(model, self.pool.local.motion(model, split), first, base)

    def _simulate(self, fitted: Fitted, split: str) -> np.ndarray:
        job = Simulation(fitted.effects, fitted.values[None], split, self.starts[split])
        return next(iter(self.pool.simulate([job])))[1][0]

    def _gaps(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return the gap of each trial of a split [m]."""
        key = (split, fitted.effects, fitted.values.tobytes())
        if key not in self._known:
            self._known[key] = floors.gap(self._simulate(fitted, split), self.trials[split])
        return self._known[key]

    def _floor(self, base: Fitted, split: str) -> Floor:
        self.report("measuring the floor", 0 if split == "train" else 1, 2, "")
        floor = floors.measure(self.pool, base, self._simulate(base, split), self.starts[split], split)
        self.report("measuring the floor", 1 if split == "train" else 2, 2, f"{1e3 * floor.total:.2f} mm")
        return floor

    def _calibrate(self) -> Fitted:
        """Return the fitted baseline; candidate number 0, the grid, is part of it where it helps."""
        model = self.pool.local.model(())
        guess = model.guess()
        self._begin(guess, ())
        names, stage = tuple(model.parameters), "calibrating the baseline"
        count = self.budget.starts
        self.report(stage, 0, 4, f"{count} starts")
        spread = self.rng.uniform(-1, 1, (count, len(names))) * np.log([30.0, 4.0, 6.0, 1, 1][: len(names)])
        spread[0], spread[:, 1] = 0.0, spread[:, 1] + spread[:, 0]
        values = guess * np.exp(spread)
        frames = self.pool.local.motion(model, "train").markers.shape[1]
        halves = np.array_split(values, 2)
        short = [Fit((), part, names, (1.0,) * len(names), 4, self.starts["train"], frames // 3) for part in halves]
        first = self._best(short, stage, 1, 4)
        if not self.starts["train"].still.all():
            self._begin(first.values, ())
        # Phases of late times are right only after early ones are: the horizon grows.
        middle = Fit((), first.values[None], names, (1.0,) * len(names), 5, self.starts["train"], 2 * frames // 3)
        first = self._best([middle], stage, 2, 4)
        size = float(np.diff(model.arclength).min())
        chained = self.pool.local.model((GRID,)).guess()
        chained[: len(first.values)] = first.values
        jobs = [Fit((), first.values[None], names, (1.0,) * len(names), self.budget.iterations, self.starts["train"])]
        for length in (size, -size):
            chained = chained.copy()
            chained[-1] = length
            free = (*names, f"{GRID}.length")
            sizes = (1.0,) * len(names) + (0.5 * size,)
            jobs.append(Fit((GRID,), chained[None], free, sizes, self.budget.iterations, self.starts["train"]))
        done = dict(self.pool.fit(jobs))
        plain, chain = done[0], min((done[1], done[2]), key=lambda f: f.point.cost)
        better = chain if chain.point.cost < 0.9 * plain.point.cost else plain
        if better is chain:
            self.notes.append(
                f"The rope moves like a chain of links of about {1e3 * abs(chain.values[-1]):.0f} mm, as "
                "simulated ones may; that was taken up before any effect was considered."
            )
        self.report(stage, 4, 4, f"{1e3 * rms(self._gaps(better, 'train')):.2f} mm")
        return better

    def _go_on(self, given: Saved) -> Fitted:
        """Return the given model, fitted to this recording."""
        model = given.model(self.recording, **self.pool.local.options)
        sizes, values = given.sizes(model), given.start(model)
        self._begin(values, given.effects)
        free, start = (tuple(sizes), tuple(sizes.values())), self.starts["train"]
        job = Fit(given.effects, values[None], *free, self.budget.iterations, start)
        return self._best([job], "fitting the given model", 1, 1)

    def _best(self, jobs: list[Fit], stage: str, done: int, total: int) -> Fitted:
        best = min((f for _, f in self.pool.fit(jobs)), key=lambda f: f.point.cost)
        if not np.isfinite(best.point.cost):
            raise InputError(
                f"{self.recording.path}: the simulation failed on the train trials from every start; check length, "
                "mass and marker_arclength, or use fewer vertices."
            )
        self.report(stage, done, total, f"{1e3 * best.point.cost:.2f} mm")
        return best

    def _round(
        self, base: Fitted, names: Sequence[str], floor: Floor, test_floor: Floor, stage: str
    ) -> tuple[Fitted | None, list[Candidate], list[str]]:
        """Return the model with the best effect added, if one pays, all candidates, and those as good as it."""
        scores = screen(
            self.pool, base, names, self.starts["train"], lambda k, n: self.report(f"{stage}: screening", k, n, "")
        )
        tried = scores[: self.budget.candidates]
        jobs = [self._candidate(base, score) for score in tried] + [self._again(base)]
        fits: dict[int, Fitted] = {}
        self.report(f"{stage}: fitting", 0, len(jobs), "")
        for k, fitted in self.pool.fit(jobs):
            fits[k] = fitted
            self.report(
                f"{stage}: fitting", len(fits), len(jobs), fitted.effects[-1] if k < len(tried) else "no effect"
            )
        # The fair rival of an effect is the baseline that was fitted for as long.
        rival = fits.pop(len(tried))
        rival = rival if rival.point.cost < base.point.cost else base
        gains = {tried[k].name: self._gain(rival, f, floor, "train") for k, f in fits.items()}
        order = sorted(fits, key=lambda k: fits[k].point.cost)
        best, reasons, rivals = None, {}, []
        for k in order:
            name, fitted = tried[k].name, fits[k]
            if best is not None:
                close = fitted.point.cost - best.point.cost < TIE * max(rival.point.cost - best.point.cost, 1e-9)
                if close and fitted.point.cost < rival.point.cost:
                    rivals.append(name)
                reasons[name] = "as good as the best" if close else "fits worse"
            elif not self._on_most(rival, fitted):
                reasons[name] = "helps on too few trials"
            elif gains[name] < PAYS:
                reasons[name] = f"closes {max(gains[name], 0):.0%} of the gap"
            elif self._gain(rival, fitted, test_floor, "test") < PAYS:
                reasons[name] = "does not help on the test trials"
            else:
                best, reasons[name] = fitted, "taken"
        held = {tried[k].name: self._gain(rival, f, test_floor, "test") for k, f in fits.items()}
        candidates = [
            Candidate(
                s.name, s.share, gains.get(s.name), held.get(s.name), reasons.get(s.name, "its doses explain less")
            )
            for s in scores
        ]
        return best, candidates, rivals

    def _gain(self, base: Fitted, fitted: Fitted, floor: Floor, split: str) -> float:
        """Return the share of the excess gap (squared, above noise) that a fit closes."""
        before, after = rms(self._gaps(base, split)) ** 2, rms(self._gaps(fitted, split)) ** 2
        return float((before - after) / max(before - floor.noise**2, (0.3 * floor.noise) ** 2, 1e-12))

    def _on_most(self, base: Fitted, fitted: Fitted) -> bool:
        better = self._gaps(fitted, "train") < self._gaps(base, "train")
        return bool(better.mean() > 0.6)

    def _candidate(self, base: Fitted, score: Score) -> Fit:
        effects = (*base.effects, score.name)
        model = self.pool.local.model(effects)
        first = model.guess()
        first[: len(base.values)] = base.values
        mine = [n.name for n in library.numbers(score.name, self.recording)]
        for name, value in score.dose.items():
            first[model.parameters.index(name)] = value
        # Numbers that no dose uses stay off: a slope where a spot fits better.
        used = [n for n in mine if n in score.dose]
        free = (*base.space.names, *used)
        units = (*base.space.units, *(score.sizes[n] for n in used))
        return Fit(effects, first[None], free, tuple(units), self.budget.iterations, self.starts["train"])

    def _again(self, base: Fitted) -> Fit:
        space, start = base.space, self.starts["train"]
        return Fit(base.effects, base.values[None], space.names, tuple(space.units), self.budget.iterations, start)

    def _conclude(
        self,
        baseline: Fitted,
        final: Fitted,
        effects: list[str],
        ties: dict[str, list[str]],
        shares: dict[str, float],
        rounds: list[list[Candidate]],
        floor: Floor,
    ) -> Diagnosis:
        before, after = self._gaps(baseline, "test"), self._gaps(final, "test")
        explained = rms(after) <= UNEXPLAINED * floor.total
        verdict = ("effects" if explained else "partial") if effects else ("none" if explained else "unknown")
        predictions: dict[str, dict[str, np.ndarray]] = {}
        for when, fitted in (("before", baseline), ("after", final)):
            predictions[when] = {}
            for split, trials in self.trials.items():
                for sim, trial in zip(self._simulate(fitted, split), trials, strict=True):
                    predictions[when][trial.name] = sim[: len(trial.time)]
        return Diagnosis(
            verdict,
            effects,
            ties,
            shares,
            baseline,
            final,
            floor,
            before,
            after,
            rounds,
            predictions,
            self.pool.local.model(final.effects),
            notes=self.notes,
        )


UNEXPLAINED = 3.0
"""Times the floor: a gap beyond that is not explained."""
