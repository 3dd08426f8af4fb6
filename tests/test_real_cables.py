"""What is planted into recordings of cables is what it is said to be."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from torchdlo.sysid.recordings.recording import load_recording

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "experiments")]

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
