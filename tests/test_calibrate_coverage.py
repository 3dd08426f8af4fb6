"""What the experiment on calibrated intervals counts is what it says."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1] / "experiments")]

import calibrate_coverage  # noqa: E402


def test_intervals_that_hold_the_truth_are_counted() -> None:
    ends = {"value": 1.0, "low": 0.9, "high": 1.1}
    rows = [{"truth": {"damping_rate": t}, "parameters": {"damping_rate": ends}} for t in (0.9, 1.0, 1.2)]
    text = calibrate_coverage.table(rows)
    assert "| damping rate | 2 of 3 | 10.00% | 11.11% |" in text


def test_inner_markers_are_moved_along_the_grip_with_their_place_on_the_rope() -> None:
    x = np.array([0.0, 0.02, 0.1, 0.18, 0.2])
    markers = np.stack([x, 0 * x, 0 * x], -1)[None].repeat(2, 0)
    trial = {"markers": markers, "marker_arclength": x}
    found = calibrate_coverage.misplaced(trial, SimpleNamespace(grippers=2), 0.003)
    np.testing.assert_allclose(found["marker_arclength"], [0.0, 0.023, 0.1, 0.177, 0.2])
    np.testing.assert_allclose(found["markers"][..., 0], [[0.0, 0.023, 0.1, 0.177, 0.2]] * 2)
    assert np.array_equal(trial["marker_arclength"], x)
