"""Films are what was asked for: moments, wrong frames, bars, blocks, and cameras that are off by no more than said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.vision.scenes import front, hanging
from torchdlo.errors import InputError
from torchdlo.sysid.video.filming import film_run
from torchdlo.vision.film import FilmLook, film, off_camera
from torchdlo.vision.video_file import write_video


def test_a_film_starts_on_its_clock_and_hides_what_is_behind_bars_and_grippers() -> None:
    time = np.linspace(0, 1, 21)
    points = hanging(31) + np.array([0.2, 0, 0]) * time[:, None, None]
    look = FilmLook(bar=(0.4, 0.0, 0.45, 1.0), noise=0, seed=1)
    held = [range(0, 3), range(28, 31)]
    seen = film(front(start=0.2, fps=10.0), time, points, 0.007, look, held=held)
    bare = film(front(start=0.2, fps=10.0), time, points, 0.007, FilmLook(noise=0))
    assert len(seen.time) == 9 and seen.time[0] == 0.2
    assert not seen.masks[:, :, 257:287].any() and bare.masks[0].sum() > seen.masks[0].sum()
    middle = [np.nonzero(m)[1].mean() for m in bare.masks]
    assert np.all(np.diff(middle) > 5)


def test_a_camera_may_start_before_the_motion_and_not_after_it() -> None:
    time = np.linspace(0, 1, 21)
    points = hanging(21) + np.array([0.2, 0, 0]) * time[:, None, None]
    small = {"size": (160, 120), "fps": 10.0}
    seen = film(front(start=-0.5, **small), time, points, 0.007, FilmLook(noise=0))
    assert len(seen.time) == 16 and seen.time[-1] == pytest.approx(1.0)
    assert (seen.masks[:5] == seen.masks[0]).all() and (seen.masks[-1] != seen.masks[0]).any()
    with pytest.raises(InputError, match="before the motion ends at 1 s, found 100"):
        film(front(start=100.0, **small), time, points, 0.007)
    with pytest.raises(InputError, match="at least 3 pictures"):
        film(front(start=0.9, **small), time, points, 0.007, FilmLook(wrong=0.1))


def test_odd_sizes_are_refused_before_the_work_unless_masks_are_written(tmp_path: Path) -> None:
    time, points = np.linspace(0, 0.1, 5), np.repeat(hanging(21)[None], 5, 0)
    run = (time, points, np.zeros(21, int), 0.007, [front(size=(161, 121))])
    with pytest.raises(InputError, match=r"camera a: expected even width and height .* 161 x 121"):
        film_run(*run, tmp_path / "films", FilmLook())
    with pytest.raises(InputError, match="even width"):
        write_video(tmp_path / "a.mp4", np.zeros((2, 121, 161, 3), np.uint8), 30.0)
    assert not list(tmp_path.iterdir())
    film_run(*run, tmp_path / "films", FilmLook(), masks=True)
    with np.load(tmp_path / "films" / "a.npz") as archive:
        assert archive["masks"].shape[1:] == (121, 161)


def test_wrong_frames_are_as_many_as_asked_for_and_said() -> None:
    time = np.linspace(0, 1, 31)
    points = np.repeat(hanging(21)[None], 31, 0)
    seen = film(front(), time, points, 0.007, FilmLook(wrong=0.2, noise=0), frames=20)
    assert seen.wrong.sum() == 4 == len(seen.kinds) and not seen.wrong[:2].any()


def test_cameras_are_off_by_no_more_than_said() -> None:
    camera = front()
    for seed in range(20):
        other = off_camera(camera, np.random.default_rng(seed))
        turn = np.array(other.rotation) @ np.array(camera.rotation).T
        assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 1.74  # one degree about each axis
        assert abs(other.fx / camera.fx - 1) < 0.011 and abs(other.start - camera.start) <= 0.5 / 30
