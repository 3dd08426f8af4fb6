"""What a search works on: what is known of a recording, a value that every stage returns anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis import error_floor as floors
from torchdlo.sysid.diagnosis.predictions import Predictions
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import PointEvaluation, cost_of, drift, extent
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model import initial_state
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial

Callback = Callable[[str, int, int, str], None]
"""Called with stage, steps done, steps in all, and a word on how it goes."""

SILENT = 1.3
"""Times the floor: below, there is nothing left to look for."""

_ASTRAY = 3.0
"""Times the gap of another model from which a simulation has gone astray."""

_TIE = 0.05
"""Share of what fits save by which their costs have to differ to be told apart,"""

_CLOSE = 0.5
"""if not by this share of what is left, or of what noise costs."""

CHAIN = "link_chain"
"""What a chain of links does that a rope does not: candidate number 0, fitted before any effect is considered."""


@dataclass(frozen=True, eq=False)
class Workspace:
    """What is known of a recording at one stage of a search; each method that learns something returns a new one."""

    pool: Pool
    """Simulates, with the options that models have from here on."""
    start: Start | None = None
    """Where all trials begin, and how simulations that begin there are corrected; not known before `begin`."""
    refinement: floors.Refinement | None = None
    """What finer steps and a finer mesh change, as far as it is known."""
    discounted: Mapping[str, int] = field(default_factory=dict)
    """Train trials that count up to a frame only, by their names."""
    early: np.ndarray = field(default_factory=lambda: np.empty(0))
    """The baseline's numbers that fit the beginning of the trials, as far as they are known."""
    linked: bool = True
    """Whether the rope may move like a chain of links, as far as the baseline tells."""
    predictions: Predictions = field(default_factory=Predictions)
    """A cache, which all workspaces of a search share."""

    @property
    def recording(self) -> Recording:
        """What was measured."""
        return self.pool.recording

    @cached_property
    def trials(self) -> dict[str, tuple[Trial, ...]]:
        """Trials by split: "train", "test", "all"."""
        return {split: self.recording.trials(split) for split in ("train", "test", "all")}

    @cached_property
    def starts(self) -> dict[str, Start]:
        """Where the trials of each split begin, and what their frames count, as many as its longest trial has."""
        weights, rows, count = self._judged[0], np.arange(len(self.trials["all"])), len(self.trials["train"])
        if weights is not None:
            weights = weights.copy()
            for k, trial in enumerate(self.trials["train"]):
                weights[k, self.discounted.get(trial.name, weights.shape[1]) :] = 0.0
        found = {"all": replace(tree.part(self.start), frame_weights=weights)}
        for split, part in (("train", rows[:count]), ("test", rows[count:])):
            own = None if weights is None else weights[part, : self._frames(split)]
            found[split] = replace(found["all"].pick(part), frame_weights=own)
        return found

    def _frames(self, split: str) -> int:
        """Return how many frames the longest trial of a split has."""
        return max((len(t.time) for t in self.trials[split]), default=0)

    @cached_property
    def floor(self) -> floors.ErrorFloor:
        """What no effect explains, on the test trials; infinite as long as it is not known."""
        if self.refinement is None:
            return floors.ErrorFloor(floors.marker_noise(self.recording), float("inf"), float("inf"))
        return self.refinement.floor(slice(len(self.trials["train"]), None), ~self.trials["all"][0].gripped)

    @property
    def level(self) -> float:
        """What `gaps` are for a perfect model [m]; infinite as long as it is not known."""
        return self._judged[1]

    @cached_property
    def _judged(self) -> tuple[np.ndarray | None, float]:
        """What errors of frames count (B, F), apart from what is discounted, and `level`."""
        if self.refinement is None:
            return None, float("inf")
        return self.refinement.frame_weights(~self.trials["all"][0].gripped)

    def with_options(self, options: Mapping[str, Any]) -> Workspace:
        """Give all models these options."""
        pool = self.pool.with_options(**options)
        return self if pool is self.pool else replace(self, pool=pool)

    def begin(self, base: np.ndarray, effects: Sequence[str]) -> Workspace:
        """Estimate where trials begin with these numbers."""
        model = self.pool.local.model(effects)
        first = initial_state.begin(model, self.trials["all"])
        simulate = self.pool.simulator(effects, "all")
        start = initial_state.refine(model, self.pool.local.motion(model, "all"), first, base, simulate)
        return replace(self, start=start, refinement=None)

    def correct(self, base: Fitted) -> Workspace:
        """Correct simulations by what finer steps and a finer mesh change of this model."""
        return self.use(floors.refine(self.pool, base, self.starts["all"], CHAIN))

    def use(self, found: floors.Refinement) -> Workspace:
        """Correct simulations by this."""
        start = replace(tree.part(self.start), discretisation_correction=found.correction)
        return replace(self, start=start, refinement=found)

    def discount(self, frames: Mapping[str, int]) -> Workspace:
        """Let train trials count up to a frame only, by their names."""
        return replace(self, discounted={**self.discounted, **frames})

    def predict(self, fits: Sequence[Fitted]) -> None:
        """Simulate all trials with several models at once, for `gaps` and `prediction` to look up."""
        self.predictions.of(self.pool, tree.part(self.start), fits)

    def prediction(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return the simulated markers of the trials of a split, shape (B, F, M, 3)."""
        return self.readings(fitted, split)[..., : len(self.recording.train[0].marker_arclength), :]

    def readings(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return likewise what is simulated, with forces behind the markers where they count, shape (B, F, R, 3)."""
        (sims,) = self.predictions.of(self.pool, tree.part(self.start), [fitted])
        first = len(self.trials["train"])
        rows = {"train": slice(first), "test": slice(first, None), "all": slice(None)}[split]
        return sims[rows, : self._frames(split)]

    def gaps(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return the gap of each trial of a split [m], frames weighted by what they tell."""
        return floors.trial_gaps(self.prediction(fitted, split), self.trials[split], self.starts[split].frame_weights)

    def diverged(self, fitted: Fitted, before: np.ndarray) -> bool:
        """Return whether a model goes astray in a trial whose gap another one kept as small as `before` [m], (B,)."""
        return not bool((self.gaps(fitted, "all") < _ASTRAY * np.maximum(before, self.level)).all())

    def tie(self, worse: float, best: float) -> float:
        """Return the difference in cost up to which fits are not told apart [m].

        Args:
            worse: cost of the model without what they have in common.
            best: cost of the best of them.
        """
        noise = cost_of(self.level) if np.isfinite(self.level) else np.inf
        return max(min(_TIE * (worse - best), _CLOSE * max(noise, best)), 1e-12)

    def extension(
        self, base: Fitted, score: Score, numbers: Sequence[str], iterations: int, frames: int | None
    ) -> FitJob:
        """Return the job of fitting a model with one effect more, from the best of several starts.

        Args:
            base: the model.
            score: the effect, with the doses that suit best.
            numbers: which of the effect's numbers to fit, besides those of the model.
            iterations: most iterations.
            frames: how many frames to fit; all if None.
        """
        effects, space = (*base.effects, score.name), base.space
        model, count = self.pool.local.model(effects), len(score.starts)
        columns = [model.parameters.index(n) for n in space.names]
        values = np.repeat(model.guess()[None], 2 * count, 0)
        values[:, : len(base.values)] = base.values
        for k, (dose, raw) in enumerate(score.starts):
            values[k, columns] = space.to_values(space.clip(raw))
            # What fitted the beginning alone had less to make up for.
            values[count + k, : len(self.early)] = self.early
            for name, value in dose.items():
                values[k::count, model.parameters.index(name)] = value
        free, sizes = (*space.names, *numbers), (*space.units, *(score.sizes[n] for n in numbers))
        return FitJob(effects, values, free, sizes, iterations, self.starts["train"], frames, 1, base.options)

    def reduction(self, fitted: Fitted, name: str, plain: Fitted, iterations: int) -> FitJob:
        """Return the job of fitting a model without one of its effects, from the best of several starts.

        Args:
            fitted: the model.
            name: the effect to leave out.
            plain: the baseline, whose numbers may be nearer than those that made up for the effect.
            iterations: most iterations.
        """
        keep = [k for k, n in enumerate(fitted.space.names) if ParameterName.parse(n).effect != name]
        whole = self.pool.local.model(fitted.effects).parameters
        left = [k for k, n in enumerate(whole) if ParameterName.parse(n).effect != name]
        names = tuple(fitted.space.names[k] for k in keep)
        sizes = tuple(fitted.space.units[k] for k in keep)
        effects, values = tuple(e for e in fitted.effects if e != name), np.repeat(fitted.values[None, left], 3, 0)
        for row, numbers in zip(values[1:], (plain.values, self.early), strict=True):
            row[: len(self.early)] = numbers[: len(self.early)]
        return FitJob(effects, values, names, sizes, iterations, self.starts["train"], keep=2)

    def exchange(self, fitted: Fitted, general: str, special: str, iterations: int) -> FitJob:
        """Return the job of fitting a model in which a special law takes the place of one that contains it.

        Args:
            fitted: the model.
            general: one of its effects.
            special: another one, whose numbers have the same names there, as far as it has them.
            iterations: most iterations.
        """

        def named(text: str) -> str:
            name = ParameterName.parse(text)
            return str(replace(name, effect=special) if name.effect == general else name)

        effects = tuple(special if e == general else e for e in fitted.effects)
        model, before = self.pool.local.model(effects), self.pool.local.model(fitted.effects).parameters
        values = dict(zip(map(named, before), fitted.values, strict=True))
        units = dict(zip(map(named, fitted.space.names), fitted.space.units, strict=True))
        # Of another name there, as the drag coefficient of a liquid is: it begins as it is declared.
        lacking = {
            n.name: n.param.scalar for n in effect_library.numbers(special, self.recording) if n.name not in values
        }
        values, units = values | lacking, units | {name: abs(value) or 1.0 for name, value in lacking.items()}
        names, first = tuple(n for n in units if n in model.parameters), [values[n] for n in model.parameters]
        sizes, start = tuple(units[n] for n in names), self.starts["train"]
        return FitJob(effects, np.array([first]), names, sizes, iterations, start, options=fitted.options)

    def further(self, found: Fitted, iterations: int, frames: int | None = None) -> FitJob:
        """Return the job of fitting on."""
        space, start = found.space, self.starts["train"]
        values, sizes = found.values[None], tuple(space.units)
        return FitJob(found.effects, values, space.names, sizes, iterations, start, frames, None, found.options)

    def drift(
        self, fitted: Fitted, others: Sequence[np.ndarray] = (), shares: tuple[float, float] = (1.0, 2.0)
    ) -> np.ndarray:
        """Return what simulations get wrong by their steps and by their mesh in a fit's coordinates, shape (2 + E, K).

        Args:
            fitted: the fit.
            others: further ways in which simulations of the train trials may be wrong [m], shape (B, F, M, 3) each.
            shares: how much of what was extrapolated for steps and mesh may be wrong. Next to clamps the mesh's error
                may be of first order: extrapolating to that would change twice as much.
        """
        look, start = PointEvaluation(fitted.space, fitted.point.raw[None]), self.starts["train"]
        model = self.pool.local.model(fitted.effects)
        rows = np.repeat(fitted.values[None], len(look.values), 0)
        rows[:, [model.parameters.index(n) for n in fitted.space.names]] = look.values
        ((_, sims),) = self.pool.simulate([SimulationJob(fitted.effects, rows, "train", start, fitted.options)])
        frame_weights = 1.0 if start.frame_weights is None else start.frame_weights[..., None, None]
        measured = self.pool.local.measured(model, "train")
        step, grid = (e[: len(measured), : measured.shape[1]] for e in tree.part(self.refinement).unsure)
        # What is wrong with forces is not known.
        behind = ((0, 0), (0, 0), (0, measured.shape[2] - model.count), (0, 0))
        errors = [
            frame_weights * np.pad(np.nan_to_num(e), behind) for e in (shares[0] * step, shares[1] * grid, *others)
        ]
        whole = extent(frame_weights * measured[..., : model.count, :])
        return drift(look, frame_weights * sims, frame_weights * measured, errors, whole)

    def fit(self, jobs: Sequence[FitJob]) -> list[Fitted]:
        """Return the results of fits in their order.

        Raises:
            InputError: No simulation ran through.
        """
        found = [f for _, f in sorted(self.pool.fit(jobs), key=lambda pair: pair[0])]
        if not np.isfinite(min(f.point.cost for f in found)):
            raise InputError(
                f"{self.recording.path}: the simulation failed on the train trials from every start; check length, "
                "mass and marker_arclength, or use fewer vertices."
            )
        return found
