"""What a fitted model is worth: its predictions of all trials, before and after, beside predictions without a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.metrics import average, free_marker_distance, mean_absolute_error
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.trivial_predictors import BASELINES

Predictions = dict[str, np.ndarray]
"""Marker positions [m] by trial name, each of shape (F, M, 3)."""


def predict(
    model: RopeModel, trials: Sequence[Trial], values: np.ndarray, simulate: starts.Simulator | None = None
) -> Predictions:
    """Simulate trials from starts estimated from their first 0.1 s, by the model itself or what stands in for it."""
    motion = model.motion(trials)
    simulate = simulate or starts.simulator(model, motion)
    begin = starts.refine(model, motion, starts.begin(model, trials), values, simulate)
    sims = simulate(begin, values[None], None)[0]
    return {name: sim[:frames] for name, sim, frames in zip(motion.names, sims, motion.frames, strict=True)}


def errors(recording: Recording, predictions: Predictions) -> dict[str, float]:
    """Return `train_mae_mm` and `test_mae_mm`."""
    return {
        f"{split}_mae_mm": 1e3 * average(mean_absolute_error, [predictions[t.name] for t in trials], trials)
        for split, trials in (("train", recording.train), ("test", recording.test))
    }


def trivial_errors(recording: Recording) -> dict[str, dict[str, float]]:
    """Return the errors of predictions without a model, by their names."""
    trials = (*recording.train, *recording.test)
    return {name: errors(recording, {t.name: rule(t, recording) for t in trials}) for name, rule in BASELINES.items()}


def by_trial(recording: Recording, before: Predictions, after: Predictions) -> list[dict[str, Any]]:
    """Return the errors of every trial."""
    return [
        {
            "name": t.name,
            "split": split,
            "mae_mm": 1e3 * mean_absolute_error(after[t.name], t),
            "before_mae_mm": 1e3 * mean_absolute_error(before[t.name], t),
            "free_distance_mm": 1e3 * free_marker_distance(after[t.name], t),
        }
        for split, trials in (("train", recording.train), ("test", recording.test))
        for t in trials
    ]


def rope_content(recording: Recording, rest: str) -> dict[str, Any]:
    """Return what a model file says of the rope itself."""
    return {
        "length": recording.length,
        "radius": recording.radius,
        "mass": recording.mass,
        "marker_mass": recording.marker_mass,
        "gravity": list(recording.gravity),
        "table_height": recording.table_height,
        "fluid_density": recording.fluid_density,
        "rest": rest,
        "rest_positions": recording.rest_positions if rest == "given" else None,
    }
