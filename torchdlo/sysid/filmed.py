"""Calibration to films: the rope's numbers, with cameras and clocks as numbers of their own.

Where films begin at rest, so does the simulation; else the shape and the motion at the start are estimated from the
first frames. Many starts are tried on the beginning of the trials, where a cost has few local minima; the best go on
over all of their time. Frames that stay far from the rope while others are near are wrong ones, and are left out. What
finer steps and a finer mesh change is computed once near the best fit, and added to simulations from then on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis.budget import options as suited
from torchdlo.sysid.diagnosis.error_floor import Refinement, refinement
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.result import Calibration
from torchdlo.sysid.footage import views_of
from torchdlo.sysid.model import equilibrium, model_file
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start, TrialBatch
from torchdlo.sysid.observation import Spines, View
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.trivial_predictors import catenary

__all__ = ["Problem", "calibrate_filmed", "picture_errors", "problem", "start_of"]

Callback = Callable[[str, int, int, str], None]

_WINDOW = 0.2
"""Seconds of a film that a start in motion is estimated from."""

_CALM = 0.03
"""Speed of a gripper below which it is at rest [m/s]."""

_SHIFT, _DRIFT = 0.05, 0.5
"""How far shapes [m] and speeds [m/s] at the start may be from those of a rope at rest that is carried along."""

_REACH = (np.log(40.0), np.log(4.0), np.log(10.0))
"""How far starts go either way of the guess."""

_BLOCK = 0.5
"""Time over which what simulations get wrong is one and the same error [s]."""

_GATE = 3.0
"""Times the usual distance in a picture from which it is a wrong one."""

_NEAR = 4e-3
"""Distance that is never taken for that of a wrong picture [m]."""


@dataclass(eq=False)
class Problem:
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
    discretisation_correction: Refinement | None = None
    """What finer simulations change, if it is known."""
    offset: np.ndarray | None = None
    """How starts differ from balance, by trial, see `refine_start`."""

    @property
    def space(self) -> ParameterSpace:
        """Numbers of the rope, then those of the cameras."""
        names, params = self.model.parameters, self.model.params
        own, other = [names[k] for k in self.free], self.spines.nuisances
        sizes = []
        for k in self.free:
            p = params[k]
            sizes.append(1.0 if p.scale == "log" else abs(self.fixed[k]) or _usual(names[k], p.low, p.high, self.model))
        return ParameterSpace(
            (*own, *other.names), (*[params[k] for k in self.free], *other.params), (*sizes, *other.units.tolist())
        )

    @property
    def extent(self) -> float:
        """How far the rope moves [m]."""
        return self.spines.extent

    def full(self, values: np.ndarray) -> np.ndarray:
        """Return all numbers of the model, (P, K), for fitted ones, (P, K + Q)."""
        out = np.repeat(self.fixed[None], len(values), 0)
        out[:, list(self.free)] = values[:, : len(self.free)]
        return out

    def simulate(self, values: np.ndarray, frames: int | None = None) -> np.ndarray:
        """Return simulated places (P, B, T, M, 3); rows that differ in their cameras only are simulated once."""
        rows, back = np.unique(self.full(values), axis=0, return_inverse=True)
        return self.model.simulate(self.motion, self.start, rows, frames=frames)[back.ravel()]

    def readings(self, seconds: float | None = None) -> tuple[levenberg_marquardt.Simulate, np.ndarray]:
        """Return what maps numbers to readings, and their targets, over the first seconds."""
        target, frames = self.spines.target, None
        if seconds is not None:
            frames = min(self.motion.markers.shape[1], int(np.ceil(seconds / self.model.dt)) + 4)
            target = target.copy()
            late = np.arange(target.shape[1]) / self.spines.views[0].camera.fps > seconds
            target[:, late] = np.nan

        def read(values: np.ndarray) -> np.ndarray:
            return self.spines.read(self.simulate(values, frames), values[:, len(self.free) :])

        return read, target


def _usual(name: str, low: float, high: float, model: RopeModel) -> float:
    """Return what counts as much of a number that is 0 when its effect is off."""
    del name, model
    return 0.1 * (high - low)


def start_of(model: RopeModel, trials: Sequence[Trial], views: Sequence[View]) -> Start:
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
        calm = quick < _CALM and all(_unchanged(view, b) for view in views)
        vel.append(0 * speed if calm else speed)
        still.append(calm)
    return Start(np.stack(pos), np.stack(vel), np.array(still))


def _unchanged(view: View, b: int) -> bool:
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
    if recording.table_height is None:
        return shape
    floor = recording.table_height + (recording.radius or 0.005)
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


def problem(
    recording: Recording,
    trials: Sequence[Trial],
    views: Sequence[View],
    *,
    effects: Sequence[str] = (),
    values: np.ndarray | None = None,
    fitted: Sequence[str] | None = None,
    options: dict[str, Any] | None = None,
) -> Problem:
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
    return Problem(model, tuple(trials), model.motion(trials), spines, begin, columns, first, {}, known)


def refine_start(own: Problem, values: np.ndarray, passes: int = 3) -> None:
    """Estimate shapes and motions at the start of trials that do not begin at rest, from their first frames.

    They are those of the rope in balance between the grippers, plus smooth shapes, by Levenberg-Marquardt.

    Args:
        own: the problem; its start is replaced.
        values: numbers of the rope and the cameras, shape (K + Q,).
        passes: most steps.
    """
    start, model = own.start, own.model
    moving = np.flatnonzero(~start.still)
    spots = np.setdiff1d(np.arange(model.count), model.gripped)
    shapes = equilibrium.smooth_shapes(model.mesh, spots)
    if not len(moving) or shapes is None:
        return
    at = shapes[list(model.marker_vertex)] * np.sqrt(len(spots))  # of size one
    count = 6 * at.shape[1]
    plain = start_of(model, own.trials, own.spines.views)
    row = own.full(values[None])
    resting = Start(plain.pos, 0 * plain.vel, np.ones(len(plain.pos), bool))
    balance = model.simulate(own.motion, resting, row, frames=1)[0, :, 0]
    sound = np.isfinite(balance).all((1, 2))[:, None, None] & ~start.still[:, None, None]
    pos, vel = np.where(sound, balance, plain.pos), plain.vel
    frames = min(own.motion.markers.shape[1], round(_WINDOW / model.dt) + 3)
    target = own.spines.target.copy()
    target[:, :, -16 * len(own.spines.nuisances.names) :] = np.nan
    target[:, np.arange(target.shape[1]) / own.spines.views[0].camera.fps > _WINDOW] = np.nan
    seen, sizes = np.isfinite(target), np.repeat([_SHIFT, _DRIFT], count // 2)

    def begin(offsets: np.ndarray) -> Start:
        """Return starts of (R, B, 6 J) offsets, for R B simulations."""
        mode = offsets.reshape(*offsets.shape[:2], 2, -1, 3)
        p, v = (x[None] + np.einsum("mj,rbjc->rbmc", at, mode[:, :, k]) for k, x in enumerate((pos, vel)))
        return Start(p.reshape(-1, *pos.shape[1:]), v.reshape(-1, *vel.shape[1:]), np.tile(start.still, len(offsets)))

    def read(offsets: np.ndarray) -> np.ndarray:
        """Return readings (R, B, F, X, 1)."""
        sims = model.simulate(own.motion, begin(offsets), np.repeat(row, len(offsets), 0), frames=frames)
        return own.spines.read(sims, np.repeat(values[None, len(own.free) :], len(offsets), 0))

    def cost(found: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the cost of trials [m], (B,)."""
        mean = [
            levenberg_marquardt.robust(found[b][seen[b]])[0].mean() if seen[b].any() else 0.0 for b in range(len(found))
        ]
        return np.nan_to_num(np.array(mean), nan=np.inf) + 0.5 * _PRIOR * ((offset / sizes) ** 2).sum(1)

    offset = own.offset if own.offset is not None else np.zeros((len(pos), count))
    nudges = np.concatenate([np.zeros((1, count)), np.diag(0.05 * sizes)])
    damping = np.full(len(pos), 1e-2)
    for _ in range(passes):
        found = read(offset[None] + nudges[:, None])
        now, steps = cost(found[0], offset), np.zeros_like(offset)
        for b in moving:
            residual = found[0, b][seen[b]]
            slope = (found[1:, b] - found[:1, b])[:, seen[b]] / (0.05 * sizes[:, None])
            if not len(residual) or not np.isfinite(slope).all():
                continue
            weight = levenberg_marquardt.robust(residual)[1]
            normal = (slope * weight) @ slope.T / len(residual) + _PRIOR * np.diag(1 / sizes**2)
            pull = (slope * weight) @ residual / len(residual) + _PRIOR * offset[b] / sizes**2
            step = -np.linalg.solve(normal + damping[b] * np.diag(np.diag(normal)), pull)
            steps[b] = step / max(1.0, float(np.abs(step / sizes).max()))
        # Whole steps, or shorter ones where those lead astray.
        tries = offset[None] + np.array([1.0, 0.3, 0.1])[:, None, None] * steps
        costs = np.stack([cost(f, o) for f, o in zip(read(tries), tries, strict=True)])
        best = costs.argmin(0)
        better = costs.min(0) < now
        rows = np.arange(len(offset))
        offset = np.where(better[:, None], tries[best, rows], offset)
        damping = np.where(better, damping / 3, damping * 10)
        if not (costs.min(0) < 0.98 * now)[moving].any():
            break
    own.offset = offset
    fresh = begin(offset[None])
    own.start = replace(fresh, discretisation_correction=start.discretisation_correction)


_TURNS = 8
"""How often starts in motion and numbers are improved in turns."""

_PRIOR = 2e-5
"""What a squared standard deviation of a start costs [m], against the mean cost of readings."""


def solve(
    own: Problem, raws: np.ndarray, iterations: int, *, seconds: float | None = None, tolerance: float = 2e-3
) -> list[Point]:
    """Improve coordinates (S, K + Q) on the readings of the first seconds; return where they end."""
    simulate, target = own.readings(seconds)
    points = levenberg_marquardt.evaluate(simulate, target, own.space, raws, own.extent)
    limits: dict[str, Any] = {"iterations": iterations, "tolerance": tolerance, "whole": own.extent}
    for points in levenberg_marquardt.improve(simulate, target, own.space, points, **limits):  # noqa: B007, B020
        pass
    return points


def scout(own: Problem, starts: int, rng: np.random.Generator, report: Callback) -> np.ndarray:
    """Return coordinates (K + Q,) in the basin of the best fit."""
    space, count, total = own.space, len(own.free), 4
    lasts = float(own.motion.markers.shape[1] - 1) * own.model.dt
    first = np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))])
    raws = np.repeat(space.to_raw(first)[None], starts, 0)
    for k in range(min(count, 3)):
        share = (rng.permutation(starts) + rng.uniform(size=starts)) / starts - 0.5
        raws[1:, k] += 2 * _REACH[k] * share[1:]
    raws[1:, 1] += raws[1:, 0] - raws[0, 0]
    raws = space.clip(raws)
    report("trying starts", 0, total, "")
    simulate, target = own.readings(0.35 * lasts)
    cost = levenberg_marquardt.costs(simulate(space.to_values(raws)), target, own.extent)
    raws = raws[np.argsort(cost, kind="stable")[: max(2, starts // 4)]]
    report("trying starts", 1, total, f"{1e3 * cost.min():.2f} mm")
    points = solve(own, raws, 4, seconds=0.35 * lasts, tolerance=1e-2)
    points = _different(points, max(2, starts // 9))
    report("trying starts", 2, total, f"{1e3 * points[0].cost:.2f} mm over 35 % of the time")
    refine_start(own, space.to_values(points[0].raw))
    points = solve(own, np.array([p.raw for p in points]), 3, seconds=0.7 * lasts, tolerance=1e-2)
    points = _different(points, 2)
    report("trying starts", 3, total, f"{1e3 * points[0].cost:.2f} mm over 70 % of the time")
    refine_start(own, space.to_values(points[0].raw))
    points = solve(own, np.array([p.raw for p in points]), 4, tolerance=1e-2)
    best = min(points, key=lambda p: p.cost)
    report("trying starts", total, total, f"{1e3 * best.cost:.2f} mm")
    return best.raw


def _different(points: Sequence[Point], most: int) -> list[Point]:
    """Return the best points that are not in the same place."""
    kept: list[Point] = []
    for p in sorted(points, key=lambda p: p.cost):
        if np.isfinite(p.cost) and all(np.abs(p.raw[:3] - o.raw[:3]).max() > 0.02 for o in kept):
            kept.append(p)
    return kept[:most] or [min(points, key=lambda p: p.cost)]


def gate(own: Problem, values: np.ndarray) -> int:
    """Take out frames in which films stay far from the rope while others are near; return how many."""
    found, target = own.readings()[0](values[None])[0], own.spines.target
    lost, start = 0, 0
    for view in own.spines.views:
        width = 2 * view.places.shape[2]
        part = slice(start, start + width)
        start += width + int(own.spines.count_free)
        with np.errstate(invalid="ignore"):
            known = np.isfinite(target[:, :, part, 0])
            size = np.where(known, np.abs(found[:, :, part, 0]), np.nan)
            distance = np.full(known.shape[:2], np.nan)
            some = known.any(2)
            distance[some] = np.nanmean(size[some], 1)
        for b, trial in enumerate(own.trials):
            rows = np.flatnonzero(some[b])
            around = np.array([np.median(distance[b, rows[max(0, k - 4) : k + 5]]) for k in range(len(rows))])
            bad = rows[distance[b, rows] > np.maximum(_GATE * around, _NEAR)]
            if len(bad):
                view.good[b, bad] = False
                lost += len(bad)
                own.dropped.setdefault(f"{trial.name}, camera {view.camera.name}", []).extend(bad.tolist())
    if lost:
        free = np.ones(own.model.count, bool)
        free[own.model.gripped] = False
        own.spines = Spines(own.spines.views, own.model.dt, own.extent, free)
    return lost


def correct(own: Problem, values: np.ndarray) -> None:
    """Add to simulations from now on what finer steps and a finer mesh change at these numbers (K + Q,)."""
    model, begin = own.model, replace(own.start, discretisation_correction=None)
    half = {"substep": model.dt / (2 * model.substeps)}
    fine = half | {"vertices": 2 * len(model.arclength) - 1}
    row, sims = own.full(values[None]), []
    for more in (fine, half, {}):
        each = RopeModel(model.recording, effects=model.effects, **(own.options | more)) if more else model
        sims.append(each.simulate(each.motion(own.trials), begin, row)[0])
    edge = float(np.mean(np.diff(model.arclength)))
    own.discretisation_correction = refinement(sims[0], sims[1], sims[2], model.numerical_damping, edge)
    own.start = replace(own.start, discretisation_correction=own.discretisation_correction.correction)


def _blocks(own: Problem, raw: np.ndarray) -> Point:
    """Return the point at coordinates, with stretches of time in the place of trials: they scatter independently."""
    simulate, target = own.readings()
    look = levenberg_marquardt.Look(own.space, raw[None])
    sims = simulate(look.values)
    frames = target.shape[1]
    length = max(3, round(_BLOCK * own.spines.views[0].camera.fps))
    priors = np.zeros(target.shape[2], bool)
    priors[-16 * len(own.spines.nuisances.names) :] = True
    parts, reads = [], []
    for b in range(len(target)):
        for k in range(0, frames, length):
            part = target[b, k : k + length].copy()
            part[:, priors] = np.nan
            if np.isfinite(part).sum() < 0.3 * np.isfinite(target[b]).sum() * length / frames:
                continue
            pad = [(0, length - len(part)), (0, 0), (0, 0)]
            parts.append(np.pad(part, pad, constant_values=np.nan))
            reads.append(np.pad(sims[:, b, k : k + length], [(0, 0), *pad]))
    data, read = np.stack(parts), np.stack(reads, 1)
    return look.points(read, data, own.extent)[0]


def intervals(own: Problem, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return 90 % limits of the fitted numbers, and how much their range is of what it may be [1], shape (K + Q,) each.

    Stretches of time scatter; what cameras may be off shifts all of them in the same way.
    """
    point, space = _blocks(own, raw), own.space
    count, blocks = len(own.free), len(point.gradient)
    # Priors: a standard deviation of one coordinate, weighed as a few independent readings of each picture are.
    pictures = sum(float(v.good.sum()) for v in own.spines.views)
    precision = 2 * (5e-4) ** 2 / (2e-3) / (2.0 * pictures)
    prior = np.diag(np.concatenate([np.zeros(count), np.full(len(space.names) - count, 0.5 * precision)]))
    whole = replace(point, curvature=point.curvature + prior[None])
    curvature = whole.curvature.sum(0)
    drifts = np.linalg.solve(levenberg_marquardt.firm(curvature), blocks * prior)[count:]
    if own.discretisation_correction is not None:
        look, target = levenberg_marquardt.Look(space, raw[None]), own.spines.target
        read = own.readings()[0](look.values)
        sims, numbers = own.simulate(look.values[:1]), look.values[:1, count:]
        # Next to clamps the mesh's error may be of first order: extrapolating to that would change twice as much.
        parts = [
            factor * np.nan_to_num(e)
            for factor, e in zip((1.0, 2.0), own.discretisation_correction.unsure, strict=True)
        ]
        wrong = [own.spines.read(sims + e[None], numbers)[0] - read[0] for e in parts]
        drifts = np.concatenate([drifts, levenberg_marquardt.drift(look, read, target, wrong, own.extent)])
    low, high = levenberg_marquardt.interval(whole, space, drifts=drifts)
    ratio = np.abs(space.to_raw(high) - space.to_raw(low))
    return np.minimum(low, high), np.maximum(low, high), ratio


def picture_errors(own: Problem, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean distance of the films' centre lines from the rope by trial [m] and [px], (B,) each."""
    sims = own.simulate(values[None])
    read = own.spines.read(sims, values[None, len(own.free) :])[0]
    metres, start = [], 0
    for view in own.spines.views:
        width = 2 * view.places.shape[2]
        part = np.where(np.isfinite(own.spines.target), read, np.nan)[:, :, start : start + width, 0]
        pairs = part.reshape(*part.shape[:2], -1, 2)
        metres.append(np.nanmean(np.linalg.norm(pairs, axis=-1), (1, 2)))
        start += width + int(own.spines.count_free)
    focal = np.mean([v.camera.fx for v in own.spines.views])
    depth = np.mean([_depth(own, v) for v in own.spines.views])
    mean = np.mean(metres, 0)
    return mean, mean * focal / depth


def _depth(own: Problem, view: View) -> float:
    held = np.concatenate([t.markers[:, t.gripped].reshape(-1, 3) for t in own.trials])
    return float(np.mean(held @ np.array(view.camera.rotation)[2] + view.camera.translation[2]))


def calibrate_filmed(
    recording: Recording,
    *,
    starts: int = 36,
    iterations: int = 15,
    seed: int = 0,
    vertices: int | None = None,
    given: ModelFile | None = None,
    callback: Callback | None = None,
) -> Calibration:
    """Fit the baseline model to the films of the train trials and judge it on those of the test trials.

    Args:
        recording: with films.
        starts: number of starts.
        iterations: most iterations of the last stage.
        seed: of the random starts.
        vertices: vertices of the simulated rope.
        given: model to start from in place of many starts, with its effects.
        callback: told (stage, steps done, in all, message).
    """
    begun = time.perf_counter()
    report = callback or (lambda *_: None)
    views, notes = views_of(recording, recording.train, report)
    options = suited(recording, vertices) if given is None else dict(given.options)
    options |= {"rest": "straight"} if given is None else {}
    if given is None:
        own = problem(recording, recording.train, views, options=options)
    else:
        model = given.model(recording)
        sizes = given.sizes(model)
        own = problem(
            recording,
            recording.train,
            views,
            effects=given.effects,
            values=given.start(model),
            fitted=tuple(sizes),
            options=options,
        )
    space = own.space
    first = np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))])
    refine_start(own, first)
    raw = space.to_raw(first) if given is not None else scout(own, starts, np.random.default_rng(seed), report)
    stage = f"fitting {len(own.trials)} filmed trials"
    still = bool(own.start.still.all())
    # Starts in motion and numbers of the rope are improved in turns.
    rounds = 3 if still else _TURNS
    best, kept = None, (own.start, own.offset)
    report(stage, 0, rounds, "")
    for k in range(rounds):
        values = space.to_values(raw)
        late = still and k >= rounds - 2
        if late:
            gate(own, values)
        refine_start(own, values)
        if late:
            correct(own, values)
        most = iterations if k == rounds - 1 else 5
        found = min(solve(own, raw[None], most), key=lambda p: p.cost)
        if not still and best is not None and found.cost > 0.98 * best.cost:
            # Starts that suit the first frames better do not suit the rest: those before were better.
            own.start, own.offset = kept
            break
        best, raw, kept = found, found.raw, (own.start, own.offset)
        report(stage, k + 1, rounds, f"{1e3 * best.cost:.2f} mm")
    if not still:
        # With the starts that did best, wrong frames are taken out and finer simulations added.
        for _ in range(2):
            values = space.to_values(raw)
            gate(own, values)
            correct(own, values)
            best = min(solve(own, raw[None], iterations), key=lambda p: p.cost)
            raw = best.raw
        report(stage, rounds, rounds, f"{1e3 * best.cost:.2f} mm")
    if not np.isfinite(best.cost):
        raise InputError(
            f"{recording.path}: the simulation failed on the train trials from every start; check length, mass, "
            "cameras and marker_arclength."
        )
    values = space.to_values(raw)
    low, high, _ = intervals(own, raw)
    for where, frames in own.dropped.items():
        notes.append(f"{where}: frames {', '.join(map(str, sorted(frames)))} stay far from the rope: left out.")
    report("judging", 0, 1, "")
    result = _judged(recording, own, first, values, low, high, notes, seed, begun, report)
    report("judging", 1, 1, "")
    return result


def _judged(
    recording: Recording,
    own: Problem,
    first: np.ndarray,
    values: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    notes: list[str],
    seed: int,
    begun: float,
    report: Callback,
) -> Calibration:
    from torchdlo.sysid.overlay import overlaps, overlays

    space, per_trial, predictions, before = own.space, [], {}, {}
    errors: dict[str, dict[str, list[float]]] = {}
    numbers, shown = len(own.free), []
    for split, trials in (("train", recording.train), ("test", recording.test)):
        if split == "train":
            here = own
        else:
            views, said = views_of(recording, trials, report)
            notes += said
            here = replace(
                own,
                trials=tuple(trials),
                motion=own.model.motion(trials),
                spines=Spines(views, own.model.dt, own.extent, own.spines.free),
                start=start_of(own.model, trials, views),
                dropped={},
                discretisation_correction=None,
                offset=None,
            )
            gate(here, values)
            refine_start(here, values)
            correct(here, values)
        old, _ = picture_errors(here, first)
        new, pixels = picture_errors(here, values)
        sims = here.simulate(np.stack([first, values]))
        share = overlaps(recording, here, sims[1], values[numbers:])
        shown += overlays(recording, here, split, sims, np.stack([first, values])[:, numbers:])
        for b, trial in enumerate(trials):
            frames = len(trial.time)
            predictions[trial.name], before[trial.name] = sims[1, b, :frames], sims[0, b, :frames]
            per_trial.append(
                {
                    "name": trial.name,
                    "split": split,
                    "mae_mm": 1e3 * float(new[b]),
                    "before_mae_mm": 1e3 * float(old[b]),
                    "distance_px": float(pixels[b]),
                    "iou": share[b],
                }
            )
        errors[split] = {"new": (1e3 * new).tolist(), "old": (1e3 * old).tolist()}
    return Calibration(
        parameters={
            name: {"value": float(v), "low": float(a), "high": float(b), "unit": p.unit}
            for name, p, v, a, b in zip(space.names, space.params, values, low, high, strict=True)
        },
        train_mae_mm=float(np.mean(errors["train"]["new"])),
        test_mae_mm=float(np.mean(errors["test"]["new"])),
        before={f"{s}_mae_mm": float(np.mean(errors[s]["old"])) for s in errors},
        baselines={},
        per_trial=per_trial,
        seconds=time.perf_counter() - begun,
        model=model_file.content(own.model, own.full(values[None])[0]),
        predictions=predictions,
        predictions_before=before,
        seed=seed,
        notes=[*notes, *_remarks(own, values, low, high)],
        overlays=shown,
    )


def _remarks(own: Problem, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[str]:
    """Return what these views cannot test."""
    out = []
    moving = [t.name for t, calm in zip(own.trials, own.start.still, strict=True) if not calm]
    if moving:
        out.append(
            f"{', '.join(moving)} begin in motion, which is estimated from the first {_WINDOW:g} s alone: ranges do not "
            "include what is wrong with that; film from rest where you can."
        )
    for name, p, v, a, b in zip(own.space.names, own.space.params, values, low, high, strict=True):
        if not name.startswith("camera_") and p.scale == "log" and b / max(a, 1e-300) > 4:
            out.append(
                f"{name.replace('_', ' ')} is not testable from these views: it may be {a:.2g} to {b:.2g} {p.unit}."
            )
        elif name.startswith("camera_") and abs(v) > 3 * own.space.units[own.space.names.index(name)]:
            out.append(
                f"{name.replace('_', ' ')} is off by {v:.3g} {p.unit}: was the camera moved after its calibration?"
            )
    return out
