"""The report of a calibration to films: verdict first, the rope over the pictures before and after, and the numbers."""

from __future__ import annotations

import base64
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.files import write_atomically
from torchdlo.report.pages.page import STYLE, listed, number, page, table, words
from torchdlo.sysid.estimation.result import Calibration, Overlay, versions
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import for_html, for_plot

__all__ = ["PAGE", "PICTURE", "filmed_html", "films_verdict", "overlay_png", "write_report"]

PAGE = "report.html"
PICTURE = "report.png"

_MOST = 12
"""Pictures that are shown."""


def write_report(result: Calibration, recording: Recording, folder: Path, *, command: str = "") -> tuple[Path, Path]:
    """Write the page and the picture; return their paths."""
    png = overlay_png(result.overlays)
    write_atomically(folder / PICTURE, png)
    write_atomically(folder / PAGE, filmed_html(result, recording, png, command=command))
    return folder / PAGE, folder / PICTURE


_FAR = 0.05
"""Distance from unseen films from which a model does not follow them, as a share of the rope's length."""


def films_verdict(result: Calibration, recording: Recording) -> str:
    """The result in one sentence."""
    tests = [t for t in result.per_trial if t["split"] == "test"]
    pixels = float(np.mean([t["distance_px"] for t in tests]))
    share = float(np.mean([t["iou"] for t in tests]))
    films = sum(len(t.films) for t in recording.train)
    better = result.test_mae_mm < result.before["test_mae_mm"]
    summary = (
        f"Calibrated on {films} film{'s' if films != 1 else ''}; on unseen films the rope's centre line is "
        f"{_mm(result.before['test_mae_mm'])} → {_mm(result.test_mae_mm)} ({pixels:.1f} px) from the simulated one, "
        f"and masks overlap by {share:.0%}."
    )
    if not better:
        return summary + " Calibration did not help on the unseen films: do not use this."
    if 1e-3 * result.test_mae_mm > _FAR * recording.length:
        return summary + " The model does not follow the unseen films: do not use this, and check the cameras."
    return summary


def _shown(overlay: Overlay) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the part of a picture that simulated ropes are in, with a margin: columns, then rows [px]."""
    ropes = np.concatenate([overlay.before, overlay.after])
    height, width = overlay.picture.shape
    ends = []
    for places, size in zip(ropes.T, (width, height), strict=True):
        inside = places[np.isfinite(places) & (places > -0.5) & (places < size - 0.5)]
        low, high = (inside.min(), inside.max()) if len(inside) else (0.0, size - 1.0)
        margin = 0.08 * width
        ends.append((max(low - margin, -0.5), min(high + margin, size - 0.5)))
    return ends[0], ends[1]


def overlay_png(overlays: list[Overlay]) -> bytes:
    """Return a PNG of pictures with the rope before and after; test trials first."""
    from matplotlib.figure import Figure

    chosen = sorted(overlays, key=lambda o: o.split != "test")
    if len(chosen) > _MOST:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, _MOST).round().astype(int)]
    columns = min(3, max(1, len(chosen)))
    rows = max(1, math.ceil(len(chosen) / columns))
    figure = Figure(figsize=(4.6 * columns, 3.6 * rows + 0.5), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axis in axes[len(chosen) :]:
        axis.axis("off")
    for axis, each in zip(axes, chosen, strict=False):
        axis.imshow(each.picture, cmap="gray", vmin=0, vmax=255, alpha=0.9)
        axis.plot(*each.before.T, color="#e0552f", lw=1.0, ls="--", label="before")
        # Thinner than the rope, which has to be seen beside it.
        axis.plot(*each.after.T, color="#00c2d6", lw=0.6, label="calibrated")
        (left, right), (top, bottom) = _shown(each)
        axis.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
        axis.set_title(for_plot(each.title), fontsize=10)
    if chosen:
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": "torchdlo"})
    return buffer.getvalue()


def filmed_html(result: Calibration, recording: Recording, png: bytes, *, command: str = "") -> str:
    """The page, with the picture inside."""
    name = for_html(recording.path.resolve().name)
    picture = base64.b64encode(png).decode("ascii")
    rope = {k: v for k, v in result.parameters.items() if not k.startswith("camera_")}
    camera = {k: v for k, v in result.parameters.items() if k.startswith("camera_")}
    tools = ", ".join(f"{tool} {version}" for tool, version in versions().items())
    sections = [
        f"<h1>{name}</h1>",
        f'<p class="verdict">{for_html(films_verdict(result, recording))}</p>',
        f'<img alt="Pictures of the films with the simulated rope before and after" '
        f'src="data:image/png;base64,{picture}">',
        "<h2>Parameters</h2>",
        "<p>Ranges are meant to hold the true value in 90 of 100 cases. They include what the cameras and the clock "
        "may be off, and what finer steps and a finer mesh would change.</p>",
        _parameters(rope),
        "<h2>What is said of the data</h2>" if result.notes else "",
        listed(result.notes),
        "<h2>Trials</h2>",
        "<p>Distance of the films' centre lines from the simulated rope, and intersection over union of the masks. The "
        "test trials were not used for the fit.</p>",
        _trials(result),
        "<h2>Cameras and clock</h2>",
        "<p>How far they seem to be off what cameras.json says; fitted with the rope, under priors of 1 degree, 10 mm, "
        "1 % and half a frame.</p>",
        _parameters(camera),
        "<h2>Made by</h2>",
        f"<pre>{for_html(command)}</pre>" if command else "",
        f"<p>{for_html(f'{result.seconds:.0f} s, seed {result.seed}; {tools}.')}</p>",
    ]
    return page(recording.path.resolve().name, STYLE, "\n".join(s for s in sections if s))


def _parameters(entries: dict[str, dict[str, Any]]) -> str:
    rows = [
        (words(name), number(e["value"], 4), f"{number(e['low'], 4)} to {number(e['high'], 4)}", str(e["unit"]))
        for name, e in entries.items()
    ]
    return table(("parameter", "value", "range", "unit"), rows)


def _trials(result: Calibration) -> str:
    rows = [
        (
            str(t["name"]),
            str(t["split"]),
            number(t["before_mae_mm"]),
            number(t["mae_mm"]),
            number(t["distance_px"]),
            f"{t['iou']:.2f}",
            f"{t['boundary_f']:.2f}" if "boundary_f" in t else "",
        )
        for t in sorted(result.per_trial, key=lambda t: str(t["split"]))
    ]
    return table(("trial", "split", "before [mm]", "calibrated [mm]", "[px]", "overlap", "edges within 1 px"), rows)


def _mm(value: float) -> str:
    return f"{value:.1f} mm" if math.isfinite(value) else "not finite"
