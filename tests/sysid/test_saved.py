"""A model file gives the same model back, starts other commands, and is refused in one sentence when it is not one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.estimation import evaluation
from torchdlo.sysid.estimation.result import result_json
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording, load_recording

EFFECTS = ("wind", "point_mass", "stretch")


@pytest.fixture
def recording(folder: Path) -> Recording:
    """A small recording."""
    return load_recording(folder)


def numbers(model: RopeModel) -> np.ndarray:
    """Numbers off their defaults."""
    values = dict(zip(model.parameters, model.guess(), strict=True))
    values |= {"wind.velocity.1": 1.5, "wind.c_d": 1.1, "point_mass.position": 0.4, "point_mass.mass": 0.004}
    return np.array([values[n] for n in model.parameters])


def write(path: Path, model: RopeModel, values: np.ndarray) -> Path:
    """Write a model file as commands do."""
    path.write_text(result_json({"generator": "torchdlo diagnose"} | model_file.content(model, values)))
    return path


@pytest.mark.parametrize(("rest", "vertices"), [("straight", 15), ("given", 26)])
def test_a_model_comes_back_and_predicts_the_same(
    recording: Recording, tmp_path: Path, rest: str, vertices: int
) -> None:
    options = {"numerical_damping": 0.0, "clamp_fraction": 0.3, "substep": 4e-3}
    model = RopeModel(recording, vertices=vertices, rest=rest, effects=EFFECTS, **options)
    values = numbers(model)
    given = model_file.load(write(tmp_path / "model.json", model, values))
    again = given.model(recording)
    assert given.effects == EFFECTS and again.parameters == model.parameters and again.step == model.step
    assert (again.rest, again.numerical_damping, again.clamp_fraction) == (rest, 0.0, 0.3)
    np.testing.assert_array_equal(again.arclength, model.arclength)
    np.testing.assert_array_equal(given.start(again), values)
    a, b = (evaluation.predict(m, recording.test[:1], values)["test_0"] for m in (model, again))
    np.testing.assert_array_equal(a, b)


def test_a_file_of_version_2_is_read(recording: Recording, tmp_path: Path) -> None:
    options = {"numerical_damping": 0.0, "clamp_fraction": 0.3, "substep": 4e-3}
    model = RopeModel(recording, vertices=15, **options)
    path = write(tmp_path / "model.json", model, numbers(model))
    now = json.loads(path.read_text())
    then = now["options"] | {"ahead": now["options"]["numerical_damping"], "grip": now["options"]["clamp_fraction"]}
    del then["numerical_damping"], then["clamp_fraction"]
    (tmp_path / "old.json").write_text(json.dumps(now | {"version": 2, "options": then}))
    assert model_file.load(tmp_path / "old.json").options == model_file.load(path).options
    assert model_file.load(path).options["clamp_fraction"] == 0.3


def test_numbers_that_are_off_stay_off(recording: Recording, tmp_path: Path) -> None:
    model = RopeModel(recording, vertices=15, effects=EFFECTS)
    sizes = model_file.load(write(tmp_path / "model.json", model, numbers(model))).sizes(model)
    # The rope is inextensible; a place or a direction is fitted even where it is zero.
    assert set(sizes) == set(model.parameters) - {"stretch.EA"}
    assert sizes["wind.velocity.1"] == 1.5 and sizes["point_mass.mass"] == 0.004 and sizes["wind.velocity.0"] > 0


def test_calibration_goes_on_from_a_model_with_its_effects(recording: Recording, tmp_path: Path) -> None:
    model = RopeModel(recording, vertices=11, effects=("air_drag",))
    values = dict(zip(model.parameters, model.guess(), strict=True)) | {"air_drag.c_d": 1.0}
    path = write(tmp_path / "model.json", model, np.array([values[n] for n in model.parameters]))
    stages: list[str] = []
    result = calibrate(
        recording, given=model_file.load(path), iterations=1, callback=lambda stage, *_: stages.append(stage)
    )
    assert not any("starts" in stage for stage in stages)
    assert set(result.parameters) == {*values}
    assert "air drag" in " ".join(result.notes)
    (tmp_path / "next.json").write_text(result_json(result.model))
    again = model_file.load(tmp_path / "next.json")
    assert again.effects == ("air_drag",) and again.values == {k: v["value"] for k, v in result.parameters.items()}
    # What it started from is what the file says.
    trials = (*recording.train, *recording.test)
    before = evaluation.errors(
        recording,
        evaluation.predict(model_file.load(path).model(recording), trials, model_file.load(path).start(model)),
    )
    assert result.before == before and result.train_mae_mm <= before["train_mae_mm"] * (1 + 1e-9)
    with pytest.raises(InputError, match=r"rest is 'given'; expected auto or straight"):
        calibrate(recording, given=model_file.load(path), rest="given")


@pytest.fixture
def edit(recording: Recording, tmp_path: Path) -> Callable[..., Path]:
    """Write a model file with one change."""

    def change(do: Callable[[dict[str, Any]], Any]) -> Path:
        model = RopeModel(recording, vertices=11, effects=EFFECTS)
        path = write(tmp_path / "model.json", model, numbers(model))
        content = json.loads(path.read_text())
        do(content)
        path.write_text(json.dumps(content))
        return path

    return change


@pytest.mark.parametrize(
    ("do", "message"),
    [
        (lambda c: c.pop("format"), r"expected a model file .*; it is another result of torchdlo: give the model.json"),
        (lambda c: c.update(version=1), r"version: expected 3, found 1; write the model again"),
        (lambda c: c.pop("effects"), r"effects: expected an object, found none"),
        (lambda c: c.update(parameters=[1]), r"parameters: expected an object, found \[1\]"),
        (lambda c: c["parameters"].pop("damping_rate"), r"found no damping_rate"),
        (lambda c: c["parameters"].update(bending_stifness=1), r"unknown name bending_stifness; did you mean bending_"),
        (
            lambda c: c["parameters"].update(damping_rate=-1),
            r"parameters.damping_rate: expected a number from 0.01 to 20",
        ),
        (lambda c: c["parameters"].update(damping_rate=True), r"expected a number from 0.01 to 20, found True"),
        (lambda c: c["parameters"].update(damping_rate=None), r"expected a number from 0.01 to 20, found None"),
        (lambda c: c["effects"].update(air_drage={}), r"effects: unknown name air_drage; did you mean air_drag\?"),
        (lambda c: c["effects"].update(wind=3), r"effects.wind: expected an object with its numbers, found 3"),
        (lambda c: c["effects"]["wind"].update(speed=3), r"effects.wind: unknown name speed; known are velocity, c_d"),
        (
            lambda c: c["effects"]["wind"].update(velocity=3),
            r"expected velocity.0, velocity.1, velocity.2, found veloc",
        ),
        (lambda c: c["effects"]["wind"].update({"velocity.3": 3}), r"found velocity.3"),
        # A digit that is no decimal number.
        (lambda c: c["effects"]["wind"].update({"velocity.²": 3}), r"found velocity.²"),
        (
            lambda c: c["effects"]["wind"].update(c_d="high"),
            r"effects.wind.c_d: expected a number from -200 to 200, found 'high'",
        ),
        (lambda c: c["options"].update(rest="bent"), r"options.rest: expected straight or given, found 'bent'"),
        (lambda c: c["options"].update(substep=0), r"options.substep: expected a number from 1e-09 to 1, found 0"),
        (lambda c: c["options"].pop("clamp_fraction"), r"options.clamp_fraction: expected this entry, found none"),
        (lambda c: c["options"].update(clamp_fractions=1), r"did you mean clamp_fraction\?"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(edit: Callable[..., Path], do: Callable[..., Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        model_file.load(edit(do))


def test_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found none"):
        model_file.load(tmp_path / "model.json")
    with pytest.raises(InputError, match=r"found a folder; give the model.json in it"):
        model_file.load(tmp_path)
    for text in ("{", "[]", '"x"', "\x00"):
        (tmp_path / "model.json").write_text(text)
        with pytest.raises(InputError, match="expected a model file"):
            model_file.load(tmp_path / "model.json")


def test_a_model_that_cannot_act_in_a_recording_is_refused(
    recording: Recording, tmp_path: Path, edit: Callable[..., Path]
) -> None:
    path = edit(lambda c: c["effects"].update(table_friction={"mu": 0.3}))
    with pytest.raises(InputError, match="table_friction: expected a recording in which it can act"):
        model_file.load(path).model(recording)
