"""Pictures of searches and of training: returns, successes and what algorithms say, over episodes."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchdlo.untrusted import for_plot

__all__ = ["learned_png", "learning_png", "stages_png", "training_png"]

_COLORS = {"cmaes": "#3d348b", "gd": "#e09f3e", "hybrid": "#00798c"}
_OTHER = "#1f2933"


def learning_png(panels: Mapping[str, Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]]) -> bytes:
    """The picture as PNG; drawn without a display.

    Args:
        panels: by title, by method, one learning curve per seed; a curve has entries with `episodes`, `best` and
            `median`. The middle of the seeds is a line, their range is a band; the median of the population is dotted
            where there is one seed.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5.4 * columns, 3.8 * rows), dpi=120, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (title, methods) in zip(grid, panels.items(), strict=False):
        for method, curves in methods.items():
            _draw(axes, method, curves)
        axes.set(title=for_plot(title), xlabel="episodes", ylabel="best return so far")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False, fontsize=8)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    return _png(figure)


def _draw(axes: Axes, method: str, curves: Sequence[Sequence[Mapping[str, Any]]]) -> None:
    color = _COLORS.get(method, _OTHER)
    count = min(len(curve) for curve in curves)
    episodes = [point["episodes"] for point in curves[0][:count]]
    best = np.array([[np.nan if p["best"] is None else p["best"] for p in curve[:count]] for curve in curves])
    axes.plot(episodes, np.median(best, 0), color=color, lw=2, label=for_plot(method))
    if len(curves) > 1:
        axes.fill_between(episodes, best.min(0), best.max(0), color=color, alpha=0.15, lw=0)
        return
    median = np.array([np.nan if p["median"] is None else p["median"] for p in curves[0]])
    axes.plot(episodes, median, color=color, lw=1, ls=":", label="median of the population")


def training_png(runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """The picture of training as PNG: returns and shares of successes over episodes.

    Args:
        runs: by name, one entry per batch with `episodes`, `return`, `success` and `failed`.
    """
    figure, (left, right) = _panels(2)
    for name, rows in runs.items():
        episodes = [row["episodes"] for row in rows]
        left.plot(episodes, [row["return"] for row in rows], lw=2, label=for_plot(name))
        (line,) = right.plot(episodes, [100 * row["success"] for row in rows], lw=2, label="success")
        failed = [100 * row["failed"] for row in rows]
        right.plot(episodes, failed, color=line.get_color(), lw=1, ls=":", label="failed")
    left.set(xlabel="episodes", ylabel="mean return of a batch")
    right.set(xlabel="episodes", ylabel="share of a batch [%]", ylim=(-2, 102))
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
    return _png(figure)


def learned_png(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> bytes:
    """The picture of what an algorithm says of its batches as PNG, a panel for each number.

    Args:
        rows: one entry per batch with `episodes`.
        names: of the numbers; a batch may lack some.
    """
    figure, panels = _panels(len(names))
    for axes, name in zip(panels, names, strict=True):
        axes.plot([row["episodes"] for row in rows], [row.get(name, np.nan) for row in rows], color=_OTHER, lw=1.5)
        axes.set(xlabel="episodes", ylabel=for_plot(name.replace("_", " ")))
    return _png(figure)


def stages_png(logs: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """The picture of the hybrid's stages as PNG: shares of successes, a panel for each stage.

    Args:
        logs: by stage, entries with `success`, and `episodes` where they were counted.
    """
    figure, panels = _panels(len(logs))
    for axes, (name, log) in zip(panels, logs.items(), strict=True):
        counted = all("episodes" in row for row in log)
        x = [row["episodes"] for row in log] if counted else range(1, 1 + len(log))
        axes.plot(x, [100 * row["success"] for row in log], "o-", color="#00798c", lw=2, ms=4, label="success")
        if any("noisy" in row for row in log):
            noisy = [100 * row.get("noisy", np.nan) for row in log]
            axes.plot(x, noisy, color=_OTHER, lw=1, ls=":", label="with noise on the actions")
            axes.legend(frameon=False, fontsize=8)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        what = "episodes" if counted else {"robust": "path that was tried", "clone": "round"}.get(name, "entry")
        axes.set(title=for_plot(name), xlabel=what, ylabel="success [%]", ylim=(-2, 102))
    return _png(figure)


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure without a display, and its panels, at most three in a row."""
    columns = min(3, max(count, 2))
    rows = -(-count // columns)
    figure = Figure(
        figsize=(10.8, 3.8 * rows if count < 3 else 3.1 * rows), dpi=120, facecolor="white", layout="constrained"
    )
    FigureCanvasAgg(figure)
    panels = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in panels:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[count:]:
        axes.set_axis_off()
    return figure, panels[:count]


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()
