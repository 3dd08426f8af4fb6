"""The published error measure, by hand."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from torchdlo.sysid import Trial, load_recording
from torchdlo.sysid.recordings.metrics import average, free_marker_distance, mean_absolute_error, scored

pytestmark = pytest.mark.quick


@pytest.fixture
def trial(template: Path) -> Trial:
    trial = load_recording(template).test[0]
    return dataclasses.replace(trial, markers=np.nan_to_num(trial.markers, nan=0.3))


def test_frames_count_from_20_ms_on(trial: Trial) -> None:
    assert scored(trial).tolist() == [False, False] + [True] * 38
    predicted = trial.markers.copy()
    predicted[:2] += 1.0
    assert mean_absolute_error(predicted, trial) == 0.0


def test_mean_is_over_coordinates_of_all_markers(trial: Trial) -> None:
    predicted = trial.markers.copy()
    predicted[:, 3] += [0.3, -0.4, 0.0]
    # One of nine markers, 0.7 m over three coordinates; six free markers, 0.5 m away.
    assert mean_absolute_error(predicted, trial) == pytest.approx(0.7 / 27)
    assert trial.gripped.sum() == 4
    assert free_marker_distance(predicted, trial) == pytest.approx(0.5 / 5)
    gripped = trial.markers.copy()
    gripped[:, 0] += 1.0
    assert mean_absolute_error(gripped, trial) == pytest.approx(1 / 9)
    assert free_marker_distance(gripped, trial) == 0.0


def test_suspect_frames_count(trial: Trial) -> None:
    predicted = trial.markers.copy()
    predicted[trial.suspect] += 0.1
    assert trial.suspect.sum() == 2
    assert mean_absolute_error(predicted, trial) == pytest.approx(0.1 * 2 / 38)


def test_unseen_markers_do_not_count(trial: Trial) -> None:
    markers = trial.markers.copy()
    markers[10:, 4] = np.nan
    unseen = dataclasses.replace(trial, markers=markers)
    predicted = trial.markers.copy()
    predicted[10:, 4] += 100.0
    assert mean_absolute_error(predicted, unseen) == 0.0
    assert free_marker_distance(predicted, unseen) == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_prediction_that_blew_up_has_no_error(trial: Trial, value: float) -> None:
    predicted = trial.markers.copy()
    predicted[30, 4] = value
    assert np.isnan(mean_absolute_error(predicted, trial))
    assert np.isnan(free_marker_distance(predicted, trial))


def test_trials_count_the_same(trial: Trial) -> None:
    short = dataclasses.replace(trial, time=trial.time[:10], markers=trial.markers[:10])
    predictions = [trial.markers + 0.1, short.markers + 0.3]
    assert average(mean_absolute_error, predictions, [trial, short]) == pytest.approx(0.2)


def test_wrong_shape_is_refused(trial: Trial) -> None:
    with pytest.raises(ValueError, match="one position for each frame and marker"):
        mean_absolute_error(trial.markers[:-1], trial)
