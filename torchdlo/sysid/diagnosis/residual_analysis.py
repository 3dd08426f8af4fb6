"""Where simulation and measurement disagree: along the rope, over time, and against the state of the rope, in words.

All of it comes from predicted and measured markers alone, so that it holds whether or not an effect has been named.
Shares are cross-validated: what is learned on all other trials has to hold on the one that was left out, so that
chance explains nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import savgol_filter

from torchdlo.sysid.diagnosis.residual_text import STATES, Residual, by_marker, describe_residual
from torchdlo.sysid.recordings.recording import Recording, Trial

if TYPE_CHECKING:
    from torchdlo.sysid.diagnosis.error_floor import ErrorFloor

__all__ = ["PARTS", "Against", "Localisation", "localise", "project", "residuals"]

Predictions = Mapping[str, np.ndarray]
"""Simulated markers [m] by trial name, each of shape (F, M, 3)."""

PARTS = {
    "shift": "one shift of all markers",
    "offsets": "a fixed shift of each marker",
    "lag": "a lag in time",
    "inertia": "a shift along the acceleration",
    "bend": "a shift towards the inner side of bends",
}
"""Simple vector fields that a residual may consist of."""

_SMOOTH = 0.06
"""Seconds over which motion is smoothed before it is differentiated."""

_BINS = 8
"""Groups of equal size that a state is divided into."""


@dataclass(frozen=True, eq=False)
class Against:
    """A residual against one state of the rope."""

    name: str
    """Which state, see `STATES`."""
    centres: np.ndarray
    """Values in the middle of groups of equal size, shape (G,)."""
    before: np.ndarray
    """Root mean square distance in each group with the baseline [m], shape (G,)."""
    after: np.ndarray
    """The same with what was found [m], shape (G,)."""
    share_before: float
    """Share of the variance of distances that the state explains on trials left out, with the baseline; but for the
    place, of distances relative to what is usual at their place."""
    share_after: float
    """The same with what was found."""


@dataclass(frozen=True, eq=False)
class Localisation:
    """Where the gap sits."""

    time: np.ndarray
    """Times of the maps [s], shape (F,)."""
    place: np.ndarray
    """Places of the free markers along the rope [m], shape (M,)."""
    before: np.ndarray
    """Root mean square distance over the test trials with the baseline [m], shape (F, M)."""
    after: np.ndarray
    """The same with what was found [m], shape (F, M)."""
    against: tuple[Against, ...]
    """Against each state."""
    parts_before: dict[str, float]
    """Share of the squared residual that simple vector fields take away on trials left out, with the baseline."""
    parts_after: dict[str, float]
    """The same with what was found."""
    words: list[str]
    """Sentences on the gap of the baseline."""
    rest: list[str]
    """Sentences on what remains with what was found."""


def residuals(recording: Recording, predictions: Predictions, trials: Sequence[Trial]) -> list[Residual]:
    """Return the residuals of trials."""
    return [_residual(recording, predictions[t.name], t) for t in trials if t.name in predictions]


def project(found: Sequence[Residual], tangents: Mapping[str, np.ndarray]) -> list[Residual]:
    """Return residuals without what the baseline's own numbers could still take up.

    Args:
        found: residuals of trials.
        tangents: by trial, change of the predicted markers with each number of the baseline, shape (K, F, M, 3).
    """
    count = len(next(iter(tangents.values())))
    rows, target = [], []
    for each in found:
        good = np.isfinite(each.error) & np.isfinite(tangents[each.name]).all(0) & each.free[:, None]
        rows.append(tangents[each.name][:, good].T)
        target.append(each.error[good])
    amounts = np.linalg.lstsq(np.concatenate(rows).reshape(-1, count), np.concatenate(target), rcond=1e-8)[0]
    return [
        Residual(r.name, r.error - np.tensordot(amounts, tangents[r.name], (0, 0)), r.free, r.states, r.fields)
        for r in found
    ]


def localise(
    recording: Recording,
    predictions: Mapping[str, Predictions],
    floor: ErrorFloor,
    *,
    tangents: Mapping[str, np.ndarray] | None = None,
) -> Localisation:
    """Return where simulation and measurement disagree.

    Args:
        recording: what was measured.
        predictions: those "before" and "after" something was added to the model.
        floor: what no effect explains.
        tangents: see `project`; with them the gap before is shown without what calibration could still take up.
    """
    trials = [*recording.train, *recording.test]
    before, after = (residuals(recording, predictions[when], trials) for when in ("before", "after"))
    if tangents is not None:
        before = project(before, tangents)
    names = [n for n in STATES if n in before[0].states and np.isfinite(before[0].states[n][:, before[0].free]).any()]
    against = tuple(_against(n, before, after) for n in names)
    parts = [_parts(each) for each in (before, after)]
    free = before[0].free
    tested = {t.name for t in recording.test}
    effects_before = [(a.name, a.share_before, a.centres, a.before) for a in against]
    effects_after = [(a.name, a.share_after, a.centres, a.after) for a in against]
    maps = [_map([r for r in each if r.name in tested]) for each in (before, after)]
    shares = [{name: share for name, (share, _) in part.items()} for part in parts]
    return Localisation(
        recording.test[0].time[: min(len(t.time) for t in recording.test)],
        recording.test[0].marker_arclength[free],
        maps[0],
        maps[1],
        against,
        shares[0],
        shares[1],
        describe_residual(recording, before, effects_before, parts[0], floor),
        describe_residual(recording, after, effects_after, parts[1], floor),
    )


def _residual(recording: Recording, simulated: np.ndarray, trial: Trial) -> Residual:
    step = trial.time[1] - trial.time[0]
    seen = np.where(trial.suspect[:, None, None], np.nan, trial.markers)
    smooth, vel, acc = _derivatives(seen, step)
    bend = _bend(smooth, trial.marker_arclength)
    size = np.linalg.norm(bend, axis=-1)
    shape = seen.shape[:2]
    states = {
        "place": np.broadcast_to(trial.marker_arclength, shape),
        "time": np.broadcast_to(trial.time[:, None], shape),
        "speed": np.linalg.norm(vel, axis=-1),
        "curvature": size,
        "curvature_rate": np.abs(_derivatives(size[..., None], step)[1][..., 0]),
        "height": smooth[..., 2],
    }
    if recording.table_height is not None:
        states["table"] = states.pop("height") - recording.table_height
    fields = {"velocity": vel, "acceleration": acc, "bend": bend}
    return Residual(trial.name, seen - simulated[: len(seen)], ~trial.gripped, states, fields)


def _derivatives(x: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return smoothed values, first and second derivative of (F, M, C); NaN where the values are."""
    frames = len(x)
    window = min(max(5, 2 * round(0.5 * _SMOOTH / step) + 1), frames - 1 + frames % 2)
    flat, time = x.reshape(frames, -1), np.arange(frames)
    filled = np.zeros_like(flat)
    for k, column in enumerate(flat.T):
        good = np.isfinite(column)
        if good.any():
            filled[:, k] = np.interp(time, time[good], column[good])
    found = [filled, 0 * filled, 0 * filled]
    if window >= 3:
        found = [savgol_filter(filled, window, 2, deriv=d, delta=step, axis=0) for d in range(3)]
    places, first, second = (np.where(np.isfinite(x), y.reshape(x.shape), np.nan) for y in found)
    return places, first, second


def _bend(x: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Return curvature vectors at inner markers [1/m], towards the inner side, shape (F, M, 3); NaN at the ends."""
    out = np.full(x.shape, np.nan)
    edge = np.diff(x, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = edge / np.linalg.norm(edge, axis=-1, keepdims=True)
    out[:, 1:-1] = np.diff(tangent, axis=1) / (0.5 * (arclength[2:] - arclength[:-2]))[:, None]
    return out


def _map(found: Sequence[Residual]) -> np.ndarray:
    frames = min(len(r.error) for r in found)
    squares = np.stack([r.distance[:frames] ** 2 for r in found])
    count = np.isfinite(squares).sum(0)
    return np.where(count > 0, np.sqrt(np.nansum(squares, 0) / np.maximum(count, 1)), np.nan)


def _groups(found: Sequence[Residual]) -> np.ndarray:
    """Return the group of each frame and marker, flat: trials, or quarters of a single one."""
    if len(found) > 1:
        return np.concatenate([np.full(r.distance.size, k) for k, r in enumerate(found)])
    frames, markers = found[0].distance.shape
    return np.repeat(np.arange(frames) * 4 // frames, markers)


def _flat(found: Sequence[Residual], name: str) -> np.ndarray:
    return np.concatenate([r.states[name][:, r.free].ravel() for r in found])


def _against(name: str, before: Sequence[Residual], after: Sequence[Residual]) -> Against:
    state, group = _flat(before, name), _groups(before)
    values = np.unique(state[np.isfinite(state)])
    if len(values) > 2 * _BINS:
        edges = np.unique(np.nanquantile(state, np.linspace(0, 1, _BINS + 1)))
    else:
        edges = np.append(values - 1e-9, values[-1] + 1e-9)
    row = np.clip(np.searchsorted(edges, state, side="right") - 1, 0, len(edges) - 2)
    count = len(edges) - 1
    shown, shares = [], []
    for found in (before, after):
        distance = np.concatenate([r.distance.ravel() for r in found])
        # Fast places are often far from the grippers too: only what goes beyond the place counts as the state's.
        usual = 1.0 if name == "place" else np.sqrt(by_marker(found)) + 1e-12
        relative = np.concatenate([(r.distance / usual).ravel() for r in found])
        good = np.isfinite(distance) & np.isfinite(state)
        squares = np.bincount(row[good], distance[good] ** 2, count) / np.maximum(
            np.bincount(row[good], None, count), 1
        )
        shown.append(np.sqrt(squares))
        shares.append(_explained(relative[good], row[good], group[good], count))
    centres = np.array([np.nanmedian(state[row == k]) if (row == k).any() else np.nan for k in range(count)])
    return Against(name, centres, shown[0], shown[1], shares[0], shares[1])


def _explained(values: np.ndarray, row: np.ndarray, group: np.ndarray, count: int) -> float:
    """Return the share of the variance that the means of rows explain in each group, learned on the other groups."""
    total = np.bincount(row, values, count)
    number = np.bincount(row, None, count)
    wrong = right = 0.0
    for each in np.unique(group):
        own = group == each
        t = total - np.bincount(row[own], values[own], count)
        n = number - np.bincount(row[own], None, count)
        mean = t.sum() / max(n.sum(), 1)
        guess = np.where(n > 0, t / np.maximum(n, 1), mean)
        wrong += float(((values[own] - guess[row[own]]) ** 2).sum())
        right += float(((values[own] - mean) ** 2).sum())
    return float(np.clip(1 - wrong / (right + 1e-30), 0.0, 1.0))


def _parts(found: Sequence[Residual]) -> dict[str, tuple[float, np.ndarray]]:
    """Return the share of the squared residual that each part takes away on trials left out, and its amounts."""
    error, group = np.concatenate([r.error[:, r.free].reshape(-1, 3) for r in found]), _groups(found)
    marker = np.concatenate([np.tile(np.arange(r.free.sum()), len(r.error)) for r in found])
    seen = np.isfinite(error).all(1)
    out = {}
    for name, row in (("shift", np.zeros_like(marker)), ("offsets", marker)):
        out[name] = _averaged(error[seen], row[seen], group[seen])
    for name, key in (("lag", "velocity"), ("inertia", "acceleration"), ("bend", "bend")):
        field = np.concatenate([r.fields[key][:, r.free].reshape(-1, 3) for r in found])
        both = seen & np.isfinite(field).all(1)
        share, amount = _scaled(field[both], error[both], group[both])
        # Of the whole residual, also of where the field is not known.
        out[name] = share * float((error[both] ** 2).sum() / ((error[seen] ** 2).sum() + 1e-30)), amount
    return out


def _averaged(y: np.ndarray, row: np.ndarray, group: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of y^2 that the means of its rows take away in each group, learned on the others; the means."""
    count, left = int(row.max()) + 1, 0.0

    def sums(pick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        total = np.stack([np.bincount(row[pick], y[pick, c], count) for c in range(3)], 1)
        return total, np.bincount(row[pick], None, count)[:, None]

    total, number = sums(np.ones(len(y), bool))
    for g in np.unique(group):
        t, n = sums(group == g)
        mean = (total - t) / np.maximum(number - n, 1)
        left += float(((y[group == g] - mean[row[group == g]]) ** 2).sum())
    return float(np.clip(1 - left / (float((y**2).sum()) + 1e-30), 0.0, 1.0)), total / np.maximum(number, 1)


def _scaled(field: np.ndarray, y: np.ndarray, group: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of y^2 that a multiple of a field takes away in each group, learned on the others; which."""
    product, square, left = (field * y).sum(1), (field**2).sum(1), 0.0
    for g in np.unique(group):
        own = group == g
        factor = product[~own].sum() / (square[~own].sum() + 1e-30)
        left += float(((y[own] - factor * field[own]) ** 2).sum())
    share = float(np.clip(1 - left / (float((y**2).sum()) + 1e-30), 0.0, 1.0))
    return share, np.array([product.sum() / (square.sum() + 1e-30)])
