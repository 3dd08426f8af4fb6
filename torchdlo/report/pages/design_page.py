"""The report of a suggested experiment: the table of motions, a page, and the picture of the best one."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchdlo.files import write_atomically
from torchdlo.report.pages.page import STYLE, listed, number, page, table
from torchdlo.sysid.experiment_design.design import Design, design_json, design_summary, motion_text, rationale
from torchdlo.sysid.experiment_design.model_discrimination import rms_size
from torchdlo.sysid.recordings.recording import save_trial
from torchdlo.untrusted import for_html

__all__ = ["FILES", "design_png", "design_table", "write_design"]

FILES = ("design.json", "report.html", "design.png", "motion.npz")
"""What is written."""

_HEADS = ("motion", "first estimate", "after full fits")


def write_design(design: Design, folder: Path, *, command: str = "") -> None:
    """Write all files into a folder, each complete or not at all."""
    picture = design_png(design)
    save_trial(folder / "motion.npz", design.trial)
    write_atomically(folder / "design.png", picture)
    write_atomically(folder / "report.html", _html(design, picture, command))
    write_atomically(folder / "design.json", design_json(design))


def _rows(design: Design) -> list[tuple[str, ...]]:
    best = [(motion_text(o.gesture, o.amplitude, o.unit), o) for o in design.options]
    rows = [(name + (" (improved)" if o.improved else ""), number(o.estimate), number(o.confirmed)) for name, o in best]
    return [*rows, ("the recording at hand", "", number(design.reference))]


def design_table(design: Design) -> str:
    """Return the motions with what they are expected to tell, as plain text; the recording at hand last."""
    rows = [_HEADS, *_rows(design)]
    wide = [max(len(row[k]) for row in rows) for k in range(3)]
    return "\n".join(f"{a:{wide[0]}}  {b:>{wide[1]}}  {c:>{wide[2]}}" for a, b, c in rows)


def _html(design: Design, picture: bytes, command: str) -> str:
    name = design.recording.path.resolve().name
    data = base64.b64encode(picture).decode("ascii")
    note = (
        "<p class=soft>Distance that is left between the worst pair of models when the rival's numbers are fitted to "
        "what the other shows, in this motion and in the recording at hand: root mean square per coordinate of the "
        f"free markers, in units of the marker noise ({1e3 * design.noise:.3g} mm). First estimates move each number "
        "once, along its slope; full fits follow for the leaders.</p>"
    )
    misfit = [(n.replace("_", " "), f"{1e3 * m:.3g} mm") for n, m in design.misfit.items()]
    body = [
        f"<h1>{for_html(name)}: the next experiment</h1>",
        f'<p class="verdict">{for_html(design_summary(design))}</p>',
        "<h2>Why</h2>",
        listed(rationale(design)),
        "<h2>The motion, and what it would show</h2>",
        f'<img alt="motion and difference" src="data:image/png;base64,{data}">',
        "<h2>All motions that were tried</h2>",
        note,
        table(_HEADS, _rows(design), last_is_ours=True),
        "<h2>The competing models</h2>",
        table(("effect", "off the recording by"), misfit),
        "<h2>Made by</h2>",
        f"<pre>{for_html(command)}</pre>" if command else "",
        f"<p class=soft>{design.duration:.0f} s, seed {design.seed}. motion.npz holds times, the positions of the "
        "gripped markers and the orientations of the clamps in the format of a trial; free markers are NaN.</p>",
    ]
    return page(name, STYLE, "\n".join(body))


def design_png(design: Design) -> bytes:
    """The picture as PNG: how the grippers move, and how far models stay apart at the markers over time."""
    pair = min(design.pairs, key=lambda p: rms_size(p.left))
    figure = Figure(figsize=(11, 8.6), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    (above, shape), (below, aside) = figure.subplots(2, 2, width_ratios=(2.2, 1.0))
    _grippers(above, design)
    _shapes(shape, design, pair)
    place, distance = design.trial.marker_arclength, 1e3 * np.linalg.norm(pair.left[0], axis=-1)
    free = np.flatnonzero(~design.trial.gripped)
    for m in free:
        shade = colormaps["viridis_r"](place[m] / place[-1])
        label = f"{1e2 * place[m]:.0f} cm" if m in (free[0], free[len(free) // 2], free[-1]) else None
        below.plot(design.trial.time, distance[:, m], color=shade, lw=1.3, label=label)
    noise = 1e3 * np.sqrt(3) * design.noise
    below.axhspan(0, noise, color="0.9", zorder=0, label="marker noise")
    truth, rival = (n.replace("_", " ") for n in (pair.truth, pair.rival))
    below.set(title=f"{rival}, fitted, against {truth}", xlabel="time [s]", ylabel="distance at the markers [mm]")
    below.legend(fontsize=8, framealpha=0.8, title="along the rope")
    _bars(aside, design)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    best = design.options[0]
    figure.suptitle(f"The gripper {motion_text(best.gesture, best.amplitude, best.unit)}", fontweight="bold")
    content = io.BytesIO()
    figure.savefig(content, format="png", metadata={"Software": "torchdlo"})
    return content.getvalue()


def _grippers(axes: Any, design: Design) -> None:
    """Draw where the grippers are over time, and how their clamps turn."""
    trial, turning = design.trial, design.options[0].unit == "rad"
    for k, group in enumerate(design.rig.groups):
        centre = trial.markers[:, group].mean(1)
        for c, color in enumerate(("#d1495b", "#00798c", "#e09f3e")):
            label = None if k else f"{'xyz'[c]} - start"
            axes.plot(trial.time, 1e2 * (centre[:, c] - centre[0, c]), color=color, ls=("-", "--")[k % 2], label=label)
    axes.set(title="grippers" + (" (second one dashed)" if len(design.rig.groups) > 1 else ""), ylabel="[cm]")
    low, high = axes.get_ylim()
    axes.set(xlabel="time [s]", ylim=(min(low, -1.0), max(high, 1.0)))
    if turning and trial.gripper_quaternion is not None:
        dot = np.abs((trial.gripper_quaternion * trial.gripper_quaternion[:1]).sum(-1)).clip(0, 1)
        other = axes.twinx()
        other.plot(trial.time, np.degrees(2 * np.arccos(dot)), color="0.4", lw=1)
        other.set_ylabel("turn of the clamps [°]")
    axes.legend(fontsize=8, frameon=False)


def _shapes(axes: Any, design: Design, pair: Any) -> None:
    """Draw both models where they are furthest apart, seen along the level direction that shows most of it."""
    shown, left = pair.shown[0], pair.left[0]
    frame = int(np.nan_to_num(left**2).sum((1, 2)).argmax())
    truth, gap = shown[frame], np.nan_to_num(left[frame])
    turn = np.linalg.svd(gap[:, :2])[2][0]
    for points, name, style in ((truth, pair.truth, "-o"), (truth + gap, pair.rival, "--s")):
        axes.plot(points[:, :2] @ turn, points[:, 2], style, ms=3, lw=1.5, label=name.replace("_", " "))
    axes.set(title=f"after {design.trial.time[frame]:.2f} s", xlabel="level [m]", ylabel="height [m]")
    axes.set_aspect("equal", "datalim")
    axes.legend(fontsize=8, frameon=False)


def _bars(axes: Any, design: Design) -> None:
    """Draw the separation of the recording at hand and of the suggestion, for each pair."""
    for k, (now, then) in enumerate(zip(design.present, design.pairs, strict=True)):
        sizes = [rms_size(p.left) / design.noise for p in (now, then)]
        axes.bar([k - 0.2, k + 0.2], sizes, 0.36, color=["#9aa5b1", "#00798c"])
    names = [f"{p.rival}\nfor {p.truth}".replace("_", " ") for p in design.pairs]
    axes.set_xticks(range(len(names)), names, fontsize=7)
    axes.axhline(design.needed, color="0.3", ls=":", lw=1.2)
    axes.set(title="grey: now; dotted: needed", ylabel="separation [noise]")
