"""Train trials that no model follows though the others are followed: what is seen in them leads a search astray.

A start that is measured badly, or a rope that snaps over to one side or the other, makes a motion that hardly tells of
the rope. Test trials are never left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from torchdlo.sysid.recordings.recording import Trial

__all__ = ["MisleadingTrial", "errors_by_frame", "misleading_trials"]

_APART = 3.0
"""Times what models leave of the other trials, and of a perfect model's error, from which a trial is not followed."""

_MOSTLY = 0.6
"""Share of the frames after which a trial is taken to be lost that have to be that far off."""

_EARLY = 0.3
"""Time before which it is the start that does not fit [s]."""

_AT_ONCE = 0.25
"""Time within which simulation and measurement part where a rope snaps over [s]."""

_LEAST = 3
"""Trials without which nothing is usual."""


@dataclass(frozen=True)
class MisleadingTrial:
    """A train trial that no model follows, though models follow the others."""

    name: str
    """Of the trial."""
    frame: int
    """From which frame on it does not count."""
    time: float
    """When that is [s]."""
    why: str
    """What seems to be wrong with it."""


def errors_by_frame(sims: np.ndarray, trials: Sequence[Trial], frame_weights: np.ndarray | None) -> np.ndarray:
    """Return weighted errors of the free markers by frame [m], root mean square, shape (B, F); NaN where not seen.

    Args:
        sims: simulated markers [m], shape (B, F, M, 3).
        trials: B trials.
        frame_weights: what errors of frames are multiplied by [1], shape (B, F); 1 if not given.
    """
    found = np.full(sims.shape[:2], np.nan)
    for k, trial in enumerate(trials):
        count, free = len(trial.time), ~trial.gripped
        error = np.where(trial.suspect[:, None, None], np.nan, trial.markers)[:, free] - sims[k][:count, free]
        seen = np.isfinite(trial.markers[:, free]) & ~trial.suspect[:, None, None]
        square = np.where(seen, np.nan_to_num(error**2, nan=np.inf), 0.0).sum((1, 2))
        number = seen.sum((1, 2))
        size = np.sqrt(np.divide(square, number, out=np.full(count, np.nan), where=number > 0))
        weight = np.ones(count) if frame_weights is None else frame_weights[k][:count]
        found[k, :count] = np.where(weight > 0, weight, np.nan) * size
    return found


class Timed(Protocol):
    """A trial, or a film of one."""

    @property
    def name(self) -> str:
        """Name of the trial."""

    @property
    def time(self) -> np.ndarray:
        """Times of the frames [s], shape (F,)."""


def misleading_trials(errors: np.ndarray, trials: Sequence[Timed], level: float) -> list[MisleadingTrial]:
    """Return the trials that none of several models follows though models follow the others.

    Args:
        errors: of L models by trial and frame, shape (L, B, F) [m], see `errors_by_frame`.
        trials: B trials.
        level: error of a perfect model [m].
    """
    if len(trials) < _LEAST or not np.isfinite(level):
        return []
    gaps = np.sqrt(np.array([[np.nanmean(e**2) if np.isfinite(e).any() else np.inf for e in m] for m in errors]))
    # The model that follows most trials best: of each by itself the best would follow its faults as well.
    best = int(np.argmin(np.median(gaps, axis=1)))
    found = []
    for k, trial in enumerate(trials):
        usual = max(float(np.median(np.delete(gaps[best], k))), level)
        bar = _APART * usual
        if gaps[:, k].min() <= bar:
            continue
        own = np.nan_to_num(errors[int(np.argmin(gaps[:, k])), k, : len(trial.time)], nan=0.0, posinf=np.inf)
        frame = _parts(own > bar)
        if frame is not None:
            found.append(MisleadingTrial(trial.name, frame, float(trial.time[frame]), _why(own, trial, frame, bar)))
    return found if len(trials) - len(found) >= _LEAST - 1 else []


def _parts(off: np.ndarray) -> int | None:
    """Return the first frame from which on most are off (F,), None if there is none."""
    later = np.cumsum(off[::-1])[::-1] / np.arange(len(off), 0, -1)
    lost = np.flatnonzero(off & (later >= _MOSTLY))
    if len(lost):
        return int(lost[0])
    at = np.flatnonzero(off)
    # What comes back is left out from where it is off first.
    return int(at[0]) if len(at) else None


def _why(errors: np.ndarray, trial: Timed, frame: int, bar: float) -> str:
    """Return what seems to be wrong with a trial that models do not follow from a frame on."""
    if trial.time[frame] < _EARLY:
        return "simulations are off from the beginning: its start is measured badly, or differs from the others'"
    window = max(1, round(_AT_ONCE / float(trial.time[1] - trial.time[0])))
    grown = errors[frame : frame + window].max()
    if grown > 2 * bar:
        return "simulations and measurement part at once, as where a rope snaps over to one side or the other"
    return "simulations and measurement drift apart, as where a motion magnifies small errors"
