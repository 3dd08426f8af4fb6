"""The report of a calibration: one page that needs nothing but itself, and its picture."""

from __future__ import annotations

import base64
import math
from pathlib import Path

from torchdlo.files import write_atomically
from torchdlo.report.figures.calibration_figure import calibration_png
from torchdlo.report.pages import films_page
from torchdlo.report.pages.page import STYLE, number, page, table, words
from torchdlo.sysid.estimation.result import Calibration, versions
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import for_html

__all__ = ["PAGE", "PICTURE", "calibration_html", "calibration_verdict", "write_report"]

PAGE = "report.html"
PICTURE = "report.png"


def write_report(result: Calibration, recording: Recording, folder: Path, *, command: str = "") -> tuple[Path, Path]:
    """Write the page and the picture.

    Args:
        result: What to report.
        recording: What it was calibrated on.
        folder: Where `report.html` and `report.png` go.
        command: The command line that makes this result again.

    Returns:
        Paths of the page and of the picture.
    """
    if recording.filmed:
        return films_page.write_report(result, recording, folder, command=command)
    png = calibration_png(result, recording)
    page = calibration_html(result, recording, png, command=command)
    write_atomically(folder / PICTURE, png)
    write_atomically(folder / PAGE, page)
    return folder / PAGE, folder / PICTURE


def calibration_verdict(result: Calibration, recording: Recording) -> str:
    """The result in one sentence."""
    if recording.filmed:
        return films_page.films_verdict(result, recording)
    others = ", ".join(f"{words(name)} {_mm(values['test_mae_mm'])}" for name, values in result.baselines.items())
    summary = (
        f"Calibrated on {_trials(len(recording.train))}; error on unseen trials "
        f"{_mm(result.before['test_mae_mm'])} → {_mm(result.test_mae_mm)}"
    )
    summary += f" ({others})." if others else "."
    if result.interrupted:
        summary += " The fit was interrupted: this is the best it had found."
    better = {
        name: values["test_mae_mm"]
        for name, values in result.baselines.items()
        # Not finite counts as worse than anything.
        if not result.test_mae_mm < values["test_mae_mm"]
    }
    if better:
        name = min(better, key=lambda key: better[key])
        summary += f" The {words(name)}, which has no parameter, is not worse: do not use this."
    elif result.test_mae_mm >= result.before["test_mae_mm"]:
        summary += " Calibration did not help on the unseen trials."
    return summary


def calibration_html(result: Calibration, recording: Recording, png: bytes, *, command: str = "") -> str:
    """The page, with the picture inside."""
    name = for_html(recording.path.resolve().name)
    picture = base64.b64encode(png).decode("ascii")
    notes = "".join(f"<li>{for_html(note)}</li>" for note in result.notes)
    sections = [
        f"<h1>{name}</h1>",
        f'<p class="verdict">{for_html(calibration_verdict(result, recording))}</p>',
        f"<ul>{notes}</ul>" if notes else "",
        f'<img alt="Measured and simulated shapes, errors along the rope and over time, and a '
        f'comparison with trivial predictions" src="data:image/png;base64,{picture}">',
        "<h2>Errors</h2>",
        "<p>The error that counts, here and above: mean absolute error per coordinate, all markers, from 0.02 s on. "
        "The test trials were not used for the fit. Curves of the picture and the last column of the trials are "
        "distances in space of the free markers instead: about twice as large, as three coordinates add up and gripped "
        "markers, which are right by construction, do not count.</p>",
        _error_table(result),
        "<h2>Parameters</h2>",
        _parameter_table(result),
        "<h2>Trials</h2>",
        _trial_table(result),
        "<h2>Made by</h2>",
        f"<pre>{for_html(command)}</pre>" if command else "",
        f"<p>{for_html(_made_by(result))}</p>",
    ]
    return page(recording.path.resolve().name, STYLE, "\n".join(s for s in sections if s))


def _error_table(result: Calibration) -> str:
    rows = [
        (words(name), values.get("train_mae_mm"), values["test_mae_mm"]) for name, values in result.baselines.items()
    ]
    before = result.before
    rows.append(("before calibration", before.get("train_mae_mm"), before["test_mae_mm"]))
    rows.append(("calibrated", result.train_mae_mm, result.test_mae_mm))
    return table(
        ("prediction", "train trials [mm]", "test trials [mm]"),
        [(name, number(train), number(test)) for name, train, test in rows],
        last_is_ours=True,
    )


def _parameter_table(result: Calibration) -> str:
    rows = [
        (
            words(name),
            number(entry.get("value"), 4),
            f"{number(entry.get('low'), 4)} to {number(entry.get('high'), 4)}",
            str(entry.get("unit", "")),
        )
        for name, entry in result.parameters.items()
    ]
    return table(("parameter", "value", "90 % range", "unit"), rows)


def _trial_table(result: Calibration) -> str:
    columns = ("split", "before_mae_mm", "mae_mm", "free_distance_mm")
    rows = [
        (
            str(entry.get("name", "")),
            str(entry.get("split", "")),
            *(number(entry.get(column)) for column in columns[1:]),
        )
        for entry in sorted(result.per_trial, key=lambda entry: str(entry.get("split")))
    ]
    heads = ("trial", "split", "before [mm]", "calibrated [mm]", "free markers' distance [mm]")
    return table(heads, rows)


def _made_by(result: Calibration) -> str:
    tools = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"{result.seconds:.0f} s, seed {result.seed}; {tools}."


def _mm(value: float) -> str:
    return f"{value:.1f} mm" if math.isfinite(value) else "not finite"


def _trials(count: int) -> str:
    return f"{count} trial" if count == 1 else f"{count} trials"
