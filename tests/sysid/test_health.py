"""Faults that are built into sound recordings are found, named and taken out; sound ones raise no alarm."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.sysid.swaying import recording as swaying
from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis.error_floor import noise_ratio
from torchdlo.sysid.recordings.data_quality import DataIssue, check
from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording

RECORDINGS = ("hanging", "both ends", "sample")


@pytest.fixture(scope="module")
def sound(repository: Path) -> dict[str, Recording]:
    """Recordings without faults: two made of formulas, and the one in the package."""
    sample = load_recording(repository / "torchdlo" / "data" / "sample_rope")
    return {"hanging": swaying(Path("a")), "both ends": swaying(Path("b"), both=True), "sample": sample}


def spoil(recording: Recording, change: Callable[[Trial], Trial], which: str | None = "train_1") -> Recording:
    """Change one trial, or all."""

    def maybe(trial: Trial) -> Trial:
        return change(trial) if which in (None, trial.name) else trial

    return replace(recording, train=tuple(map(maybe, recording.train)), test=tuple(map(maybe, recording.test)))


def moved(trial: Trial, do: Callable[[np.ndarray], None]) -> Trial:
    """Change the markers of a trial."""
    markers = trial.markers.copy()
    do(markers)
    return replace(trial, markers=markers)


def found(recording: Recording) -> tuple[dict[str, Trial], list[DataIssue]]:
    """Trials after the check by name, and the faults."""
    clean, faults = check(recording)
    return {t.name: t for t in (*clean.train, *clean.test)}, faults


@pytest.mark.parametrize("name", RECORDINGS)
def test_sound_recordings_raise_no_alarm(sound: dict[str, Recording], name: str) -> None:
    clean, faults = check(sound[name])
    assert faults == []
    for a, b in zip(clean.train + clean.test, sound[name].train + sound[name].test, strict=True):
        np.testing.assert_array_equal(a.markers, b.markers)
        np.testing.assert_array_equal(a.suspect, b.suspect)


@pytest.mark.parametrize("name", RECORDINGS)
@pytest.mark.parametrize("noise", [5e-4, 2e-3])
def test_noise_alone_raises_no_alarm(sound: dict[str, Recording], name: str, noise: float) -> None:
    rng = np.random.default_rng(0)
    shaken = spoil(sound[name], lambda t: moved(t, lambda x: x.__iadd__(noise * rng.normal(size=x.shape))), None)
    assert check(replace(shaken, marker_noise_std=None))[1] == []


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_jump_is_left_out(sound: dict[str, Recording], name: str) -> None:
    def jump(x: np.ndarray) -> None:
        x[60, 6] += [0.03, 0.02, 0.0]
        x[90:95, 7, 2] += 0.05

    trials, faults = found(spoil(sound[name], lambda t: moved(t, jump)))
    assert [(f.trial, f.kind) for f in faults] == [("train_1", "jump")]
    assert "marker 6 in frame 60" in faults[0].message and "marker 7 in frames 90 to 94" in faults[0].message
    lost = np.isnan(trials["train_1"].markers[..., 0]) & ~np.isnan(sound[name].train[1].markers[..., 0])
    assert lost.sum() == 6 and lost[60, 6] and lost[90:95, 7].all()


@pytest.mark.parametrize("name", RECORDINGS)
@pytest.mark.parametrize("pair", [(6, 7), (5, 9)])
def test_swapped_markers_are_left_out(sound: dict[str, Recording], name: str, pair: tuple[int, int]) -> None:
    def swap(x: np.ndarray) -> None:
        x[50:80, pair] = x[50:80, pair[::-1]]

    trials, faults = found(spoil(sound[name], lambda t: moved(t, swap)))
    assert [(f.trial, f.kind) for f in faults] == [("train_1", "swap")], faults
    assert f"markers {pair[0]} and {pair[1]} are swapped in frames 50 to 79" in faults[0].message
    lost = np.isnan(trials["train_1"].markers[..., 0]) & ~np.isnan(sound[name].train[1].markers[..., 0])
    assert lost.sum() == 60 and lost[50:80][:, pair].all()


def test_a_swap_that_lasts_is_taken_out_where_it_is_wrong(sound: dict[str, Recording]) -> None:
    def swap(x: np.ndarray) -> None:
        x[50:, (6, 7)] = x[50:, (7, 6)]

    trials, faults = found(spoil(sound["hanging"], lambda t: moved(t, swap)))
    # The rope's length tells that the longer part is the wrong one.
    assert [f.kind for f in faults] == ["swap"] and "frames 50 to 249" in faults[0].message
    assert np.isfinite(trials["train_1"].markers[:50]).all()


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_camera_that_slips_ends_the_trial(sound: dict[str, Recording], name: str) -> None:
    turn = Rotation.from_rotvec([0.0, 0.01, 0.02])

    def slip(x: np.ndarray) -> None:
        x[120:] = turn.apply(x[120:].reshape(-1, 3)).reshape(x[120:].shape) + np.array([0.02, 0.0, -0.01])

    trials, faults = found(spoil(sound[name], lambda t: moved(t, slip)))
    assert [(f.trial, f.kind) for f in faults] == [("train_1", "camera")], faults
    assert "(frame 120)" in faults[0].message
    assert trials["train_1"].suspect[120:].all() and not trials["train_1"].suspect[:120].any()


def test_missing_frames_are_told_from_a_slipped_camera(sound: dict[str, Recording]) -> None:
    def drop(t: Trial) -> Trial:
        keep = np.r_[0:100, 103 : len(t.time)]
        cut = {k: getattr(t, k)[keep] for k in ("markers", "suspect")}
        return replace(t, time=t.time[: len(keep)], **cut)

    trials, faults = found(spoil(sound["hanging"], drop))
    assert [(f.trial, f.kind) for f in faults] == [("train_1", "clock")]
    assert "about 3 frames are missing at 1.00 s (frame 100)" in faults[0].message
    assert trials["train_1"].suspect[100:150].all() and trials["train_1"].suspect.sum() == 50


def test_repeated_frames_are_left_out(sound: dict[str, Recording]) -> None:
    def stall(x: np.ndarray) -> None:
        x[70:74] = x[70]

    trials, faults = found(spoil(sound["hanging"], lambda t: moved(t, stall)))
    assert ("train_1", "stall") in [(f.trial, f.kind) for f in faults]
    assert trials["train_1"].suspect[71:74].all() and not trials["train_1"].suspect[:71].any()


def test_a_sliding_marker_is_named(sound: dict[str, Recording]) -> None:
    def slide(x: np.ndarray) -> None:
        way = x[:, 8] - x[:, 7]
        # By 20 mm of the 67 mm to the next one, through the trial.
        x[:, 7] += np.linspace(0, 0.3, len(x))[:, None] * way

    _, faults = found(spoil(sound["hanging"], lambda t: moved(t, slide)))
    said = [f.message for f in faults if f.kind == "drift" and f.trial == "train_1"]
    assert any("markers 6 and 7 creep apart by 20 mm" in s for s in said), faults
    assert any("markers 7 and 8 creep together by 20 mm" in s for s in said), faults


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_marker_in_the_wrong_place_is_named(sound: dict[str, Recording], name: str) -> None:
    arclength = sound[name].train[0].marker_arclength
    wrong = arclength.copy()
    wrong[6] -= 0.3 * (arclength[6] - arclength[5])
    size = 1e3 * (arclength[6] - wrong[6])
    _, faults = found(spoil(sound[name], lambda t: replace(t, marker_arclength=wrong), None))
    assert [f.kind for f in faults] == ["place"], faults
    told = re.match(r"marker 6 sits (\d+) mm further along", faults[0].message)
    # Noise, and markers in the package's recording that sit up to 1 mm off, leave some mm.
    assert abs(int(told[1]) - size) <= 1.5


@pytest.mark.parametrize("name", RECORDINGS)
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_wrong_length_is_named(sound: dict[str, Recording], name: str, factor: float) -> None:
    rope = spoil(sound[name], lambda t: replace(t, marker_arclength=t.marker_arclength * factor), None)
    _, faults = found(replace(rope, length=rope.length * factor))
    assert [f.kind for f in faults] == ["length"]
    # Bends and noise change lengths by less than a per cent.
    told = re.match(r"markers are (\d+)% (further apart|closer together)", faults[0].message)
    assert abs(int(told[1]) - 100 * abs(1 / factor - 1)) <= 1.5 and (told[2] == "further apart") == (factor < 1)


@pytest.mark.parametrize(("factor", "said"), [(1000.0, "looks like millimetres"), (1e-3, "looks like millimetres")])
def test_lengths_in_other_units_are_refused(sound: dict[str, Recording], factor: float, said: str) -> None:
    rope = spoil(sound["hanging"], lambda t: replace(t, marker_arclength=t.marker_arclength * factor), None)
    with pytest.raises(InputError, match=f"expected both in metres.*{said}"):
        check(replace(rope, length=rope.length * factor, radius=None))


def test_a_mass_in_grams_is_refused(sound: dict[str, Recording]) -> None:
    rope = sound["hanging"]
    with pytest.raises(InputError, match=r"make 7.07e\+05 kg/m\^3, expected .*; mass looks like grams"):
        check(replace(rope, mass=50.0))
    with pytest.raises(InputError, match=r"expected 20 to 23000; one of them is wrong"):
        check(replace(rope, mass=5e-5))
    assert check(replace(rope, mass=50.0, radius=None))[1] == []


def test_gravity_in_another_unit_is_refused(sound: dict[str, Recording]) -> None:
    with pytest.raises(InputError, match=r"gravity: expected m/s\^2, found 981; divide by 100"):
        check(replace(sound["hanging"], gravity=np.array([0.0, 0.0, -981.0])))


def test_a_scaled_clock_is_refused(sound: dict[str, Recording]) -> None:
    with pytest.raises(
        InputError, match=r"train_1.npz: time: expected frames every 10 ms as in train_0.npz, found every 9"
    ):
        check(spoil(sound["hanging"], lambda t: replace(t, time=t.time * 0.9)))


def test_a_cut_trial_is_named(sound: dict[str, Recording]) -> None:
    def cut(t: Trial) -> Trial:
        return replace(t, time=t.time[:60], markers=t.markers[:60], suspect=t.suspect[:60])

    _, faults = found(spoil(sound["hanging"], cut, "test_0"))
    assert [(f.trial, f.kind) for f in faults] == [("test_0", "cut")]


def test_a_trial_of_which_nothing_is_left_is_refused(sound: dict[str, Recording]) -> None:
    def slip(x: np.ndarray) -> None:
        x[3:] += 0.05

    with pytest.raises(InputError, match=r"train_1.npz: all markers, held ones too, step by .*leave it out"):
        check(spoil(sound["hanging"], lambda t: moved(t, slip)))


def test_a_jerk_of_the_rope_is_no_fault(sound: dict[str, Recording]) -> None:
    # Gripper and rope are pulled by 5 g from one frame to the next, and stopped by 5 g.
    def jerk(x: np.ndarray) -> None:
        pull = np.zeros(len(x))
        pull[100:110], pull[110:120] = 50.0, -50.0
        x[..., 0] += np.cumsum(np.cumsum(pull))[:, None] * 0.01**2

    assert check(spoil(sound["hanging"], lambda t: moved(t, jerk)))[1] == []


def test_real_recordings_lose_few_frames(shared_data: Path) -> None:
    for name in ("deform_dlo1", "deform_dlo2", "deform_dlo4"):
        rope = load_recording(shared_data / name)
        clean, faults = check(rope)
        # One trial of the first cable is suspect throughout.
        gone = [f.trial for f in faults if f.kind == "unseen"]
        assert gone == (["train_090"] if name == "deform_dlo1" else [])
        kept = [t for t in rope.train + rope.test if t.name not in gone]
        trials = list(zip(clean.train + clean.test, kept, strict=True))
        lost = np.mean([a.suspect.mean() - b.suspect.mean() for a, b in trials])
        assert lost < 0.02
    for folder in sorted((shared_data / "hidden_effects").glob("dev_*")):
        assert check(load_recording(folder))[1] == []


def test_a_noise_in_millimetres_is_refused(sound: dict[str, Recording]) -> None:
    with pytest.raises(InputError, match=r"marker_noise_std: expected metres, found 0\.3, \d+ times .* is it in mm\?"):
        check(replace(sound["hanging"], marker_noise_std=0.3))
    # Smooth markers may have a noise that neighbouring frames do not show.
    still = spoil(sound["hanging"], lambda t: replace(t, markers=np.repeat(t.markers[:1], len(t.time), 0)), None)
    assert noise_ratio(replace(still, marker_noise_std=5e-4)) == pytest.approx(2.5)
    assert noise_ratio(replace(still, marker_noise_std=None)) == 0.0


def test_trials_with_nothing_to_judge_by_are_left_out_and_said(sound: dict[str, Recording]) -> None:
    def unseen(x: np.ndarray) -> None:
        x[4:, 2:] = np.nan

    clean, faults = check(spoil(sound["hanging"], lambda t: moved(t, unseen), "test_0"))
    assert [t.name for t in clean.test] == ["test_1"] and [(f.trial, f.kind) for f in faults] == [("test_0", "unseen")]
    hidden = spoil(sound["hanging"], lambda t: replace(t, suspect=np.ones_like(t.suspect)), "train_1")
    assert [t.name for t in check(hidden)[0].train] == ["train_0", "train_2"]
    with pytest.raises(InputError, match="found 4, and no better train trial; nothing could be judged"):
        check(spoil(sound["hanging"], lambda t: moved(t, unseen), None))


def test_frames_that_are_all_stored_twice_are_seen(sound: dict[str, Recording]) -> None:
    def twice(x: np.ndarray) -> None:
        x[1::2, 2:] = x[:-1:2, 2:]

    trials, faults = found(spoil(sound["hanging"], lambda t: moved(t, twice)))
    assert [(f.trial, f.kind) for f in faults] == [("train_1", "stall")] and "every other frame" in faults[0].message
    assert trials["train_1"].suspect[1::2].all() and not trials["train_1"].suspect[::2].any()
