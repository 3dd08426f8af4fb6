"""The picture of a calibration: shapes, errors in place and time, and what had to be beaten."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchdlo.sysid.estimation.result import Calibration
from torchdlo.sysid.recordings.metrics import mean_absolute_error, scored
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.untrusted import for_plot

__all__ = ["calibration_png"]

_BEFORE = "#d1495b"
_AFTER = "#00798c"
_OTHER = "#9aa5b1"
_INK = "#1f2933"
_TIMES = ("#3d348b", "#0f8b8d", "#e09f3e", "#9e2a2b")
"""One colour for each snapshot, dark to warm."""
_NAMES = {"frozen_shape": "frozen shape", "catenary": "catenary"}


def calibration_png(result: Calibration, recording: Recording) -> bytes:
    """The picture as PNG; drawn without a display and without touching matplotlib's settings."""
    trials = _chosen(result, recording)
    figure = Figure(figsize=(13.2, 11.4), dpi=120, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    (shapes,), (errors,) = figure.subfigures(2, 1, height_ratios=(2.2, 1.0), squeeze=False)
    panels = shapes.subplots(2, len(trials), squeeze=False)
    for (above, below), trial in zip(panels.T, trials, strict=True):
        _overlay(above, trial, result.predictions_before[trial.name], recording, "before", _BEFORE)
        _overlay(below, trial, result.predictions[trial.name], recording, "after", _AFTER)
    left, middle, right = errors.subplots(1, 3)
    _error_along_rope(left, result, recording.test)
    _error_over_time(middle, result, recording.test)
    _bars(right, result)
    shapes.suptitle(
        f"{for_plot(recording.path.resolve().name)}: measured (dots) and simulated (lines), test trials",
        fontsize=14,
        color=_INK,
        fontweight="bold",
    )
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()


def _chosen(result: Calibration, recording: Recording) -> list[Trial]:
    """The test trials with the smallest, the middle and the largest error after the fit."""
    error = {entry["name"]: entry["mae_mm"] for entry in result.per_trial}
    trials = sorted(recording.test, key=lambda trial: error.get(trial.name, 0.0))
    picks = sorted({0, len(trials) // 2, len(trials) - 1})
    return [trials[i] for i in picks]


def _overlay(
    axes: Any,
    trial: Trial,
    predicted: np.ndarray,
    recording: Recording,
    when: str,
    color: str,
) -> None:
    frames = np.linspace(np.argmax(scored(trial)), len(trial.time) - 1, len(_TIMES) + 1)
    frames = frames[1:].round().astype(int)
    across, up, up_label = _plane(trial, recording)
    for frame, shade in zip(frames, _TIMES, strict=True):
        measured, simulated = trial.markers[frame], predicted[frame]
        axes.plot(simulated @ across, simulated @ up, color=shade, lw=2.0, solid_capstyle="round")
        axes.plot(measured @ across, measured @ up, "o", color=shade, ms=4.5, mec="white", mew=0.6)
    if recording.table_height is not None and up_label.startswith("height"):
        axes.axhline(recording.table_height, color=_OTHER, lw=1.2, ls="--", zorder=0)
    error = mean_absolute_error(predicted, trial) * 1e3
    said = f"{error:.1f} mm" if np.isfinite(error) else "not finite"
    axes.set_title(f"{for_plot(trial.name)}, {when}: {said}", fontsize=11, color=color, loc="left")
    _frame(axes, trial.markers[frames] @ across, trial.markers[frames] @ up)
    _style(axes, "along the main direction [m]", up_label)
    handles = [
        Line2D([], [], color=shade, marker="o", ms=4.5, lw=2, label=f"{trial.time[frame]:.1f} s")
        for frame, shade in zip(frames, _TIMES, strict=True)
    ]
    if when == "before":
        axes.legend(handles=handles, fontsize=8, frameon=False, ncols=2, loc="best")


def _frame(axes: Any, x: np.ndarray, y: np.ndarray) -> None:
    """Limits of the same scale from the measurement alone.

    So the panels of a trial agree, and a simulation that blew up does not shrink the rest.
    """
    shape = 0.85  # height of a panel over its width
    size = max(np.nanmax(x) - np.nanmin(x), (np.nanmax(y) - np.nanmin(y)) / shape)
    for values, half, set_limits in (
        (x, 0.58 * size, axes.set_xlim),
        (y, 0.58 * size * shape, axes.set_ylim),
    ):
        middle = 0.5 * (np.nanmax(values) + np.nanmin(values))
        set_limits(middle - half, middle + half)
    axes.set_aspect("equal", adjustable="box")


def _plane(trial: Trial, recording: Recording) -> tuple[np.ndarray, np.ndarray, str]:
    """Two unit vectors of the plane that shows most of the motion, and the second one's label.

    The first is the level direction of the largest spread; the second is up or, where the rope
    stays at one height, the other level direction.
    """
    size = np.linalg.norm(recording.gravity)
    up = -recording.gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])
    points = trial.markers[~np.isnan(trial.markers).any(-1)]
    centred = points - points.mean(0)
    level = centred - (centred @ up)[:, None] * up
    across, aside = np.linalg.svd(level.T @ level)[0][:, :2].T
    across = across * np.sign(across[np.argmax(np.abs(across))])
    if np.std(points @ up) < 0.3 * np.std(points @ aside):
        return across, np.cross(up, across), "level, across it [m]"
    return across, up, "height [m]"


def _error_along_rope(axes: Any, result: Calibration, trials: Sequence[Trial]) -> None:
    for predictions, name, color in _both(result):
        errors = [_distance(predictions[t.name], t) for t in trials]
        profile = np.array([_over(np.nanmean, e) for e in errors]) * 1e3
        place = trials[0].marker_arclength
        _band(axes, place, profile, color)
        axes.plot(place, _over(np.nanmean, profile), "-o", color=color, ms=3.5, lw=1.8, label=name)
    held = trials[0].marker_arclength[trials[0].gripped]
    axes.plot(held, np.zeros(len(held)), "s", color=_INK, ms=5, clip_on=False, label="gripped")
    axes.set_title("Error along the rope (band: all test trials)", fontsize=11, loc="left")
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8, frameon=False)
    _style(axes, "arclength [m]", "mean distance [mm]")


def _error_over_time(axes: Any, result: Calibration, trials: Sequence[Trial]) -> None:
    longest = max(trials, key=lambda trial: len(trial.time))
    for predictions, name, color in _both(result):
        table = np.full((len(trials), len(longest.time)), np.nan)
        for row, trial in zip(table, trials, strict=True):
            error = _distance(predictions[trial.name], trial)[:, ~trial.gripped]
            row[: len(trial.time)] = _over(np.nanmean, error.T) * 1e3
        _band(axes, longest.time, table, color)
        axes.plot(longest.time, _over(np.nanmean, table), color=color, lw=1.8, label=name)
    axes.set_title("Error over time (free markers)", fontsize=11, loc="left")
    axes.set_xlim(0, longest.time[-1])
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8, frameon=False)
    _style(axes, "time [s]", "mean distance [mm]")


def _bars(axes: Any, result: Calibration) -> None:
    rows = [(_NAMES.get(name, name), values["test_mae_mm"], _OTHER) for name, values in result.baselines.items()]
    rows += [
        ("before calibration", result.before["test_mae_mm"], _BEFORE),
        ("calibrated", result.test_mae_mm, _AFTER),
    ]
    values = [value if np.isfinite(value) else 0.0 for _, value, _ in rows]
    bars = axes.barh(range(len(rows)), values, color=[color for *_, color in rows], height=0.62)
    labels = [f"{v:.1f} mm" if np.isfinite(v) else "not finite" for _, v, _ in rows]
    axes.bar_label(bars, labels, padding=4, fontsize=9, color=_INK)
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows])
    axes.invert_yaxis()
    axes.set_xlim(0, 1.22 * max([*values, 1e-9]))
    axes.set_title("Error on unseen trials", fontsize=11, loc="left")
    _style(axes, "mean absolute error per coordinate [mm]", "")
    axes.grid(axis="y", visible=False)


def _band(axes: Any, x: np.ndarray, table: np.ndarray, color: str) -> None:
    low, high = _over(np.nanmin, table), _over(np.nanmax, table)
    axes.fill_between(x, low, high, color=color, alpha=0.13, lw=0)


def _over(reduce: Callable[..., np.ndarray], table: np.ndarray) -> np.ndarray:
    """Reduce the first axis, leaving out NaN; NaN, without a warning, where nothing is left."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return reduce(table, axis=0)


def _both(result: Calibration) -> tuple[tuple[dict[str, np.ndarray], str, str], ...]:
    return (
        (result.predictions_before, "before", _BEFORE),
        (result.predictions, "after", _AFTER),
    )


def _distance(predicted: np.ndarray, trial: Trial) -> np.ndarray:
    """Distance of simulated and measured markers [m], NaN where unseen, shape (F, M)."""
    distance = np.linalg.norm(predicted - trial.markers, axis=-1)
    return np.where(np.isfinite(distance) & scored(trial)[:, None], distance, np.nan)


def _style(axes: Any, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=9, color=_INK)
    axes.set_ylabel(y, fontsize=9, color=_INK)
    axes.tick_params(labelsize=8.5, colors=_INK, length=3)
    axes.grid(color=to_rgb("#e4e7eb"), lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_OTHER)
