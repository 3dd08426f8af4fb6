"""Films are what was asked for: moments, wrong frames, bars, blocks, and cameras that are off by no more than said."""

from __future__ import annotations

import numpy as np

from tests.vision.scenes import front, hanging
from torchdlo.vision.film import FilmLook, film, off_camera


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
