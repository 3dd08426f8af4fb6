"""How far a predicted motion is from a measured one.

`mean_absolute_error` is the measure published for the DEFORM cables (Chen et al., CoRL 2024):
every marker counts, gripped ones too, and every frame from 0.02 s on, suspect ones too.
A marker that was not seen (NaN in the measurement) does not count; a prediction that is not
finite makes the error NaN, so that a simulation that blew up never looks good.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torchdlo.sysid.recordings.recording import Trial

__all__ = ["FIRST_SCORED", "average", "free_marker_distance", "mean_absolute_error", "scored"]

FIRST_SCORED = 0.02
"""Time of the first frame that counts [s]; what comes before serves to estimate the start."""


def scored(trial: Trial) -> np.ndarray:
    """Frames that count, shape (F,) bool."""
    return trial.time >= FIRST_SCORED - 1e-9


def mean_absolute_error(predicted: np.ndarray, trial: Trial) -> float:
    """Mean absolute error per coordinate [m], over all markers and the scored frames.

    Args:
        predicted: Marker positions [m], shape (F, M, 3).
        trial: The measurement.
    """
    return _mean_seen(np.abs(_difference(predicted, trial)))


def free_marker_distance(predicted: np.ndarray, trial: Trial) -> float:
    """Mean Euclidean distance of the free markers [m], over the scored frames.

    Args:
        predicted: Marker positions [m], shape (F, M, 3).
        trial: The measurement.
    """
    return _mean_seen(_distance(_difference(predicted, trial)[:, ~trial.gripped]))


def average(
    measure: Callable[[np.ndarray, Trial], float],
    predictions: Iterable[np.ndarray],
    trials: Iterable[Trial],
) -> float:
    """Mean of a measure over trials, each trial counting the same."""
    return float(np.mean([measure(p, trial) for p, trial in zip(predictions, trials, strict=True)]))


def _difference(predicted: np.ndarray, trial: Trial) -> np.ndarray:
    predicted = np.asarray(predicted, dtype=float)
    if predicted.shape != trial.markers.shape:
        raise ValueError(
            f"{trial.name}: expected a prediction of shape {trial.markers.shape}, one position "
            f"for each frame and marker, got {predicted.shape}."
        )
    # Measured NaN marks what was not seen and is left out; predicted NaN must stay visible.
    seen = ~np.isnan(trial.markers)
    difference = np.where(seen, predicted - trial.markers, np.nan)
    broken = seen & ~np.isfinite(predicted)
    return np.where(broken, np.inf, difference)[scored(trial)]


def _distance(difference: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(difference).sum(-1))


def _mean_seen(error: np.ndarray) -> float:
    seen = error[~np.isnan(error)]
    if not len(seen) or not np.isfinite(seen).all():
        return float("nan")
    return float(seen.mean())
