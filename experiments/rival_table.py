"""The table of what other methods say, which needs nothing but their rows."""

from __future__ import annotations

from typing import Any


def table(rows: list[dict[str, Any]]) -> str:
    """Return a markdown table of what all methods say."""
    lines = [
        "| recording | hidden | calibration alone [mm] | `diagnose` | BIC | regression | network, train / test |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        hidden = "?" if r["hidden"] is None else ", ".join(r["hidden"]) or "nothing"
        ours = f"{', '.join(r['diagnose']['named']) or r['diagnose']['verdict']} ({r['diagnose']['closed_test']:.0%})"
        terms_ = ", ".join(t["name"] for t in r["regression"]) or "none"
        net = " / ".join(f"{r['network'][split]:.0%}" for split in ("train", "test"))
        cells = (r["recording"], hidden, f"{1e3 * r['gap_m']:.1f}", ours, r["bic"] or "none", terms_, net)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
