"""Which second camera shows what films at hand cannot: cases in which it is known where it has to stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.sysid.test_filmed_beginnings import gripped
from torchdlo.physics.effects.base import Param
from torchdlo.report.pages.camera_page import places_png, places_table
from torchdlo.sysid.estimation.levenberg_marquardt import KNEE, ParameterSpace
from torchdlo.sysid.estimation.observation import INDEPENDENT, SURE, FilmView
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording, load_recording
from torchdlo.sysid.video import second_view as second_views
from torchdlo.sysid.video.filmed_fit import look
from torchdlo.sysid.video.filmed_problem import FilmedProblem, filmed_problem, start_of
from torchdlo.sysid.video.second_view import (
    SecondView,
    added_rows,
    effect_notes,
    number_notes,
    rank_places,
    second_view_json,
    visible,
)
from torchdlo.sysid.video.view_information import MotionVariations, SimulatedTrials, doses_of, varied
from torchdlo.vision.camera import Camera, lens, looking_at, project

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"
STEP = 0.02
SPACE = ParameterSpace(("bending_stiffness",), (Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, ""),))


def swinging(recording: Recording, doses: dict[str, int]) -> MotionVariations:
    """Return a hanging rope that swings in the plane of x and z, with effects that move it along an axis each."""
    time, place = np.arange(101) * STEP, np.linspace(0, 1, 21)
    rope = np.zeros((1, len(time), len(place), 3))
    rope[..., 0] = 0.1 * np.sin(5 * time)[:, None] * place
    rope[..., 2] = -0.4 * place
    wave = np.sin(7 * time)[:, None] * np.sin(3 * np.pi * place)
    changes = np.zeros((len(doses), *rope.shape))
    for k, axis in enumerate(doses.values()):
        changes[k, 0, :, :, axis] = 2e-3 * wave
    number = np.zeros((1, *rope.shape))
    number[0, 0, :, :, 0] = 5e-3 * np.cos(5 * time)[:, None] * np.sin(2 * np.pi * place)
    probes = tuple((name.split(".")[0], {name: 1.0}) for name in doses)
    return MotionVariations(rope, number, SPACE, STEP, np.ones(21, bool), changes, probes, np.zeros((0, *rope.shape)))


def towards(camera: Camera) -> np.ndarray:
    """Return the direction in which a camera looks."""
    return np.array(camera.rotation)[2]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return load_recording(SAMPLE)


def placed(recording: Recording, motion: MotionVariations, eye: list[float], **options: object) -> SecondView:
    own = looking_at("a", eye, [0.0, 0.0, -0.2])
    found = rank_places(recording, motion, [own], own, **options)  # type: ignore[arg-type]
    assert found is not None
    return found


def test_edge_on_the_second_camera_looks_along_the_normal_of_the_plane(recording: Recording) -> None:
    motion = swinging(recording, {"wind.velocity.0": 0})
    view = placed(recording, motion, [1.0, 0.0, -0.2])
    assert view.effects == ("wind",) and view.best.worst == "wind"
    assert view.best.regret == pytest.approx(1.0)
    assert abs(towards(view.best.camera)[1]) > 0.8 and abs(towards(view.best.camera)[0]) < 1e-9
    # One more edge-on is worth nothing, from the side or from above.
    edge_on = [abs(towards(p.camera)[1]) < 1e-9 for p in view.places]
    assert edge_on == sorted(edge_on) and sum(edge_on) == 6 and view.places[-1].regret > 10
    (note, *_) = effect_notes(view)
    assert note.startswith("Where they show least, these films cannot test wind: one more camera, ")
    assert view.best.where in note and f"wind from {view.best.limits['wind'].hardest:.2g} m/s" in note
    # A change of 2 mm, half of it at the mean square of either sine, in one of two cameras; hardly a pose explains it.
    shown = view.best.told.probes[0][2]
    assert 0.8 < shown / (2e-3 / 2 / np.sqrt(2)) < 1.05
    # The force of wind grows with its square.
    assert view.best.limits["wind"].hardest == pytest.approx((view.level / shown) ** 0.5)


def test_out_of_the_plane_the_second_camera_looks_along_the_plane(recording: Recording) -> None:
    motion = swinging(recording, {"wind.velocity.0": 0, "wind.velocity.1": 1})
    view = placed(recording, motion, [0.0, -1.0, -0.2])
    assert abs(towards(view.best.camera)[0]) > 0.8
    (note, *_) = effect_notes(view)
    sizes = (f"{each['wind'].hardest:.2g} m/s" for each in (view.best.limits, view.limits))
    assert note.startswith(f"One more camera, {view.best.where}, would lower")
    assert note.endswith("wind from {} instead of from {}.".format(*sizes))
    # With a camera on either side, no third one adds much.
    two = rank_places(recording, motion, [*view.cameras, view.best.camera], view.cameras[0])
    assert two is not None and effect_notes(two)[0].startswith("No second camera would halve")


def test_what_shows_from_nowhere_decides_nothing(recording: Recording) -> None:
    motion = swinging(recording, {"wind.velocity.0": 0, "air_drag.c_d": 1})
    hidden = replace(motion, doses=motion.doses * np.array([1.0, 0.0])[:, None, None, None, None])
    view = placed(recording, hidden, [1.0, 0.0, -0.2])
    assert view.effects == ("wind",)
    assert any(note == "From no place would this motion show air drag." for note in effect_notes(view))
    assert placed(recording, motion, [1.0, 0.0, -0.2], named=["air_drag"]).effects == ("air_drag",)


def test_doses_and_trials_whose_simulation_fails_tell_nothing(recording: Recording) -> None:
    motion = swinging(recording, {"wind.velocity.0": 0, "air_drag.c_d": 0})
    doses = motion.doses.copy()
    doses[1, 0, 50:] = np.nan
    whole, some = (
        placed(recording, m, [0.0, -1.0, -0.2]).now for m in (motion, replace(motion, doses=doses, _sampled={}))
    )
    assert whole is not None and some is not None and np.isnan(some.probes[1][2])
    assert some.probes[0][2] == pytest.approx(whole.probes[0][2]) and some.deviations == whole.deviations
    assert set(some.limits(1e-3, recording)) == {"wind"}
    two = replace(
        motion, **{n: np.repeat(getattr(motion, n), 2, -4) for n in ("rope", "numbers", "doses")}, frames=(101, 51)
    )
    two.rope[0, 70] = np.nan
    assert two.sound.tolist() == [False, True]
    kept = two.picked(np.flatnonzero(two.sound))
    assert kept.rope.shape[:2] == (1, 51) and kept.doses.shape[:3] == (2, 1, 51) and kept.frames == (51,)


def test_numbers_of_the_rope_are_told_better_from_where_they_show(recording: Recording) -> None:
    view = placed(recording, swinging(recording, {}), [1.0, 0.0, -0.2])
    assert view.effects == () and abs(towards(view.best.camera)[1]) > 0.8
    scores = [p.told.score for p in view.places]
    assert scores == sorted(scores)
    (note,) = number_notes(view)
    assert note.startswith(
        f"One more camera, {view.best.where}, would narrow ranges: that of the bending stiffness from"
    )
    lost = replace(swinging(recording, {}), numbers=np.zeros((1, 1, 101, 21, 3)))
    assert number_notes(placed(recording, lost, [1.0, 0.0, -0.2])) == [
        "From no place would these motions tell the bending stiffness: another motion may."
    ]


def test_what_no_place_would_tell_is_looked_for_in_all_places(recording: Recording) -> None:
    motion = swinging(recording, {"wind.velocity.0": 0})
    view = placed(recording, motion, [1.0, 0.0, -0.2])
    # The best place is told first; here it is one that shows nothing.
    turned = replace(view, places=(view.places[-1], *view.places[:-1]))
    assert turned.best.told.deviations["bending_stiffness"] > 0.42
    assert not any("From no place" in note for note in number_notes(turned))
    (note,) = effect_notes(turned)
    assert note.startswith("The best place of one more camera would not halve") and view.best.where in note
    alone = replace(view, places=view.places[-1:])
    assert effect_notes(alone)[0].startswith("No second camera would halve")
    assert number_notes(alone)[-1].startswith("From no place would these motions tell")


def test_a_view_is_shown_in_tables_a_picture_and_json(recording: Recording) -> None:
    view = placed(recording, swinging(recording, {"wind.velocity.0": 0}), [1.0, 0.0, -0.2])
    assert places_table(view).splitlines()[1].startswith(view.best.where)
    heads, rows = added_rows(view)
    assert len(heads) == len(rows[0]) and rows[0][:3] == ("wind", "velocity", "cannot be seen")
    assert places_png(view)[:4] == b"\x89PNG"
    content = second_view_json(view)
    eye = np.array(content["places"][0]["position"])
    assert np.abs(np.array(view.best.camera.rotation) @ eye + np.array(view.best.camera.translation)).max() < 1e-9
    assert content["now"]["detection_limits"]["wind"]["hardest"] is None


def problem_of(recording: Recording, cameras: list[Camera]) -> FilmedProblem:
    """Return the problem of films from rest without any error."""
    options = {"vertices": 21, "numerical_damping": 0.05}
    model = RopeModel(recording, **options)
    begun = start_of(model, recording.train, ())
    start = replace(begun, vel=0 * begun.vel, still=np.ones(len(recording.train), bool))
    every = model.simulate(model.motion(recording.train), start, model.guess()[None])[0][:, ::2]
    views = []
    for name, camera in zip("ab", cameras, strict=False):
        camera = replace(camera, fps=50.0, name=name)
        pixel, _ = project(lens([camera]), torch.as_tensor(every.reshape(1, -1, 3)))
        places = pixel.numpy().reshape(*every.shape[:3], 2)
        tangents = np.gradient(places, axis=2)
        tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
        views.append(FilmView(camera, np.ones(places.shape[:2], bool), places, tangents, 3.0))
    own = filmed_problem(recording, recording.train, views, options=options)
    own.start, own.offset = start, np.zeros((len(recording.train), 0))
    return own


def test_what_is_expected_of_films_is_what_fits_to_them_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Expectations are lengths across the rope; fits read centre lines of masks, both ways: an independent path."""
    monkeypatch.setattr(second_views, "HORIZON", 1.0)
    recording = gripped(0.6, 1)
    front = looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0)
    own = problem_of(recording, [front])
    raw = own.space.to_raw(np.concatenate([own.fixed, np.zeros(8)]))
    view = second_views.second_view(own, raw)
    assert view is not None and view.now is not None
    for cameras, expected in (([front], view.now), ([front, view.best.camera], view.best.told)):
        here = problem_of(recording, cameras)
        at = here.space.to_raw(np.concatenate([here.fixed, np.zeros(8 * len(cameras))]))
        _, curvature = look(here, at, here.offset).normal(here.prior)
        pictures = sum(float(v.good.sum()) for v in here.spines.views)
        information = curvature.mean(0) * KNEE / SURE**2 * INDEPENDENT * pictures
        deviations = np.sqrt(np.diag(np.linalg.inv(information)))
        for k, said in enumerate(expected.deviations.values()):
            assert 0.75 < said / deviations[k] < 1.4


def test_natural_curvature_out_of_the_plane_of_a_loop_is_seen_along_the_plane(recording: Recording) -> None:
    # A rope that hangs at rest in a plane, almost, between clamps that stay where they are.
    model = RopeModel(recording, vertices=21, numerical_damping=0.05)
    trial = recording.train[0]
    markers = np.repeat(trial.markers[:1, :], 12, 0)
    turn = None if trial.gripper_quaternion is None else np.repeat(trial.gripper_quaternion[:1], 12, 0)
    parts = {"time": trial.time[:12], "markers": markers, "suspect": trial.suspect[:12], "gripper_quaternion": turn}
    held = replace(trial, **parts)
    numbers = dict(zip(model.parameters, model.guess(), strict=True))
    motion = model.motion([held])
    options = {"vertices": 21, "numerical_damping": 0.05}
    run = SimulatedTrials(recording, (), options, numbers, motion, start_of(model, [held], ()), 12)
    found = doses_of(run, varied(run, {"bending_stiffness": 1.0}), ["rest_curvature"], lambda *_: None)
    shape = found.rope[0, 0] - found.rope[0, 0].mean(0)
    _, sizes, axes = np.linalg.svd(shape)
    normal = axes[2]
    assert sizes[2] < 0.15 * sizes[1] and abs(normal[2]) < 0.35
    out, within = np.abs(found.doses @ normal).max((1, 2, 3)), np.abs(found.doses @ axes[:2].T).max((1, 2, 3, 4))
    assert (out > 3 * within).any()
    middle = found.rope.reshape(-1, 3).mean(0)
    front = looking_at("a", (middle - 1.2 * normal).tolist(), middle.tolist())
    view = rank_places(recording, found, [front], front)
    assert view is not None and abs(towards(view.best.camera) @ normal) < 0.5
    assert abs(towards(view.places[-1].camera) @ normal) > 0.8
    assert "rest_curvature" in visible(recording, model, ()) and "time_delay" not in visible(recording, model, ())
