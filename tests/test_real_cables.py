"""What is planted into recordings of cables is what it is said to be."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from torchdlo.sysid.recordings.recording import load_recording

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "experiments")]

import cable_table  # noqa: E402
import real_cables  # noqa: E402


@pytest.fixture(scope="module")
def recording():
    return load_recording(ROOT / "torchdlo" / "data" / "sample_rope")


def test_a_delay_lets_free_markers_lag_the_gripped_ones(recording):
    trial = recording.train[0]
    late = real_cables.delayed(trial)
    step = trial.time[1] - trial.time[0]
    shift = round(0.02 / step)
    assert shift >= 1 and len(late.time) == len(trial.time) - shift
    free, held = ~trial.gripped, trial.gripped
    assert np.array_equal(late.markers[:, held], trial.markers[shift:, held], equal_nan=True)
    assert np.array_equal(late.markers[:, free], trial.markers[:-shift, free], equal_nan=True)


def test_a_tilt_turns_the_frame_by_two_degrees(recording):
    trial = recording.train[0]
    turned = real_cables.tilted(trial)
    a = trial.markers[0, -1] - trial.markers[0, 0]
    b = turned.markers[0, -1] - turned.markers[0, 0]
    across, after = a[1:], b[1:]
    angle = np.arctan2(across[0] * after[1] - across[1] * after[0], across @ after)
    assert np.isclose(np.degrees(angle), 2.0) and np.isclose(a[0], b[0])


def test_blocks_are_the_last_trials_by_number(recording):
    split = real_cables.blocks(recording)
    numbers = [[t.name.rpartition("_")[2] for t in part] for part in (split.train, split.test)]
    assert max(numbers[0]) <= min(numbers[1]) and len(split.test) == len(recording.trials("all")) // 5


def cable(name: str, plant: str = "", **fields: object) -> dict:
    """A row of a cable in which friction is named, with p = 0.01."""
    limits = [
        {"name": "time_delay", "number": "delay", "unit": "s", "easiest": 0.004, "hardest": None, "note": None},
        {"name": "point_mass", "number": "mass", "unit": "kg", "easiest": 0.03, "hardest": 0.09, "note": None},
        {"name": "marker_offset", "number": "offset", "unit": "m", "easiest": None, "hardest": None, "note": "unseen"},
    ]
    base = {"recording": name, "plant": plant, "verdict": "partial", "effects": ["friction"], "ties": {"friction": []}}
    errors = {"test_mae_before_mm": 11.55, "test_mae_after_mm": 9.26, "test_trials": [14, 14]}
    return base | errors | {"p_values": {"friction": 0.01}, "detection_limits": limits, "named": not plant} | fields


def test_a_plant_that_is_missed_is_held_against_what_was_said_beforehand():
    rows = [cable("a"), *(cable("a", plant) for plant in ("time_delay", "point_mass", "marker_offset"))]
    rows += [cable("b", "time_delay", effects=["time_delay"], ties={"time_delay": ["wind"]}, named=True)]
    told = cable_table.table(rows)
    assert "| a | 11.6 → 9.3 | `partial` | friction | 0.01 | 14 of 14 |" in told
    ends = {line.split(" | ")[0][2:]: line.split(" | ")[-1][:-2] for line in told.splitlines() if " | a | " in line}
    # A delay of 20 ms is five times what was said to be seen; a bead of 10 g a third of it; no offset can be seen.
    assert ends == {"delay of 20 ms": "**no**", "bead of 10 g": "said to be too small"} | {
        "markers 8 mm beside the axis": "said to be too small"
    }
    assert "mass 0.03 to 0.09 kg" in told and "delay 0.004 s" in told and "| unseen |" in told
    # Nothing was said beforehand of the other cable.
    assert "| delay of 20 ms | b | not said | 11.6 → 9.3 | time_delay / wind | - | yes |" in told


def test_rows_of_a_folder_are_read_without_its_models(tmp_path: Path):
    for name, content in {"a": cable("a"), "a-model": {"effects": []}, "real_cables": [cable("a")]}.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    assert real_cables.stored(tmp_path) == [cable("a")]
