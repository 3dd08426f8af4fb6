"""A stand-in for the fit, so that what surrounds it is tested in milliseconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from torchdlo.sysid import Recording
from torchdlo.sysid.estimation.result import Calibration
from torchdlo.sysid.recordings.metrics import average, free_marker_distance, mean_absolute_error
from torchdlo.sysid.recordings.trivial_predictors import BASELINES


def fake_result(recording: Recording, *, share: float = 0.8, **fields: Any) -> Calibration:
    """Predictions that lie between the catenary and the truth, `share` of the way."""
    trials = {t.name: t for t in recording.train + recording.test}
    trivial = {
        name: {key: predict(trial, recording) for key, trial in trials.items()} for name, predict in BASELINES.items()
    }
    start = trivial["catenary"]
    after = {key: start[key] + share * np.nan_to_num(trial.markers - start[key]) for key, trial in trials.items()}

    def errors(predictions: dict[str, np.ndarray]) -> dict[str, float]:
        return {
            f"{split}_mae_mm": 1e3 * average(mean_absolute_error, [predictions[t.name] for t in group], group)
            for split, group in (("train", recording.train), ("test", recording.test))
        }

    per_trial = [
        {
            "name": key,
            "split": key.split("_")[0],
            "mae_mm": 1e3 * mean_absolute_error(after[key], trial),
            "before_mae_mm": 1e3 * mean_absolute_error(start[key], trial),
            "free_distance_mm": 1e3 * free_marker_distance(after[key], trial),
        }
        for key, trial in trials.items()
    ]
    stiffness = {"value": np.float64(5e-4), "low": 4e-4, "high": np.inf, "unit": "N m^2"}
    return Calibration(
        **{
            "parameters": {"bending_stiffness": stiffness},
            **errors(after),
            "before": errors(start),
            "baselines": {name: errors(predictions) for name, predictions in trivial.items()},
            "per_trial": per_trial,
            "seconds": 1.5,
            "model": {"vertices": 31, "bending_stiffness": np.float32(5e-4)},
            "predictions": after,
            "predictions_before": start,
            **fields,
        }
    )


class FakeFit:
    """Called like the fit; remembers its options and counts to `iterations` in the callback."""

    def __init__(self) -> None:
        self.options: dict[str, Any] = {}
        self.fields: dict[str, Any] = {}
        self.during: Callable[[int], None] = lambda iteration: None
        self.keep_best = True

    def __call__(self, recording: Recording, *, callback: Callable[..., None], **options: Any) -> Calibration:
        self.options = options
        try:
            for iteration in range(options.get("iterations", 3)):
                self.during(iteration)
                callback("fit", iteration + 1, options.get("iterations", 3), "error 1 mm")
        except KeyboardInterrupt:
            if not self.keep_best:
                raise
            return fake_result(recording, interrupted=True)
        return fake_result(recording, seed=options["seed"], **self.fields)
