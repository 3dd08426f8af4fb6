"""Films that cannot be used are refused in a sentence."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.vision import video_file
from torchdlo.vision.video_file import frame_rate, read_video, some_pictures, write_video


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


def write(path: Path, shown: list[int], fps: int = 30) -> None:
    """Write a film of the pictures of these numbers, as bright as they are high, at their times."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width = stream.height = 32
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "0", "bf": "0"}
        stream.codec_context.time_base = stream.time_base = Fraction(1, 90_000)
        for k in shown:
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 3 * k, np.uint8), format="rgb24")
            frame.pts, frame.time_base = k * 90_000 // fps, stream.codec_context.time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize("gone", [{20, 21}, set(range(10, 45))])
def test_the_picture_before_stands_in_the_place_of_those_that_were_dropped(tmp_path: Path, gone: set[int]) -> None:
    write(tmp_path / "a.mp4", [k for k in range(60) if k not in gone])
    pictures, fps = read_video(tmp_path / "a.mp4")
    assert fps == pytest.approx(30.0)
    expected = [min(gone) - 1 if k in gone else k for k in range(60)]
    assert np.round(pictures[:, 5, 5, 0] / 3).astype(int).tolist() == expected


def test_films_larger_than_memory_should_hold_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.mp4", list(range(20)))
    write(tmp_path / "b.mp4", [*range(9), 19])
    monkeypatch.setattr(video_file, "_LARGEST", 19 * 32 * 32 * 3)
    for name in ("a", "b"):
        with pytest.raises(InputError, match="20 of 32 x 32 pixels"):
            read_video(tmp_path / f"{name}.mp4")
    with pytest.raises(InputError, match="at most 15 pictures, found 20"):
        read_video(tmp_path / "a.mp4", most=15)


def test_pictures_are_chosen_while_they_are_decoded(tmp_path: Path) -> None:
    write(tmp_path / "a.mkv", list(range(40)))
    count, pictures = some_pictures(tmp_path / "a.mkv", 5)
    found = {k: round(float(picture[5, 5, 0]) / 3) for k, picture in pictures}
    assert count == 5 and found == {0: 0, 10: 10, 20: 20, 29: 29, 39: 39}


def test_a_film_is_held_once(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", np.full((40, 720, 960, 3), 128, np.uint8), 30.0, quality=40)
    code = """
import resource, sys
from torchdlo.vision.video_file import av, read_video
av(); most = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = most()
pictures, _ = read_video(sys.argv[1])
print((most() - before) / pictures.nbytes)
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.mp4"], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 1.6  # decoders hold pictures themselves
