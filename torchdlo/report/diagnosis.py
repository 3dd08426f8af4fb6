"""The report of a diagnosis: one page that needs nothing but itself."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchdlo.files import write_atomically
from torchdlo.report.page import STYLE, number, page, table, words
from torchdlo.sysid.diagnose import Diagnosis
from torchdlo.sysid.findings import findings, kind, sentence, separating
from torchdlo.sysid.recording import Recording, Trial

__all__ = ["PAGE", "diagnosis_html", "write_report"]

PAGE = "report.html"

_BEFORE, _AFTER, _FLOOR = "#d1495b", "#00798c", "#9aa5b1"


def write_report(result: Diagnosis, recording: Recording, folder: Path, *, command: str = "") -> Path:
    """Write the page into a folder and return its path."""
    write_atomically(folder / PAGE, diagnosis_html(result, recording, command=command))
    return folder / PAGE


def diagnosis_html(result: Diagnosis, recording: Recording, *, command: str = "") -> str:
    """Return the page."""
    found = findings(result, recording)
    name = recording.path.resolve().name
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in result.notes)
    sections = [
        f"<h1>{html.escape(name)}</h1>",
        f'<p class="verdict">{html.escape(sentence(result, recording))}</p>',
        f"<ul>{notes}</ul>" if notes else "",
        "<h2>The gap on unseen trials</h2>",
        _image(_bars(result, recording), "Gap of each test trial before and after, beside the floor"),
        "<h2>Where simulation and measurement disagree</h2>",
        "<p>Distance of the free markers, mean over the test trials: dark is near, bright is far.</p>",
        _image(_maps(result, recording), "Distance by place along the rope and time, before and after"),
        "<h2>Shapes of the worst trial</h2>",
        _image(_overlay(result, recording), "Measured and simulated shapes, before and after"),
        "<h2>What was found</h2>" if found["effects"] else "",
        _effects(found),
        "<h2>Every candidate, and why it was left</h2>",
        _candidates(found),
        "<h2>The floor</h2>",
        _floor(found),
        "<h2>Made by</h2>",
        f"<pre>{html.escape(command)}</pre>" if command else "",
        f"<p>{result.seconds:.0f} s; {', '.join(f'{k} {v}' for k, v in found['versions'].items())}.</p>",
    ]
    return page(name, STYLE, "\n".join(s for s in sections if s))


def _effects(found: dict[str, Any]) -> str:
    rows, hints = [], []
    for effect in found["effects"]:
        for key, n in effect["parameters"].items():
            reach = f"{number(n['low'], 3)} to {number(n['high'], 3)}"
            rows.append(
                (words(effect["name"]), kind(effect["name"]), words(key), number(n["value"], 4), reach, n["unit"])
            )
        for other in effect["indistinguishable_from"]:
            hints.append(f"To tell {words(effect['name'])} from {words(other)}: {separating(effect['name'], other)}.")
    heads = ("effect", "kind", "number", "value", "90 % range", "unit")
    return (table(heads, rows) if rows else "") + "".join(f"<p>{html.escape(h)}</p>" for h in hints)


def _candidates(found: dict[str, Any]) -> str:
    rows = [
        (
            words(c["name"]),
            str(c["round"]),
            number(c["score"], 2),
            number(c["train_gain"], 2),
            number(c["heldout_gain"], 2),
            c["reason"],
        )
        for c in found["candidates"]
    ]
    heads = ("effect", "round", "share that doses explain", "gap closed, train", "gap closed, test", "why")
    return table(heads, rows)


def _floor(found: dict[str, Any]) -> str:
    parts = found["gap"]["floor_parts_m"]
    rows = [(words(name), number(1e3 * value, 3)) for name, value in parts.items()]
    rows.append(("together", number(1e3 * found["gap"]["noise_floor_m"], 3)))
    return table(("part", "root mean square per coordinate [mm]"), rows)


def _image(png: bytes, text: str) -> str:
    return f'<img alt="{html.escape(text)}" src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}">'


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()


def _bars(result: Diagnosis, recording: Recording) -> bytes:
    figure = _figure(10, 3.2)
    axes = figure.subplots()
    at = np.arange(len(recording.test))
    axes.bar(at - 0.2, 1e3 * result.before, 0.38, color=_BEFORE, label="baseline")
    axes.bar(at + 0.2, 1e3 * result.after, 0.38, color=_AFTER, label="with what was found")
    axes.axhline(1e3 * result.floor.total, color=_FLOOR, ls="--", label="floor")
    axes.set_xticks(at, [t.name for t in recording.test])
    axes.set_ylabel("gap [mm]")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return _png(figure)


def _distances(predictions: dict[str, np.ndarray], trial: Trial) -> np.ndarray:
    """Return distances of the free markers [mm], shape (F, M)."""
    return 1e3 * np.linalg.norm(predictions[trial.name] - trial.markers, axis=-1)[:, ~trial.gripped]


def _maps(result: Diagnosis, recording: Recording) -> bytes:
    figure = _figure(10, 3.6)
    panels = figure.subplots(1, 2, sharey=True)
    frames = min(len(t.time) for t in recording.test)
    first = recording.test[0]
    free = first.marker_arclength[~first.gripped]
    both = []
    for when in ("before", "after"):
        stacked = np.stack([_distances(result.predictions[when], t)[:frames] for t in recording.test])
        both.append(np.sqrt(np.nanmean(stacked**2, axis=0)))
    most = float(np.nanmax(both[0])) or 1.0
    for axes, values, title in zip(panels, both, ("baseline", "with what was found"), strict=True):
        shown = axes.pcolormesh(
            first.time[:frames], free, values.T, vmin=0, vmax=most, cmap="viridis", shading="nearest"
        )
        axes.set_title(title, loc="left", fontsize=11)
        axes.set_xlabel("time [s]")
    panels[0].set_ylabel("place along the rope [m]")
    figure.colorbar(shown, ax=panels, label="distance [mm]")
    return _png(figure)


def _overlay(result: Diagnosis, recording: Recording) -> bytes:
    trial = recording.test[int(np.argmax(result.before))]
    figure = _figure(10, 4.2)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    flat = trial.markers.reshape(-1, 3)
    spread = np.nanstd(flat[:, :2], axis=0)
    across = int(np.argmax(spread))
    for axes, when, color in zip(panels, ("before", "after"), (_BEFORE, _AFTER), strict=True):
        for frame in np.linspace(0, len(trial.time) - 1, 5).astype(int):
            simulated, measured = result.predictions[when][trial.name][frame], trial.markers[frame]
            axes.plot(simulated[:, across], simulated[:, 2], color=color, lw=1.8)
            axes.plot(measured[:, across], measured[:, 2], "o", color="#1f2933", ms=3)
        axes.set_title("baseline" if when == "before" else "with what was found", loc="left", fontsize=11)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{'xy'[across]} [m]")
    panels[0].set_ylabel("z [m]")
    figure.suptitle(f"{trial.name}: measured (dots) and simulated (lines)", fontsize=12)
    return _png(figure)
