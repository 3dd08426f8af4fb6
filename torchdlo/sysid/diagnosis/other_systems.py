"""What is missing in a model of something that is no rope: the rules of a diagnosis with a simulator of one's own.

A system says how it is simulated, which numbers its plain model has, and which effects may be missing; recordings are
trials of points in space, as those of ropes are. Calibration, judgement by held-out trials, tests and ranges are the
ones that ropes are judged by; starts, meshes, contact and all else that is a rope's own is not here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics.effects.base import Param
from torchdlo.sysid.diagnosis import selection
from torchdlo.sysid.diagnosis.error_floor import gap_rms, trial_gaps
from torchdlo.sysid.diagnosis.plausibility import implausible
from torchdlo.sysid.diagnosis.significance import RATE, Agreement, agreement, benjamini_hochberg, chance
from torchdlo.sysid.diagnosis.verdict import verdict_word
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, evaluate, improve_points, interval
from torchdlo.sysid.recordings.recording import Trial

__all__ = ["EffectSpec", "Selection", "System", "points_trial", "select"]

_TIE = 0.05
"""Share of what the best fit saves by which costs have to differ to be told apart,"""

_CLOSE = 0.5
"""if not by this share of what is left."""

_DONE = 1.3
"""Times the level of a perfect model below which no further effect is looked for."""

_DOSES = (1.0, 0.1)
"""Shares of the doses from which fits start."""

_HORIZONS = (0.1, 0.3, 1.0)
"""Shares of the trials that the baseline is fitted to, one after the other."""

_FEWEST = 5
"""Frames with a free point below which a trial tells nothing."""

_EVEN = 0.01
"""Largest deviation of a time step from the median step, as a share of it: printed times are rounded."""

_SPREAD = (1.0, 0.5, 2.0)
"""Multiples of the baseline's numbers from which its fit starts."""


@dataclass(frozen=True)
class EffectSpec:
    """An effect that a system may lack."""

    name: str
    """What it is called."""
    law: str
    """Its equation, for a reader."""
    params: Mapping[str, Param]
    """Its numbers; those with an `off` value switch it."""
    starts: tuple[Mapping[str, float], ...]
    """Doses from which fits start; what they leave out has its default."""


@dataclass(frozen=True, eq=False)
class System:
    """Something that moves, and what its model may lack."""

    simulate: Callable[[dict[str, np.ndarray], Sequence[Trial]], np.ndarray]
    """Maps numbers (P,) by name, `effect.number` or of the baseline, and B trials to points (P, B, F, M, 3) [m]; gets
    all numbers, those of effects that are not in a model at their off values."""
    baseline: Mapping[str, Param]
    """Numbers of the plain model."""
    effects: tuple[EffectSpec, ...]
    """What may be missing."""
    error: float = 0.0
    """What the simulation itself gets wrong, root mean square per coordinate [m]."""


@dataclass(eq=False)
class Selection:
    """What was found."""

    verdict: str
    """"none", "effects", "partial" or "unknown"."""
    effects: list[str]
    """Names of the missing effects, in the order in which they were found."""
    numbers: dict[str, tuple[float, float, float]]
    """By name: value, low and high end of the 90 % range."""
    ties: dict[str, list[str]]
    """By effect: others that the data cannot tell from it."""
    tests: dict[str, Agreement]
    """By effect: whether what it explains on the test trials could be chance."""
    rates: dict[str, float]
    """By effect: the false discovery rate at which it is named, with all candidates that were looked at."""
    before: float
    """Gap on the test trials with the baseline, root mean square per coordinate [m]."""
    after: float
    """The same with the effects [m]."""
    level: float
    """Gap of a perfect model [m]."""
    candidates: list[dict[str, object]] = field(default_factory=list)
    """Round, name, gains on train and test trials, and why it was taken or left."""
    doubts: list[str] = field(default_factory=list)
    """What speaks against the names, a sentence each."""


def points_trial(name: str, time: np.ndarray, points: np.ndarray, given: np.ndarray | None = None) -> Trial:
    """Return a trial of points in space.

    Args:
        name: of the trial.
        time: from 0 on, in even steps [s], shape (F,).
        points: NaN where not seen [m], shape (F, M, 3).
        given: which points are an input, not to be explained, shape (M,); none if not given.
    """
    if points.ndim != 3 or points.shape[0] != len(time) or points.shape[2] != 3:
        raise InputError(f"{name}: points have shape {points.shape}; expected ({len(time)}, points, 3) in metres.")
    count = points.shape[1]
    held = np.zeros(count, bool) if given is None else np.asarray(given, bool)
    _check_readings(name, np.asarray(time, float), np.asarray(points, float), held)
    suspect = np.zeros(len(time), bool)
    return Trial(name, np.asarray(time, float), points, np.arange(count, dtype=float), held, None, None, suspect)


def _check_readings(name: str, time: np.ndarray, points: np.ndarray, held: np.ndarray) -> None:
    """Refuse times that are not even, points that are given but not known, and trials with hardly a free point."""
    steps = np.diff(time)
    if len(time) < _FEWEST or not np.isfinite(time).all() or abs(time[0]) > 1e-9 or (steps <= 0).any():
        raise InputError(f"{name}: time: expected at least {_FEWEST} finite times that rise from 0 s.")
    step = float(np.median(steps))
    uneven = np.abs(steps - step) > _EVEN * step
    if uneven.any():
        frame = int(np.argmax(uneven)) + 1
        raise InputError(
            f"{name}: time: expected even steps of {step:g} s, found {steps[frame - 1]:g} s before frame {frame}; "
            "interpolate the points to even steps, NaN where too much is missing."
        )
    if np.isinf(points).any() or not np.isfinite(points[:, held]).all():
        raise InputError(
            f"{name}: points: expected finite numbers in metres, or NaN for a free point that is not seen."
        )
    seen = int(np.isfinite(points[:, ~held]).all(-1).any(-1).sum())
    if seen < _FEWEST:
        raise InputError(f"{name}: points: expected free points in at least {_FEWEST} frames, found them in {seen}.")


def select(
    system: System,
    train: Sequence[Trial],
    test: Sequence[Trial],
    noise: float,
    *,
    rounds: int = 2,
    iterations: int = 12,
) -> Selection:
    """Name what recordings of a system show that its plain model lacks.

    Args:
        system: how it is simulated and what it may lack.
        train: trials that choose effects and fit their numbers.
        test: trials that judge them.
        noise: of the points, root mean square per coordinate [m].
        rounds: most effects that are added one after the other.
        iterations: most iterations of each fit.
    """
    if not train or not test:
        raise InputError(f"{len(train)} train and {len(test)} test trials are given; expected at least one of each.")
    return _Selector(system, tuple(train), tuple(test), noise, iterations).run(rounds)


class _Selector:
    """One selection."""

    def __init__(
        self, system: System, train: tuple[Trial, ...], test: tuple[Trial, ...], noise: float, iterations: int
    ) -> None:
        self.system, self.noise, self.iterations = system, noise, iterations
        self.trials = {"train": train, "test": test}
        self.level = float(np.hypot(noise, system.error))
        self.specs = {spec.name: spec for spec in system.effects}
        self._sims: dict[tuple[tuple[str, ...], bytes, str], np.ndarray] = {}

    def run(self, rounds: int) -> Selection:
        """Go through all stages."""
        defaults = {name: p.scalar for name, p in self.system.baseline.items()}
        starts = [{name: times * value for name, value in defaults.items()} for times in _SPREAD]
        base = first = self.fit((), starts)
        rivals: dict[str, Fitted] = {}
        ties: dict[str, list[str]] = {}
        looked: list[dict[str, object]] = []
        tested: list[tuple[str, Agreement]] = []
        for number in range(1, rounds + 1):
            names = [name for name in self.specs if name not in base.effects]
            if not names or (ties and gap_rms(self.gaps(base, "test")) < _DONE * self.level):
                break
            rival = self.fit(base.effects, [self.values(base)])
            fits = {name: self._extended(rival, name) for name in names}
            tests = {name: self.test(rival, fitted, len(names)) for name, fitted in fits.items()}
            tested += tests.items()
            by_chance = chance(tests, len(names))
            reasons = {n: self._refused(first, rival, fits[n], by_chance.get(n)) for n in names}
            fair = sorted((n for n in names if reasons[n] is None), key=lambda n: fits[n].point.cost)
            close: list[str] = []
            if fair:
                lead = fits[fair[0]].point.cost
                tie = min(_TIE * (rival.point.cost - lead), _CLOSE * lead)
                close = [n for n in fair if fits[n].point.cost - lead <= tie]
                best = min(close, key=lambda n: len(fits[n].space.names))
                reasons |= dict.fromkeys(close, "as good as the best") | {best: "taken"}
            for name in names:
                gains = [
                    selection.gain(self.gaps(rival, split), self.gaps(fits[name], split), self.noise)
                    for split in ("train", "test")
                ]
                looked.append(
                    {"round": number, "name": name, "train_gain": gains[0], "heldout_gain": gains[1]}
                    | {"reason": reasons[name] or "fits worse", "p_value": tests[name].p}
                )
            if not fair:
                break
            rivals[best], ties[best], base = rival, [n for n in close if n != best], fits[best]
            base = self._pruned(first, base, ties, rivals)
        return self._conclude(first, base, ties, rivals, looked, tested)

    def values(self, fitted: Fitted) -> dict[str, float]:
        """Return the numbers of a fit by name."""
        return dict(zip(fitted.space.names, map(float, fitted.values), strict=True))

    def fit(self, effects: tuple[str, ...], starts: Sequence[Mapping[str, float]]) -> Fitted:
        """Return the best fit of a model with some effects, from several starts."""
        names, params, sizes = [], [], []
        for name, param in self.system.baseline.items():
            names.append(name)
            params.append(param)
            sizes.append(abs(param.scalar) or 1.0)
        for effect in effects:
            spec = self.specs[effect]
            for number, param in spec.params.items():
                names.append(f"{effect}.{number}")
                params.append(param)
                sizes.append(max((abs(s.get(number, 0.0)) for s in spec.starts), default=0.0) or 1.0)
        # Where a number stands for a spring in series, its size is that of one over it.
        sizes = [1 / s if p.scale == "reciprocal" else s for s, p in zip(sizes, params, strict=True)]
        space = ParameterSpace(tuple(names), tuple(params), tuple(sizes))
        given = [[start.get(n, p.default) for n, p in zip(names, params, strict=True)] for start in starts]
        raws, whole = space.clip(space.to_raw(np.array(given, float))), self.measured("train")

        def simulate(values: np.ndarray) -> np.ndarray:
            return self.simulated(dict(zip(names, values.T, strict=True)), "train")

        # Phases of late times are right only after early ones are: the horizon of a first fit grows.
        for share in _HORIZONS if not effects else (1.0,):
            measured = whole.copy()
            measured[:, max(2, int(share * whole.shape[1])) :] = np.nan
            points = evaluate(simulate, measured, space, raws)
            for found in improve_points(simulate, measured, space, points, iterations=self.iterations):
                points = found
            raws = np.array([p.raw for p in points])
        best = min(points, key=lambda p: p.cost)
        if not np.isfinite(best.cost):
            raise InputError(f"the simulation with {', '.join(effects) or 'no effect'} failed from every start.")
        return Fitted(effects, space.to_values(best.raw), space, best)

    def measured(self, split: str) -> np.ndarray:
        """Return the points of trials that are to be explained [m], shape (B, F, M, 3), padded with NaN."""
        trials = self.trials[split]
        frames = max(len(t.time) for t in trials)
        found = np.full((len(trials), frames, *trials[0].markers.shape[1:]), np.nan)
        for k, trial in enumerate(trials):
            found[k, : len(trial.time)] = np.where(trial.gripped[:, None], np.nan, trial.markers)
        return found

    def simulated(self, numbers: dict[str, np.ndarray], split: str) -> np.ndarray:
        """Return simulated points (P, B, F, M, 3) [m]; effects that are not in the model are off."""
        count = len(next(iter(numbers.values())))
        given = {
            f"{spec.name}.{number}": np.full(count, p.default if p.off is None else p.off)
            for spec in self.system.effects
            for number, p in spec.params.items()
        }
        return self.system.simulate(given | numbers, self.trials[split])

    def prediction(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return what a fit says of the trials of a split [m], shape (B, F, M, 3)."""
        key = (fitted.effects, fitted.values.tobytes(), split)
        if key not in self._sims:
            numbers = {name: np.array([value]) for name, value in self.values(fitted).items()}
            self._sims[key] = self.simulated(numbers, split)[0]
        return self._sims[key]

    def gaps(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return the gap of each trial of a split [m]."""
        return trial_gaps(self.prediction(fitted, split), self.trials[split])

    def test(self, less: Fitted, more: Fitted, looked_at: int) -> Agreement:
        """Return whether what an effect explains on the test trials could be chance."""
        before, after = (self.prediction(fitted, "test") for fitted in (less, more))
        return agreement(before, after, self.trials["test"], looked_at=looked_at)

    def _extended(self, rival: Fitted, name: str) -> Fitted:
        """Return the best fit with one effect more."""
        old = self.values(rival)
        starts = [
            old | {f"{name}.{k}": self._dose(name, k, v, share) for k, v in start.items()}
            for start in self.specs[name].starts
            for share in _DOSES
        ]
        return self.fit((*rival.effects, name), starts)

    def _dose(self, name: str, number: str, value: float, share: float) -> float:
        """Return a share of what a number of a dose is away from its off value, if it has one, in its coordinate."""
        param = self.specs[name].params[number]
        if param.off is None:
            return value
        space = ParameterSpace((number,), (param,), (1.0,))
        ends = space.to_raw(np.array([[param.off], [value]]))
        return float(space.to_values(ends[:1] + share * (ends[1:] - ends[:1]))[0, 0])

    def _matters(self, first: Fitted, less: Fitted, more: Fitted, split: str) -> bool:
        whole, before, after = (self.gaps(f, split) for f in (first, less, more))
        return selection.matters(*selection.compared([whole], before, after), self.noise, self.level)

    def _refused(self, first: Fitted, rival: Fitted, fitted: Fitted, by_chance: str | None) -> str | None:
        train, held = ((self.gaps(rival, split), self.gaps(fitted, split)) for split in ("train", "test"))
        enough = all(self._matters(first, rival, fitted, split) for split in ("train", "test"))
        why = selection.refused(train, held, self.noise, enough)
        return why or by_chance or implausible(fitted, fitted.effects[-1])

    def _pruned(self, first: Fitted, base: Fitted, ties: dict[str, list[str]], rivals: dict[str, Fitted]) -> Fitted:
        """Return the model without effects that the last one has made needless."""
        for name in [*ties][:-1]:
            rest = tuple(e for e in base.effects if e != name)
            less = self.fit(rest, [self.values(base), self.values(first)])
            if self._matters(first, less, base, "train"):
                rivals[name] = less
            else:
                base = less
                del ties[name], rivals[name]
        return base

    def _conclude(
        self,
        first: Fitted,
        final: Fitted,
        ties: dict[str, list[str]],
        rivals: dict[str, Fitted],
        looked: list[dict[str, object]],
        tested: list[tuple[str, Agreement]],
    ) -> Selection:
        before, after = (gap_rms(self.gaps(f, "test")) for f in (first, final))
        for name in ties:
            rest = tuple(e for e in final.effects if e != name)
            if set(rivals[name].effects) != set(rest):
                # Beside an effect that was dropped, it would show what that one does, too.
                rivals[name] = self.fit(rest, [self.values(final), self.values(first)])
        tests = {name: self.test(rivals[name], final, len(looked)) for name in ties}
        p = [t.p for t in tests.values()] + [t.p for name, t in tested if name not in tests]
        rates = dict(zip(tests, map(float, benjamini_hochberg(p, len(looked))), strict=False))
        ranges = zip(final.space.names, final.values, *interval(final.point, final.space), strict=True)
        numbers = {n: (float(v), float(min(a, b)), float(max(a, b))) for n, v, a, b in ranges}
        verdict = verdict_word([*ties], after, self.level, after / max(before, 1e-30))
        doubts = self._doubts(ties, rates)
        return Selection(verdict, [*ties], numbers, ties, tests, rates, before, after, self.level, looked, doubts)

    def _doubts(self, ties: dict[str, list[str]], rates: dict[str, float]) -> list[str]:
        """Return what speaks against the names; nothing where none are given."""
        said = [f"{other} would do as well as {name}" for name, others in ties.items() for other in others]
        train, test = (len(self.trials[split]) for split in ("train", "test"))
        if few := [name for name, rate in rates.items() if rate > RATE]:
            said.append(f"the test trials are too few to exclude that {' or '.join(few)} is chance")
        elif ties and test < 2:
            said.append("there is one test trial only")
        if ties and train < 3:
            said.append("there are fewer than three train trials")
        return said
