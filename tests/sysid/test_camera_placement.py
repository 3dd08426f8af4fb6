"""Where a camera is put: what it is blind to is worth nothing, and nuisances take their share."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.test_cli import run
from torchdlo.errors import InputError
from torchdlo.sysid.estimation.observation import INDEPENDENT, SURE
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.camera_placement import camera_places, information, place_cameras
from torchdlo.vision.camera import lens, looking_at, project

DATA = Path(__file__).parents[2] / "torchdlo" / "data"
STEP = 0.02


def waving(size: float) -> np.ndarray:
    """A hanging rope, and how it waves along x when its parameter changes; shape (2, T, M, 3)."""
    time, place = np.arange(101) * STEP, np.linspace(0, 1, 21)
    rope = np.zeros((2, len(time), len(place), 3))
    rope[..., 2] = -0.4 * place
    rope[1, :, :, 0] = size * np.sin(7 * time)[:, None] * np.sin(3 * np.pi * place)
    return rope


def test_information_is_what_is_seen_across_the_rope() -> None:
    size, nudge, free = 1e-3, 0.02, np.ones(21, bool)
    front, side = (looking_at("a", eye, [0.0, 0.0, -0.2]) for eye in ([0.0, -1.0, -0.2], [1.0, 0.0, -0.2]))
    seen, blind = (information(c, waving(size), np.array([nudge]), STEP, free)[0, 0] for c in (front, side))
    frames, scale = 61, 1.0 / 600.0
    expected = frames * INDEPENDENT * (size / nudge) ** 2 / (SURE**2 + (0.15 * scale) ** 2) / 4
    assert 0.8 < seen / expected < 1.02  # a wave is hardly what a camera's pose can explain
    assert blind < 1e-3 * seen


def test_what_a_camera_may_be_off_tells_nothing() -> None:
    rope = waving(0.0)
    rope[1, ..., 0] += 1e-3
    front = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    shifted = information(front, rope, np.array([0.02]), STEP, np.ones(21, bool))[0, 0]
    # A shift of 10 mm of the camera is a standard deviation: 1 mm per 0.02 is known to no better than 0.2.
    assert shifted < 1.05 / 0.2**2


def test_places_see_all_of_a_motion_and_a_camera_that_does_not_is_left_out() -> None:
    rope = waving(0.1)
    own = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    found = camera_places(own, rope[1].reshape(-1, 3), -0.25)
    assert len(found) == 16
    for camera, _ in found:
        pixel, depth = project(lens([camera]), lens([camera]).rotation.new_tensor(rope[1].reshape(1, -1, 3)))
        assert (depth > 0).all() and (pixel >= 0).all()
        assert (pixel[..., 0] <= camera.width - 1).all() and (pixel[..., 1] <= camera.height - 1).all()
    near = looking_at("a", [0.0, -0.2, -0.2], [0.0, 0.0, -0.2])
    assert information(near, rope, np.array([0.02]), STEP, np.ones(21, bool)) is None


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A model of the filmed sample rope."""
    recording = load_recording(DATA / "sample_film")
    built = RopeModel(recording, vertices=21, numerical_damping=0.05, clamp_fraction=1.0)
    path = tmp_path / "model.json"
    path.write_text(
        json.dumps(model_file.content(built, np.array([3e-3, 2e-3, 0.5])), default=lambda x: np.asarray(x).tolist())
    )
    return path


def test_films_have_options_of_their_own(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more in (["--effects", "wind,air_drag"], ["--tip-mass", "0.01"], ["--resume"]):
        assert run("design-experiment", str(DATA / "sample_film"), "--model", str(model), *more) == 2
        assert "for films" in capsys.readouterr().err
    assert run("design-experiment", str(DATA / "sample_rope"), "--model", str(model), "--effects", "wind") == 2
    assert "for films only" in capsys.readouterr().err
    with pytest.raises(InputError, match="seconds: expected 1 to 60"):
        place_cameras(load_recording(DATA / "sample_film"), model_file.load(model), seconds=0.5)


@pytest.mark.slow
def test_a_place_and_a_motion_are_proposed(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "design"
    options = ["--model", str(model), "--seconds", "1", "--out", str(out)]
    assert run("design-experiment", str(DATA / "sample_film"), *options) == 0
    found = json.loads((out / "design.json").read_text())
    scores = [p["score"] for p in found["placements"]]
    assert scores == sorted(scores) and found["with_one_more"][0]["score"] < found["as_it_stands"]["score"]
    assert set(found["placements"][0]["standard_deviations"]) == {
        "bending_stiffness",
        "twisting_stiffness",
        "damping_rate",
    }
    with np.load(out / "motion.npz") as motion:
        assert motion["gripped"].all() and np.isfinite(motion["markers"]).all()
