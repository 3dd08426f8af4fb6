"""What a calibration found, and the plain objects made of it for JSON files."""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Calibration", "Overlay", "model_json", "result_json", "result_summary", "summary_json", "versions"]


@dataclass(frozen=True, eq=False)
class Overlay:
    """A picture of a film and where the simulated rope is in it."""

    title: str
    """Trial, camera and time."""
    split: str
    """train or test."""
    picture: np.ndarray
    """Grey, shape (H, W) uint8."""
    before: np.ndarray
    """The rope before the fit [px], shape (M, 2)."""
    after: np.ndarray
    """The rope after the fit [px], shape (M, 2)."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A rope model fitted to the train trials of a recording, judged on its test trials."""

    parameters: dict[str, dict[str, Any]]
    """Fitted numbers by name, each with `value`, `low`, `high` (a 90 % interval, see `notes`) and
    `unit`."""
    train_mae_mm: float
    """Mean absolute error per coordinate on the train trials after the fit [mm]."""
    test_mae_mm: float
    """Mean absolute error per coordinate on the test trials after the fit [mm]."""
    before: dict[str, float]
    """`train_mae_mm` and `test_mae_mm` with the numbers that the fit started from."""
    baselines: dict[str, dict[str, float]]
    """By baseline name (`frozen_shape`, `catenary`): `train_mae_mm` and `test_mae_mm`."""
    per_trial: list[dict[str, Any]]
    """One object per trial: `name`, `split`, `mae_mm`, `before_mae_mm`, `free_distance_mm`."""
    seconds: float
    """Time that the calibration took [s]."""
    model: dict[str, Any]
    """The model file: what the simulator needs to predict this rope again."""
    predictions: dict[str, np.ndarray]
    """Simulated marker positions after the fit by trial name [m], each of shape (F, M, 3)."""
    predictions_before: dict[str, np.ndarray]
    """Simulated marker positions before the fit by trial name [m], each of shape (F, M, 3)."""
    seed: int = 0
    """Seed of the random starts."""
    interrupted: bool = False
    """Whether the user stopped the fit, so that this is the best until then."""
    notes: list[str] = field(default_factory=list)
    """Sentences that a reader of the result should know."""
    overlays: list[Overlay] = field(default_factory=list)
    """Pictures of films with the rope before and after, if there are films."""


def result_summary(result: Calibration, recording: str | Path) -> dict[str, Any]:
    """The result without its motions, for people and programs."""
    return {
        "recording": str(recording),
        "test_mae_mm": result.test_mae_mm,
        "train_mae_mm": result.train_mae_mm,
        "before": result.before,
        "baselines": result.baselines,
        "parameters": result.parameters,
        "per_trial": result.per_trial,
        "seconds": result.seconds,
        "seed": result.seed,
        "interrupted": result.interrupted,
        "notes": result.notes,
        "versions": versions(),
    }


def summary_json(result: Calibration, recording: str | Path) -> str:
    """`result_summary` as JSON text."""
    return result_json({"generator": "torchdlo calibrate"} | result_summary(result, recording))


def model_json(result: Calibration) -> str:
    """The model file as JSON text, marked as ours."""
    return result_json({"generator": "torchdlo calibrate"} | result.model)


def versions() -> dict[str, str]:
    """Versions of what the result depends on."""
    found = {"python": platform.python_version()}
    for name in ("torchdlo", "torch", "numpy"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def result_json(content: dict[str, Any]) -> str:
    """Plain objects as JSON text."""
    # JSON has no NaN: a number that is not finite is written as null.
    return json.dumps(_plain(content), indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """Python numbers, lists and dicts only; None in the place of what is not finite."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
