"""The page about a policy that was trained: what came out, curves, stages, and the settings that it took."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

from torchdlo.report.figures.learning_curve import learned_png, stages_png, training_png
from torchdlo.report.pages.page import STYLE, number, page, percent, table, words
from torchdlo.untrusted import for_html

__all__ = ["hybrid_html", "training_html"]

_USUAL = ("episodes", "seconds", "return", "success", "failed")
"""What every algorithm says of a batch; the rest is its own."""


def training_html(result: Mapping[str, Any]) -> str:
    """Return the page of a run without stages, from the content of its result.json."""
    rows, best = result["curve"], result["best_batch"]
    title = f"{words(result['task'])} by {result['algorithm'].upper()}"
    said = "No policy has played a batch."
    if best:
        said = f"The best batch succeeds in {percent(best['success'])} of its episodes and earns {best['return']:.4g}."
    parts = [
        f"<h1>{for_html(title)}</h1>",
        f'<p class="verdict">{said}</p>',
        f"<p>{_spent(result)}, at the fidelity {for_html(result['fidelity'])}. Batches are played with noise on the "
        "actions, from starts of training: <code>torchdlo evaluate</code> judges the policy from starts that it has "
        "not seen.</p>",
    ]
    if result["interrupted"]:
        parts.append("<p>It was stopped before its budget was spent; <code>--resume</code> goes on.</p>")
    if rows:
        parts.append(_image(training_png({title: rows}), "returns and shares of successes over episodes"))
    own = [name for name in dict.fromkeys(n for row in rows for n in row) if name not in _USUAL]
    if own:
        parts += ["<h2>What the algorithm says</h2>", _image(learned_png(rows, own), ", ".join(map(words, own)))]
    parts += ["<h2>Settings</h2>", _settings(result["settings"])]
    return page(f"torchdlo train: {title}", STYLE, "\n".join(parts))


def hybrid_html(notes: Mapping[str, Any], stages: Sequence[str]) -> str:
    """Return the page of a run of the hybrid.

    Args:
        notes: content of its stages.json.
        stages: names of all stages, in their order.
    """
    run = [name for name in stages if name in notes]
    last = [row for row in notes[run[-1]]["log"] if "success" in row] if run else []
    said = "No stage was run."
    if last:
        share = last[-1].get("best", last[-1]["success"])
        share = share[0] if isinstance(share, (list, tuple)) else share
        said = f"After the stage {run[-1]}, {percent(share)} of the episodes of training or validation succeed."
    parts = [
        f"<h1>{for_html(words(notes['task']))} by the hybrid</h1>",
        f'<p class="verdict">{said}</p>',
        "<p><code>torchdlo evaluate</code> judges the policy from starts that it has not seen.</p>",
        table(
            ("stage", "episodes", "CPU s", "ended by"),
            [_stage(name, notes[name]) for name in run],
        ),
    ]
    # A last entry may say which budget ended the stage.
    logs = {name: [row for row in notes[name]["log"] if "success" in row] for name in run}
    drawn = {name: log for name, log in logs.items() if log}
    if drawn:
        parts.append(_image(stages_png(drawn), "shares of successes of each stage"))
    parts += ["<h2>Plan</h2>", _settings(notes["plan"]), "<h2>Settings</h2>", _settings(notes["settings"])]
    return page(f"torchdlo train: {notes['task']} by the hybrid", STYLE, "\n".join(parts))


def _stage(name: str, stage: Mapping[str, Any]) -> tuple[str, ...]:
    ended = stage.get("ended")
    return name, str(stage["episodes"]), number(stage["cpu_seconds"]), f"budget of {ended}" if ended else "its plan"


def _spent(result: Mapping[str, Any]) -> str:
    minutes, device = number(result["seconds"] / 60), for_html(result["device"])
    return f"{result['episodes']} episodes in {minutes} minutes on {device}, {result['cpu_seconds']:.0f} CPU s"


def _settings(settings: Mapping[str, Any]) -> str:
    """Return settings as a table in pairs of columns."""
    pairs = [(words(name), _value(value)) for name, value in settings.items()]
    half = -(-len(pairs) // 2)
    left, right = pairs[:half], [*pairs[half:], *[("", "")] * (2 * half - len(pairs))]
    rows = [(*a, *b) for a, b in zip(left, right, strict=True)]
    return f'<div class="text">{table(("setting", "value") * 2, rows)}</div>'


def _value(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return ", ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _image(png: bytes, what: str) -> str:
    return f'<img alt="{for_html(what)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
