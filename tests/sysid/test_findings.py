"""A verdict says what was found, how sure it is, and what would tell rivals apart."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.report.fake_diagnosis import BASELINE, fake_diagnosis, fitted
from tests.sysid.swaying import recording as swaying
from torchdlo.physics.effects import EFFECTS
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.effect_library import MEANING, separating_experiment
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.diagnosis.findings import absorbed, confidence, findings, findings_json, summary
from torchdlo.sysid.diagnosis.verdict import Diagnosis
from torchdlo.sysid.recordings.data_quality import DataIssue
from torchdlo.sysid.recordings.recording import Recording


@pytest.fixture(scope="module")
def rope() -> Recording:
    """A rope that sways."""
    return swaying(Path("rope"), frames=120)


@pytest.fixture(scope="module")
def found(rope: Recording) -> Diagnosis:
    """Air drag, or wind."""
    return fake_diagnosis(rope, data_issues=[DataIssue("train_1", "swap", "markers 3 and 4 are swapped")])


def test_the_sentence_has_number_range_gap_and_doubt(rope: Recording, found: Diagnosis) -> None:
    result = replace(
        found, before=np.array([5e-3, 5e-3]), after=np.array([1e-3, 1e-3]), floor=ErrorFloor(6e-4, 0.0, 8e-4)
    )
    said = summary(result, rope)
    assert said.startswith("Missing: air drag (c_d 1.4 [")
    # (25 - 1) / (25 - 0.36) = 97.4 %.
    assert "not to be told from wind. Gap on trials that were not used: 5.0 → 1.0 mm (floor 1.0 mm), 97% of" in said
    assert said.endswith("Confidence: moderate (wind would do as well).")


def test_trials_that_a_simulation_fails_on_are_left_out_and_said(rope: Recording, found: Diagnosis) -> None:
    failed = replace(found, before=np.array([5e-3, np.inf]), after=np.array([1e-3, 3e-3]))
    said = summary(failed, rope)
    assert "5.0 → 1.0 mm" in said and "Left out are 1 of 2 such trials, which a simulation fails on." in said
    gap = findings(failed, rope)["gap"]
    assert (gap["test_rmse_before_m"], gap["test_rmse_after_m"]) == (5e-3, 1e-3)
    unknown = replace(failed, verdict="unknown", effects=[], ties={}, final=found.baseline)
    assert "Left out are 1 of 2" in summary(unknown, rope)
    assert "Left out" not in summary(found, rope)
    nothing = replace(found, before=np.full(2, np.inf), after=np.full(2, np.inf))
    assert np.isinf(nothing.gaps).all()


@pytest.mark.parametrize(("verdict", "start"), [("none", "Nothing is missing"), ("unknown", "Something is missing")])
def test_other_verdicts_compare_the_gap_with_the_floor(
    rope: Recording, found: Diagnosis, verdict: str, start: str
) -> None:
    none = replace(found, verdict=verdict, effects=[], ties={}, final=found.baseline, before=np.array([4e-3, 4e-3]))
    said = summary(replace(none, floor=ErrorFloor(1e-3, 0.0, 0.0)), rope)
    assert said.startswith(start) and "4.0 mm" in said and "1.0 mm" in said
    assert confidence(none) is None
    partial = replace(found, verdict="partial")
    assert "A part remains that no effect of the library explains" in summary(partial, rope)


def test_confidence_falls_with_every_doubt(found: Diagnosis) -> None:
    sure = replace(found, ties={"air_drag": []})
    assert confidence(sure) == {"word": "high", "doubts": []}
    worse = replace(sure, after=np.array([found.before[0] * 2, found.after[1]]))
    assert confidence(worse) == {"word": "moderate", "doubts": ["1 of 2 test trials did not get better"]}
    both = replace(worse, ties={"air_drag": ["wind", "tilted_gravity"]})
    assert confidence(both)["word"] == "low" and "tilted gravity or wind would do as well" in confidence(both)["doubts"]
    off = replace(sure, final=fitted(BASELINE | {"air_drag.c_d": 1e-4}, ("air_drag",)))
    assert "air drag has a range that holds the value at which it does nothing" in confidence(off)["doubts"]
    few = replace(sure, final=fitted(BASELINE | {"air_drag.c_d": 1.4}, ("air_drag",), trials=2))
    assert "there are fewer than three train trials" in confidence(few)["doubts"]


def test_what_calibration_had_absorbed_is_a_ratio(found: Diagnosis) -> None:
    rows = {r["name"]: r for r in absorbed(found)}
    assert set(rows) == set(BASELINE)
    # 0.8 alone, 0.5 with drag.
    assert rows["damping_rate"]["change"] == pytest.approx(0.6) and rows["bending_stiffness"][
        "change"
    ] == pytest.approx(0)


def test_findings_are_json_with_all_that_the_page_says(rope: Recording, found: Diagnosis) -> None:
    plain = json.loads(findings_json(found, rope))
    effect = plain["effects"][0]
    assert set(effect["parameters"]["c_d"]) == {"value", "low", "high", "unit"}
    assert effect["indistinguishable_from"] == ["wind"] and effect["separating_experiments"]["wind"].startswith(
        "repeat"
    )
    assert plain["data_issues"] == [{"trial": "train_1", "kind": "swap", "message": "markers 3 and 4 are swapped"}]
    assert set(plain["gap"]) >= {"test_rmse_before_m", "test_rmse_after_m", "noise_floor_m", "per_trial"}
    assert any("10 ms behind" in s for s in plain["localisation"]["before"])
    assert plain["model"] == "model.json" and plain["verdict"] == "effects" and len(plain["recording_sha256"]) == 64
    assert [c["name"] for c in plain["candidates"]][:2] == ["air_drag", "wind"]


def test_every_effect_has_a_law_with_its_numbers() -> None:
    for name in effect_library.library():
        law = EFFECTS[name].equation
        assert EFFECTS[name].kind in MEANING
        # What is fitted is in the formula by its name, or is said in it in words.
        numbers = {n for n in EFFECTS[name].params if n not in effect_library.spec(name).fixed}
        spoken = {"velocity": "velocity", "curvature": "κ̄", "offset": "offset", "c": "c κ³", "modes": "modesₖ"}
        assert all(spoken.get(n, n) in law for n in numbers), (name, numbers)


def test_experiments_do_not_depend_on_the_order() -> None:
    assert (
        separating_experiment("wind", "tilted_gravity")
        == separating_experiment("tilted_gravity", "wind")
        != separating_experiment("wind", "stretch")
    )


def test_the_page_on_diagnoses_has_the_library_with_its_laws() -> None:
    page = Path(__file__).parents[2] / "docs" / "diagnose.md"
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*?) \| `", page.read_text(), re.MULTILINE))
    assert rows == {name: EFFECTS[name].equation.replace("|", "\\|") for name in effect_library.library()}
