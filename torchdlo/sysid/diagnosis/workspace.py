"""What a search works on: the trials of a recording, where they begin, and what models say of them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import error_floor as floors
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import PointEvaluation, cost_of, drift, extent
from torchdlo.sysid.estimation.worker_pool import Pool, spread_jobs
from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model.trial_batch import Start

Callback = Callable[[str, int, int, str], None]
"""Called with stage, steps done, steps in all, and a word on how it goes."""

SILENT = 1.3
"""Times the floor: below, there is nothing left to look for."""

_ASTRAY = 3.0
"""Times the gap of another model from which a simulation has gone astray."""

_TORN = 0.1
"""Share of the rope's length by which markers may be further apart than along it: a simulated rope that is torn
further has missed what happened within a step."""

_FINER = 4
"""How many times shorter the steps are with which such a trial is simulated once more."""

_TIE = 0.05
"""Share of what fits save by which their costs have to differ to be told apart,"""

_CLOSE = 0.5
"""if not by this share of what is left, or of what noise costs."""

CHAIN = "link_chain"
"""What a chain of links does that a rope does not: candidate number 0, fitted before any effect is considered."""


def _key(fitted: Fitted) -> Hashable:
    return fitted.effects, fitted.options, fitted.values.tobytes()


def torn_apart(sims: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Return which trials of simulated markers (B, F, M, 3), at places (M,) along the rope [m], tear it; shape (B,)."""
    apart = np.linalg.norm(np.diff(sims, axis=2), axis=3) - np.diff(arclength)
    return ~(apart <= _TORN * (arclength[-1] - arclength[0])).all((1, 2))


class Workspace:
    """Trials, their starts and the predictions that were asked for."""

    def __init__(self, pool: Pool) -> None:
        self.pool, self.recording = pool, pool.recording
        self.trials = {split: self.recording.trials(split) for split in ("train", "test", "all")}
        self.starts: dict[str, Start] = {}
        self.early = np.empty(0)
        """The baseline's numbers that fit the beginning of the trials, as far as they are known."""
        self.linked = True
        """Whether the rope may move like a chain of links, as far as the baseline tells."""
        self.floor = floors.ErrorFloor(floors.marker_noise(self.recording), float("inf"), float("inf"))
        """What no effect explains, on the test trials, as far as it is known."""
        self.level = float("inf")
        """What `gaps` are for a perfect model [m]."""
        self.mended: set[str] = set()
        """Trials that were simulated once more in finer steps."""
        self.discounted: dict[str, int] = {}
        """Train trials that count up to a frame only."""
        self._finer: floors.Refinement | None = None
        self._known: dict[Hashable, np.ndarray] = {}

    def begin(self, base: np.ndarray, effects: Sequence[str]) -> None:
        """Estimate where trials begin with these numbers."""
        model = self.pool.local.model(effects)
        first = starts.begin(model, self.trials["all"])
        simulate = self.pool.simulator(effects, "all")
        start = starts.refine(model, self.pool.local.motion(model, "all"), first, base, simulate)
        train = np.arange(len(self.trials["train"]))
        test = np.arange(len(train), len(self.trials["all"]))
        self.starts = {"all": start, "train": start.pick(train), "test": start.pick(test)}

    def correct(self, base: Fitted) -> floors.Refinement:
        """Correct simulations from now on by what finer steps and a finer mesh change of this model; return that."""
        found = floors.refine(self.pool, base, self.starts["all"], CHAIN)
        self.use(found)
        return found

    def use(self, found: floors.Refinement) -> None:
        """Correct simulations from now on by this."""
        train, free = len(self.trials["train"]), ~self.trials["all"][0].gripped
        self.floor, self._finer = found.floor(slice(train, None), free), found
        frame_weights, self.level = found.frame_weights(free)
        frame_weights = self._discounted(frame_weights)
        start = replace(self.starts["all"], discretisation_correction=found.correction, frame_weights=frame_weights)
        rows = np.arange(len(start.pos))
        self.starts = {"all": start, "train": start.pick(rows[:train]), "test": start.pick(rows[train:])}
        self._known.clear()

    def discount(self, frames: dict[str, int]) -> None:
        """Let train trials count up to a frame only, by their names, from now on."""
        self.discounted |= frames
        frame_weights = self._discounted(tree.part(self.starts["all"].frame_weights))
        rows, train = np.arange(len(self.trials["all"])), len(self.trials["train"])
        start = replace(self.starts["all"], frame_weights=frame_weights)
        self.starts = {"all": start, "train": start.pick(rows[:train]), "test": start.pick(rows[train:])}

    def _discounted(self, frame_weights: np.ndarray) -> np.ndarray:
        """Return what errors of frames count (B, F), nothing of what is discounted."""
        found = frame_weights.copy()
        for k, trial in enumerate(self.trials["train"]):
            found[k, self.discounted.get(trial.name, found.shape[1]) :] = 0.0
        return found

    def forget(self) -> None:
        """Forget predictions that were made with other readings."""
        self._known.clear()

    def predict(self, fits: Sequence[Fitted]) -> None:
        """Simulate all trials with several models at once, for `gaps` and `prediction` to look up."""
        new = [f for f in fits if _key(f) not in self._known]
        # Models that settle twists take longer than others, which all fit into one batch.
        kinds = [(self.pool.local.framed(f.effects), f.options) for f in new]
        groups = [[new[k] for k in group] for group in spread_jobs(kinds, self.pool.workers)]
        for k, sims in self.pool.simulate([self.pool.local.joined(g, "all", self.starts["all"]) for g in groups]):
            self._known |= {_key(f): sim for f, sim in zip(groups[k], sims, strict=True)}
        for fitted in new:
            self._mend(fitted, self._known[_key(fitted)])

    def _mend(self, fitted: Fitted, sims: np.ndarray) -> None:
        """Simulate the trials in which the rope was torn apart once more, in finer steps, into (B, F, M, 3)."""
        model = self.pool.local.model(fitted.effects, fitted.options)
        torn = np.flatnonzero(torn_apart(sims[..., : model.count, :], model.mesh.marker_arclength))
        if not len(torn):
            return
        options = dict(fitted.options) | {"substep": model.dt / (_FINER * model.substeps)}
        names = tuple(self.trials["all"][k].name for k in torn)
        start = replace(self.starts["all"].pick(torn), discretisation_correction=None)
        job = SimulationJob(fitted.effects, fitted.values[None], names, start, tuple(options.items()))
        ((_, again),) = self.pool.simulate([job])
        sims[torn, : again.shape[2]] = again[0]
        self.mended |= set(names)

    def notes(self) -> list[str]:
        """Return sentences on the simulations that a reader should know."""
        if not self.mended:
            return []
        return [
            f"Simulated ropes were torn apart in {', '.join(sorted(self.mended))}, by some model at least; they were "
            f"simulated once more there in steps of a {_FINER}th."
        ]

    def prediction(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return the simulated markers of the trials of a split, shape (B, F, M, 3)."""
        return self.readings(fitted, split)[..., : len(self.recording.train[0].marker_arclength), :]

    def readings(self, fitted: Fitted, split: str) -> np.ndarray:
        """Return likewise what is simulated, with forces behind the markers where they count, shape (B, F, R, 3)."""
        self.predict([fitted])
        first = len(self.trials["train"])
        return self._known[_key(fitted)][{"train": slice(first), "test": slice(first, None), "all": slice(None)}[split]]

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
            special: another one, whose numbers have the same names there.
            iterations: most iterations.
        """

        def named(text: str) -> str:
            name = ParameterName.parse(text)
            return str(replace(name, effect=special) if name.effect == general else name)

        effects = tuple(special if e == general else e for e in fitted.effects)
        model, before = self.pool.local.model(effects), self.pool.local.model(fitted.effects).parameters
        values = dict(zip(map(named, before), fitted.values, strict=True))
        units = dict(zip(map(named, fitted.space.names), fitted.space.units, strict=True))
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
        step, grid = (e[: len(measured)] for e in tree.part(self._finer).unsure)
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
