"""The commands about cameras and films, as a person uses them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.vision.scenes import front
from tests.vision.test_calibrate_camera import BOARDS, filmed
from tests.vision.test_segment import COLORS, swinging
from torchdlo.cli.app import app, main
from torchdlo.errors import InputError
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video import filmed as filmed_fits
from torchdlo.sysid.video import filmed_diagnosis, filmed_fit
from torchdlo.sysid.video.filming import film_recording
from torchdlo.vision.camera import load_cameras, looking_at, save_cameras, states_rate
from torchdlo.vision.film import FilmLook
from torchdlo.vision.segment import load_ranges, ranges_of
from torchdlo.vision.video_file import write_video

DATA = Path(__file__).parents[2] / "torchdlo" / "data"


def run(*args: object) -> str:
    done = CliRunner().invoke(app, [str(a) for a in args], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def test_a_camera_is_calibrated_and_added_to_others(tmp_path: Path) -> None:
    filmed(BOARDS[0], tmp_path / "board.mp4", 8)
    out = tmp_path / "cameras.json"
    save_cameras([front()], out)
    said = run(
        "calibrate-camera", tmp_path / "board.mp4", "--board", "8x6", "--square", 0.03, "--name", "c", "--out", out
    )
    assert "reprojection error" in said and [c.name for c in load_cameras(out)] == ["a", "c"]
    assert (tmp_path / "cameras_c.png").read_bytes().startswith(b"\x89PNG")
    starts = {"train_0": 0.1}
    save_cameras([replace(load_cameras(out)[1], start=-0.4, starts=starts), front()], out, unknown_rate={"a"})
    again = ("calibrate-camera", tmp_path / "board.mp4", "--board", "8x6", "--square", 0.03, "--out", out)
    said = run(*again, "--name", "c")
    assert "start = -0.4 s is kept" in said and "starts of 1 trials are kept" in said
    assert load_cameras(out)[1].start == -0.4 and load_cameras(out)[1].starts == starts
    assert states_rate(out) == {"c"}  # that of the other one is as unknown as before
    for name in ("a/b", "left cam", ""):
        with pytest.raises(InputError, match="--name: expected letters"):
            run(*again, "--name", name)
    run("calibrate-camera", "-", "--board", "8x6", "--print-board", tmp_path / "board.png")
    assert (tmp_path / "board.png").exists()
    with pytest.raises(InputError, match=r"ends in \.png, found .*board\.jpg"):
        run("calibrate-camera", "-", "--board", "8x6", "--print-board", tmp_path / "board.jpg")
    with pytest.raises(InputError, match="COLUMNSxROWS"):
        run("calibrate-camera", tmp_path / "board.mp4", "--board", "8by6")


def test_masks_are_made_by_a_colour(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4", swinging(8).pictures, 30.0)
    color = ",".join(map(str, COLORS[0]))
    where = ("--out", tmp_path / "segment.json", "--masks", tmp_path / "masks.npz")
    said = run("segment", tmp_path / "film.mp4", "--color", color, *where)
    assert "8 of 8 frames" in said and load_ranges(tmp_path / "segment.json") == ranges_of(COLORS[0])
    with np.load(tmp_path / "masks.npz") as archive:
        assert archive["masks"].shape == (8, 480, 640)
    other = ("--out", tmp_path / "other.json", "--masks", tmp_path / "other.npz")
    with pytest.raises(InputError, match="never visible"):
        run("segment", tmp_path / "film.mp4", "--color", "200,30,230", *other)
    assert not (tmp_path / "other.json").exists() and not (tmp_path / "other.npz").exists()
    with pytest.raises(InputError, match="R,G,B"):
        run("segment", tmp_path / "film.mp4", "--color", "green", "--out", tmp_path / "segment.json")


def test_the_background_is_taken_as_stored_and_ranges_tidy_its_masks(tmp_path: Path) -> None:
    from PIL import Image

    empty = np.full((100, 160, 3), 120, np.uint8)
    empty[:20] = (200, 30, 30)
    (tmp_path / "film").mkdir()
    for k in range(6):
        picture = empty.copy()
        picture[60 + k : 64 + k, 20:140] = (20, 160, 60)
        picture[30:34, 20 + k : 100 + k] = (20, 160, 60)
        Image.fromarray(picture).save(tmp_path / "film" / f"{k}.png")
    tag = Image.Exif()
    tag[0x0112] = 3  # turned by half a circle, as a viewer shows it
    Image.fromarray(empty).save(tmp_path / "empty.jpg", exif=tag, quality=98)
    (tmp_path / "ranges.json").write_text('{"ignore": [[0, 0.5, 1, 1]]}')
    given = ("--ranges", tmp_path / "ranges.json", "--masks", tmp_path / "masks.npz", "--out", tmp_path / "out.json")
    run("segment", tmp_path / "film", "--background", tmp_path / "empty.jpg", *given)
    with np.load(tmp_path / "masks.npz") as archive:
        assert archive["masks"].sum((1, 2)).tolist() == [320] * 6
    with pytest.raises(InputError, match="--color or --background"):
        run("segment", tmp_path / "film", "--background", tmp_path / "empty.jpg", "--color", "1,200,3", *given[2:])


def test_a_recording_is_filmed_and_checked(tmp_path: Path) -> None:
    camera = looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0)
    save_cameras([camera], tmp_path / "cameras.json")
    common = ("film", DATA / "sample_rope", tmp_path / "cameras.json", "--trials", 1, "--seconds", 0.4)
    said = run(*common, "--out", tmp_path / "filmed", "--wrong", 0.1, "--off", 1)
    assert "wrong:" in said and load_recording(tmp_path / "filmed").filmed
    assert load_cameras(tmp_path / "filmed" / "cameras.json")[0].fx != camera.fx
    assert "can be used" in run("check", tmp_path / "filmed")
    with pytest.raises(InputError, match="not an empty folder"):
        run(*common, "--out", tmp_path / "filmed")
    with pytest.raises(InputError, match="--bar"):
        run(*common, "--out", tmp_path / "other", "--bar", "1,2")
    assert not (tmp_path / "other").exists()


def test_a_run_is_filmed_with_its_loop_closed_and_refuses_what_it_would_ignore(tmp_path: Path) -> None:
    turn = 2 * np.pi * np.arange(24) / 24
    loop = [[0.2 * np.cos(t), 0.0, 0.5 + 0.2 * np.sin(t)] for t in turn]
    rope = {"points": loop, "closed": True, "radius": 0.006, "mass": 0.03, "youngs": 1e6}
    scene = {"format": "torchdlo scene 2", "duration": 0.04, "effects": {}, "ropes": [rope]}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    run("simulate", tmp_path / "scene.json", "--out", tmp_path / "run", "--execution", "eager")
    camera = looking_at("a", [0.0, -1.0, 0.5], [0.0, 0.0, 0.5], size=(160, 120), focal=150.0)
    save_cameras([camera], tmp_path / "cameras.json")
    common = ("film", tmp_path / "run", tmp_path / "cameras.json", "--out", tmp_path / "films")
    with pytest.raises(InputError, match="--off and --trials and --seconds for a recording only"):
        run(*common, "--off", 3, "--seconds", 0.1, "--trials", 1)
    run(*common, "--masks")
    with np.load(tmp_path / "films" / "a.npz") as archive:
        around, _ = cv2.connectedComponents((~archive["masks"][0]).astype(np.uint8))
    assert around == 3  # the mask, what is around the loop, and what is within
    sizes = []
    for quality in (10, 45):
        run(*common[:4], tmp_path / f"films_{quality}", "--quality", quality)
        sizes.append((tmp_path / f"films_{quality}" / "a.mp4").stat().st_size)
    assert sizes[0] > 2 * sizes[1]


def test_a_stopped_calibration_of_films_goes_on_from_its_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    camera = looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0)
    film_recording(
        load_recording(DATA / "sample_rope"), [camera], tmp_path / "rope", FilmLook(), trials=1, seconds=0.25
    )
    given, out = ["calibrate", str(tmp_path / "rope"), "--starts", "3", "--iterations", "1"], tmp_path / "out"
    with monkeypatch.context() as patched:
        patched.setattr(filmed_fits, "test_problem", stop)
        with pytest.raises(SystemExit) as ended:
            main([*given, "--out", str(out)])
    said = capsys.readouterr().err
    assert ended.value.code == 130 and f"kept in {out / 'journal'}" in said and "--resume" in said
    assert not (out / "model.json").exists()
    monkeypatch.setattr(filmed_fit, "_improved", lambda *_: pytest.fail("fitted again"))
    run(*given, "--out", out, "--resume")
    assert (out / "model.json").is_file() and not (out / "journal").exists()
    with pytest.raises(SystemExit):
        main([*given, "--out", str(out), "--resume"])
    assert "leave out --resume" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["train_0.a.mp4", "test_0.a.mp4"])
@pytest.mark.parametrize("command", ["calibrate", "diagnose"])
def test_a_film_that_is_refused_leaves_nothing_behind(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(DATA / "sample_film", tmp_path / "rope")
    (tmp_path / "rope" / name).write_bytes(b"")

    def fitted(*_: object, **__: object) -> None:
        raise AssertionError("test films are looked at before any fit")

    monkeypatch.setattr(filmed_fits, "baseline", fitted)
    monkeypatch.setattr(filmed_diagnosis, "baseline", fitted)
    out = tmp_path / "out"
    with pytest.raises(InputError, match=f"{name}: expected a film, found an empty file"):
        run(command, tmp_path / "rope", "--out", out / "model.json" if command == "calibrate" else out)
    assert not out.exists() or not list(out.iterdir())


def test_the_film_in_the_package_is_small_and_sound() -> None:
    folder = DATA / "sample_film"
    assert sum(f.stat().st_size for f in folder.iterdir()) < 300_000
    assert load_recording(folder).filmed
