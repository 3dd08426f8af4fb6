"""Fits of rope, cameras and starts in motion to films, all at once, by Levenberg-Marquardt.

A trial that begins in motion has numbers of its own: how far its first shape and velocities are from those of a rope in
balance that is carried along, in a few smooth shapes. They matter to this trial alone, so they are eliminated from its
normal equations (Schur complement), and what is left is a problem of the numbers that all trials share.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import torch

from torchdlo.sysid.diagnosis.misleading_trials import MisleadingTrial, misleading_trials
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import Point
from torchdlo.sysid.estimation.model_uncertainty import CLAMP_SPREAD, radius_of_clamps, shear_share
from torchdlo.sysid.estimation.observation import (
    INDEPENDENT,
    POSE,
    FilmView,
    Pairs,
    Spines,
    by_camera,
    half_a_picture,
    seen_by,
)
from torchdlo.sysid.video import fit_memory
from torchdlo.sysid.video.filmed_problem import STRETCHES, FilmedProblem
from torchdlo.vision.spine import curve_vectors

__all__ = [
    "Fit",
    "film_gaps",
    "fit",
    "gate",
    "intervals",
    "look",
    "misleading_films",
    "picture_errors",
    "spread",
    "time_films",
    "total",
]

_BLOCK = 0.5
"""Time over which what simulations get wrong is one and the same error [s]."""

_GATE = 3.0
"""Times the usual distance in a picture from which it is a wrong one."""

_NEAR = 4e-3
"""Distance that is never taken for that of a wrong picture [m]."""

_USUAL, _BEGUN = 1e-3, 0.4
"""Error of trials that fits follow, at the least [m], and time that tells of their starts alone [s]."""

_LOST = 1.0
"""What a trial costs whose simulation fails [m]."""

_FIRM = 5e-3
"""Share of the cost that a number has to save per squared coordinate to be followed as far as its gradient says."""

_NUDGE = 0.02
"""Steps of finite differences of starts far from the films, in standard deviations of their priors."""

_WHOLE = 1.0
"""Share of steps of finite differences with which fits look for a basin: these see past what is uneven."""

_FAR, _FINEST = 3e-3, 0.05
"""Error [m] from which the steps with which fits come to their end are whole, and the least share of them.

A rope that moves answers to its start by ten times as much, and not in proportion: near the films whole steps go past
the minimum. Begun with, fine ones lead into nearer minima: fits of `sample_film` ended with 16 % less damping."""

_CLOCKS = np.linspace(-4.0, 4.0, 33)
"""What clocks of test films may be off those of the others, in halves of a picture."""

_SHARP = 5e-3
"""Tolerance up to which fits come to their end; others only look for a basin."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Numbers and starts, and what is known of the readings there."""

    raw: np.ndarray
    """Coordinates of the numbers of rope and cameras, shape (N,)."""
    offset: np.ndarray
    """Starts in standard deviations of their priors, shape (B, J); no columns where all trials begin at rest."""
    costs: np.ndarray
    """Cost by trial [m], shape (B,); infinite where the simulation failed."""
    residual: np.ndarray
    """Readings [m], NaN where there are none, shape (B, F, R)."""
    jacobian: np.ndarray
    """What they change with, of numbers and starts, float32, shape (B, N + J, F, R)."""

    @property
    def cost(self) -> float:
        """Mean over trials [m]."""
        return float(np.mean(self.costs))

    def normal(self, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradients (B, N + J) and curvatures (B, N + J, N + J) of the cost, with priors of starts (B,)."""
        return normal(self.residual, self.jacobian, self.offset, prior)


def normal(
    residual: np.ndarray, jacobian: np.ndarray, offset: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients and curvatures of the robust cost by trial, see `Fit.normal`."""
    trials, size = jacobian.shape[:2]
    gradient, curvature = np.zeros((trials, size)), np.zeros((trials, size, size))
    count = offset.shape[1]
    for b in range(trials):
        seen = np.isfinite(residual[b])
        if not seen.any():
            continue
        r, j = residual[b][seen], jacobian[b][:, seen]
        weight = levenberg_marquardt.robust(r)[1]
        gradient[b] = j @ (weight * r) / len(r)
        curvature[b] = (j * weight) @ j.T / len(r)
        gradient[b, size - count :] += prior[b] * offset[b]
        curvature[b, size - count :, size - count :] += prior[b] * np.eye(count)
    return gradient, curvature


def eliminated(gradient: np.ndarray, curvature: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients (B, N) and curvatures (B, N, N) of shared numbers; starts, the last `count`, follow them."""
    if not count:
        return gradient, curvature
    a, b, c = curvature[:, :-count, :-count], curvature[:, :-count, -count:], curvature[:, -count:, -count:]
    c = c + 1e-12 * np.eye(count)
    solved = np.linalg.solve(c, np.concatenate([b.transpose(0, 2, 1), gradient[:, -count:, None]], 2))
    return gradient[:, :-count] - (b @ solved[..., -1:])[..., 0], a - b @ solved[..., :-1]


def look(
    own: FilmedProblem,
    raw: np.ndarray,
    offset: np.ndarray,
    seconds: float | None = None,
    *,
    fixed: bool = False,
    finest: float = _FINEST,
    worth: Callable[[np.ndarray], bool] = lambda costs: True,
) -> Fit:
    """Return readings and their derivatives at coordinates (N,) and starts (B, J), over the first seconds.

    Where numbers are fixed, derivatives are those of starts alone, shape (B, J, F, R). They are most of the work, and
    left out, `jacobian` being empty, where costs (B,) are not worth it. Near the films they are differences over steps
    down to `finest` times what they are far away.
    """
    values, target = own.space.to_values(raw)[None], own.target(seconds)
    sims = own.simulate(values, own.frames(seconds), offset[None])
    read, pairs = own.spines.paired(sims, values[:, len(own.free) :])
    here, seen = read[..., 0], np.isfinite(target)
    residual = np.where(seen, here[0], np.nan)
    good = np.isfinite(sims).all((0, 2, 3, 4)) & np.isfinite(np.where(seen, here, 0.0)).all((0, 2, 3))
    costs, priors = np.full(len(residual), np.inf), 0.5 * own.prior * (offset**2).sum(1)
    for b in np.flatnonzero(good):
        costs[b] = levenberg_marquardt.robust(residual[b][seen[b]])[0].mean()
    errors = np.minimum(levenberg_marquardt.error_of(costs), _FAR)
    costs = costs + priors
    if not worth(costs):
        return Fit(raw, offset, costs, residual, np.zeros((len(costs), 0, *residual.shape[1:]), np.float32))
    change, width = _changes(own, raw, offset, sims, pairs, np.maximum(errors / _FAR, finest), fixed)
    change -= here
    good &= np.isfinite(np.where(seen, change, 0.0)).all((0, 2, 3))
    jacobian = (change.astype(np.float32) / width[..., None, None].astype(np.float32)).transpose(1, 0, 2, 3)
    jacobian[:, :, ~seen.any(0)] = 0.0
    jacobian[~good] = 0.0
    if offset.shape[1]:
        jacobian[own.start.still, -offset.shape[1] :] = 0.0
    return Fit(raw, offset, np.where(good, costs, np.inf), residual, jacobian)


def _changes(
    own: FilmedProblem,
    raw: np.ndarray,
    offset: np.ndarray,
    sims: np.ndarray,
    pairs: Sequence[Pairs],
    share: np.ndarray,
    fixed: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return readings beside a point, (C, B, F, R), and how far beside, (C, B): numbers, cameras, then starts."""
    point = levenberg_marquardt.PointEvaluation(own.space, raw[None], float(share.mean()))
    moving, values = offset.shape[1], point.values
    numbers, last = (0, 1) if fixed else (len(own.free), len(values))
    # What cameras are off needs no simulation of its own.
    rows = np.concatenate([values[1 : numbers + 1], np.repeat(values[:1], moving, 0)])
    offsets = np.repeat(offset[None], len(rows), 0)
    for k in range(moving):
        offsets[numbers + k, :, k] += _NUDGE * share
    moved = own.simulate(rows, sims.shape[2], offsets) if len(rows) else sims[:0]
    motions = np.concatenate([moved[:numbers], np.repeat(sims, last - numbers - 1, 0), moved[numbers:]])
    cameras = np.concatenate([values[1:last], rows[numbers:]])[:, len(own.free) :]
    steps = np.concatenate([point.steps[0, : last - 1], np.full(moving, _NUDGE)])[:, None].repeat(len(share), 1)
    steps[last - 1 :] *= share
    return own.spines.beside(pairs, motions, cameras)[..., 0], steps


def fit(
    own: FilmedProblem,
    raw: np.ndarray,
    iterations: int,
    *,
    seconds: float | None = None,
    tolerance: float = 2e-3,
    near: bool = False,
) -> Fit:
    """Improve numbers (N,) and the starts of the problem, which are set to what is found.

    Args:
        own: the problem.
        raw: coordinates to start from.
        iterations: most steps of each size.
        seconds: how much of the trials to look at; all of them if not given.
        tolerance: share of the cost that a step has to save for another one to be worth while.
        near: whether the start is in the basin of the minimum, which fine steps suffice to come to.
    """
    if own.trials[0].still:
        first = look(own, raw, own.offset, seconds, worth=lambda costs: False)
        if np.isfinite(first.costs).all():
            own.weigh(first.residual)
    job = fit_memory.task(own, "fit", raw, iterations, seconds, tolerance, near)
    stages = [_FINEST] if near else [_WHOLE, _FINEST] if tolerance <= _SHARP else [_WHOLE]
    if (known := fit_memory.recall(job)) is not None:
        raw, own.offset = known
        return look(own, raw, own.offset, seconds, finest=stages[-1])
    for finest in stages:
        now = _improved(own, raw, iterations, seconds, tolerance, finest)
        raw = now.raw
    fit_memory.keep(job, now.raw, now.offset)
    return now


def _improved(
    own: FilmedProblem, raw: np.ndarray, iterations: int, seconds: float | None, tolerance: float, finest: float
) -> Fit:
    """Return a fit that is improved in some steps, see `fit`, with derivatives over steps down to a share."""
    now, damping = look(own, raw, own.offset, seconds, finest=finest), 1e-2
    for _ in range(iterations):
        if not np.isfinite(now.costs).any():
            break
        raw_step, offset_step = _step(own, now, damping)
        least = total(now)
        point = own.space.clip(now.raw + raw_step), now.offset + offset_step
        tried = look(own, *point, seconds, finest=finest, worth=partial(_less, least))
        if total(tried) < least:
            done = least - total(tried) < tolerance * least
            now, damping = tried, max(damping / 5, 1e-6)
            if done:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    own.offset = now.offset
    return now


def total(found: Fit) -> float:
    """Return the mean cost, of which trials that failed have a large one."""
    return float(levenberg_marquardt.together(found.costs, _LOST))


def _less(least: float, costs: np.ndarray) -> bool:
    return float(levenberg_marquardt.together(costs, _LOST)) < least


def _step(own: FilmedProblem, now: Fit, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a step of numbers (N,) and one of starts (B, J)."""
    gradient, curvature = now.normal(own.prior)
    count, size = now.offset.shape[1], len(now.raw)
    inner = np.arange(size, size + count)
    damped = curvature.copy()
    damped[:, inner, inner] *= 1 + damping
    damped[:, inner, inner] += 1e-12
    cost = float(np.mean(now.costs[np.isfinite(now.costs)]))
    g, h = eliminated(gradient, damped, count)
    scale = np.diag(curvature.mean(0))[:size]
    firm = damping * (scale + 1e-9 * scale.sum() + 1e-12) + _FIRM * cost
    step = -np.linalg.solve(h.mean(0) + np.diag(firm), g.mean(0))
    step = step / max(1.0, float(np.abs(step / own.space.limits()).max()))
    step = own.space.clip(now.raw + step) - now.raw
    if not count:
        return step, np.zeros_like(now.offset)
    right = gradient[:, size:] + (damped[:, size:, :size] @ step)
    moves = -np.linalg.solve(damped[:, size:, size:], right[..., None])[..., 0]
    longest = np.maximum(1.0, np.abs(moves).max(1, keepdims=True))
    return step, moves / longest


def film_gaps(own: FilmedProblem, found: Fit) -> np.ndarray:
    """Return root mean squares of the readings of trials [m], shape (B,); infinite where the simulation failed."""
    gaps = np.sqrt(np.nanmean(found.residual[..., : own.spines.priors.start] ** 2, (1, 2)))
    return np.where(np.isfinite(found.costs), gaps, np.inf)


def gate(own: FilmedProblem, values: np.ndarray) -> int:
    """Take out frames in which films stay far from the rope while others are near; return how many."""
    found, target = own.readings()[0](values[None])[0], own.spines.target
    good, dropped = [view.good.copy() for view in own.spines.views], {k: list(v) for k, v in own.dropped.items()}
    for kept, view, whole in zip(good, own.spines.views, _of_views(own), strict=True):
        part = slice(whole.start, whole.start + 2 * view.places.shape[2])
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
                kept[b, bad] = False
                dropped.setdefault(f"{trial.name}, camera {view.camera.name}", []).extend(bad.tolist())
    lost = sum(int((v.good & ~kept).sum()) for v, kept in zip(own.spines.views, good, strict=True))
    if lost:
        own.take(replace(own.counting(good), dropped=dropped))
    return lost


def misleading_films(models: Sequence[tuple[FilmedProblem, Fit]]) -> list[MisleadingTrial]:
    """Return the trials that none of some fits follows from some time on though fits follow the others.

    A rope that snaps over to the other side than the simulated one tells nothing of its numbers from there on. Trials
    of which less would be left than starts take up count as they are, as do those that are known already.
    """
    own = models[0][0]
    if own.trials[0].still:
        return []
    # Cameras may have rates of their own: what they read goes to pictures of the quickest one.
    grid = max((v.time for v in own.spines.views), key=lambda time: time.shape[1])
    errors = np.stack([_errors_by_picture(problem, found, grid) for problem, found in models])
    seen = np.isfinite(errors).any(0)
    last = [int(np.flatnonzero(row).max(initial=-1)) + 1 for row in seen]
    films = [SimpleNamespace(name=t.name, time=w[:n]) for t, w, n in zip(own.trials, grid, last, strict=True)]
    names, known = [t.name for t in own.trials], {each.name for each in own.misleading}
    lost = [each for each in misleading_trials(errors, films, _USUAL) if each.name not in known]
    return [each for each in lost if _tells(own, names.index(each.name), each.time)]


def _errors_by_picture(own: FilmedProblem, found: Fit, grid: np.ndarray) -> np.ndarray:
    """Return root mean squares of readings [m] by picture of the given times, (B, F); NaN where there are none."""
    last = own.spines.priors.start
    errors = np.full(grid.shape, np.nan)
    for b, (left, when) in enumerate(zip(found.residual[..., :last], own.spines.times[..., :last], strict=True)):
        seen = np.isfinite(left)
        frame = np.minimum(np.searchsorted(grid[b], when[seen]), grid.shape[1] - 1)
        count = np.bincount(frame, minlength=grid.shape[1])
        square = np.bincount(frame, left[seen] ** 2, grid.shape[1])
        errors[b, count > 0] = np.sqrt(square[count > 0] / count[count > 0])
    return errors


def _tells(own: FilmedProblem, b: int, seconds: float) -> bool:
    """Return whether the beginning of a trial tells more than how it began, in every view."""
    pictures = min(int((v.good[b] & (v.time[b] < seconds)).sum()) for v in own.spines.views)
    return seconds > _BEGUN and pictures > 2


def time_films(own: FilmedProblem, values: np.ndarray) -> None:
    """Set what clocks of films are off that are not fitted with the rope, those of test trials, at numbers (N,).

    A film is begun when somebody presses a button: those of the camera that were fitted to say about when.
    """
    old = own.spines
    if own.trials[0].still or all((np.asarray(v.clock) >= 0).all() for v in old.views):
        return
    told = values[len(own.free) :]
    usual = [float(n[POSE:].mean()) for n in by_camera(old.views, told)]
    sims, costs = own.simulate(values[None]), []
    for share in _CLOCKS:
        views = [_late(v, middle, share) for v, middle in zip(old.views, usual, strict=True)]
        read = Spines(views, old.step, old.extent, old.free, old.sure).read(sims, told[None])[0, ..., 0]
        costs.append([_cost_of_view(own, read, k) + _prior(own, v) * share**2 / 2 for k, v in enumerate(views)])
    best = _lowest(_CLOCKS, np.nan_to_num(np.array(costs), nan=np.inf))
    views = [_late(*each) for each in zip(old.views, usual, best, strict=True)]
    own.spines = Spines(views, old.step, old.extent, old.free, old.sure)


def _late(view: FilmView, middle: float, share: np.ndarray | float) -> FilmView:
    """Return a view whose clocks, where they are not fitted, are off by a share of half a picture from the middle."""
    return replace(view, off=np.where(np.asarray(view.clock) < 0, middle + share * half_a_picture(view), 0.0))


def _prior(own: FilmedProblem, view: FilmView) -> np.ndarray:
    """Return what a squared standard deviation of a number of one film costs [m], shape (B,)."""
    return own.spines.sure**2 / levenberg_marquardt.KNEE / (INDEPENDENT * np.maximum(view.good.sum(1), 1))


def _cost_of_view(own: FilmedProblem, read: np.ndarray, view: int) -> np.ndarray:
    """Return costs (B,) of the readings (B, F, R) of one view."""
    part = _of_views(own)[view]
    residual = np.where(np.isfinite(own.spines.target[..., part, 0]), read[..., part], np.nan)
    each = levenberg_marquardt.robust(residual)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a film of which no frame is good
        return np.nanmean(each.reshape(len(each), -1), 1)


def _lowest(places: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """Return where costs (K, ...) at even places (K,) are lowest, by the parabola through the three lowest; (...)."""
    least = costs.argmin(0)
    inner = np.clip(least, 1, len(places) - 2)
    a, b, c = (np.take_along_axis(costs, (inner + k)[None], 0)[0] for k in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = 0.5 * (a - c) / (a - 2 * b + c)
    known = (inner == least) & np.isfinite(shift) & np.isfinite(b)
    found = np.where(known, places[inner] + shift * (places[1] - places[0]), places[least])
    return np.where(np.isfinite(costs.min(0)), found, 0.0)


def _of_views(own: FilmedProblem) -> list[slice]:
    """Return where the readings of each view are: of its centre lines, two numbers a point, then of the rope."""
    widths = [2 * v.places.shape[2] + own.spines.count_free for v in own.spines.views]
    return [slice(sum(widths[:k]), sum(widths[: k + 1])) for k in range(len(widths))]


def intervals(own: FilmedProblem, found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return 90 % limits of the fitted numbers, shape (N,) each; all that is possible where films do not tell."""
    point, drifts = spread(own, found)
    low, high = levenberg_marquardt.interval(point, own.space, drifts=drifts)
    silent = np.diag(point.curvature.sum(0)) <= 0
    ends = [np.array([getattr(p, end) for p in own.space.params]) for end in ("low", "high")]
    low, high = np.where(silent, ends[0], low), np.where(silent, ends[1], high)
    return np.minimum(low, high), np.maximum(low, high)


def spread(own: FilmedProblem, found: Fit) -> tuple[Point, np.ndarray]:
    """Return a fit with stretches of time in the place of trials, and what shifts all of them alike, (E, N).

    Stretches of time scatter; what cameras may be off shifts all of them in the same way, and starts in motion follow.
    """
    space, numbers = own.space, len(own.free)
    gradient, curvature = _blocks(own, found)
    blocks = len(gradient)
    # Priors: a standard deviation of one coordinate, weighed as a few independent readings of each picture are.
    pictures = sum(float(v.good.sum()) for v in own.spines.views)
    precision = own.spines.sure**2 / levenberg_marquardt.KNEE / (INDEPENDENT * pictures)
    prior = np.diag(np.concatenate([np.zeros(numbers), np.full(len(space.names) - numbers, precision)]))
    curvature = curvature + prior[None]
    gradient = gradient + found.raw * np.diag(prior)
    point = Point(found.raw, found.cost, gradient, curvature, found.costs)
    drifts = np.linalg.solve(levenberg_marquardt.firm(curvature.sum(0)), blocks * prior).T[numbers:]
    if own.discretisation_correction is not None:
        values = space.to_values(found.raw)[None]
        sims = own.simulate(values)
        read = own.spines.changes(sims, values[:, numbers:])
        # Next to clamps the mesh's error may be of first order: extrapolating to that would change twice as much.
        unsure = [f * np.nan_to_num(x) for f, x in zip((1.0, 2.0), own.discretisation_correction.unsure, strict=True)]
        radius = own.model.recording.radius
        if less := radius_of_clamps(own.model, radius):
            # Where a clamp begins to hold is known to about half a radius, and the model's rope does not shear.
            other = own.with_options(clamp_fraction=own.model.clamp_fraction - less)
            unsure.append(CLAMP_SPREAD * np.nan_to_num(other.simulate(values) - sims)[0])
        for wrong in unsure:
            moved = np.concatenate([sims, sims + wrong[None]])
            change = own.spines.changes(moved, np.repeat(values[:, numbers:], 2, 0))[1, ..., 0] - read[0, ..., 0]
            weighted = replace(found, residual=found.residual + change)
            g, h = (x.sum(0) for x in eliminated(*_difference(own, found, weighted), found.offset.shape[1]))
            drifts = np.concatenate([drifts, np.linalg.solve(levenberg_marquardt.firm(h), g)[None]])
        if radius and "bending_stiffness" in space.names:
            share = np.zeros((1, len(space.names)))
            arclength = own.model.mesh.marker_arclength
            share[0, space.names.index("bending_stiffness")] = shear_share(sims[0], arclength, radius)
            drifts = np.concatenate([drifts, share])
    return point, drifts


def _difference(own: FilmedProblem, found: Fit, moved: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return what another residual changes of gradients, and the curvatures as they are."""
    before, curvature = found.normal(own.prior)
    after, _ = moved.normal(own.prior)
    return after - before, curvature


def _blocks(own: FilmedProblem, found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients (E, N) and curvatures (E, N, N) of stretches of time of all trials, starts being eliminated.

    Of ropes at rest they are of stretches along the rope.
    """
    if own.trials[0].still:
        return _stretches(own, found)
    count, size, last = found.offset.shape[1], found.raw.size, own.spines.priors.start
    data, times = found.residual[..., :last], own.spines.times[..., :last]
    blocks = np.floor((times - times.min()) / _BLOCK).astype(int)
    least = 0.3 * _BLOCK / max(np.ptp(times), _BLOCK)
    gradients, curvatures = [], []
    for b in range(len(data)):
        whole = np.isfinite(data[b]).sum()
        single = slice(b, b + 1)
        jacobian = found.jacobian[single][..., :last]
        _, h = normal(data[single], jacobian, found.offset[single], own.prior[single])
        follow = np.zeros((size, count))
        if count:
            inner = h[0, size:, size:] + 1e-12 * np.eye(count)
            follow = np.linalg.solve(inner, h[0, size:, :size]).T
        for k in range(blocks.max() + 1):
            inside = np.where(blocks[single] == k, data[single], np.nan)
            if np.isfinite(inside).sum() < least * max(whole, 1):
                continue
            g, c = normal(inside, jacobian, found.offset[single], 0 * own.prior[single])
            gradients.append(g[0, :size] - follow @ g[0, size:])
            reduced = np.concatenate([np.eye(size), -follow], 1)
            curvatures.append(reduced @ c[0] @ reduced.T)
    return np.stack(gradients), np.stack(curvatures)


def _stretches(own: FilmedProblem, found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients (E, N) and curvatures (E, N, N) of stretches along ropes at rest."""
    values = own.space.to_values(found.raw)[None]
    places = torch.as_tensor(own.simulate(values), dtype=torch.float32)
    spots = np.flatnonzero(own.spines.free)
    parts = []
    for k, view in enumerate(own.spines.views):
        numbers = torch.as_tensor(by_camera(own.spines.views, values[:, len(own.free) :])[k], dtype=torch.float32)
        pixel = seen_by(view, places, numbers, own.spines.step)[0][0]
        points = torch.as_tensor(view.places, dtype=torch.float32).nan_to_num(1e6)
        along = curve_vectors(pixel, points)[1].numpy()
        own_place = np.broadcast_to(spots, (*along.shape[:2], len(spots)))
        parts.append(np.concatenate([np.repeat(along, 2, -1), own_place], -1))
    share = np.concatenate(parts, -1) / (own.model.count - 1)
    number = np.minimum((share * STRETCHES).astype(int), STRETCHES - 1)
    gradients, curvatures = [], []
    data = slice(0, own.spines.priors.start)
    for b in range(len(found.residual)):
        whole = np.isfinite(found.residual[b, :, data]).sum()
        for k in range(STRETCHES):
            residual = np.where(number[b] == k, found.residual[b, :, data], np.nan)
            count = np.isfinite(residual).sum()
            if not count:
                continue
            g, c = normal(
                residual[None], found.jacobian[b : b + 1, :, :, data], found.offset[b : b + 1], own.prior[b : b + 1]
            )
            gradients.append(g[0] * count / whole * STRETCHES)
            curvatures.append(c[0] * count / whole * STRETCHES)
    return np.stack(gradients), np.stack(curvatures)


def picture_errors(own: FilmedProblem, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean distance of the films' centre lines from the rope by trial [m] and [px], (B,) each."""
    sims = own.simulate(values[None])
    read = own.spines.read(sims, values[None, len(own.free) :])[0]
    metres, pixels, start = [], [], 0
    for view in own.spines.views:
        width = 2 * view.places.shape[2]
        part = np.where(np.isfinite(own.spines.target), read, np.nan)[:, :, start : start + width, 0]
        pairs = part.reshape(*part.shape[:2], -1, 2)
        metres.append(np.nanmean(np.linalg.norm(pairs, axis=-1), (1, 2)))
        pixels.append(metres[-1] * view.camera.fx / own.depth(view))
        start += width + int(own.spines.count_free)
    return np.mean(metres, 0), np.mean(pixels, 0)
