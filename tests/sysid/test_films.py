"""Folders with films: what belongs together is found, what does not is refused in a sentence, and trials get places."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.vision.scenes import front
from torchdlo.errors import InputError
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filming import film_recording
from torchdlo.sysid.video.footage import masks_of, views_of
from torchdlo.vision.camera import looking_at, save_cameras
from torchdlo.vision.film import FilmLook
from torchdlo.vision.segment import save_masks
from torchdlo.vision.video_file import read_video, write_video

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"


def view_of_sample(**others):
    """A camera in front of the sample rope."""
    return looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0, **others)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample recording, filmed for half a second; read only."""
    out = tmp_path_factory.mktemp("films") / "rope"
    film_recording(load_recording(SAMPLE), [view_of_sample()], out, FilmLook(noise=1.0), trials=1, seconds=0.5)
    return out


@pytest.fixture
def filmed(made: Path, tmp_path: Path) -> Path:
    """One of one's own."""
    import shutil

    return Path(shutil.copytree(made, tmp_path / "rope"))


def test_films_are_read_with_their_cameras_and_places(filmed: Path) -> None:
    recording = load_recording(filmed)
    trial = recording.train[0]
    assert recording.filmed and trial.films[0].camera.name == "a" and recording.color == (25, 150, 60)
    assert len(trial.marker_arclength) > 35 and (np.diff(trial.marker_arclength) > 0).all()
    assert trial.gripped.sum() == 4 and np.isfinite(trial.markers[:, trial.gripped]).all()
    assert np.isnan(trial.markers[:, ~trial.gripped]).all()
    assert trial.gripped[list(trial.gripper_marker)].all()
    views, notes = views_of(recording, recording.train)
    assert (
        views[0].camera.fps == 30.0 and views[0].good.all() and not notes and np.isfinite(views[0].places).mean() > 0.5
    )


def _cameras(filmed: Path) -> None:
    (filmed / "cameras.json").unlink()


def _two(filmed: Path) -> None:
    save_masks(np.zeros((15, 480, 640), bool), filmed / "train_0.a.npz")


def _another(filmed: Path) -> None:
    # A test film of another camera would be judged with pose, zoom and clock that were fitted to the first one's.
    save_cameras([view_of_sample(), replace(view_of_sample(), name="b")], filmed / "cameras.json")
    (filmed / "test_0.a.mp4").rename(filmed / "test_0.b.mp4")


def _fewer(filmed: Path) -> None:
    save_cameras([view_of_sample(), replace(view_of_sample(), name="b")], filmed / "cameras.json")
    save_masks(np.zeros((15, 480, 640), bool), filmed / "train_0.b.npz")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_another, "cameras a as train_0 has, found b"),
        (_fewer, "cameras a, b as train_0 has, found a"),
        (_cameras, "expected the file of the cameras"),
        (lambda f: (f / "train_0.a.mp4").rename(f / "train_0.b.mp4"), "name of a camera"),
        (lambda f: (f / "train_0.a.mp4").rename(f / "train_7.a.mp4"), "train_7.npz with the motion"),
        (lambda f: (f / "train_0.a.mp4").rename(f / "train_0.mp4"), "camera's name in the film's"),
        (lambda f: (f / "test_0.a.mp4").unlink(), "expected a film test_0.a.mp4"),
        (_two, "found two"),
    ],
)
def test_what_does_not_belong_together_is_refused(filmed: Path, spoil, message: str) -> None:
    spoil(filmed)
    with pytest.raises(InputError, match=message):
        load_recording(filmed)


def test_free_markers_beside_films_are_refused(filmed: Path) -> None:
    with np.load(SAMPLE / "train_0.npz") as archive:
        np.savez(filmed / "train_0.npz", **archive)
    with pytest.raises(InputError, match="grippers only"):
        load_recording(filmed)


def _masks(filmed: Path, masks: np.ndarray) -> None:
    (filmed / "train_0.a.mp4").unlink()
    save_masks(masks, filmed / "train_0.a.npz")


def _turned(filmed: Path, degrees: float) -> None:
    """Let the file say that the camera looks past the rope."""
    view, angle = view_of_sample(), np.radians(degrees)
    away = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turn, shift = away @ np.array(view.rotation), away @ np.array(view.translation)
    save_cameras([replace(view, rotation=tuple(map(tuple, turn)), translation=tuple(shift))], filmed / "cameras.json")


def _in_millimetres(filmed: Path) -> None:
    view = view_of_sample()
    far = tuple(1000.0 * x for x in view.translation)
    save_cameras([replace(view, translation=far)], filmed / "cameras.json")


def _twice(filmed: Path) -> None:
    recording = load_recording(filmed)
    masks = masks_of(recording, recording.train[0].films[0])[0]
    _masks(filmed, masks | np.roll(masks, 60, 1))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "train_0.a.mp4").write_bytes(b""), "empty file"),
        (_twice, "two ropes"),
        (lambda f: _turned(f, 12.0), "px from where camera a has a gripper; check rotation"),
        (_in_millimetres, "px from where camera a has a gripper; check rotation, translation .m."),
        (
            lambda f: save_cameras([looking_at("a", [0, -1, 1], [0, -2, 1], focal=650.0)], f / "cameras.json"),
            "behind it",
        ),
        (lambda f: _masks(f, np.zeros((15, 480, 640), bool)), "never visible"),
        (lambda f: _masks(f, np.zeros((15, 120, 160), bool)), "640 x 480"),
        (lambda f: _masks(f, np.ones((6, 480, 640), bool)), "about 15 pictures"),
        (lambda f: save_cameras([view_of_sample(fps=60.0)], f / "cameras.json"), "60 pictures per second"),
        (lambda f: save_cameras([view_of_sample(start=-9.0)], f / "cameras.json"), "check start"),
        (lambda f: save_cameras([front(size=(320, 240))], f / "cameras.json"), "320 x 240"),
        (lambda f: _color(f, None), "the rope's colour"),
        (lambda f: _color(f, [220, 220, 220]), "stands out"),
    ],
)
def test_films_that_cannot_be_used_are_refused(filmed: Path, spoil, message: str) -> None:
    spoil(filmed)
    recording = load_recording(filmed)
    with pytest.raises(InputError, match=message) as caught:
        views_of(recording, recording.train)
    assert str(caught.value).startswith(str(filmed)) and "\n" not in str(caught.value)


def test_a_camera_as_wrong_as_its_prior_is_taken_and_one_farther_off_is_doubted(filmed: Path) -> None:
    for degrees, doubted in ((1.0, False), (4.5, True)):
        _turned(filmed, degrees)
        recording = load_recording(filmed)
        notes = views_of(recording, recording.train)[1]
        assert any("has a gripper: check the camera" in note for note in notes) == doubted


def test_films_that_last_longer_or_less_than_their_trial_say_so(filmed: Path) -> None:
    pictures, fps = read_video(filmed / "train_0.a.mp4")
    write_video(filmed / "train_0.a.mp4", np.concatenate([pictures, pictures[-1:].repeat(9, 0)]), fps)
    recording = load_recording(filmed)
    assert any("25 pictures for 0.5 s, which have 16" in note for note in views_of(recording, recording.train)[1])
    write_video(filmed / "train_0.a.mp4", pictures[:11], fps)
    recording = load_recording(filmed)
    assert any("11 pictures for 0.5 s, which have 16" in note for note in views_of(recording, recording.train)[1])


def test_films_have_a_rate_of_their_own(filmed: Path) -> None:
    pictures, _ = read_video(filmed / "train_0.a.mp4")
    for name in ("train_0", "test_0"):
        write_video(filmed / f"{name}.a.mp4", pictures, 30000 / 1001)
    recording = load_recording(filmed)
    views, _ = views_of(recording, recording.train)
    assert recording.train[0].films[0].camera.fps == 30
    assert views[0].camera.fps == pytest.approx(29.97, rel=1e-5)
    write_video(filmed / "test_0.a.mp4", pictures.repeat(5, 0), 29.5)
    with pytest.raises(InputError, match="same settings"):
        views_of(recording, recording.train)


def test_pictures_before_the_trial_are_skipped(filmed: Path) -> None:
    recording = load_recording(filmed)
    view = views_of(recording, recording.train)[0][0]
    masks = masks_of(recording, recording.train[0].films[0])[0]
    _masks(filmed, np.concatenate([np.zeros((7, 480, 640), bool), masks]))
    save_masks(np.zeros((22, 480, 640), bool), filmed / "test_0.a.npz")
    (filmed / "test_0.a.mp4").unlink()
    save_cameras([view_of_sample(start=-0.23)], filmed / "cameras.json")
    recording = load_recording(filmed)
    views, notes = views_of(recording, recording.train)
    # The seventh picture, at -0.03 s, is the last one that is more than three quarters of a picture early.
    assert views[0].camera.start == pytest.approx(-0.23 + 7 / 30) and not notes
    assert np.array_equal(views[0].packed[0], view.packed[0]) and np.array_equal(views[0].good, view.good)


def test_films_begin_at_times_of_their_own(filmed: Path) -> None:
    save_cameras([view_of_sample(start=0.01, starts={"test_0": -0.5, "train_0": 0.04})], filmed / "cameras.json")
    recording = load_recording(filmed)
    assert [t.films[0].camera.start for t in recording.trials("all")] == [0.04, -0.5]
    view = views_of(recording, recording.train)[0][0]
    assert view.camera.start == 0.04 and view.time[0, 0] == 0.04
    save_cameras([view_of_sample(starts={"train_0": 0.2})], filmed / "cameras.json")
    recording = load_recording(filmed)
    with pytest.raises(
        InputError, match=r"from the beginning of train_0.npz on, found one that begins after 0.2 of its"
    ):
        views_of(recording, recording.train)
    save_cameras([view_of_sample(starts={"train_7": 0.1})], filmed / "cameras.json")
    with pytest.raises(
        InputError, match=r"starts of camera a: expected names of trials .train_0, test_0., found 'train_7'"
    ):
        load_recording(filmed)


def test_pictures_before_a_trial_are_skipped_film_by_film(made: Path, tmp_path: Path) -> None:
    recording = load_recording(SAMPLE)
    camera = view_of_sample(starts={"train_0": -0.2})
    film_recording(recording, [camera], tmp_path / "own", FilmLook(noise=1.0), trials=2, seconds=0.5)
    recording = load_recording(tmp_path / "own")
    view = views_of(recording, recording.train)[0][0]
    assert np.allclose(view.late, [0.0, 0.0], atol=1e-9) and np.allclose(view.time[:, 0], 0.0, atol=1e-9)
    assert view.clocks == ("train_0", "train_1") and view.clock.tolist() == [0, 1]


def test_starts_of_trials_that_are_not_filmed_are_left_out(tmp_path: Path) -> None:
    recording, look = load_recording(SAMPLE), FilmLook(noise=1.0)
    camera = view_of_sample(starts={"train_0": -0.2, "train_1": -0.1})
    film_recording(recording, [camera], tmp_path / "one", look, trials=1, seconds=0.5)
    assert load_recording(tmp_path / "one").train[0].films[0].camera.start == -0.2
    with pytest.raises(InputError, match=r"starts of camera a: expected names of trials .* found 'train_9'"):
        film_recording(recording, [view_of_sample(starts={"train_9": 0.0})], tmp_path / "no", look)
    assert not (tmp_path / "no").exists()


def test_films_may_begin_off_what_is_written(tmp_path: Path) -> None:
    recording = load_recording(SAMPLE)
    look = FilmLook(noise=0.0)
    for name, off in (("exact", 0.0), ("off", 0.5)):
        film_recording(recording, [view_of_sample()], tmp_path / name, look, trials=1, seconds=0.5, begun_off=off)
    exact, off = (views_of(r, r.train)[0][0] for r in (load_recording(tmp_path / n) for n in ("exact", "off")))
    assert exact.camera.start == off.camera.start and not np.array_equal(exact.packed[0], off.packed[0])


def test_masks_need_a_rate_and_as_many_pictures_as_their_trial_has(filmed: Path) -> None:
    masks = masks_of(load_recording(filmed), load_recording(filmed).train[0].films[0])[0]
    _masks(filmed, masks)
    file = filmed / "cameras.json"

    def seen(fps: float | None) -> list[str]:
        content = json.loads(file.read_text())
        content["cameras"][0] |= {"fps": fps}
        content["cameras"][0] = {k: v for k, v in content["cameras"][0].items() if v is not None}
        file.write_text(json.dumps(content))
        recording = load_recording(filmed)
        return views_of(recording, recording.train)[1]

    assert not seen(None) and not seen(30.0)  # the test trial has a film, which says it
    (filmed / "test_0.a.mp4").unlink()
    save_masks(masks, filmed / "test_0.a.npz")
    assert not seen(30.0)
    with pytest.raises(InputError, match="expected fps of camera a"):
        seen(None)
    with pytest.raises(InputError, match=r"expected 11 pictures .* found 16"):
        seen(20.0)
    assert "16 pictures for 0.5 s, which have 21 at 40" in seen(40.0)[0]


def _color(filmed: Path, color: list[int] | None) -> None:
    rope = json.loads((filmed / "rope.json").read_text())
    rope["color"] = color
    (filmed / "rope.json").write_text(json.dumps(rope))
