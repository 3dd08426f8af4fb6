"""What rival models say of motions that nobody has done yet, and how far apart they stay when each may adapt.

A motion separates a true model from a rival by the distance that is left when the rival's numbers are fitted to what
the true one shows, in that motion and in the trials at hand: T-optimality (Atkinson and Fedorov 1975,
doi:10.1093/biomet/62.1.57). Nobody knows which one is true: the smallest distance over all ordered pairs counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from torchdlo.physics import tree
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.workspace import Callback, Workspace
from torchdlo.sysid.estimation.jobs import Fitted, Models, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace
from torchdlo.sysid.experiment_design import excitation_motions
from torchdlo.sysid.experiment_design.excitation_motions import ExcitationMotion, GripperLimits
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Trial

__all__ = ["ModelDiscrimination", "Pair", "measured_misfit", "rms_size"]

_LOAD = "point_mass"
"""The effect by which a known mass hangs on the rope."""


@dataclass(frozen=True, eq=False)
class Pair:
    """What is left between a true model and a rival that did its best to follow it."""

    truth: str
    """Effect of the model that is taken to be true."""
    rival: str
    """Effect of the model that was fitted to it."""
    shown: np.ndarray
    """Markers of the true model [m], shape (B, F, M, 3)."""
    left: np.ndarray
    """What the rival says minus that [m], NaN at grippers and where a model fails, shape (B, F, M, 3)."""
    values: np.ndarray
    """The rival's numbers after the fit, shape (K,)."""


@dataclass(frozen=True, eq=False)
class _Play:
    """Motions to simulate."""

    trials: tuple[Trial, ...]
    effects: tuple[str, ...]
    values: np.ndarray
    start: Start
    options: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True, eq=False)
class _Follow:
    """A rival to fit to what another model shows: in the train trials, and in each of several motions by itself."""

    rival: Fitted
    load: tuple[float, ...]
    """Numbers of the mass on the rope in the motions, none for none."""
    known: np.ndarray
    """The rival in the train trials as it is, and with each number a little changed [m], shape (1 + K, B, F, M, 3)."""
    past: np.ndarray
    """What the other shows there [m], shape (B, F, M, 3)."""
    past_start: Start
    trials: tuple[Trial, ...]
    """The motions, with what the other shows; none: only the train trials count."""
    start: Start | None
    iterations: int
    """Steps of Gauss-Newton that are checked by simulation; 0 for one that is not."""
    options: tuple[tuple[str, Any], ...] = ()


def _model(models: Models, job: _Play | _Follow, effects: tuple[str, ...]) -> RopeModel:
    recording = replace(models.recording, train=job.trials, test=())
    return RopeModel(recording, effects=effects, **(models.options | dict(job.options)))


def _play(models: Models, job: _Play) -> np.ndarray:
    """Return markers [m], shape (P, B, F, M, 3)."""
    model = _model(models, job, job.effects)
    return model.simulate(model.motion(job.trials), job.start, job.values)


class _Chase:
    """A rival on its way to what another model shows."""

    def __init__(self, models: Models, job: _Follow) -> None:
        self.job, self.rival, self.space = job, job.rival, job.rival.space
        self.old = models.model(job.rival.effects, job.options)
        self.old_motion = replace(models.motion(self.old, "train"), markers=job.past)
        self.columns = [self.old.parameters.index(n) for n in self.space.names]
        self.free = ~models.recording.train[0].gripped
        self.shown = np.stack([t.markers for t in job.trials])[:, None] if job.trials else job.past[None]
        if job.trials:
            self.new = _model(models, job, (*job.rival.effects, *((_LOAD,) if job.load else ())))
            self.new_motion = self.new.motion(job.trials)

    def rows(self, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return numbers at coordinates (K,) and with each a little changed, shape (1 + K, N), and the changes (K,)."""
        moved = _moved(self.space, raw)
        values = np.repeat(self.rival.values[None], len(raw) + 1, 0)
        values[:, self.columns] = self.space.to_values(np.concatenate([raw[None], moved]))
        return values, np.diag(moved) - raw

    def simulate(self, raws: np.ndarray, first: bool) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the train trials (C, 1 + K, B, F, M, 3) and the motion of each of C rows of coordinates.

        Where all rows are the same (`first`), what is known of the train trials is taken.
        """
        sets = np.stack([self.rows(raw)[0] for raw in raws])
        count, own = sets.shape[:2]
        some = sets[0] if first else sets.reshape(count * own, -1)
        past = self.job.known[None]
        if not first:
            past = self.old.simulate(self.old_motion, self.job.past_start, some)
            past = past.reshape(count, own, *past.shape[1:])
        if not self.job.trials:
            return past, None
        loaded = np.concatenate([some, np.tile(self.job.load, (len(some), 1))], 1)
        sims = self.new.simulate(self.new_motion, tree.part(self.job.start), loaded)
        # All rows meet all motions; each row's own motion is kept.
        at = np.arange(count)
        each = np.moveaxis(sims, 1, 0) if first else sims.reshape(count, own, *sims.shape[1:])[at, :, at]
        return np.broadcast_to(past, (count, *past.shape[1:])), each[:, :, None]

    def run(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rival's numbers (C, N), and what is left in each motion [m], (C, B, F, M, 3)."""
        job, count = self.job, max(len(self.job.trials), 1)
        raws = np.repeat(self.space.to_raw(self.rival.values[self.columns])[None], count, 0)
        cost, reach = np.full(count, np.inf), np.ones(count)
        best, steps, left = raws.copy(), np.zeros_like(raws), np.full_like(self.shown, np.nan)
        for k in range(job.iterations + 1):
            past, new = self.simulate(raws, k == 0)
            for c in range(count):
                old_slope, old_left = self._linear(raws[c], past[c], job.past)
                gradient, gap = (old_slope, old_left) if new is None else self._linear(raws[c], new[c], self.shown[c])
                total = float(np.nansum(gap**2) + (0.0 if new is None else np.nansum(old_left**2)))
                if not np.isfinite(gap[..., self.free, :]).all() or total >= cost[c]:
                    reach[c] *= 0.3
                    raws[c] = self.space.clip(best[c] + reach[c] * steps[c])
                    continue
                cost[c], best[c], left[c], reach[c] = total, raws[c], gap, 1.0
                rows = [x.reshape(-1, x.shape[-1]) for x in ((old_slope,) if new is None else (old_slope, gradient))]
                gaps = [x.ravel() for x in ((old_left,) if new is None else (old_left, gap))]
                steps[c] = self._step(best[c], np.concatenate(rows), np.concatenate(gaps))
                raws[c] = self.space.clip(best[c] + steps[c])
                if not job.iterations:
                    left[c], best[c] = gap + gradient @ steps[c], raws[c]
        values = np.repeat(self.rival.values[None], count, 0)
        values[:, self.columns] = self.space.to_values(best)
        return values, left

    def _linear(self, raw: np.ndarray, sims: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradients (B, F, M, 3, K) and differences (B, F, M, 3) [m], NaN at grippers."""
        change = self.rows(raw)[1]
        left = np.where(self.free[:, None], sims[0] - shown, np.nan)
        return np.moveaxis(sims[1:] - sims[0], 0, -1) / change, left

    def _step(self, raw: np.ndarray, gradient: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return by how much numbers move to follow, within their bounds."""
        good = np.isfinite(left) & np.isfinite(gradient).all(1)
        low, high = (self.space.clip(raw + s * self.space.limits()) - raw for s in (-1, 1))
        turning = np.array([p.periodic for p in self.space.params])
        low, high = np.where(turning, -1.0, low), np.where(turning, 1.0, high)
        q, r = np.linalg.qr(gradient[good])
        return lsq_linear(r, -(q.T @ left[good]), bounds=(np.minimum(low, -1e-9), np.maximum(high, 1e-9))).x


def _follow(models: Models, job: _Follow) -> tuple[np.ndarray, np.ndarray]:
    return _Chase(models, job).run()


class ModelDiscrimination:
    """Rival models of one recording."""

    def __init__(
        self, bench: Workspace, models: dict[str, Fitted], rig: GripperLimits, seconds: float, noise: float
    ) -> None:
        """Prepare.

        Args:
            bench: the trials at hand, with their starts.
            models: the rivals by their names, fitted to the train trials.
            rig: what the grippers can do.
            seconds: how long a new trial lasts.
            noise: of the markers, per coordinate [m].
        """
        self.bench, self.models, self.rig, self.seconds, self.noise = bench, models, rig, seconds, noise
        self.pairs = list(itertools.permutations(models, 2))
        self._past: dict[str, np.ndarray] = {}

    def prepare(self, report: Callback) -> None:
        """Simulate the trials at hand with every model, and with each of its numbers a little changed."""
        names, stage, jobs = list(self.models), "what competing models say of the recording", []
        for model in self.models.values():
            columns = [self.bench.pool.local.model(model.effects).parameters.index(n) for n in model.space.names]
            raw = model.space.to_raw(model.values[columns])
            rows = np.repeat(model.values[None], len(raw) + 1, 0)
            rows[1:, columns] = model.space.to_values(_moved(model.space, raw))
            jobs.append(SimulationJob(model.effects, rows, "train", self.bench.starts["train"]))
        for done, (k, sims) in enumerate(self.bench.pool.simulate(jobs), 1):
            self._past[names[k]] = sims
            report(stage, done, len(jobs), "")

    def _load(self, mass: float) -> tuple[float, ...]:
        """Return the numbers of a mass on the rope: at the free end, or in the middle between two grippers."""
        if not mass:
            return ()
        recording = self.bench.recording
        place = {"position": recording.length * (0.5 if recording.train[0].gripped[-1] else 1.0), "mass": mass}
        return tuple(place[n.which.number] for n in effect_library.numbers(_LOAD, recording))

    def _trials(self, gestures: Sequence[ExcitationMotion], shown: np.ndarray | None = None) -> tuple[Trial, ...]:
        """Return motions as trials, with markers as given."""
        trials = [
            excitation_motions.motion_trial(self.rig, g, self.seconds, f"train_{k}") for k, g in enumerate(gestures)
        ]
        if shown is None:
            return tuple(trials)
        free = ~self.rig.trial.gripped[:, None]
        return tuple(replace(t, markers=np.where(free, x, t.markers)) for t, x in zip(trials, shown, strict=True))

    def _showing(self, gestures: Sequence[ExcitationMotion], name: str) -> _Play:
        """Return the job of simulating motions with a model; all have the same mass."""
        model, load = self.models[name], self._load(gestures[0].mass)
        effects = (*model.effects, *((_LOAD,) if load else ()))
        values = np.concatenate([model.values, load])[None]
        return _Play(self._trials(gestures), effects, values, excitation_motions.first_pose(self.rig, gestures))

    def judge(
        self, gestures: Sequence[ExcitationMotion], iterations: int, report: Callback, stage: str
    ) -> list[list[Pair]]:
        """Return what is left between each pair in each motion.

        Args:
            gestures: the motions.
            iterations: steps of the rivals' fits that are checked by simulation; 0 for one that is not.
            report: told how it goes.
            stage: what it is called.
        """
        found: dict[tuple[int, int], Pair] = {}
        loads, names = sorted({g.mass for g in gestures}), list(self.models)
        total, done, said = len(loads) * (len(names) + len(self.pairs)), 0, f"{len(gestures)} motions"
        report(stage, 0, total, said)
        for mass in loads:
            rows = [k for k, g in enumerate(gestures) if g.mass == mass]
            some, shown = [gestures[k] for k in rows], {}
            for k, sims in self.bench.pool.run(_play, [self._showing(some, n) for n in names]):
                shown[names[k]], done = sims[0], done + 1
                report(stage, done, total, said)
            start, load = excitation_motions.first_pose(self.rig, some), self._load(mass)
            jobs = [self._chase(a, b, load, self._trials(some, shown[a]), start, iterations) for a, b in self.pairs]
            for p, (values, left) in self.bench.pool.run(_follow, jobs):
                for row, v, gap, seen in zip(rows, values, left, shown[self.pairs[p][0]], strict=True):
                    found[row, p] = Pair(*self.pairs[p], seen[None], gap, v)
                done += 1
                report(stage, done, total, said)
        return [[found[k, p] for p in range(len(self.pairs))] for k in range(len(gestures))]

    def present(self, iterations: int, report: Callback, stage: str) -> list[Pair]:
        """Return what is left between each pair in the trials at hand."""
        jobs, found = [self._chase(a, b, (), (), None, iterations) for a, b in self.pairs], {}
        report(stage, 0, len(jobs), "")
        for p, (values, left) in self.bench.pool.run(_follow, jobs):
            found[p] = Pair(*self.pairs[p], self._past[self.pairs[p][0]][0], left[0], values[0])
            report(stage, len(found), len(jobs), "")
        return [found[p] for p in range(len(jobs))]

    def _chase(
        self,
        truth: str,
        rival: str,
        load: tuple[float, ...],
        trials: tuple[Trial, ...],
        start: Start | None,
        iterations: int,
    ) -> _Follow:
        past, begin = self._past[truth][0], self.bench.starts["train"]
        return _Follow(self.models[rival], load, self._past[rival], past, begin, trials, start, iterations)

    def worst(self, pairs: Sequence[Pair]) -> float:
        """Return the smallest distance over pairs [noise]; NaN where a model fails."""
        return float(np.min([rms_size(p.left) for p in pairs])) / self.noise


def _moved(space: ParameterSpace, raw: np.ndarray) -> np.ndarray:
    """Return coordinates with each one a little changed, inwards where it stands at a bound, shape (K, K)."""
    nudge = np.diag(space.nudges())
    upward = space.clip(raw + nudge)
    return np.where(np.isclose(upward, raw + nudge), upward, raw - nudge)


def rms_size(left: np.ndarray) -> float:
    """Return the root mean square of what is seen; NaN for nothing."""
    return float(np.sqrt(np.nanmean(np.square(left)))) if np.isfinite(left).any() else float("nan")


def measured_misfit(models: dict[str, Fitted], bench: Workspace) -> dict[str, float]:
    """Return how far each model is from the train trials, root mean square per coordinate [m]."""
    bench.predict(list(models.values()))
    return {n: float(np.sqrt(np.mean(bench.gaps(m, "train") ** 2))) for n, m in models.items()}
