"""Other ways of finding what is missing do what they say where the answer is known."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from tests.report.fake_diagnosis import fake_diagnosis
from tests.sysid.swaying import recording as swaying
from torchdlo.sysid.diagnosis.verdict import Candidate
from torchdlo.sysid.recordings.recording import Recording

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))

import rival_methods
from rival_table import table


@pytest.fixture(scope="module")
def rope() -> Recording:
    """A rope that sways."""
    return swaying(Path("rope"), frames=200)


def lacking(rope: Recording, dose: float) -> dict[str, np.ndarray]:
    """Predictions that lack the accelerations of a drag."""
    found = {}
    for trial in (*rope.train, *rope.test):
        dt = float(trial.time[1])
        v = np.gradient(uniform_filter1d(trial.markers, 21, axis=0), dt, axis=0)
        force = -dose * np.linalg.norm(v, axis=-1, keepdims=True) * v
        found[trial.name] = trial.markers - np.cumsum(np.cumsum(force, 0), 0) * dt**2
    return found


def test_regression_finds_the_term_that_is_lacking(rope: Recording) -> None:
    (first, *_), none = rival_methods.regress(rope, lacking(rope, 1.0)), rival_methods.regress(rope, lacking(rope, 0.0))
    assert first[0] == "air_drag" and first[1] > 0.5 and first[2] < 0.01
    assert none == []


def test_a_network_learns_what_depends_on_the_state(rope: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rival_methods, "EPOCHS", 150)
    # An error that lags, as that of a delay: the velocity tells it, on other trials as well.
    late = {t.name: t.markers - 0.01 * np.gradient(t.markers, t.time, axis=0) for t in (*rope.train, *rope.test)}
    closed = rival_methods.learned(rope, late, 3e-4)
    assert closed["train"] > 0.8 and closed["test"] > 0.5


def test_bic_takes_what_saves_more_than_its_numbers_cost(rope: Recording) -> None:
    better = Candidate("air_drag", 0.5, 0.4, 0.4, "taken")
    worse = replace(better, name="point_mass", gain=-0.1)
    found = fake_diagnosis(rope, candidates=[[worse, better]])
    assert rival_methods.bic(found, rope) == "air_drag"
    assert rival_methods.bic(fake_diagnosis(rope, candidates=[[worse]]), rope) is None


def test_the_table_says_what_each_method_says() -> None:
    row = {
        "recording": "a",
        "hidden": [],
        "gap_m": 2e-3,
        "diagnose": {"verdict": "none", "named": [], "closed_test": 0.0},
        "bic": None,
        "regression": [],
        "network": {"train": 0.8, "test": -0.1},
    }
    assert table([row]).splitlines()[-1] == "| a | nothing | 2.0 | none (0%) | none | none | 80% / -10% |"
