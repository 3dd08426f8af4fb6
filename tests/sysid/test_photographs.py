"""Photographs of ropes at rest: read, refused in a sentence, and what they tell of stiffness and natural curvature."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdlo.errors import InputError
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.diagnosis.effect_search import diagnose
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filmed_problem import start_of
from torchdlo.sysid.video.footage import views_of
from torchdlo.vision.camera import lens, looking_at, project, save_cameras
from torchdlo.vision.segment import Ranges, ranges_from, tidy
from torchdlo.vision.spine import along

LENGTH, HELD, APART = 0.84, 0.02, 0.3
BEND = 1.5e-3
CAMERA = looking_at("a", [0.0, -1.2, -0.17], [0.0, 0.0, -0.17], size=(320, 240), focal=430.0)


def drawn(line: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """A picture of a curve (V, 3) [m] by OpenCV."""
    import cv2

    pixel = project(lens([CAMERA]), torch.as_tensor(line[None]))[0][0].numpy()
    picture = np.full((240, 320, 3), 190, np.uint8)
    points = np.round(16 * pixel).astype(np.int32)[:, None]
    return cv2.polylines(picture, [points], False, color[::-1], 3, cv2.LINE_AA, 4)


def photographed(
    folder: Path, numbers: dict[str, float] | None = None, *, color: tuple[int, int, int] = (20, 150, 50)
) -> Path:
    """A rope that hangs between two level clamps, photographed once."""
    import cv2

    folder.mkdir()
    rope = {"length": LENGTH, "radius": 0.003, "mass": 0.025, "gravity": [0, 0, -9.81], "table_height": None}
    (folder / "rope.json").write_text(json.dumps(rope | {"marker_noise_std": None, "color": list(color)}))
    save_cameras([CAMERA], folder / "cameras.json")
    places = np.array([0.0, HELD, LENGTH - HELD, LENGTH])
    x = 0.5 * APART
    held = np.array([[-x - HELD, 0, 0], [-x, 0, 0], [x, 0, 0], [x + HELD, 0, 0]])
    np.savez(folder / "train_0.npz", time=[0.0], markers=held[None], marker_arclength=places, gripped=np.ones(4, bool))
    cv2.imwrite(str(folder / "train_0.a.png"), np.zeros((240, 320, 3), np.uint8))
    recording = load_recording(folder)
    values = {"bending_stiffness": BEND, "twisting_stiffness": BEND} | (numbers or {})
    effects = sorted({n.split(".")[0] for n in values if "." in n})
    model = RopeModel(recording, vertices=83, effects=effects, numerical_damping=0.05)
    row = [values.get(n, g) for n, g in zip(model.parameters, model.guess(), strict=True)]
    trials = recording.train
    line = model.simulate(model.motion(trials), start_of(model, trials, ()), np.array([row]), frames=1)[0, 0, 0]
    cv2.imwrite(str(folder / "train_0.a.png"), drawn(line, color))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photograph of a straight elastic rope; read only."""
    return photographed(tmp_path_factory.mktemp("photographs") / "rope")


def test_a_photograph_is_a_rope_at_rest_of_which_stretches_are_left_out(made: Path) -> None:
    recording = load_recording(made)
    assert recording.still and recording.filmed and len(recording.train[0].time) > 1
    assert [t.name for t in recording.test] == ["train_0_left_out"]
    (train, notes), (test, _) = (views_of(recording, trials) for trials in (recording.train, recording.test))
    seen = [np.isfinite(v[0].places[0, 0]).all(1) for v in (train, test)]
    assert not (seen[0] & seen[1]).any() and 60 < seen[0].sum() < 130 and 60 < seen[1].sum() < 130 and not notes
    assert start_of(RopeModel(recording, vertices=41), recording.train, train).at_rest.all()


def test_a_centre_line_is_ordered_from_where_it_begins() -> None:
    angle = np.random.default_rng(0).permutation(np.linspace(0.2, 6.0, 90))
    circle = 40 * np.stack([np.cos(angle), np.sin(angle)], 1)
    far = along(circle, np.array([45.0, 10.0]))
    assert np.allclose(far, 40 * (angle - 0.2), atol=0.5)


def test_rectangles_are_left_out_of_masks() -> None:
    mask = np.ones((40, 60), bool)
    left = tidy(mask, ranges_from({"ignore": [[0.5, 0.0, 1.0, 0.25]]}, "segment.json"))
    assert not left[:10, 30:].any() and left[10:].all() and left[:, :30].all() and Ranges().ignore == ()
    for wrong in ([[0.5, 0.0, 0.2, 1.0]], [[0, 0, 1]], 3, [[0, 0, 1, 2]]):
        with pytest.raises(InputError, match="ignore: expected"):
            ranges_from({"ignore": wrong}, "segment.json")


def _many_frames(folder: Path) -> None:
    with np.load(folder / "train_0.npz") as old:
        new = dict(old) | {"time": 0.01 * np.arange(4), "markers": np.repeat(old["markers"], 4, 0)}
    np.savez(folder / "train_0.npz", **new)


def _broken(folder: Path) -> None:
    (folder / "train_0.a.png").write_bytes(b"no picture")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [(_many_frames, "expected one frame in train_0.npz beside a photograph"), (_broken, "expected a picture")],
)
def test_what_is_no_photograph_of_a_rope_at_rest_is_refused(made: Path, tmp_path: Path, spoil, message: str) -> None:
    import shutil

    folder = Path(shutil.copytree(made, tmp_path / "rope"))
    spoil(folder)
    with pytest.raises(InputError, match=message):
        recording = load_recording(folder)
        views_of(recording, recording.train)


def test_white_on_white_is_refused_in_a_sentence(tmp_path: Path) -> None:
    folder = photographed(tmp_path / "rope", color=(194, 192, 188))
    recording = load_recording(folder)
    with pytest.raises(InputError, match="stands out from grey surroundings"):
        views_of(recording, recording.train)
    # Nor do ranges that a person sets tell it from the sheet.
    (folder / "segment.json").write_text(json.dumps({"value": [0.7, 1.0]}))
    with pytest.raises(InputError, match="the background has the rope's colour"):
        views_of(recording, recording.train)


@pytest.mark.slow
def test_a_photograph_tells_the_bending_stiffness(made: Path) -> None:
    found = calibrate(load_recording(made), starts=8, vertices=41)
    stiffness = found.parameters["bending_stiffness"]
    assert "damping_rate" not in found.parameters
    assert stiffness["low"] < BEND < stiffness["high"] < 2 * stiffness["low"]
    assert abs(stiffness["value"] / BEND - 1) < 0.1
    assert found.test_mae_mm < 1.0


@pytest.mark.slow
def test_natural_curvature_is_named(tmp_path: Path) -> None:
    folder = photographed(
        tmp_path / "rope", {"varying_rest_curvature.modes.0": 1.0, "varying_rest_curvature.modes.1": 4.0}
    )
    found = diagnose(load_recording(folder), vertices=41)
    assert found.effects and "rest_curvature" in found.effects[0]
    assert "nonuniform_stiffness" in found.ties[found.effects[0]]
    assert found.gaps[1] < 0.4 * found.gaps[0]
