"""Simulations and fits of many models, as jobs, and the models that do them."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchdlo.physics import tree
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model.grip_wrench import measured_wrench, packed
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start, TrialBatch
from torchdlo.sysid.recordings.recording import Recording


@dataclass(frozen=True, eq=False)
class SimulationJob:
    """Parameter sets to simulate."""

    effects: tuple[str, ...]
    """Effects of the model."""
    values: np.ndarray
    """Parameter sets in the order of the model's numbers, shape (P, K)."""
    split: str | tuple[str, ...] = "train"
    """Trials: "train", "test", "all", or their names."""
    start: Start | None = None
    """Where the trials begin; read off them if not given."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of `RopeModel` that differ from those of the pool."""
    frames: int | None = None
    """How many frames to simulate; all if not given."""


@dataclass(frozen=True, eq=False)
class FitJob:
    """Numbers to fit to the train trials."""

    effects: tuple[str, ...]
    """Effects of the model."""
    values: np.ndarray
    """Where to start, in the order of the model's numbers, shape (S, K)."""
    free: tuple[str, ...]
    """Numbers to fit; the others stay as they are in the first start."""
    sizes: tuple[float, ...]
    """What counts as much of each of them, see `ParameterSpace`."""
    iterations: int
    """Most iterations."""
    start: Start | None = None
    """Where the trials begin; read off them if not given."""
    frames: int | None = None
    """How many frames to fit; all if not given."""
    keep: int | None = None
    """With how many of the starts, the best, to go on; all if not given."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of `RopeModel` that differ from those of the pool."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit found."""

    effects: tuple[str, ...]
    """Effects of the model."""
    values: np.ndarray
    """Best numbers, in the order of the model's, shape (K,)."""
    space: ParameterSpace
    """The numbers that were fitted."""
    point: Point
    """Their coordinates, with costs and gradients."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of `RopeModel` that differ from those of the pool."""


_Search = Generator[np.ndarray, np.ndarray, Fitted]
"""Yields parameter sets (P, K) of its model, takes their simulations (P, B, F, M, 3)."""

Search = Generator[SimulationJob, np.ndarray, Any]
"""Yields simulations, takes their markers."""


class Models:
    """Models of one process by their effects and options."""

    def __init__(self, recording: Recording, options: dict[str, Any]) -> None:
        self.recording, self.options = recording, options
        self._models: dict[Any, RopeModel] = {}
        self._motions: dict[Any, TrialBatch] = {}

    def model(self, effects: Sequence[str], options: tuple[tuple[str, Any], ...] = ()) -> RopeModel:
        """Return the model with these effects."""
        key = (tuple(effects), options)
        if key not in self._models:
            self._models[key] = RopeModel(self.recording, effects=effects, **(self.options | dict(options)))
        return self._models[key]

    def motion(self, model: RopeModel, split: str | tuple[str, ...]) -> TrialBatch:
        """Return the motion of the trials of a split."""
        key = (split, model.substeps, len(model.arclength))
        if key not in self._motions:
            self._motions[key] = model.motion(self.recording.trials(split))
        return self._motions[key]

    def measured(self, model: RopeModel, split: str | tuple[str, ...]) -> np.ndarray:
        """Return what was measured of the trials of a split as the model simulates it, shape (B, F, R, 3) [m]."""
        markers, worth = self.motion(model, split).markers, model.force_worth
        if worth is None:
            return markers
        sensor, trials = tree.part(self.recording.wrench), self.recording.trials(split)
        return packed(markers, measured_wrench(trials, sensor, markers.shape[1], len(model.grips)), worth)

    def simulate(self, job: SimulationJob, part: int = 0, parts: int = 1) -> np.ndarray:
        """Return what `RopeModel.simulate` does, shape (P, B, F, R, 3) [m].

        Of one of several parts, return those of its P B / parts scenes.
        """
        model = self.model(job.effects, job.options)
        start = job.start or starts.begin(model, self.recording.trials(job.split))
        motion = self.motion(model, job.split)
        if parts == 1:
            return model.simulate(motion, start, job.values, frames=job.frames)
        rows = np.array_split(np.arange(len(job.values) * len(motion.names)), parts)[part]
        return model.scenes(motion, start, job.values, rows, frames=job.frames)

    def search(self, jobs: Sequence[FitJob]) -> Search:
        """Ask for what several fits with the same start, frames and options need, together; return their results."""
        options = jobs[0].options
        model = self.model(_all(jobs), options)
        measured = self.measured(model, "train")[:, : jobs[0].frames]
        start = jobs[0].start or starts.begin(model, self.recording.train)
        frame_weights = 1.0 if start.frame_weights is None else start.frame_weights[:, : jobs[0].frames, None, None]
        searches = []
        for job in jobs:
            own = self.model(job.effects, options)
            columns = [own.parameters.index(name) for name in job.free]
            space = ParameterSpace(job.free, tuple(own.params[k] for k in columns), job.sizes)
            searches.append(_search(job, space, columns, measured, frame_weights, model.count))
        found: dict[int, Fitted] = {}
        asked = {k: next(search) for k, search in enumerate(searches)}
        while asked:
            # Each effect costs in all scenes: those of fits that have ended are left out.
            model = self.model(_all([jobs[k] for k in asked]), options)
            places = {k: _places(model, self.model(jobs[k].effects, options)) for k in asked}
            rows = [_filled(model.guess(), places[k], values) for k, values in asked.items()]
            sims = yield SimulationJob(model.effects, np.concatenate(rows), "train", start, options, jobs[0].frames)
            ends = np.cumsum([len(r) for r in rows])[:-1]
            for k, sim in zip(list(asked), np.split(sims, ends), strict=True):
                try:
                    asked[k] = searches[k].send(sim)
                except StopIteration as end:
                    found[k] = replace(end.value, options=options)
                    del asked[k]
        return tuple(found[k] for k in range(len(jobs)))

    def framed(self, effects: Sequence[str]) -> bool:
        """Return whether twists have to be searched for in a model with these effects, which takes longer."""
        laws = [effect_library.instance(e, self.model(()).mesh) for e in effects]
        return any(law.frame_bending or law.is_quasistatic for law in laws)

    def joined(self, fits: Sequence[Fitted], split: str, start: Start) -> SimulationJob:
        """Return one job that simulates several fits with the same options, by a model that has the effects of all."""
        options = fits[0].options
        model = self.model(_all(fits), options)
        owns = [_places(model, self.model(f.effects, options)) for f in fits]
        rows = [_filled(model.guess(), own, f.values[None]) for own, f in zip(owns, fits, strict=True)]
        return SimulationJob(model.effects, np.concatenate(rows), split, start, options)


def _all(models: Sequence[FitJob] | Sequence[Fitted]) -> tuple[str, ...]:
    """Return the effects that any of several models has."""
    return tuple(dict.fromkeys(e for model in models for e in model.effects))


def _places(model: RopeModel, own: RopeModel) -> list[int]:
    """Return where the numbers of a model with some of the effects are among those of a model with all."""
    return [model.parameters.index(name) for name in own.parameters]


def _filled(guess: np.ndarray, places: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Return values of some numbers (P, K) among all; the others do nothing."""
    full = np.repeat(guess[None], len(values), 0)
    full[:, places] = values
    return full


def _search(
    job: FitJob,
    space: ParameterSpace,
    columns: Sequence[int],
    measured: np.ndarray,
    frame_weights: np.ndarray | float,
    markers: int,
) -> _Search:
    """Fit: yield parameter sets (P, K) of the job's model, take their simulations, return the best.

    Readings (..., B, F, R, 3), measured and simulated, are multiplied by what they are trusted, (B, F, 1, 1). The first
    of them, `markers`, are places.
    """
    measured = frame_weights * measured
    whole = levenberg_marquardt.extent(measured[..., :markers, :])

    def full(values: np.ndarray) -> np.ndarray:
        return _filled(job.values[0], columns, values)

    raws = space.clip(space.to_raw(job.values[:, columns]))
    if job.keep is not None:
        costs = levenberg_marquardt.costs(frame_weights * (yield full(space.to_values(raws))), measured, whole)
        raws = raws[np.argsort(costs)[: job.keep]]
    look = levenberg_marquardt.PointEvaluation(space, raws)
    climb = levenberg_marquardt.Climb(space, look.points(frame_weights * (yield full(look.values)), measured, whole))
    for _ in range(job.iterations):
        tries = climb.tries()
        if not len(tries):
            break
        look = levenberg_marquardt.PointEvaluation(space, tries)
        climb.take(look.points(frame_weights * (yield full(look.values)), measured, whole))
    best = min(climb.points, key=lambda p: p.cost)
    return Fitted(job.effects, full(space.to_values(best.raw)[None])[0], space, best)
