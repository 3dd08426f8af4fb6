"""Calibration to films: the rope's numbers, with cameras and clocks as numbers of their own.

Where films begin at rest, so does the simulation; else the shape and the motion at the start are estimated from the
first frames. Many starts are tried on the beginning of the trials, where a cost has few local minima; the best go on
over all of their time. Frames that stay far from the rope while others are near are wrong ones, and are left out. What
finer steps and a finer mesh change is computed once near the best fit, and added to simulations from then on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics.effects.table import TableFriction
from torchdlo.sysid.diagnosis.budget import model_options as suited
from torchdlo.sysid.estimation.observation import (
    POSE,
    FilmView,
    Spines,
    by_camera,
    half_a_picture,
    own_clocks,
    unfitted_clocks,
)
from torchdlo.sysid.estimation.result import Calibration, Overlay
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import MAX_SUBSTEP
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.video.filmed_fit import (
    Fit,
    film_gaps,
    fit,
    gate,
    intervals,
    look,
    misleading_films,
    picture_errors,
    time_films,
)
from torchdlo.sysid.video.filmed_problem import (
    FilmedProblem,
    add_correction,
    begin_from_balance,
    correct,
    filmed_problem,
    without_rest,
)
from torchdlo.sysid.video.filmed_starts import START_WINDOW, fit_starts, refine_start, restart, scout, start_window
from torchdlo.sysid.video.first_pictures import look_at_first_pictures
from torchdlo.sysid.video.footage import views_of
from torchdlo.sysid.video.overlay import mask_overlaps, overlays
from torchdlo.sysid.video.picture_gradient import descend, whitening, with_profile
from torchdlo.sysid.video.second_view import number_notes, second_view

__all__ = [
    "FILMED_STARTS",
    "METHODS",
    "baseline",
    "calibrate_filmed",
    "corrected",
    "doubts",
    "require_simulated",
    "sharper",
    "test_problem",
]

Callback = Callable[[str, int, int, str], None]

FILMED_STARTS = 36
"""Starts that are enough."""

METHODS = ("auto", "differences", "gradient")
"""How numbers are fitted to films."""

_LAST = 6
"""Most iterations with finer steps, of fits that begin near their minimum."""

_MOST_OF, _ROUGH = 0.7, 1e-2
"""Share of the time of the first fits of all that is fitted, and what another step has to save there."""

_PROFILE = 12
"""Least iterations of a fit of the stiffness along a rope to centre lines."""

_WORSE = 1.05
"""Times the cost from which a correction of simulations makes the fit worse."""

_CLOCKED = 0.8
"""Share of the cost that is left where films are taken to have each a clock of its own."""

_DOUBT, _DOUBT_MM = 3.0, 3.0
"""Times the error of the nearest trial, and error [mm], from which a start in motion is not believed."""


def calibrate_filmed(
    recording: Recording,
    *,
    starts: int = FILMED_STARTS,
    iterations: int = 15,
    seed: int = 0,
    vertices: int | None = None,
    given: ModelFile | None = None,
    method: str = "auto",
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
        method: "gradient" to go on with the stiffness along the rope, by the gradient of masks; "differences" or "auto"
            to stay with few numbers, for which finite differences of centre lines are quicker.
        callback: told (stage, steps done, in all, message).
    """
    begun = time.perf_counter()
    report = callback or (lambda *_: None)
    views, notes = views_of(recording, recording.train, report)
    # Test films that cannot be used are refused now, and not when the fit is done.
    unseen = views_of(recording, recording.test, report)
    own, first, best = baseline(recording, views, starts, iterations, seed, vertices, given, report)
    if method == "gradient":
        own, first, best = _by_gradient(own, first, best, iterations, report)
    space = own.space
    values = space.to_values(best.raw)
    low, high = intervals(own, best)
    for where, frames in own.dropped.items():
        notes.append(f"{where}: frames {', '.join(map(str, sorted(frames)))} stay far from the rope: left out.")
    notes += [f"{trial.name} counts up to {trial.time:.2f} s only: {trial.why}." for trial in own.misleading]
    report("judging", 0, 1, "")
    here = test_problem(own, recording.test, unseen[0], values)
    notes += [*unseen[1], *begun_elsewhere(here)]
    found = [_judged(*each, first, values, notes) for each in (("train", own), ("test", here))]
    report("judging", 1, 1, "")
    trials = [t for f in found for t in f.trials]
    if method != "gradient" and (view := second_view(own, best.raw)) is not None:
        notes += number_notes(view)
    notes += doubts(trials, [name for f in found for name in f.moving])
    return Calibration(
        parameters={
            name: {"value": float(v), "low": float(a), "high": float(b), "unit": p.unit}
            for name, p, v, a, b in zip(space.names, space.params, values, low, high, strict=True)
        },
        train_mae_mm=_mean(trials, "train", "mae_mm"),
        test_mae_mm=_mean(trials, "test", "mae_mm"),
        before={f"{s}_mae_mm": _mean(trials, s, "before_mae_mm") for s in ("train", "test")},
        baselines={},
        per_trial=trials,
        seconds=time.perf_counter() - begun,
        model=model_file.content(own.model, own.full(values[None])[0]),
        predictions={k: v[1] for f in found for k, v in f.predictions.items()},
        predictions_before={k: v[0] for f in found for k, v in f.predictions.items()},
        seed=seed,
        notes=[*notes, *_remarks(own, values, low, high)],
        overlays=[o for f in found for o in f.overlays],
    )


def baseline(
    recording: Recording,
    views: Sequence[FilmView],
    starts: int,
    iterations: int,
    seed: int,
    vertices: int | None,
    given: ModelFile | None,
    report: Callback,
    near: float = np.inf,
) -> tuple[FilmedProblem, np.ndarray, Fit]:
    """Return the problem of the train trials, numbers (N,) to start from, and the best fit; see `calibrate_filmed`.

    A fit that stays farther than `near` [m] from the films, root mean square per reading, is not made sharper; where
    that is finite a fit whose simulations fail before the films end is returned, too: their beginnings may still do.
    """
    own = _problem(recording, views, vertices, given)
    # Balances are cheap, and stiff ropes have shapes that do not depend on how stiff they are.
    starts = max(starts, FILMED_STARTS) if recording.still else starts
    first = np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))])
    raw = look_at_first_pictures(own, own.space.to_raw(first), cameras=True)
    if given is not None:
        refine_start(own, own.space.to_values(raw), search=True)
    else:
        raw = _scouted(own, raw, starts, seed, report)
    best = _fitted(own, raw, iterations, report, near)
    first = np.concatenate([first[: len(own.free)], np.zeros(len(own.spines.nuisances.names))])
    if not np.isfinite(near):
        require_simulated(recording, best)
    return own, first, best


def require_simulated(recording: Recording, best: Fit) -> None:
    """Raise unless the simulations of a fit of the train trials went through."""
    if not np.isfinite(best.cost):
        raise InputError(
            f"{recording.path}: the simulation failed on the train trials from every start; check length, mass, "
            "cameras and marker_arclength."
        )


def _scouted(own: FilmedProblem, raw: np.ndarray, starts: int, seed: int, report: Callback) -> np.ndarray:
    """Return coordinates (N,) in the basin of the best fit; of ropes at rest with the clamps that fit better.

    A rope that bends within clamps that hold it looks like a very stiff one at rest: a basin of its own.
    """
    raw = scout(own, raw, starts, np.random.default_rng(seed), report)
    if not (own.trials[0].still and own.model.mesh.clamps and "clamp_fraction" in own.options):
        return raw
    other = own.with_options(clamp_fraction=1.0 - own.model.clamp_fraction)
    best = fit(own, raw, 6)
    found = fit(other, scout(other, raw, starts, np.random.default_rng(seed), report), 6)
    if found.cost < best.cost:
        own.take(other)
        best = found
    return best.raw


def _by_gradient(
    own: FilmedProblem, first: np.ndarray, found: Fit, iterations: int, report: Callback
) -> tuple[FilmedProblem, np.ndarray, Fit]:
    """Return what `baseline` does, with the stiffness along the rope: by centre lines, then by gradients of masks."""
    count, values = len(own.free), own.space.to_values(found.raw)
    fuller = with_profile(own)
    more = np.zeros(len(fuller.free) - count)
    both = [np.concatenate([x[:count], more, x[count:]]) for x in (first, values)]
    found = fit(fuller, fuller.space.to_raw(both[1]), max(iterations, _PROFILE))
    report("fitting the stiffness along the rope", 1, 1, f"{1e3 * found.cost:.2f} mm")
    raw = descend(fuller, found.raw, iterations, report, whitening(fuller, found.raw))
    sharper = look(fuller, raw, fuller.offset)
    # Blurred masks are less sharp than centre lines, and see what those do not: ends, and crossings.
    return fuller, both[0], sharper if sharper.cost < _WORSE * found.cost else found


def test_problem(
    own: FilmedProblem, trials: Sequence[Trial], views: Sequence[FilmView], values: np.ndarray
) -> FilmedProblem:
    """Return the problem of test trials that were filmed, which begin as their first pictures say with numbers (N,)."""
    spines = Spines(
        unfitted_clocks(views, own.spines.views), own.model.dt, own.extent, own.spines.free, own.spines.sure
    )
    parts: dict[str, Any] = {"trials": tuple(trials), "motion": own.model.motion(trials), "spines": spines}
    here = replace(own, **parts, dropped={}, misleading=(), discretisation_correction=None, shown=None)
    begin_from_balance(here, own.full(values[None])[0])
    look_at_first_pictures(here, own.space.to_raw(values))
    if here.offset.shape[1]:
        coarse = here.with_options(substep=MAX_SUBSTEP)
        refine_start(coarse, values, search=True)
        here.offset = coarse.offset
    time_films(here, values)
    gate(here, values)
    add_correction(here, values)
    if here.offset.shape[1]:
        fit_starts(here, own.space.to_raw(values), 8, seconds=start_window(here))
        time_films(here, values)
    return here


def _mean(trials: Sequence[dict[str, Any]], split: str, name: str) -> float:
    return float(np.mean([t[name] for t in trials if t["split"] == split]))


def _problem(
    recording: Recording, views: Sequence[FilmView], vertices: int | None, given: ModelFile | None
) -> FilmedProblem:
    """Return the problem of the train trials, with a model that suits them or a given one."""
    if given is None:
        options = suited(recording, vertices) | {"rest": "straight"}
        own = filmed_problem(recording, recording.train, views, options=options)
        return _at_rest(own) if recording.still else own
    options = dict(given.options) | ({} if vertices is None else {"vertices": vertices})
    model = given.model(recording, **({} if vertices is None else {"vertices": vertices}))
    sizes = given.sizes(model)
    more: dict[str, Any] = {"effects": given.effects, "values": given.start(model), "fitted": tuple(sizes)}
    own = replace(filmed_problem(recording, recording.train, views, options=options, **more), sizes=sizes)
    return _at_rest(own) if recording.still else own


def _at_rest(own: FilmedProblem) -> FilmedProblem:
    """Return the problem without what a rope at rest tells nothing of."""
    return replace(own, free=tuple(k for k in own.free if own.model.parameters[k] != "damping_rate"))


def _fitted(own: FilmedProblem, raw: np.ndarray, iterations: int, report: Callback, near: float = np.inf) -> Fit:
    """Return the best fit of all trials, without wrong frames and with what finer simulations change.

    One that is not `near` [m] the films over 70 % of the time stays as it is.
    """
    stage = f"fitting {len(own.trials)} filmed trials"
    best = fit(own, raw, 6, seconds=_MOST_OF * own.lasts, tolerance=_ROUGH)
    if own.model.mesh.clamps and "clamp_fraction" in own.options and not own.model.effects:
        # The rope may be held up to the last marker of a clamp, or bend between its markers.
        other = own.with_options(clamp_fraction=1.0 - own.model.clamp_fraction)
        found = fit(other, best.raw, 6, seconds=_MOST_OF * own.lasts, tolerance=_ROUGH)
        if found.cost < best.cost:
            own.take(other)
            best = found
    report(stage, 1, 3, f"{1e3 * best.cost:.2f} mm")
    if np.isfinite(best.cost) and film_gaps(own, best).max() > near:
        return best
    best = restart(own, fit(own, best.raw, iterations), iterations)
    # A diagnosis asks what effects say of a trial before it takes one for misleading.
    alone = not np.isfinite(near)
    best = _discounted(own, best, iterations) if alone else best
    report(stage, 2, 3, f"{1e3 * best.cost:.2f} mm")
    if not np.isfinite(best.cost):
        return best
    # A rope may snap over to another side with other steps.
    best = sharper(own, best.raw, iterations)
    best = clocked(own, _discounted(own, best, iterations) if alone else best, iterations)
    report(stage, 3, 3, f"{1e3 * best.cost:.2f} mm")
    return best


def _discounted(own: FilmedProblem, best: Fit, iterations: int) -> Fit:
    """Return the fit without the rest of trials that it does not follow."""
    lost = misleading_films([(own, best)])
    if not lost:
        return best
    own.take(without_rest(own, lost))
    return fit(own, best.raw, iterations)


def clocked(own: FilmedProblem, best: Fit, iterations: int) -> Fit:
    """Return the fit with a clock of each film instead of one of each camera, if films fit much better to that.

    Films that were begun by hand, one by one, are each off by another part of a picture.
    """
    if len(own.trials) < 2 or own.trials[0].still:
        return best
    views = own.spines.views
    if all(v.clocks != ("",) for v in views):
        return best
    many = [v if v.clocks != ("",) else replace(v, **own_clocks([t.name for t in own.trials])) for v in views]
    values, old = own.space.to_values(best.raw), own.spines
    parts = by_camera(views, values[len(own.free) :])
    numbers = [
        np.concatenate([n[:POSE], np.resize(n[POSE:], v.numbers - POSE)]) for n, v in zip(parts, many, strict=True)
    ]
    other = replace(own, spines=Spines(many, old.step, old.extent, old.free, old.sure))
    raw = other.space.to_raw(np.concatenate([values[: len(own.free)], *numbers]))
    found = fit(other, raw, min(iterations, _LAST), near=True)
    if not found.cost < _CLOCKED * best.cost:
        return best
    own.take(other)
    return found


def sharper(own: FilmedProblem, raw: np.ndarray, iterations: int) -> Fit:
    """Return the fit with half the steps, without wrong frames and with what finer simulations change."""
    # What steps damp is taken for damping.
    own.take(own.with_options(substep=own.model.dt / (2 * own.model.substeps)))
    # Ropes that begin with a jerk need other starts then.
    best = restart(own, fit(own, raw, min(iterations, _LAST), near=True), iterations)
    gate(own, own.space.to_values(best.raw))
    return corrected(own, best.raw, iterations)


def corrected(own: FilmedProblem, raw: np.ndarray, iterations: int) -> Fit:
    """Return the fit with what finer simulations change, asked again nearer to the minimum if that fits worse."""
    offset = own.offset
    if not offset.shape[1]:
        add_correction(own, own.space.to_values(raw))
        return fit(own, raw, iterations)
    before = look(own, raw, offset, worth=lambda costs: False).cost
    best = _finer(own, raw, iterations, before)
    if not best.cost > _WORSE * before:
        return best
    own.offset = offset
    correct(own, None)
    plain = fit(own, raw, iterations)
    return _finer(own, plain.raw, iterations, plain.cost)


def _finer(own: FilmedProblem, raw: np.ndarray, iterations: int, before: float) -> Fit:
    """Return the fit with what finer simulations change, of their steps alone if their mesh costs more than before.

    Args:
        own: the problem, of trials in motion.
        raw: coordinates (N,) to start from.
        iterations: most steps.
        before: cost of the fit without corrections [m].
    """
    offset, own.steps_only = own.offset, False
    add_correction(own, own.space.to_values(raw))
    best = fit(own, raw, min(iterations, _LAST), near=True)
    if best.cost > _WORSE * before:
        own.offset, own.steps_only = offset, True
        correct(own, own.discretisation_correction)
        best = fit(own, raw, min(iterations, _LAST), near=True)
    return best


@dataclass(frozen=True, eq=False)
class _Judged:
    """What a fit is worth on the trials of a split."""

    trials: list[dict[str, Any]]
    """Errors, see `Calibration.per_trial`."""
    predictions: dict[str, np.ndarray]
    """Places of the rope before and after by trial [m], shape (2, T, M, 3)."""
    overlays: list[Overlay]
    """Pictures."""
    moving: list[str]
    """Trials that begin in motion."""


def _judged(split: str, here: FilmedProblem, first: np.ndarray, values: np.ndarray, notes: list[str]) -> _Judged:
    """Return what numbers (K + Q,) are worth, beside those that the fit began with; what is wrong goes into notes."""
    numbers = len(here.free)
    other = replace(here)
    time_films(other, first)
    old, _ = picture_errors(other, first)
    new, pixels = picture_errors(here, values)
    sims = here.simulate(np.stack([first, values]))
    for trial, sim in zip(here.trials, sims[1], strict=True):
        if not (whole := np.isfinite(sim[: len(trial.time)]).all((1, 2))).all():
            until = float(trial.time[int(whole.argmin())])
            notes.append(f"{trial.name}: the simulation fails after {until:.2f} s; errors are of what came before.")
    share = mask_overlaps(here, sims[1], values[numbers:])
    trials = [
        {
            "name": trial.name,
            "split": split,
            "mae_mm": 1e3 * float(new[b]),
            "before_mae_mm": 1e3 * float(old[b]),
            "distance_px": float(pixels[b]),
            "iou": share[b][0],
            "boundary_f": share[b][1],
        }
        for b, trial in enumerate(here.trials)
    ]
    predictions = {trial.name: sims[:, b, : len(trial.time)] for b, trial in enumerate(here.trials)}
    shown = overlays(here, split, sims, np.stack([first, values])[:, numbers:])
    moving = [trial.name for trial, calm in zip(here.trials, here.start.at_rest, strict=True) if not calm]
    return _Judged(trials, predictions, shown, moving)


def begun_elsewhere(own: FilmedProblem) -> list[str]:
    """Return which test films seem to have begun more than one and a half pictures off what is written."""
    return [
        begun_text(trial.name, view.camera.name, off)
        for view in own.spines.views
        for trial, off in zip(own.trials, np.zeros(len(own.trials)) + view.off, strict=True)
        if abs(off) > 3 * half_a_picture(view)
    ]


def begun_text(trial: str, camera: str, late: float) -> str:
    """Return that a film began at another time than is written, `late` seconds later."""
    return (
        f"{trial}, camera {camera}: its film seems to have begun {1e3 * abs(late):.0f} ms or more "
        f"{'later' if late > 0 else 'earlier'} than cameras.json says; set starts there."
    )


def doubts(trials: Sequence[dict[str, Any]], moving: Sequence[str]) -> list[str]:
    """Return which trials in motion may have been given a wrong start: they stay far from their films, others do not.

    Args:
        trials: errors, see `Calibration.per_trial`.
        moving: names of those that begin in motion.
    """
    near = min((t["mae_mm"] for t in trials if t["split"] == "train"), default=np.inf)
    return [
        f"{t['name']} begins in motion and stays {t['mae_mm']:.1f} mm from its films, the nearest trial {near:.1f} mm: "
        "where and how fast it began was perhaps not found, and its error then says little of the rope; film it with a "
        "second camera, or from rest."
        for t in trials
        if t["name"] in moving and not t["mae_mm"] < max(_DOUBT * near, _DOUBT_MM)
    ]


def _remarks(own: FilmedProblem, values: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[str]:
    """Return what these views cannot test."""
    out = [
        f"Films of camera {view.camera.name} seem to have begun each at a time of its own: their clocks were fitted "
        "one by one; starts in cameras.json may say when they began."
        for view in own.spines.views
        if view.clocks != ("",) and not view.camera.starts
    ]
    if own.model.recording.table_height is not None and TableFriction.name not in own.model.effects:
        out.append(
            "Friction on the table is not testable here: the rope of this model slides without any; torchdlo diagnose "
            "looks for it."
        )
    moving = [t.name for t, calm in zip(own.trials, own.start.at_rest, strict=True) if not calm]
    if moving:
        out.append(
            f"{', '.join(moving)} begin in motion: shape and velocities there were fitted, too; those of test trials "
            f"are taken from their first {START_WINDOW:g} s."
        )
    for name, p, v, a, b in zip(own.space.names, own.space.params, values, low, high, strict=True):
        if not name.startswith("camera_") and p.scale == "log" and b / max(a, 1e-300) > 4:
            out.append(
                f"{name.replace('_', ' ')} is not testable from these views: it may be {a:.2g} to {b:.2g} {p.unit}."
            )
        elif name.startswith("camera_") and abs(v) > 3 * own.space.units[own.space.names.index(name)]:
            camera, clock, trial = name.partition(".clock")
            if clock:
                which = trial.removeprefix(".") or own.trials[0].name
                out.append(begun_text(which, camera.removeprefix("camera_"), v))
                continue
            out.append(
                f"{name.replace('_', ' ')} is off by {v:.3g} {p.unit}: was the camera moved after its calibration?"
            )
    return out
