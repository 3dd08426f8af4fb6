"""Report of where to put a camera: verdict first, then all motions and places with what they are expected to tell."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.files import write_atomically
from torchdlo.report.pages.page import STYLE, listed, number, page, table, words
from torchdlo.sysid.recordings.recording import save_trial
from torchdlo.sysid.video.camera_placement import (
    CameraDesign,
    CameraPlacement,
    camera_json,
    camera_summary,
    recorded_notes,
)
from torchdlo.sysid.video.second_view import SecondView, added_rows, place_rows
from torchdlo.untrusted import for_html, for_plot
from torchdlo.vision.camera import Camera, save_cameras

__all__ = ["FILES", "camera_table", "places_png", "places_table", "write_placement"]

FILES = ("design.json", "report.html", "design.png", "cameras.json", "motion.npz")
"""What is written."""

_MOST = 12
"""Rows of a table in a terminal."""


def write_placement(design: CameraDesign, folder: Path, *, command: str = "") -> None:
    """Write all files into a folder, each complete or not at all; without a picture, an earlier one is removed."""
    save_trial(folder / "motion.npz", design.trial)
    save_cameras(design.best.cameras, folder / "cameras.json")
    picture = places_png(design.recorded) if design.recorded is not None else None
    if picture is not None:
        write_atomically(folder / "design.png", picture)
    else:
        (folder / "design.png").unlink(missing_ok=True)
    write_atomically(folder / "report.html", _html(design, picture, command))
    write_atomically(folder / "design.json", camera_json(design))


def _heads(design: CameraDesign) -> tuple[str, ...]:
    return ("motion", "camera", *map(words, design.best.deviations), "dose" if design.effects else "mean")


def _rows(placements: Sequence[CameraPlacement]) -> list[tuple[str, ...]]:
    return [(p.moves, p.stands, *(number(d) for d in p.deviations.values()), number(p.score)) for p in placements]


def camera_table(design: CameraDesign) -> str:
    """Return the best motions and places as plain text."""
    rows = [_heads(design), *_rows(design.single[:_MOST])]
    return _plain(rows)


def places_table(view: SecondView, most: int = 6) -> str:
    """Return the best places of one more camera for the recorded motion, as plain text."""
    heads, rows = place_rows(view)
    return _plain([heads, *rows[:most]])


def _plain(rows: Sequence[Sequence[str]]) -> str:
    wide = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, wide, strict=True)).rstrip() for row in rows)


def _recorded(design: CameraDesign, picture: bytes | None) -> list[str]:
    """Return the part on the recorded motion."""
    view = design.recorded
    if view is None or picture is None:
        return [listed(recorded_notes(design))]
    data = base64.b64encode(picture).decode("ascii")
    heads, rows = place_rows(view)
    more, added = added_rows(view)
    note = (
        "<p class=soft>Small doses of every effect were simulated in the recorded motion, and seen from places around "
        "it beside the cameras at hand. A place is worth what the effect is that it shows worst, compared with the "
        "best place for that effect (times its detection limit), after parameters, cameras, clocks and starts took up "
        f"what they can. An effect counts as shown from {1e3 * view.level:.2g} mm of root mean square per reading. "
        "Ranges are half the width of a 90 % range.</p>"
    )
    return [
        "<h2>The recorded motion: which camera would test what these cannot</h2>",
        listed(recorded_notes(design)),
        f'<img alt="places of cameras from above and from the side" src="data:image/png;base64,{data}">',
        note,
        table(heads, rows),
        "<h2>What the best place adds</h2>",
        table(more, added),
    ]


def places_png(view: SecondView) -> bytes:
    """Return a PNG of the rope, the cameras at hand and the places for one more, from above and from the side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 5.4), dpi=110, facecolor="white", layout="constrained")
    above, side, bars = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.9))
    places = np.array([_eye(p.camera) for p in view.places])
    own = np.array([_eye(c) for c in view.cameras]).reshape(-1, 3)
    middle = 0.5 * (view.rope.min((0, 1)) + view.rope.max((0, 1)))
    shade = [p.regret for p in view.places]
    for axes, (a, b), title in ((above, (0, 1), "from above"), (side, (0, 2), "from the side")):
        for shape in view.rope:
            axes.plot(shape[:, a], shape[:, b], color="#d1495b", lw=1.2, alpha=0.5)
        axes.plot([places[0, a], middle[a]], [places[0, b], middle[b]], color="#00798c", lw=1.0, ls="--")
        dots = axes.scatter(places[:, a], places[:, b], c=shade, cmap="viridis_r", norm="log", s=46, zorder=3)
        axes.scatter(*places[0, [a, b]], marker="*", s=260, color="#00798c", zorder=4, label="best place")
        if len(own):
            axes.scatter(own[:, a], own[:, b], marker="s", s=60, color="black", zorder=4, label="at hand")
            for camera, place in zip(view.cameras, own, strict=True):
                axes.annotate(for_plot(camera.name), place[[a, b]], textcoords="offset points", xytext=(6, 4))
        axes.set(title=title, xlabel="x [m]", ylabel="yz"[b - 1] + " [m]")
        axes.set_aspect("equal", "datalim")
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    above.legend(fontsize=8, frameon=False)
    figure.colorbar(dots, ax=side, label="worst effect: times the best place's limit", shrink=0.8)
    _limits(bars, view)
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()


def _limits(axes: Any, view: SecondView) -> None:
    """Draw how large effects have to be, in doses that were tried, with the cameras at hand and with one more."""
    after = view.best.told.doses(view.level)
    before = {} if view.now is None else view.now.doses(view.level)
    names = sorted((n for n in view.effects if math.isfinite(after[n])), key=lambda n: before.get(n, 0) / after[n])
    for k, name in enumerate(names):
        if math.isfinite(before.get(name, math.inf)):
            axes.plot([before[name], after[name]], [k, k], color="0.7", lw=2, zorder=1)
            axes.scatter(before[name], k, color="black", s=26, label="cameras at hand" if k == 0 else None)
        label = "and the best place" if view.now is not None else "the best place"
        axes.scatter(after[name], k, marker="*", color="#00798c", s=70, label=label if k == 0 else None, zorder=3)
    axes.set_yticks(range(len(names)), [n.replace("_", " ") for n in names], fontsize=8)
    axes.set(xscale="log", xlabel="dose from which it is named,\nwhere it shows least (1: a small dose)")
    axes.grid(alpha=0.3, axis="x")
    axes.spines[["top", "right"]].set_visible(False)
    if names:
        axes.legend(fontsize=8, frameon=False)


def _eye(camera: Camera) -> np.ndarray:
    """Return where a camera is [m], shape (3,)."""
    return np.asarray(-np.array(camera.rotation).T @ np.array(camera.translation))


def _html(design: CameraDesign, picture: bytes | None, command: str) -> str:
    name = for_html(design.recording.path.resolve().name)
    note = (
        "<p class=soft>Standard deviations that are expected of one such film: of the logarithm of stiffness and "
        "damping (0.01 is about one per cent), else in the number's unit; pose, focal length and clock of each camera "
        "are fitted as well. The last column ranks: "
        + (
            "how many times as large as tried the dose of the worst named effect has to be.</p>"
            if design.effects
            else "the geometric mean along the principal axes.</p>"
        )
    )
    body = [
        f"<h1>{name}: the next film</h1>",
        f'<p class="verdict">{for_html(camera_summary(design))}</p>',
        listed(design.notes),
        *_recorded(design, picture),
        "<h2>Another motion, and one camera</h2>",
        note,
        table(_heads(design), _rows(design.single)),
        "<h2>The cameras as they stand, and one more</h2>" if design.added else "",
        table(_heads(design), _rows(design.added)) if design.added else "",
        f"<pre>{for_html(command)}</pre>" if command else "",
    ]
    return page(design.recording.path.resolve().name, STYLE, "\n".join(b for b in body if b))
