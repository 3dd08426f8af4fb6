"""The problem of fitting a model to films: what is simulated, where it begins, and what is read of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis.error_floor import Refinement, refinement
from torchdlo.sysid.diagnosis.misleading_trials import MisleadingTrial
from torchdlo.sysid.diagnosis.workspace import CHAIN
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import KNEE, ParameterSpace
from torchdlo.sysid.estimation.observation import INDEPENDENT, SURE, FilmView, Spines
from torchdlo.sysid.model import equilibrium
from torchdlo.sysid.model.length_projection import lay_rope
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start, TrialBatch
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.trivial_predictors import catenary

__all__ = [
    "STRETCHES",
    "FilmedProblem",
    "add_correction",
    "begin_from_balance",
    "correct",
    "filmed_problem",
    "first_frames",
    "start_of",
    "without_rest",
]

STRETCHES = 14
"""Stretches along a rope at rest, in each of which what a model gets wrong is one and the same error."""

_CALM = 0.03
"""Speed of a gripper below which it is at rest [m/s]."""

_REACH = np.array([[0.03] * 3, [0.3] * 3])
"""How far shapes [m] and speeds [m/s] at the start usually are from those of a rope at rest that is carried along, by
axis."""

_ON_TABLE = np.array([2.0, 2.0, 0.3])
"""Times as far as that along a table and above it: a rope there may lie anywhere, but it lies there."""


@dataclass(eq=False)
class FilmedProblem:
    """A model, trials, and what films show of them."""

    model: RopeModel
    trials: tuple[Trial, ...]
    motion: TrialBatch
    spines: Spines
    start: Start
    free: tuple[int, ...]
    """Columns of the model's numbers that are fitted."""
    fixed: np.ndarray
    """All of the model's numbers, shape (K,)."""
    dropped: dict[str, list[int]]
    """Wrong frames by trial and camera."""
    options: dict[str, Any] = field(default_factory=dict)
    """Of the model."""
    misleading: tuple[MisleadingTrial, ...] = ()
    """Trials that count up to a time only, as no fit follows them further."""
    discretisation_correction: Refinement | None = None
    """What finer simulations change, if it is known."""
    offset: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """How starts differ from `start`, in standard deviations of what is expected of that: coefficients of smooth shapes
    of positions and velocities, shape (B, J); no columns where all trials begin at rest."""
    shapes: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """Those smooth shapes at the places of the rope, of size one, shape (M, J / 6)."""
    shown: Start | None = None
    """Where trials in motion begin as their first pictures show it, see `moved`, if these were looked at."""
    sizes: dict[str, float] = field(default_factory=dict)
    """What counts as much of some numbers, in the terms of their scale."""
    steps_only: bool = False
    """Whether corrections are what finer steps change alone: where ropes bifurcate, another mesh tells nothing."""

    @property
    def lasts(self) -> float:
        """Length of the longest trial [s]."""
        return float(self.motion.markers.shape[1] - 1) * self.model.dt

    @property
    def prior(self) -> np.ndarray:
        """What half a squared standard deviation of a start costs [m], by trial, shape (B,)."""
        pictures = np.sum([v.good.sum(1) for v in self.spines.views], 0)
        return self.spines.sure**2 / KNEE / (INDEPENDENT * np.maximum(pictures, 1))

    def with_options(self, **options: Any) -> FilmedProblem:
        """Return the problem with a model that has other options."""
        known = self.options | options
        model = RopeModel(self.model.recording, effects=self.model.effects, **known)
        return replace(self, model=model, motion=model.motion(self.trials), options=known)

    def with_effects(self, effects: Sequence[str], sizes: dict[str, float], numbers: Sequence[str]) -> FilmedProblem:
        """Return the problem with a model that has these effects, of which numbers with sizes are fitted as well.

        Args:
            effects: all of the model.
            sizes: what counts as much of the numbers of effects, in the terms of their scale.
            numbers: those of effects that are fitted.
        """
        model = RopeModel(self.model.recording, effects=effects, **self.options)
        known = dict(zip(self.model.parameters, self.fixed, strict=True))
        fixed = np.array([known.get(n, g) for n, g in zip(model.parameters, model.guess(), strict=True)])
        old = [self.model.parameters[k] for k in self.free]
        free = tuple(k for k, n in enumerate(model.parameters) if n in old or n in numbers)
        return replace(self, model=model, fixed=fixed, free=free, sizes=self.sizes | sizes)

    def picked(self, rows: np.ndarray) -> FilmedProblem:
        """Return the problem with these trials, in their order, repeated as given."""
        views = [v.picked(rows) for v in self.spines.views]
        spines = Spines(views, self.model.dt, self.extent, self.spines.free, self.spines.sure)
        trials = tuple(self.trials[b] for b in rows)
        parts: dict[str, Any] = {"trials": trials, "motion": self.motion.pick(rows), "spines": spines}
        parts["shown"] = None if self.shown is None else self.shown.pick(rows)
        if (known := self.discretisation_correction) is not None:
            parts["discretisation_correction"] = replace(known, step=known.step[rows], grid=known.grid[rows])
        return replace(self, **parts, start=self.start.pick(rows), offset=self.offset[rows], dropped={})

    def counting(self, good: Sequence[np.ndarray]) -> FilmedProblem:
        """Return the problem in which these pictures count, (B, F) by view."""
        old = self.spines
        views = [replace(v, good=g) for v, g in zip(old.views, good, strict=True)]
        return replace(self, spines=Spines(views, old.step, old.extent, old.free, old.sure))

    def shortened(self, seconds: float) -> FilmedProblem:
        """Return the problem of the first seconds of all trials."""
        count = int(np.ceil(seconds / self.model.dt)) + 1
        if count >= self.motion.markers.shape[1]:
            return self
        found = self.discretisation_correction
        if found is not None:
            found = replace(found, step=found.step[:, :count], grid=found.grid[:, :count])
        trials = first_frames(self.trials, count)
        views = [v.shortened(seconds) for v in self.spines.views]
        spines = Spines(views, self.model.dt, self.extent, self.spines.free, self.spines.sure)
        start = replace(self.start, discretisation_correction=self.added(found))
        parts: dict[str, Any] = {"trials": trials, "motion": self.model.motion(trials), "spines": spines}
        return replace(self, **parts, start=start, discretisation_correction=found)

    def over(self, whole: FilmedProblem, seconds: float) -> FilmedProblem:
        """Return the problem with the first seconds of the trials of another one; corrections are not known there."""
        views = []
        for known, view in zip(self.spines.views, whole.spines.views, strict=True):
            good = view.good.copy()
            # Wrong pictures stay so.
            good[:, : known.good.shape[1]] &= known.good
            views.append(replace(view, good=good))
        spines = Spines(views, self.model.dt, self.extent, self.spines.free, self.spines.sure)
        parts: dict[str, Any] = {"trials": whole.trials, "motion": self.model.motion(whole.trials), "spines": spines}
        start = replace(self.start, discretisation_correction=None)
        longer = replace(self, **parts, start=start, discretisation_correction=None)
        return without_rest(longer, self.misleading).shortened(seconds)

    def weigh(self, residual: np.ndarray) -> None:
        """Take for what readings get wrong what a model of a rope at rest leaves of them (B, F, R) [m].

        Neighbours along the rope have one and the same error of the model: cameras would be bent to take it up.
        """
        left = residual[..., : self.spines.priors.start]
        square = KNEE * np.nanmean(left**2 * levenberg_marquardt.robust(left)[1]) * INDEPENDENT / STRETCHES
        sure, old = max(SURE, float(np.sqrt(square))), self.spines
        self.spines = Spines(old.views, old.step, old.extent, old.free, sure)

    def added(self, found: Refinement | None) -> np.ndarray | None:
        """Return what is added to simulations [m], (B, F, M, 3), where this is known of finer ones; nothing if not."""
        if found is None:
            return None
        return (replace(found, grid=np.zeros_like(found.grid)) if self.steps_only else found).correction

    def take(self, other: FilmedProblem) -> None:
        """Become another problem."""
        vars(self).update(vars(other))

    @property
    def space(self) -> ParameterSpace:
        """Numbers of the rope, then those of the cameras."""
        names, params = self.model.parameters, self.model.params
        own, other = [names[k] for k in self.free], self.spines.nuisances
        sizes = []
        for k in self.free:
            p = params[k]
            size = self.sizes.get(names[k]) or abs(self.fixed[k]) or 0.1 * (p.high - p.low)
            sizes.append(1.0 if p.scale == "log" else size)
        return ParameterSpace(
            (*own, *other.names), (*[params[k] for k in self.free], *other.params), (*sizes, *other.units.tolist())
        )

    @property
    def extent(self) -> float:
        """How far the rope moves [m]."""
        return self.spines.extent

    def depth(self, view: FilmView) -> float:
        """Return how far the grippers are from a camera in the mean [m]."""
        held = np.concatenate([t.markers[:, t.gripped].reshape(-1, 3) for t in self.trials])
        return float(np.mean(held @ np.array(view.camera.rotation)[2] + view.camera.translation[2]))

    def full(self, values: np.ndarray) -> np.ndarray:
        """Return all numbers of the model, (P, K), for fitted ones, (P, K + Q)."""
        out = np.repeat(self.fixed[None], len(values), 0)
        out[:, list(self.free)] = values[:, : len(self.free)]
        return out

    def simulate(self, values: np.ndarray, frames: int | None = None, offsets: np.ndarray | None = None) -> np.ndarray:
        """Return simulated places (P, B, T, M, 3); rows that differ in their cameras only are simulated once.

        Args:
            values: numbers of rope and cameras, shape (P, N).
            frames: how many to simulate; all if not given.
            offsets: of starts, shape (P, B, J); those of the problem if not given.
        """
        full = self.full(values)
        if offsets is None or not offsets.shape[-1]:
            rows, back = np.unique(full, axis=0, return_inverse=True)
            begin = self.begin(self.offset[None]) if self.offset.shape[1] else self.start
            return self.model.simulate(self.motion, begin, rows, frames=frames)[back.ravel()]
        return self.model.simulate(self.motion, self.begin(offsets), full, frames=frames)

    def begin(self, offsets: np.ndarray) -> Start:
        """Return starts for P B simulations with offsets (P, B, J); moved ropes are as long as they are."""
        moved = self.moved(offsets)
        pos, moving, free = moved.pos, ~moved.at_rest, self.spines.free
        above = np.maximum(pos[..., 2], _lowest(self.model.recording))
        pos[..., 2] = np.where(moving[:, None] & free, above, pos[..., 2])
        pos[moving] = self._laid(pos[moving])
        known = self.start.discretisation_correction
        more = None if known is None else np.tile(known, (len(offsets), 1, 1, 1))
        return replace(moved, discretisation_correction=more)

    @property
    def reach(self) -> np.ndarray:
        """How far places [m] and speeds [m/s] at the start usually are from those of `start`, by axis, shape (2, 3)."""
        return _REACH * (1.0 if self.model.recording.table_height is None else _ON_TABLE)

    def moved(self, offsets: np.ndarray) -> Start:
        """Return starts with offsets (P, B, J) as they are: longer ropes, and some below the table."""
        mode = offsets.reshape(*offsets.shape[:2], 2, -1, 3)
        pos, vel = (
            (x[None] + size * np.einsum("mj,pbjc->pbmc", self.shapes, mode[:, :, k])).reshape(-1, *x.shape[1:])
            for k, (x, size) in enumerate(zip((self.start.pos, self.start.vel), self.reach, strict=True))
        )
        return Start(pos, vel, np.tile(self.start.at_rest, len(offsets)))

    @property
    def fresh(self) -> np.ndarray:
        """Offsets (B, J) of starts that no fit has led astray: as first pictures show them, or of ropes in balance."""
        if self.shown is None or not self.offset.shape[1]:
            return np.zeros_like(self.offset)
        ways = (self.shown.pos - self.start.pos, self.shown.vel - self.start.vel)
        off = np.stack([way / size for way, size in zip(ways, self.reach, strict=True)], 1)
        return np.einsum("jm,bkmc->bkjc", np.linalg.pinv(self.shapes), off).reshape(self.offset.shape)

    def _laid(self, pos: np.ndarray) -> np.ndarray:
        """Return places (N, M, 3) of ropes that are as long as they are, in the directions of given ones.

        Offsets along the rope would make it longer, and nearest positions of the right length have a folded end.
        """
        trial = self.trials[0]
        length = torch.as_tensor(np.append(np.diff(trial.marker_arclength), 1.0)[:, None])
        held = np.flatnonzero(trial.gripped).tolist()
        return lay_rope(torch.as_tensor(pos), length, held, closed=False).numpy()  # as models are

    def frames(self, seconds: float | None) -> int | None:
        """Return how many frames have to be simulated for readings of the first seconds."""
        if seconds is None:
            return None
        return min(self.motion.markers.shape[1], int(np.ceil(seconds / self.model.dt)) + 4)

    def target(self, seconds: float | None) -> np.ndarray:
        """Return what readings (B, F, R) of the first seconds should be [m], NaN where there are none."""
        target = self.spines.target[..., 0].copy()
        if seconds is not None:
            target[self.spines.times > seconds] = np.nan
        return target

    def readings(self, seconds: float | None = None) -> tuple[levenberg_marquardt.Simulate, np.ndarray]:
        """Return what maps numbers to readings, and their targets, over the first seconds."""
        frames = self.frames(seconds)

        def read(values: np.ndarray) -> np.ndarray:
            return self.spines.read(self.simulate(values, frames), values[:, len(self.free) :])

        return read, self.target(seconds)[..., None]


def first_frames(trials: Sequence[Trial], count: int) -> tuple[Trial, ...]:
    """Return trials that end after so many frames."""
    series = ("time", "markers", "suspect", "gripper_quaternion", "wrench")
    cut = ({n: getattr(t, n)[:count] for n in series if getattr(t, n) is not None} for t in trials)
    return tuple(replace(t, **parts) for t, parts in zip(trials, cut, strict=True))


def start_of(model: RopeModel, trials: Sequence[Trial], views: Sequence[FilmView]) -> Start:
    """Return where trials begin: hanging between the grippers, at rest if those are and pictures do not change."""
    pos, vel, still = [], [], []
    recording = model.recording
    for b, trial in enumerate(trials):
        shape = catenary(trial, recording)
        pos.append(_placed(shape[0], trial, recording))
        frames = max(3, min(len(trial.time), round(0.05 / model.dt) + 1))
        speed = (shape[frames - 1] - shape[0]) / (trial.time[frames - 1] - trial.time[0])
        held = trial.markers[:frames, trial.gripped]
        quick = np.linalg.norm(held[-1] - held[0], axis=-1).max() / (trial.time[frames - 1] - trial.time[0])
        calm = trial.still or (quick < _CALM and all(_unchanged(view, b) for view in views))
        vel.append(0 * speed if calm else speed)
        still.append(calm)
    return Start(np.stack(pos), np.stack(vel), np.array(still))


def _unchanged(view: FilmView, b: int) -> bool:
    """Return whether the centre line stays where it is in the first good pictures of a trial."""
    rows = np.flatnonzero(view.good[b])[:3]
    if len(rows) < 2:
        return False
    first, later = (view.places[b, k] for k in (rows[0], rows[-1]))
    first, later = (p[np.isfinite(p).all(1)] for p in (first, later))
    if not len(first) or not len(later):
        return False
    away = np.linalg.norm(first[:, None] - later[None], axis=-1).min(1)
    return bool(np.median(away) < 3.0)


def _placed(shape: np.ndarray, trial: Trial, recording: Recording) -> np.ndarray:
    """Return places (M, 3) of a rope that may lie on a table: a free end is laid out along its gripper's direction."""
    floor = _lowest(recording)
    if not np.isfinite(floor):
        return shape
    held = np.flatnonzero(trial.gripped)
    at, out = trial.marker_arclength, shape.copy()
    for last, inner, free in (
        (held[-1], held[-2:][0], slice(held[-1] + 1, None)),
        (held[0], held[:2][-1], slice(0, held[0])),
    ):
        if last == inner or not len(out[free]):
            continue
        way = trial.markers[0, last] - trial.markers[0, inner]
        way = way / np.linalg.norm(way)
        out[free] = trial.markers[0, last] + np.abs(at[free] - at[last])[:, None] * way
    out[:, 2] = np.maximum(out[:, 2], floor)
    return out


def _lowest(recording: Recording) -> float:
    """Return the height of a rope that lies on the table [m]; -inf if there is none."""
    return -np.inf if recording.table_height is None else recording.table_height + (recording.radius or 0.005)


def filmed_problem(
    recording: Recording,
    trials: Sequence[Trial],
    views: Sequence[FilmView],
    *,
    effects: Sequence[str] = (),
    values: np.ndarray | None = None,
    fitted: Sequence[str] | None = None,
    options: dict[str, Any] | None = None,
) -> FilmedProblem:
    """Return the problem of fitting a model to films.

    Args:
        recording: the rope.
        trials: which of its trials.
        views: what cameras saw of those.
        effects: besides the baseline.
        values: numbers to start from, shape (K,); the model's guess if not given.
        fitted: numbers to fit; all if not given.
        options: of the model.
    """
    model = RopeModel(recording, effects=effects, **(options or {}))
    free = np.ones(model.count, bool)
    free[model.gripped] = False
    spines = Spines(views, model.dt, recording.length, free)
    names = model.parameters if fitted is None else fitted
    columns = tuple(k for k, n in enumerate(model.parameters) if n in names)
    first = model.guess() if values is None else np.asarray(values, dtype=float)
    begin = start_of(model, trials, views)
    known = dict(options or {})
    own = FilmedProblem(model, tuple(trials), model.motion(trials), spines, begin, columns, first, {}, known)
    begin_from_balance(own, first)
    return own


def begin_from_balance(own: FilmedProblem, numbers: np.ndarray) -> None:
    """Let trials in motion begin, until more is known, in balance with numbers (K,), carried along by the grippers.

    Where first pictures show a rope elsewhere, it begins there, as something that is off from that balance.
    """
    model, plain = own.model, start_of(own.model, own.trials, own.spines.views)
    spots = np.setdiff1d(np.arange(model.count), model.gripped)
    shapes = equilibrium.smooth_shapes(model.mesh, spots)
    if plain.at_rest.all() or shapes is None:
        own.start, own.offset = plain, np.zeros((len(own.trials), 0))
        return
    own.shapes = shapes[list(model.marker_vertex)] * np.sqrt(len(spots))
    resting = Start(plain.pos, 0 * plain.vel, np.ones(len(plain.pos), bool))
    balance = model.simulate(own.motion, resting, numbers[None], frames=1)[0, :, 0]
    sound = np.isfinite(balance).all((1, 2))[:, None, None] & ~plain.at_rest[:, None, None]
    own.start = replace(plain, pos=np.where(sound, balance, plain.pos))
    own.offset = np.zeros((len(own.trials), 6 * own.shapes.shape[1]))
    own.offset = own.fresh


def add_correction(own: FilmedProblem, values: np.ndarray) -> None:
    """Add to simulations from now on what finer steps and a finer mesh change at these numbers (K + Q,).

    Of a chain of links it is what they change of a rope, whose mesh is right where its edges are as long as the links.
    """
    model, row = own.model, own.full(values[None])
    own.start = replace(own.start, discretisation_correction=None)
    begin = own.begin(own.offset[None]) if own.offset.shape[1] else own.start
    links = np.array([ParameterName.parse(name).effect == CHAIN for name in model.parameters])
    length, row = float(np.abs(row[:, links]).sum()), row[:, ~links]
    effects = tuple(e for e in model.effects if e != CHAIN)
    if links.any():
        model = RopeModel(model.recording, effects=effects, **own.options)
    plain = model.simulate(own.motion, begin, row)[0]
    # Starts are fitted: only what the motion from one and the same place gets wrong is to be corrected.
    moving = ~own.start.at_rest[:, None, None] & np.isfinite(plain[:, 0])
    begin = replace(begin, pos=np.where(moving, plain[:, 0], begin.pos))
    half = {"substep": model.dt / (2 * model.substeps)}
    fine = half | {"vertices": 2 * len(model.arclength) - 1}
    sims = []
    for more in (fine, half):
        each = RopeModel(model.recording, effects=effects, **(own.options | more))
        sims.append(each.simulate(each.motion(own.trials), begin, row)[0])
    edge = float(np.mean(np.diff(model.arclength)))
    found = refinement(sims[0], sims[1], plain, model.numerical_damping, edge)
    correct(own, replace(found, links=length))


def correct(own: FilmedProblem, found: Refinement | None) -> None:
    """Add to simulations from now on what is known of finer ones."""
    own.discretisation_correction = found
    own.start = replace(own.start, discretisation_correction=own.added(found))


def without_rest(own: FilmedProblem, lost: Sequence[MisleadingTrial]) -> FilmedProblem:
    """Return the problem in which trials count up to where they mislead."""
    good, names = [view.good.copy() for view in own.spines.views], [t.name for t in own.trials]
    for each in lost:
        b = names.index(each.name)
        for kept, view in zip(good, own.spines.views, strict=True):
            kept[b, view.time[b] >= each.time] = False
    known = {each.name for each in lost}
    return replace(own.counting(good), misleading=(*(m for m in own.misleading if m.name not in known), *lost))
