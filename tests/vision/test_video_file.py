"""Films that cannot be used are refused in a sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.vision import video_file
from torchdlo.vision.video_file import frame_rate, read_video, write_video


def test_a_film_comes_back_with_its_rate(tmp_path: Path) -> None:
    pictures = np.zeros((6, 32, 48, 3), np.uint8)
    pictures[:, 8:24, 8:24] = 200
    write_video(tmp_path / "a.mp4", pictures, 25.0)
    found, fps = read_video(tmp_path / "a.mp4")
    assert found.shape == pictures.shape and fps == pytest.approx(25.0, rel=1e-3)
    assert np.abs(found.astype(int) - pictures).mean() < 4


@pytest.mark.parametrize("content", [b"not a film at all " * 50, b"\0" * 2000])
def test_files_that_are_no_films_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match="expected a film") as caught:
        read_video(path)
    assert "\n" not in str(caught.value)


def test_half_a_film_is_refused_or_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, np.random.default_rng(0).integers(0, 255, (8, 32, 48, 3)).astype(np.uint8), 25.0)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="expected a film"):
        read_video(path)


def test_a_varying_frame_rate_is_refused_and_a_dropped_picture_is_not() -> None:
    even = np.arange(60) / 30.0
    assert frame_rate(Path("a.mp4"), list(np.delete(even, 20))) == pytest.approx(30.0)
    with pytest.raises(InputError, match="constant frame rate"):
        frame_rate(Path("a.mp4"), list(np.cumsum(np.where(np.arange(60) % 3, 0.033, 0.05))))
    with pytest.raises(InputError, match="rising times"):
        frame_rate(Path("a.mp4"), list(-even))


@pytest.mark.parametrize("rate", [30, 60, 120, 240])
def test_times_in_whole_milliseconds_give_the_rate(rate: int) -> None:
    # Matroska and WebM keep whole milliseconds: the median of steps is 17 of 16.67 ms at 60 pictures per second.
    times = [round(1000 * k / rate) / 1000 for k in range(2 * rate)]
    assert frame_rate(Path("a.mkv"), times) == pytest.approx(rate, rel=2e-4)


def test_a_rate_that_falls_from_30_to_25_is_refused() -> None:
    # As phones do in dim light: no step is 25 % from the usual one, but the last picture is 0.4 s from where it seems.
    times = np.concatenate([np.arange(60) / 30, 2 + np.arange(60) / 25])
    with pytest.raises(InputError, match="constant frame rate"):
        frame_rate(Path("a.mp4"), list(times))
    jitter = np.random.default_rng(0).uniform(-3e-3, 3e-3, 120)
    assert frame_rate(Path("a.mp4"), list(np.arange(120) / 30 + jitter)) == pytest.approx(30, rel=5e-4)
    with pytest.raises(InputError, match="times of its pictures"):
        frame_rate(Path("a.h264"), [None, None])


def test_the_picture_before_stands_in_the_place_of_those_that_were_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = [(np.full((2, 2, 3), k, np.uint8), k / 30.0) for k in range(40) if k not in (20, 21)]
    monkeypatch.setattr(video_file, "_decoded", lambda path: iter(shown))
    pictures, fps = read_video(tmp_path / "a.mp4")
    assert fps == pytest.approx(30.0)
    assert pictures[:, 0, 0, 0].tolist() == [*range(20), 19, 19, *range(22, 40)]
