"""Report of where to put a camera: verdict first, then all motions and places with what they are expected to tell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchdlo.files import write_atomically
from torchdlo.report.pages.page import STYLE, listed, number, page, table, words
from torchdlo.sysid.recordings.recording import save_trial
from torchdlo.sysid.video.camera_placement import CameraDesign, CameraPlacement, camera_json, camera_summary
from torchdlo.untrusted import for_html
from torchdlo.vision.camera import save_cameras

__all__ = ["FILES", "camera_table", "write_placement"]

FILES = ("design.json", "report.html", "cameras.json", "motion.npz")
"""What is written."""

_MOST = 12
"""Rows of a table in a terminal."""


def write_placement(design: CameraDesign, folder: Path, *, command: str = "") -> None:
    """Write all files into a folder, each complete or not at all."""
    save_trial(folder / "motion.npz", design.trial)
    save_cameras(design.best.cameras, folder / "cameras.json")
    write_atomically(folder / "report.html", _html(design, command))
    write_atomically(folder / "design.json", camera_json(design))


def _heads(design: CameraDesign) -> tuple[str, ...]:
    return ("motion", "camera", *map(words, design.best.deviations), "mean")


def _rows(placements: Sequence[CameraPlacement]) -> list[tuple[str, ...]]:
    return [(p.moves, p.stands, *(number(d) for d in p.deviations.values()), number(p.score)) for p in placements]


def camera_table(design: CameraDesign) -> str:
    """Return the best motions and places as plain text."""
    rows = [_heads(design), *_rows(design.single[:_MOST])]
    wide = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(row, wide, strict=True)).rstrip() for row in rows)


def _html(design: CameraDesign, command: str) -> str:
    name = for_html(design.recording.path.resolve().name)
    note = (
        "<p class=soft>Standard deviations that are expected of one such film: of the logarithm of stiffness and "
        "damping (0.01 is about one per cent), else in the number's unit; pose, focal length and clock of each camera "
        "are fitted as well. The last column is the geometric mean along the principal axes, by which they are "
        "ranked.</p>"
    )
    body = [
        f"<h1>{name}: the next film</h1>",
        f'<p class="verdict">{for_html(camera_summary(design))}</p>',
        listed(design.notes),
        "<h2>One camera</h2>",
        note,
        table(_heads(design), _rows(design.single)),
        "<h2>The cameras as they stand, and one more</h2>" if design.added else "",
        table(_heads(design), _rows(design.added)) if design.added else "",
        f"<pre>{for_html(command)}</pre>" if command else "",
    ]
    return page(design.recording.path.resolve().name, STYLE, "\n".join(b for b in body if b))
