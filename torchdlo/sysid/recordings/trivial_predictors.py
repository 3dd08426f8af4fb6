"""What a prediction must beat: two rules without a single fitted number.

`frozen_shape` keeps the shape of the start and lets the grippers carry it along;
`catenary` hangs an inextensible, perfectly flexible rope between the grippers, at rest.
The closed form of the catenary: Irvine, "Cable Structures", 1981, chapter 1.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchdlo.sysid.recordings.metrics import scored

if TYPE_CHECKING:
    from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = ["BASELINES", "catenary", "frozen_shape", "hang"]


def frozen_shape(trial: Trial, recording: Recording | None = None) -> np.ndarray:
    """The shape just before scoring starts, each free marker moved along with the grippers.

    A marker between two gripped ones is displaced by a mixture of their displacements, weighted
    by distance along the rope; a marker on a free end by that of the nearest gripped one.

    Args:
        trial: Only its gripped markers and its first frames are used.
        recording: Not used; here so that all baselines are called alike.

    Returns:
        Marker positions [m], shape (F, M, 3).
    """
    del recording
    start = max(int(np.argmax(scored(trial))) - 1, 0)
    shape = _fill(trial.markers[start], trial.marker_arclength)
    held = np.flatnonzero(trial.gripped)
    displacement = trial.markers[:, held] - shape[held]
    weights = _linear_weights(trial.marker_arclength, trial.marker_arclength[held])
    return shape + np.einsum("mg,fgc->fmc", weights, displacement)


def catenary(trial: Trial, recording: Recording) -> np.ndarray:
    """Catenaries of the measured lengths between the gripped markers; free ends hang straight down.

    Table, stiffness, speed and markers beside the axis are ignored.

    Args:
        trial: Only its gripped markers are used.
        recording: For the direction of gravity, the length and whether the rope is closed.

    Returns:
        Marker positions [m], shape (F, M, 3).
    """
    size = np.linalg.norm(recording.gravity)
    down = recording.gravity / size if size > 0 else np.array([0.0, 0.0, -1.0])
    predicted = np.array(trial.markers, dtype=float)
    for run in _free_runs(trial, recording.length if recording.closed else None):
        start = trial.markers[:, run.start]
        if run.end is None:
            predicted[:, run.markers] = start[:, None] + run.along[:, None] * down
        else:
            end = trial.markers[:, run.end]
            predicted[:, run.markers] = hang(start, end, run.along, run.length, down)
    return predicted


BASELINES = {"frozen_shape": frozen_shape, "catenary": catenary}
"""Each takes a trial and its recording and returns marker positions [m], shape (F, M, 3)."""


def hang(start: np.ndarray, end: np.ndarray, along: np.ndarray, length: float, down: np.ndarray) -> np.ndarray:
    """Points of an inextensible rope at rest between two supports; straight where it is too short.

    Args:
        start: First support [m], shape (F, 3).
        end: Second support [m], shape (F, 3).
        along: Distances of the wanted points from the first support along the rope [m], shape (K,).
        length: Length of rope between the supports [m].
        down: Unit vector of gravity, shape (3,).

    Returns:
        Positions [m], shape (F, K, 3).
    """
    chord = end - start
    rise = -chord @ down
    level = chord + rise[:, None] * down
    span = np.linalg.norm(level, axis=-1)
    # A tiny span stands in for none: the loop then hangs as two vertical strands.
    span_safe = np.maximum(span, 1e-9 * length)
    across = level / span_safe[:, None]
    slack = length**2 - rise**2 - span_safe**2
    # Below this slack the sag is under a micrometre per metre and the formula loses its digits.
    taut = slack < 1e-12 * length**2
    straight = start[:, None] + chord[:, None] * (along / length)[:, None]
    rope = np.sqrt(np.where(taut, span_safe**2 * 1.01, slack + span_safe**2))
    # sinh(x)/x = sqrt(L^2 - rise^2) / span, with x = span / 2a and a the catenary's parameter.
    x = _inverse_sinhc(np.log(rope / span_safe))
    a = (0.5 * span_safe / x)[:, None]
    lowest = 0.5 * (rise / np.tanh(x) - length)[:, None]  # arclength of the start from the vertex
    here = lowest + along
    run = a * (np.arcsinh(here / a) - np.arcsinh(lowest / a))
    height = (here - lowest) * (here + lowest) / (np.hypot(a, here) + np.hypot(a, lowest))
    slung = start[:, None] + run[..., None] * across[:, None] - height[..., None] * down
    return np.where(taut[:, None, None], straight, slung)


def _inverse_sinhc(log_ratio: np.ndarray) -> np.ndarray:
    """Solve log(sinh(x)/x) = log_ratio for x > 0 by Newton's method, shape of the argument."""
    # Convex and increasing: from below, the first step lands above the root, then it only falls.
    x = np.sqrt(6.0 * np.maximum(log_ratio, 1e-14))
    for _ in range(60):
        # log sinh x without overflow; for small x by its series, where the difference cancels.
        small = x < 1e-2
        safe = np.where(small, 1.0, x)
        value = np.where(
            small,
            x**2 / 6 - x**4 / 180,
            safe + np.log1p(-np.exp(-2 * safe)) - np.log(2 * safe),
        )
        gradient = np.where(small, x / 3 - x**3 / 45, 1 / np.tanh(safe) - 1 / safe)
        step = (value - log_ratio) / gradient
        x = np.maximum(x - step, 1e-9)
        if np.all(np.abs(step) <= 1e-13 * x):
            break
    return x


class _Run(NamedTuple):
    """Neighbouring free markers and the gripped ones that hold them."""

    start: int
    end: int | None
    markers: np.ndarray
    along: np.ndarray
    length: float


def _free_runs(trial: Trial, circumference: float | None) -> list[_Run]:
    """Split the free markers by the gripped ones; a closed rope has its length as circumference."""
    s = trial.marker_arclength
    held = np.flatnonzero(trial.gripped)
    first, last = int(held[0]), int(held[-1])
    runs = []
    for left, right in pairwise(held.tolist()):
        if right - left > 1:
            inside = np.arange(left + 1, right)
            runs.append(_Run(left, right, inside, s[inside] - s[left], s[right] - s[left]))
    before, after = np.arange(first), np.arange(last + 1, len(s))
    if circumference is not None:
        around = np.concatenate([after, before])
        along = np.concatenate([s[after] - s[last], s[before] + circumference - s[last]])
        if len(around):
            runs.append(_Run(last, first, around, along, s[first] + circumference - s[last]))
        return runs
    if len(before):
        runs.append(_Run(first, None, before, s[first] - s[before], s[first]))
    if len(after):
        runs.append(_Run(last, None, after, s[after] - s[last], s[-1] - s[last]))
    return runs


def _linear_weights(at: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Weights of linear interpolation, constant beyond the ends, shape (len(at), len(knots))."""
    return np.stack([np.interp(at, knots, unit) for unit in np.eye(len(knots))], axis=1)


def _fill(shape: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Replace markers not seen by interpolation along the rope [m], shape (M, 3)."""
    seen = ~np.isnan(shape).any(-1)
    return _linear_weights(arclength, arclength[seen]) @ shape[seen]
