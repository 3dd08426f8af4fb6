"""A gap that was made on purpose is found where, when and with what it was made, and described so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import LENGTH, NOISE, PLACES, recording
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.diagnosis.residual_analysis import Localisation, localise, project, residuals
from torchdlo.sysid.recordings.recording import Recording, Trial

FLOOR = ErrorFloor(NOISE, 0.0, 0.0)


@pytest.fixture(scope="module")
def swaying() -> Recording:
    """Three train and two test trials, the rope hanging from one gripper."""
    return recording(Path("rope"))


def found(rope: Recording, error: object, left: object = None) -> Localisation:
    """Predictions whose residual is a function of the trial, on top of the noise of the markers."""
    trials, still = (*rope.train, *rope.test), lambda t: np.random.default_rng(len(t.name)).normal(size=t.markers.shape)
    fields = {"before": error, "after": left or (lambda t: NOISE * still(t))}
    predictions = {when: {t.name: t.markers - field(t) for t in trials} for when, field in fields.items()}
    return localise(rope, predictions, FLOOR)


def velocity(trial: Trial) -> np.ndarray:
    """Velocities, noisy."""
    return np.gradient(trial.markers, trial.time, axis=0)


def test_noise_is_not_described(swaying: Recording) -> None:
    rng = np.random.default_rng(0)
    here = found(swaying, lambda t: NOISE * rng.normal(size=t.markers.shape))
    assert here.words[0].startswith("Nothing above the floor: 0.30 mm") and len(here.words) == 1
    assert here.rest[0].startswith("Nothing above the floor")
    # Of some 16 000 distances in groups of 2000, chance explains 1/2000; cross-validation takes that off again.
    assert max(a.share_before for a in here.against) < 2e-3 and max(here.parts_before.values()) < 2e-3
    assert here.before.shape == (250, 13) and here.place.shape == (13,) and here.time.shape == (250,)
    # A mean of two trials and three coordinates of noise: NOISE sqrt(3), within its own spread.
    assert np.sqrt(np.mean(here.before**2)) == pytest.approx(NOISE * np.sqrt(3), rel=0.02)


def test_a_lag_is_told_with_its_size(swaying: Recording) -> None:
    here = found(swaying, lambda t: -0.012 * velocity(t))
    assert any(s.startswith("The measurement runs 12 ms behind the simulation") for s in here.words), here.words
    # The noise of the markers, differentiated over two frames, is all that smoothing takes away.
    noise = 2 * (0.012 * NOISE / 0.02) ** 2 * 3 / np.mean(np.sum((0.012 * velocity(swaying.train[0])) ** 2, -1)[:, 2:])
    assert here.parts_before["lag"] > 0.99 - noise
    assert any("speed" in s for s in here.words)
    numerical_damping = found(swaying, lambda t: 0.02 * velocity(t))
    assert any(s.startswith("The measurement runs 20 ms ahead of") for s in numerical_damping.words)


def test_a_shift_is_told_with_its_direction(swaying: Recording) -> None:
    here = found(swaying, lambda t: np.broadcast_to([0.0, 0.001, -0.004], t.markers.shape))
    assert any("One shift of all markers by (+0.0, +1.0, -4.0) mm takes 100%" in s for s in here.words), here.words
    assert any(s.startswith("It is nearly constant in time (100%") for s in here.words)
    assert any(s == "It is spread along the whole rope." for s in here.words)


def test_an_offset_of_one_marker_is_told_apart_from_a_shift(swaying: Recording) -> None:
    own = np.random.default_rng(3).normal(size=(len(PLACES), 3)) * 5e-3
    here = found(swaying, lambda t: np.broadcast_to(own, t.markers.shape))
    assert here.parts_before["offsets"] == pytest.approx(1.0, abs=1e-6)
    assert any(s.startswith("A fixed shift of each marker, the same in all trials, takes 100%") for s in here.words)


def test_a_local_gap_is_found_in_its_place() -> None:
    rope = recording(Path("rope"), both=True)

    def near(place: float) -> Localisation:
        return found(
            rope,
            lambda t: 5e-3 * np.exp(-(((PLACES - place) / 0.06) ** 2))[:, None] * np.sin(9 * t.time)[:, None, None],
        )

    second = next(s for s in near(0.79).words if s.startswith("Largest"))
    # 60 % of a bell of width 6 cm / sqrt(2) lies within 2.5 cm of its middle, 2.5 cm before the gripper.
    assert "of the second gripper" in second and int(second.split()[2]) <= 12
    middle = next(s for s in near(0.45).words if s.startswith("Largest"))
    low, high = (int(middle.split()[k]) for k in (2, 4))
    assert middle.startswith("Largest between") and low < 45 < high and high - low < 15


def test_a_wrong_bend_is_found_where_it_is_made(swaying: Recording) -> None:
    # A kink at 0.4 m: nothing is wrong before it, and everything behind it turns.
    def kinked(trial: Trial) -> np.ndarray:
        behind = np.clip(PLACES - 0.4, 0, None)[:, None] * np.array([0.05, 0.0, 0.0])
        noise = NOISE * np.random.default_rng(4).normal(size=trial.markers.shape)
        return behind * np.sin(5 * trial.time)[:, None, None] + noise

    here = found(swaying, kinked)
    assert any("grows towards the free end" in s for s in here.words)
    bend = next(s for s in here.words if s.startswith("Its curvature is wrong most"))
    low, high = (int(bend.split()[k]) for k in (6, 8))
    assert low < 40 < high and high - low < 0.3 * 100 * LENGTH


def test_what_goes_with_the_curvature_is_told(swaying: Recording) -> None:
    def bent(trial: Trial) -> np.ndarray:
        direction = np.random.default_rng(len(trial.name)).normal(size=3)
        size = np.zeros(trial.markers.shape[:2])
        edge = np.diff(trial.markers, axis=1)
        tangent = edge / np.linalg.norm(edge, axis=-1, keepdims=True)
        size[:, 1:-1] = np.linalg.norm(np.diff(tangent, axis=1), axis=-1)
        return 0.05 * size[..., None] * direction / np.linalg.norm(direction)

    here = found(swaying, bent)
    shares = {a.name: a.share_before for a in here.against}
    assert max(shares, key=shares.get) == "curvature" and shares["curvature"] > 0.5
    assert any("grows with curvature" in s for s in here.words)


def test_what_calibration_can_take_up_is_projected_out(swaying: Recording) -> None:
    trials = (*swaying.train, *swaying.test)
    rng = np.random.default_rng(1)
    tangents = {t.name: rng.normal(size=(2, *t.markers.shape)) for t in trials}
    field = {t.name: rng.normal(size=t.markers.shape) * 1e-3 for t in trials}
    mixed = {
        n: t.markers - field[n] - 2e-3 * tangents[n][0] + 1e-3 * tangents[n][1]
        for n, t in ((t.name, t) for t in trials)
    }
    left = project(residuals(swaying, mixed, trials), tangents)
    pure = project(residuals(swaying, {t.name: t.markers - field[t.name] for t in trials}, trials), tangents)
    for a, b in zip(left, pure, strict=True):
        np.testing.assert_allclose(a.error, b.error, atol=1e-12)


def test_unseen_and_suspect_frames_are_left_out(swaying: Recording) -> None:
    def spoiled(trial: Trial) -> Trial:
        markers, suspect = trial.markers.copy(), trial.suspect.copy()
        markers[20:30, 5], suspect[50:60] = np.nan, True
        markers[50:60] += 1.0
        return replace(trial, markers=markers, suspect=suspect)

    trials = {t.name: spoiled(t) for t in (*swaying.train, *swaying.test)}
    rope = replace(
        swaying, train=tuple(trials[t.name] for t in swaying.train), test=tuple(trials[t.name] for t in swaying.test)
    )
    sims = {t.name: t.markers - 5e-3 for t in (*swaying.train, *swaying.test)}
    here = localise(rope, {"before": sims, "after": sims}, FLOOR)
    assert np.isnan(here.before[50:60]).all() and np.nanmax(here.before) == pytest.approx(5e-3 * np.sqrt(3))
    assert any("One shift of all markers by (+5.0, +5.0, +5.0)" in s for s in here.words)
