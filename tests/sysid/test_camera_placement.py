"""Where a camera is put: what it is blind to is worth nothing, and nuisances take their share."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.test_cli import run
from torchdlo.errors import InputError
from torchdlo.physics.effects.base import Param
from torchdlo.report.pages.camera_page import FILES, write_placement
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace
from torchdlo.sysid.estimation.observation import INDEPENDENT, SURE
from torchdlo.sysid.experiment_design.excitation_motions import ExcitationMotion
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video import camera_placement, second_view
from torchdlo.sysid.video.camera_placement import CameraDesign, CameraPlacement, place_cameras
from torchdlo.sysid.video.view_information import MotionVariations, camera_information, camera_places, told
from torchdlo.vision.camera import Camera, lens, looking_at, project

DATA = Path(__file__).parents[2] / "torchdlo" / "data"
STEP = 0.02


def waving(size: float) -> np.ndarray:
    """A hanging rope, and how it waves along x when its parameter changes; shape (2, T, M, 3)."""
    time, place = np.arange(101) * STEP, np.linspace(0, 1, 21)
    rope = np.zeros((2, len(time), len(place), 3))
    rope[..., 2] = -0.4 * place
    rope[1, :, :, 0] = size * np.sin(7 * time)[:, None] * np.sin(3 * np.pi * place)
    return rope


def motion_of(sims: np.ndarray, nudge: float) -> MotionVariations:
    """Return a motion and what a change of its one number by `nudge` changes."""
    space = ParameterSpace(("bending_stiffness",), (Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, ""),))
    nothing = np.zeros((0, 1, *sims.shape[1:]))
    change = (sims[1:] - sims[:1])[:, None] / nudge
    return MotionVariations(sims[:1], change, space, STEP, np.ones(sims.shape[2], bool), nothing, starts=nothing)


def precision(camera: Camera, motion: MotionVariations) -> float:
    """Return what films by a camera tell of the number, without what was known before."""
    return told([camera_information(camera, motion)], motion).deviations["bending_stiffness"] ** -2 - np.log(10) ** -2


def test_information_is_what_is_seen_across_the_rope() -> None:
    size, nudge = 1e-3, 0.02
    motion = motion_of(waving(size), nudge)
    front, side = (looking_at("a", eye, [0.0, 0.0, -0.2]) for eye in ([0.0, -1.0, -0.2], [1.0, 0.0, -0.2]))
    seen, blind = (precision(c, motion) for c in (front, side))
    frames, scale = 61, 1.0 / 600.0
    expected = frames * INDEPENDENT * (size / nudge) ** 2 / (SURE**2 + (0.15 * scale) ** 2) / 4
    assert 0.8 < seen / expected < 1.02  # a wave is hardly what a camera's pose can explain
    assert blind < 1e-3 * seen
    both = told([camera_information(c, motion) for c in (front, front)], motion).deviations["bending_stiffness"] ** -2
    assert both == pytest.approx(2 * seen + np.log(10) ** -2, rel=1e-6)


def test_readings_outside_of_pictures_do_not_count_as_noise() -> None:
    motion = motion_of(waving(1e-3), 0.02)
    front, low = (looking_at("a", [0.0, -1.0, z], [0.0, 0.0, z]) for z in (-0.2, -0.6))
    whole, part = (camera_information(c, motion) for c in (front, low))
    assert whole.whole and whole.readings == pytest.approx(61 * INDEPENDENT)
    assert not part.whole and 0 < part.readings < 0.6 * whole.readings
    # Both are one metre away.
    assert told([part], motion).noise == pytest.approx(told([whole], motion).noise, rel=1e-3)
    assert told([whole, part], motion).noise == pytest.approx(told([whole], motion).noise, rel=1e-3)


def test_what_a_camera_may_be_off_tells_nothing() -> None:
    rope = waving(0.0)
    rope[1, ..., 0] += 1e-3
    motion = motion_of(rope, 0.02)
    front = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    # A shift of 10 mm of the camera is a standard deviation: 1 mm per 0.02 is known to no better than 0.2.
    assert precision(front, motion) < 1.05 / 0.2**2
    # Nor does what the start of the trial may be off.
    assert precision(front, motion_of(waving(1e-3), 0.02)) > 100.0
    wave = motion_of(waving(1e-3), 0.02)
    started = MotionVariations(
        wave.rope, wave.numbers, wave.space, STEP, wave.free, wave.doses, starts=0.02 * wave.numbers
    )
    assert precision(front, started) < 1.01 / 0.02**2


def test_places_see_all_of_a_motion_and_one_that_does_not_is_told() -> None:
    rope = waving(0.1)
    own = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    found = camera_places(own, rope[1].reshape(-1, 3), -0.25)
    assert len(found) == 20
    for camera, _ in found:
        pixel, depth = project(lens([camera]), lens([camera]).rotation.new_tensor(rope[1].reshape(1, -1, 3)))
        assert (depth > 0).all() and (pixel >= 0).all()
        assert (pixel[..., 0] <= camera.width - 1).all() and (pixel[..., 1] <= camera.height - 1).all()
        assert camera_information(camera, motion_of(rope, 0.02)).whole
    near = looking_at("a", [0.0, -0.2, -0.2], [0.0, 0.0, -0.2])
    assert not camera_information(near, motion_of(rope, 0.02)).whole
    away = looking_at("a", [0.0, -1.0, -0.2], [0.0, -2.0, -0.2])
    assert camera_information(away, motion_of(rope, 0.02)).weight == 0.0


@pytest.mark.parametrize("lost", [slice(1, 2), slice(2, 4), slice(1, 4)])
def test_a_named_effect_whose_simulation_fails_does_not_rank_a_motion_higher(lost: slice) -> None:
    recording = load_recording(DATA / "sample_rope")
    front = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    around = camera_placement._Surroundings(RopeModel(recording), (front,), front, ("wind", "air_drag"))
    wave = motion_of(waving(1e-3), 0.02)
    change = np.zeros((4, *wave.rope.shape))
    change[..., 0] = (1e-3 * np.sin(np.arange(101) * 0.3)[:, None] * np.sin(np.linspace(0, 9, 21)))[None, None]
    change *= np.array([1.0, 0.1, 0.2, 0.3])[:, None, None, None, None]
    probes = (("wind", {"x": 1.0}), ("wind", {"y": 1.0}), ("air_drag", {"x": 1.0}), ("air_drag", {"y": 1.0}))
    failed = change.copy()
    failed[lost, 0, 50:] = np.nan
    scores = []
    for doses in (change, failed):
        motion = replace(wave, doses=doses, probes=probes, _sampled={})
        scores.append(around.score(told([camera_information(front, motion)], motion)))
    assert np.isfinite(scores[0]) and scores[1] == np.inf


def test_the_page_says_how_much_of_the_recorded_motion_is_looked_at() -> None:
    said = f"the first {100 * second_view.HORIZON:.0f} % of at most {camera_placement._SECONDS:.0f} s of each"
    text = (Path(__file__).parents[2] / "docs" / "design_experiment.md").read_text(encoding="utf-8")
    assert said in " ".join(text.split()) and said in (camera_placement._recorded.__doc__ or "")


def test_a_picture_of_an_earlier_run_does_not_stay_beside_a_report_without_one(tmp_path: Path) -> None:
    recording = load_recording(DATA / "sample_rope")
    front = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    best = CameraPlacement(ExcitationMotion("swing"), "swings", (front,), "here", {"bending_stiffness": 0.1}, 0.1)
    design = CameraDesign(recording, {}, [best], [], None, recording.train[0], 1.0, 0.0)
    (tmp_path / "design.png").write_bytes(b"earlier")
    for _ in range(2):
        write_placement(design, tmp_path)
        assert {p.name for p in tmp_path.iterdir()} == set(FILES) - {"design.png"}


def test_a_motion_in_which_the_named_effect_could_not_be_simulated_is_not_recommended() -> None:
    recording = load_recording(DATA / "sample_rope")
    front = looking_at("a", [0.0, -1.0, -0.2], [0.0, 0.0, -0.2])
    said = []
    for score in (0.1, np.inf):
        best = CameraPlacement(ExcitationMotion("swing"), "swings", (front,), "here", {"bending_stiffness": 0.1}, score)
        design = CameraDesign(recording, {}, [best], [], None, recording.train[0], 1.0, 0.0, effects=("air_drag",))
        said.append(camera_placement.camera_summary(design))
    assert "film it from here: air drag shows best" in said[0]
    assert "air drag failed in all" in said[1] and "Move" not in said[1]


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
    dropped = (["--seed", "0"], ["--vertices", "11"], ["--workers", "1"])
    for more in (["--findings", "here"], ["--tip-mass", "0.01"], ["--resume"], *dropped):
        assert run("design-experiment", str(DATA / "sample_film"), "--model", str(model), *more) == 2
        assert f"none of {more[0]} for films" in capsys.readouterr().err
    assert run("design-experiment", str(DATA / "sample_rope"), "--model", str(model), "--effects", "wind") == 2
    assert "for films only" in capsys.readouterr().err
    for unknown in ("winds", "table_friction"):
        assert run("design-experiment", str(DATA / "sample_film"), "--model", str(model), "--effects", unknown) == 2
        assert unknown in capsys.readouterr().err
    with pytest.raises(InputError, match="seconds: expected 1 to 60"):
        place_cameras(load_recording(DATA / "sample_film"), model_file.load(model), seconds=0.5)


@pytest.mark.slow
def test_a_place_and_a_motion_are_proposed(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "design"
    options = ["--model", str(model), "--seconds", "1", "--out", str(out)]
    assert run("design-experiment", str(DATA / "sample_film"), *options) == 0
    found = json.loads((out / "design.json").read_text())
    scores = [p["score"] for p in found["placements"]]
    assert scores == sorted(scores) and found["with_one_more"][0]["score"] < found["as_it_stands"]["score"]
    assert (out / "design.png").stat().st_size > 1e4
    places = found["recorded_motion"]["places"]
    regrets = [p["times_the_best_limit"] for p in places]
    assert regrets == sorted(regrets, key=lambda r: round(float(np.log(r)), 2)) and min(regrets) >= 1.0
    assert found["recorded_motion"]["cameras_at_hand"] == ["a"] and found["recorded_notes"]
    assert "The recorded motion" in capsys.readouterr().out
    assert set(found["placements"][0]["standard_deviations"]) == {
        "bending_stiffness",
        "twisting_stiffness",
        "damping_rate",
    }
    with np.load(out / "motion.npz") as motion:
        assert motion["gripped"].all() and np.isfinite(motion["markers"]).all()


@pytest.mark.slow
def test_a_first_camera_is_placed_for_markers(model: Path, tmp_path: Path) -> None:
    out = tmp_path / "design"
    options = ["--model", str(model), "--seconds", "1", "--out", str(out), "--camera", "nominal", "--effects", "wind"]
    assert run("design-experiment", str(DATA / "sample_rope"), *options) == 0
    found = json.loads((out / "design.json").read_text())
    assert found["effects"] == ["wind"] and found["as_it_stands"] is None
    assert found["recorded_motion"]["now"] is None and found["recorded_motion"]["ranked_by"] == ["wind"]
    assert set(found["recorded_motion"]["places"][0]["detection_limits"]) == {"wind"}
