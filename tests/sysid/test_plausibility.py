"""Recordings in wrong units, with turned axes or other quaternions are doubted; right ones are not."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchdlo.sysid.recordings.recording import Recording, load_recording
from torchdlo.sysid.recordings.unit_doubts import doubts

SAMPLE = load_recording(Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope")


def changed(recording: Recording, change) -> Recording:
    """The recording with other trials."""
    return replace(recording, train=tuple(map(change, recording.train)), test=tuple(map(change, recording.test)))


def y_up(trial):
    return replace(trial, markers=trial.markers[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0]), gripper_quaternion=None)


def rolled(trial):
    return replace(trial, gripper_quaternion=np.roll(trial.gripper_quaternion, -1, -1))


def sideways(trial):
    turn = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])  # x to -z
    w, v = trial.gripper_quaternion[..., :1], trial.gripper_quaternion[..., 1:]
    real = w * turn[0] - (v * turn[1:]).sum(-1, keepdims=True)
    rest = w * turn[1:] + turn[0] * v + np.cross(v, turn[1:])
    return replace(trial, gripper_quaternion=np.concatenate([real, rest], -1))


def test_a_right_recording_is_not_doubted() -> None:
    assert doubts(SAMPLE) == []


@pytest.mark.parametrize(
    ("strange", "words"),
    [
        (replace(SAMPLE, mass=45.0), "mass: 45 kg are 56.2 kg a metre .*; is it in grams"),
        (replace(SAMPLE, radius=4e-4), "heavier than any metal"),
        (replace(SAMPLE, marker_noise_std=2.5e-3), "marker_noise_std: it is 2.5 mm, 4 times what neighbouring frames"),
        (replace(SAMPLE, length=800.0), "length: 800 m is a long rope"),
        (replace(SAMPLE, length=8.0), "length: markers span 0.8 m of a rope of 8 m"),
        (
            replace(SAMPLE, gravity=np.array([0, 0, 9.81])),
            r"gravity: it is \[0, 0, 9.81\], but the rope hangs towards -z",
        ),
        (replace(SAMPLE, gravity=np.array([0, 0, -9810.0])), "gravity: it is 9810 m/s"),
        (changed(SAMPLE, y_up), r"gravity: it is \[0, 0, -9.81\], but the rope hangs towards -y"),
        (changed(SAMPLE, rolled), r"read as \(x, y, z, w\) they fit the markers"),
        (changed(SAMPLE, sideways), "their x axes are 90 degrees off"),
    ],
)
def test_what_can_hardly_be_is_said(strange: Recording, words: str) -> None:
    (said,) = doubts(strange)
    assert re.search(words, said), said


def test_markers_are_to_be_turned_not_gravity() -> None:
    (said,) = doubts(changed(SAMPLE, y_up))
    assert said.endswith(
        "turn the markers (not gravity: effects take z for the vertical) so that it hangs along gravity."
    )


def test_a_test_trial_that_is_a_train_trial_is_doubted() -> None:
    train = SAMPLE.train[0]
    whole = replace(train, name="test_0")
    part = replace(
        train, name="test_0", time=train.time[:90], markers=train.markers[30:120], suspect=train.suspect[:90]
    )
    for test in (whole, replace(part, gripper_quaternion=None)):
        (said,) = doubts(replace(SAMPLE, test=(test,)))
        assert said == f"test_0: its markers are those of {train.name}; a test trial that was fitted to judges nothing."
