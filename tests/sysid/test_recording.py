"""Recordings are read as they were written."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.sysid import Recording, Trial, load_recording, save_recording, save_trial

pytestmark = pytest.mark.quick


def assert_same(a: object, b: object, *, skip: tuple[str, ...] = ()) -> None:
    for field in dataclasses.fields(a):  # type: ignore[arg-type]
        left, right = getattr(a, field.name), getattr(b, field.name)
        if field.name in skip:
            continue
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype
            np.testing.assert_array_equal(left, right)
        elif isinstance(left, tuple):
            for x, y in zip(left, right, strict=True):
                assert_same(x, y)
        else:
            assert left == right, field.name


def test_reads_everything_as_float64(folder: Path) -> None:
    recording = load_recording(folder)
    assert [t.name for t in recording.train] == ["train_0", "train_1"]
    assert [t.name for t in recording.test] == ["test_0", "test_1"]
    assert recording.mass == 0.05 and recording.radius == 0.004
    assert recording.table_height is None and recording.marker_mass is None
    assert not recording.closed and recording.notes == "made of formulas"
    assert recording.rest_positions is not None and recording.rest_positions.shape == (9, 3)
    trial = recording.train[0]
    for name in ("time", "markers", "marker_arclength", "gripper_quaternion"):
        assert getattr(trial, name).dtype == np.float64
    assert trial.gripped.dtype == bool and trial.suspect.dtype == bool
    assert np.isnan(trial.markers[5:9, 4]).all()


def test_suspect_is_always_there(folder: Path) -> None:
    file = folder / "train_0.npz"
    with np.load(file) as archive:
        arrays = {name: archive[name] for name in archive if name != "suspect"}
    np.savez(file, **arrays)
    suspect = load_recording(folder).train[0].suspect
    assert suspect.shape == (40,) and not suspect.any()


def test_round_trip(folder: Path, tmp_path: Path) -> None:
    recording = load_recording(folder)
    save_recording(recording, tmp_path / "new" / "copy")
    assert_same(recording, load_recording(tmp_path / "new" / "copy"), skip=("path",))
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["copy"]


def test_saving_leaves_no_half_recording(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = load_recording(folder)

    def fail(*args: object, **kwargs: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    (tmp_path / "new").mkdir()
    with pytest.raises(OSError, match="disk full"):
        save_recording(recording, tmp_path / "new" / "copy")
    with pytest.raises(OSError, match="disk full"):
        save_trial(tmp_path / "new" / "train_0.npz", recording.train[0])
    assert not list((tmp_path / "new").iterdir())


def test_saving_does_not_overwrite(folder: Path) -> None:
    recording = load_recording(folder)
    with pytest.raises(InputError, match="not an empty folder"):
        save_recording(recording, folder)


def test_last_marker_may_lie_at_the_end_within_float32(folder: Path, edit_rope: Callable[..., None]) -> None:
    edit_rope(length=float(np.float32(1.0)) - 5e-8)
    assert isinstance(load_recording(folder), Recording)


def test_single_bad_frames_are_not_a_matter_of_format(folder: Path) -> None:
    file = folder / "train_0.npz"
    with np.load(file) as archive:
        arrays = dict(archive)
    arrays["markers"][20, 3] = arrays["markers"][20, 2]
    arrays["markers"][30, 5, 0] += 3.0
    np.savez(file, **arrays)
    assert isinstance(load_recording(folder).train[0], Trial)


def test_a_trial_may_be_suspect_throughout(folder: Path) -> None:
    file = folder / "train_0.npz"
    with np.load(file) as archive:
        arrays = dict(archive)
    np.savez(file, **(arrays | {"suspect": np.ones(40, dtype=bool)}))
    assert load_recording(folder).train[0].suspect.all()


def test_reads_measured_recordings(shared_data: Path) -> None:
    folders = [*shared_data.glob("deform_dlo*"), *shared_data.glob("hidden_effects/dev_*")]
    assert folders
    for path in folders:
        recording = load_recording(path)
        assert recording.train and recording.test
