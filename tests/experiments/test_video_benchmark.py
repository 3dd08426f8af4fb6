"""What the documentation says of the films of three ropes is what was measured."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_the_table_holds_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "experiments"))
    benchmark = importlib.import_module("video_benchmark")
    rows = json.loads((ROOT / "experiments" / "video_benchmark.json").read_text())["rows"]
    assert len({r["seed"] for r in rows}) == len(rows) and {r["rope"] for r in rows} == set(benchmark.ROPES)
    text = (ROOT / "docs" / "video.md").read_text()
    said = benchmark.summary(rows)
    assert said in text
    # The first row by hand.
    soft = [r["parameters"]["bending_stiffness"] for r in rows if r["rope"] == "soft"]
    errors = sorted(100 * (p["value"] / p["true"] - 1) for p in soft)
    assert f"| soft | {len(soft)} | {errors[0]:.1f}" in said
