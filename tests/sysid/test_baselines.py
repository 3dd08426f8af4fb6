"""The two predictions without parameters."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest

from torchdlo.sysid import Recording, load_recording
from torchdlo.sysid.recordings.metrics import average, mean_absolute_error
from torchdlo.sysid.recordings.trivial_predictors import BASELINES, catenary, frozen_shape, hang

DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture
def recording(template: Path) -> Recording:
    return load_recording(template)


def one(start: list[float], end: list[float], along: np.ndarray, length: float) -> np.ndarray:
    return hang(np.array([start]), np.array([end]), along, length, DOWN)[0]


def test_hang_is_the_textbook_catenary() -> None:
    # z = a cosh(x / a) from x = -0.3 to 0.5, arclength a sinh(x / a); supports at unequal height.
    a, x = 0.25, np.linspace(-0.3, 0.5, 41)
    z, s = a * np.cosh(x / a), a * np.sinh(x / a)
    points = np.stack([0.6 * x, 0.8 * x, z], axis=-1)  # in a plane turned about z
    result = one(points[0], points[-1], s[1:-1] - s[0], s[-1] - s[0])
    np.testing.assert_allclose(result, points[1:-1], atol=1e-12)


@pytest.mark.parametrize("span", [0.0, 1e-12, 1e-6, 1e-3, 0.3, 0.9, 0.999999, 1 - 1e-12, 1.0, 1.2])
@pytest.mark.parametrize("rise", [0.0, 0.3, -0.3, 0.99, 1.0])
def test_hang_keeps_the_rope_continuous_and_its_length(span: float, rise: float) -> None:
    along = np.linspace(0, 1, 1001)
    result = one([0.1, 0.2, 0.3], [0.1 + span, 0.2, 0.3 + rise], along, 1.0)
    assert np.isfinite(result).all()
    np.testing.assert_allclose(result[0], [0.1, 0.2, 0.3], atol=2e-9)
    np.testing.assert_allclose(result[-1], [0.1 + span, 0.2, 0.3 + rise], atol=2e-9)
    steps = np.linalg.norm(np.diff(result, axis=0), axis=-1)
    # A rope that is long enough keeps its length (chords fall short only at a sharp bend).
    assert steps.max() <= max(1.0, np.hypot(span, rise)) * 1e-3 * (1 + 1e-6)
    assert steps.sum() > 0.999


def test_hang_in_a_vertical_loop_is_two_strands() -> None:
    result = one([0, 0, 0], [0, 0, 0.2], np.array([0.2, 0.4, 0.6, 0.8]), 1.0)
    np.testing.assert_allclose(result[:, 2], [-0.2, -0.4, -0.2, 0.0], atol=1e-7)


def test_catenary_keeps_gripped_markers_and_hangs_in_their_plane(recording: Recording) -> None:
    trial = recording.test[0]
    result = catenary(trial, recording)
    np.testing.assert_array_equal(result[:, trial.gripped], trial.markers[:, trial.gripped])
    steps = np.linalg.norm(np.diff(result[:, 1:8], axis=1), axis=-1)
    assert (steps <= np.diff(trial.marker_arclength)[1:7] + 1e-12).all()


def test_free_ends_hang_straight_down(recording: Recording) -> None:
    trial = recording.test[0]
    gripped = np.zeros(9, dtype=bool)
    gripped[3] = True
    result = catenary(dataclasses.replace(trial, gripped=gripped), recording)
    below = np.abs(trial.marker_arclength - trial.marker_arclength[3])
    expected = trial.markers[:, 3, None] + below[:, None] * DOWN
    np.testing.assert_allclose(result, expected, atol=1e-12)


def test_closed_rope_hangs_on_both_sides(recording: Recording) -> None:
    trial = recording.test[0]
    gripped = np.zeros(9, dtype=bool)
    gripped[[2, 6]] = True
    held = dataclasses.replace(trial, gripped=gripped)
    loop = dataclasses.replace(recording, length=1.2, closed=True)
    result = catenary(held, loop)
    # 0.6 m of rope on each side between supports at equal height: mirror images in place.
    np.testing.assert_allclose(result[:, 4, 2], result[:, 2, 2] - _sag(result, 0.6), atol=1e-9)
    assert np.isfinite(result).all()
    assert (result[:, [0, 1, 7, 8], 2] < result[:, [2], 2] + 1e-9).all()


def _sag(result: np.ndarray, length: float) -> np.ndarray:
    # From L = 2 a sinh(d / 2a), sag = a (cosh(d / 2a) - 1), solved by bisection.
    span = np.linalg.norm(result[:, 6] - result[:, 2], axis=-1)
    low, high = np.full_like(span, 1e-3), np.full_like(span, 1e3)
    for _ in range(200):
        a = np.sqrt(low * high)
        longer = 2 * a * np.sinh(np.minimum(span / (2 * a), 300)) > length
        low, high = np.where(longer, a, low), np.where(longer, high, a)
    return a * (np.cosh(span / (2 * a)) - 1)


def test_no_gravity_is_not_an_error(recording: Recording) -> None:
    weightless = dataclasses.replace(recording, gravity=np.zeros(3))
    assert np.isfinite(catenary(recording.test[0], weightless)).all()


def test_frozen_shape_follows_the_grippers(recording: Recording) -> None:
    trial = recording.test[0]
    result = frozen_shape(trial)
    np.testing.assert_allclose(result[:, trial.gripped], trial.markers[:, trial.gripped])
    np.testing.assert_allclose(result[1, 2:4], trial.markers[1, 2:4])
    # Marker 4 is halfway between the inner gripped markers 1 and 7, at 0.03, 0.5 and 0.97 m.
    moved = 0.5 * (trial.markers[:, 1] + trial.markers[:, 7])
    expected = trial.markers[1, 4] + moved - moved[1]
    np.testing.assert_allclose(result[:, 4], expected, atol=1e-12)


def test_frozen_shape_fills_markers_not_seen_at_the_start(recording: Recording) -> None:
    trial = recording.test[0]
    markers = trial.markers.copy()
    markers[:5, 4] = np.nan
    result = frozen_shape(dataclasses.replace(trial, markers=markers))
    middle = 0.5 * (trial.markers[1, 3] + trial.markers[1, 5])
    np.testing.assert_allclose(result[1, 4], middle, atol=1e-12)


def test_predictions_do_not_see_the_free_markers(recording: Recording) -> None:
    trial = recording.test[0]
    markers = trial.markers.copy()
    markers[2:, ~trial.gripped] += 5.0
    changed = dataclasses.replace(trial, markers=markers)
    for predict in BASELINES.values():
        np.testing.assert_array_equal(predict(trial, recording), predict(changed, recording))


@pytest.mark.parametrize(
    ("cable", "frozen", "hanging"),
    [("deform_dlo1", 31.8, 20.5), ("deform_dlo2", 27.3, 21.9), ("deform_dlo4", 27.7, 17.0)],
)
def test_reproduces_the_known_errors_on_real_cables(
    cable: str, frozen: float, hanging: float, shared_data: Path
) -> None:
    recording = load_recording(shared_data / cable)
    start = time.process_time()
    for predict, expected in ((frozen_shape, frozen), (catenary, hanging)):
        predictions = [predict(trial, recording) for trial in recording.test]
        error = average(mean_absolute_error, predictions, recording.test) * 1e3
        assert error == pytest.approx(expected, abs=0.06)  # given with one decimal
    assert time.process_time() - start < 2.0
