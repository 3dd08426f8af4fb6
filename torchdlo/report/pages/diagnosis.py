"""The report of a diagnosis: one page that needs nothing but itself."""

from __future__ import annotations

import base64
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.files import write_atomically
from torchdlo.report.figures import chart
from torchdlo.report.pages import films_page, player
from torchdlo.report.pages.page import STYLE, listed, number, page, percent, table, words
from torchdlo.sysid.diagnosis.detection_limit import HIDDEN
from torchdlo.sysid.diagnosis.effect_library import MEANING, effect_equation, separating_experiment
from torchdlo.sysid.diagnosis.findings import absorbed, findings, summary
from torchdlo.sysid.diagnosis.residual_analysis import PARTS, Localisation, localise
from torchdlo.sysid.diagnosis.residual_text import STATES
from torchdlo.sysid.diagnosis.verdict import Diagnosis
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import for_html

__all__ = ["PAGE", "diagnosis_html", "snippet", "write_report"]

PAGE = "report.html"

_SHOWN = 6
"""Candidates of a round that are shown at once."""


def write_report(result: Diagnosis, recording: Recording, folder: Path, *, command: str = "") -> Path:
    """Write the page into a folder and return its path."""
    write_atomically(folder / PAGE, diagnosis_html(result, recording, command=command, model=folder / "model.json"))
    return folder / PAGE


def diagnosis_html(
    result: Diagnosis, recording: Recording, *, command: str = "", model: Path = Path("model.json")
) -> str:
    """Return the page."""
    found = findings(result, recording)
    where = None if recording.filmed else localise(recording, result.predictions, result.floor)
    name = recording.path.resolve().name
    order = [recording.test[k] for k in np.argsort(-np.nan_to_num(result.before, nan=np.inf))]
    sections = [
        f"<h1>{for_html(name)}</h1>",
        f'<p class="verdict">{for_html(summary(result, recording))}</p>',
        listed(result.notes),
        _section("The gap on trials that were not used", _bars(result, recording)),
        _section("The films, before and after", _films(result)) if where is None else "",
        _section("Replay, worst trial first", player.replay(recording, result.predictions, order)) if where else "",
        _section("Where simulation and measurement disagree", _where(where, result)) if where else "",
        _section("What was found", _effects(found)),
        _section("Fitted numbers of the rope", _baseline(found)),
        _section("What the data cannot tell apart", _ties(found)),
        _section("What calibration had absorbed", _absorbed(result)),
        _section("Every candidate, and why it was left", _candidates(found)),
        _section("How large an effect would have to be to be named here", _limits(found)),
        _section("Trials that counted less", _misleading(found)),
        _section("What remains", listed(where.rest)) if where else "",
        _section("The floor", _floor(found)),
        _section("Health of the data", _health(found)),
        _section("The model again", _again(recording, model)),
        _section("Limits", f"<p>{for_html(_LIMITS)}</p>"),
        _section("Made by", _made_by(found, command)),
    ]
    return page(name, STYLE + chart.STYLE + player.STYLE, "\n".join(s for s in sections if s))


_LIMITS = (
    "A name is the best explanation among the laws that were tried, not a proof. Stiffnesses and forces are relative "
    "to the mass in rope.json. Ranges come from leaving out one trial at a time: with few trials they are rough, and "
    "what every trial gets wrong in the same way does not show in them."
)


def _films(result: Diagnosis) -> str:
    picture = base64.b64encode(films_page.overlay_png(result.overlays)).decode("ascii")
    words_of = "Pictures of the films with the simulated rope before and after"
    return f'<img alt="{words_of}" src="data:image/png;base64,{picture}">'


def _section(title: str, content: str) -> str:
    return f"<h2>{for_html(title)}</h2>\n{content}" if content else ""


def _bars(result: Diagnosis, recording: Recording) -> str:
    rows = [("all test trials" if result.compared.all() else "test trials that none fails on", *result.gaps)]
    rows += [(t.name, b, a) for t, b, a in zip(recording.test, result.before, result.after, strict=True)]
    shown = chart.bars([(n, 1e3 * b, 1e3 * a) for n, b, a in rows], 1e3 * result.floor.total)
    note = "<p class=soft>Root mean square per coordinate of the free markers, in mm.</p>"
    return f"{note}{chart.legend()}{shown}"


def _where(where: Localisation, result: Diagnosis) -> str:
    both = np.concatenate([where.before.ravel(), where.after.ravel()])
    most = 1e3 * float(np.nanpercentile(both, 99)) or 1.0
    shown = [("baseline", where.before), ("with what was found", where.after)]
    # Without an effect both are the same.
    maps = [
        chart.heat(title, 1e3 * values, where.time, where.place, most)
        for title, values in (shown if result.effects else shown[:1])
    ]
    top = 1.1e3 * max(float(np.nanmax(y)) for a in where.against for y in (a.before, a.after)) or 1.0
    floor = 1e3 * np.sqrt(3) * result.floor.total
    plots = [
        chart.lines(
            f"{STATES[a.name][0]}: explains {percent(a.share_before)} → {percent(a.share_after)}",
            f"{STATES[a.name][0]} [{STATES[a.name][1]}]",
            a.centres,
            {"before": 1e3 * a.before, "after": 1e3 * a.after},
            top,
            floor,
        )
        for a in where.against
    ]
    rows = [(PARTS[k], percent(where.parts_before[k]), percent(where.parts_after[k])) for k in PARTS]
    return "".join(
        (
            listed(where.words),
            "<p class=soft>Distance of the free markers, root mean square over the test trials, by place and time"
            f"{'; both maps have one scale' if result.effects else ''}.</p>",
            f'<div class="maps">{"".join(maps)}</div>{chart.ramp(most, "mm")}',
            "<h3>By the state of the rope</h3><p class=soft>Distance [mm] in groups of equal size, all trials. In "
            "per cent: share of its variance that the state explains on trials left out, beyond the place.</p>",
            f'{chart.legend()}<div class="grid">{"".join(plots)}</div>',
            "<h3>Made of</h3>",
            table(("a field as simple as", "share of the square, before", "after"), rows)
            if any(max(where.parts_before[k], where.parts_after[k]) > 0.05 for k in PARTS)
            else "<p>No simple field (a shift, a lag, one along acceleration or bends) makes more than 5 % of it.</p>",
        )
    )


def _effects(found: dict[str, Any]) -> str:
    parts = []
    for effect in found["effects"]:
        rows = [
            (
                words(key),
                "not told" if n["value"] is None else number(n["value"], 4),
                f"{number(n['low'], 3)} to {number(n['high'], 3)}",
                n["unit"],
            )
            for key, n in effect["parameters"].items()
        ]
        share = percent(effect["share_of_gap"])
        equation = for_html(effect_equation(effect["name"]))
        parts.append(
            f"<h3>{for_html(words(effect['name']))}</h3><p>{MEANING[effect['kind']].capitalize()}; it closes "
            f"{share} of the gap above the floor on the test trials.</p><pre>{equation}</pre>"
            + _test(effect["test"])
            + (table(("number", "value", "90 % range", "unit"), rows) if rows else "")
        )
    return "".join(parts)


def _test(test: dict[str, Any] | None) -> str:
    """Return in words whether what an effect explains could be chance."""
    if test is None:
        return ""
    doses = ", ".join("not known" if d is None else f"{d:.2f}" for d in test["dose_by_trial"])
    over = test["p_value_over_trials"]
    trials = "" if over is None else f" An exact F test of these doses over trials gives p {over:.2g}."
    return (
        f"<p>Could that be chance? By {for_html(test['method'])}: p {test['p_value']:.2g}; with all "
        f"{test['candidates_looked_at']} candidates that were looked at, a false discovery rate of "
        f"{test['false_discovery_rate']:.2g} (Benjamini-Hochberg). The test trials ask for {doses} times the dose "
        f"that was fitted to the train trials.{trials}</p>"
    )


def _baseline(found: dict[str, Any]) -> str:
    rows = [
        (words(key), number(n["value"], 4), f"{number(n['low'], 4)} to {number(n['high'], 4)}", n["unit"])
        for key, n in found["baseline"].items()
    ]
    return table(("number", "value", "90 % range", "unit"), rows) if rows else ""


def _ties(found: dict[str, Any]) -> str:
    pairs = [(e["name"], other) for e in found["effects"] for other in e["indistinguishable_from"]]
    if not pairs:
        return "<p>No other effect that was fitted does as well.</p>" if found["effects"] else ""
    rows = [(f"{words(a)} or {words(b)}", f"{separating_experiment(a, b)}") for a, b in pairs]
    return '<div class="text">' + table(("either", "this experiment would tell"), rows) + "</div>"


def _absorbed(result: Diagnosis) -> str:
    rows = absorbed(result)
    if not rows or not result.effects:
        return ""
    said = [
        f"Without it, calibration had set the {words(r['name'])} {abs(r['change']):.0%} too "
        f"{'high' if r['change'] > 0 else 'low'}."
        for r in rows
        if abs(r["change"]) > 0.05
    ]
    shown = [
        (
            words(r["name"]),
            number(r["before"], 4),
            number(r["after"], 4),
            f"{-r['change'] / (1 + r['change']):+.0%}",
            r["unit"],
        )
        for r in rows
    ]
    heads = ("number", "baseline alone", "with what was found", "change", "unit")
    return listed(said or ["Hardly anything: no number of the baseline changed by more than 5 %."]) + table(
        heads, shown
    )


def _candidates(found: dict[str, Any]) -> str:
    out = []
    for each in sorted({c["round"] for c in found["candidates"]}):
        rows = [c for c in found["candidates"] if c["round"] == each]
        shown = [_candidate(c) for c in rows]
        out.append(f"<h3>Round {each}</h3>" + _candidate_table(shown[:_SHOWN]))
        if len(shown) > _SHOWN:
            rest = _candidate_table(shown[_SHOWN:])
            out.append(f"<details><summary>{len(shown) - _SHOWN} more</summary>{rest}</details>")
    note = (
        "<p class=soft>Explained by doses: share of the residual that small doses take away beyond calibration. "
        "Closed: share of the squared gap above the floor after a joint fit, negative where it grew.</p>"
    )
    return note + "".join(out) if out else ""


def _candidate(c: dict[str, Any]) -> tuple[str, ...]:
    numbers = (percent(c["score"]), percent(c["train_gain"]), percent(c["heldout_gain"]))
    return (words(c["name"]), *numbers, c["reason"], effect_equation(c["name"]))


def _candidate_table(rows: list[tuple[str, ...]]) -> str:
    heads = ("effect", "explained by doses", "closed, train", "closed, test", "verdict", "law")
    return f'<div class="candidates">{table(heads, rows)}</div>'


def _limits(found: dict[str, Any]) -> str:
    rows = [
        (
            words(limit["name"]),
            words(limit["number"]),
            HIDDEN if limit["easiest"] is None else number(limit["easiest"], 3),
            HIDDEN if limit["hardest"] is None else number(limit["hardest"], 3),
            number(limit["greatest"], 3),
            "" if limit["unit"] == "1" else limit["unit"],
        )
        for limit in found["detection_limits"]
    ]
    if not rows:
        return ""
    note = (
        "<p class=soft>From this size on (stretch, compliance and damping of grippers: up to it) an effect closes more "
        "of the gap than the floor leaves open, where it is placed or directed so that it shows best, and where it "
        "shows least. By doses on the train trials, to first order: smaller ones may be there. What would have to be "
        "larger (softer) than the last number, the most that can be, cannot be seen.</p>"
    )
    return note + table(("effect", "number", "at best", "at worst", "most", "unit"), rows)


def _misleading(found: dict[str, Any]) -> str:
    return listed([f"{t['name']} counts up to {t['time']:.2f} s only: {t['why']}." for t in found["misleading_trials"]])


def _floor(found: dict[str, Any]) -> str:
    gap = found["gap"]
    rows = [(words(name), number(1e3 * value, 3)) for name, value in gap["floor_parts_m"].items()]
    rows.append(("together", number(1e3 * gap["noise_floor_m"], 3)))
    said = "<p>What even a perfect list of effects would leave: noise of the markers, and what finer steps and a finer "
    said += "mesh would still change.</p>"
    grid = gap["floor_parts_m"].get("grid", 0.0)
    excess = np.sqrt(max(gap["test_rmse_before_m"] ** 2 - gap["floor_parts_m"].get("marker_noise", 0.0) ** 2, 0.0))
    if grid > excess / 3:
        said += "<p><strong>The mesh alone makes more than a third of the gap: run again with more --vertices before "
        said += "trusting a name.</strong></p>"
    return said + table(("part", "per coordinate [mm]"), rows, last_is_ours=True)


def _health(found: dict[str, Any]) -> str:
    faults = [f"{f['trial']}: {f['message']}" if f["trial"] else f["message"] for f in found["data_issues"]]
    return listed(faults or ["No fault found: labels, jumps, spacing, clock and frame are consistent."])


def snippet(recording: Recording, model: Path) -> str:
    """Return a script that predicts the test trials with the model again."""
    return (
        "from torchdlo.sysid import load_recording\n"
        "from torchdlo.sysid.estimation import evaluation\n"
        "from torchdlo.sysid.model import model_file\n\n"
        f"recording = load_recording({str(recording.path)!r})\n"
        f"given = model_file.load({str(model)!r})\n"
        "model = given.model(recording)\n"
        "markers = evaluation.predict(model, recording.test, given.start(model))  # [m], by trial\n"
    )


def _again(recording: Recording, model: Path) -> str:
    path = shlex.quote(str(recording.path))
    return (
        f"<pre>{for_html(snippet(recording, model))}</pre><p>Or go on from it:</p>"
        f"<pre>torchdlo calibrate {for_html(path)} --model {for_html(shlex.quote(str(model)))}</pre>"
    )


def _made_by(found: dict[str, Any], command: str) -> str:
    versions = ", ".join(f"{k} {v}" for k, v in found["versions"].items())
    asked = ", ".join(f"{k} {v}" for k, v in found["options"].items() if v is not None)
    lines = [f"{found['seconds']:.0f} s; {versions}.", f"Options: {asked}." if asked else ""]
    lines.append(f"Content of the recording: sha256 {found['recording_sha256'][:16]}.")
    told = "".join(f"<p class=soft>{for_html(line)}</p>" for line in lines if line)
    return (f"<pre>{for_html(command)}</pre>" if command else "") + told
