"""Videos of a run as MP4: H.264, in real time or slowed down by a given factor."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.files import check_writable, replace_atomically
from torchdlo.report.render.picture import drawing
from torchdlo.scene_files.run import Frames

__all__ = ["CODECS", "check_video", "write_video"]

RATE = 30
"""Pictures per second."""
CODECS = ("libx264", "libopenh264", "h264")
"""Encoders of H.264, the best one first."""
_MARK = b"torchdlo"
"""Stands in the comment of our videos, which is at the end of the file."""


def check_video(path: Path) -> None:
    """Refuse a path at which something is that `write_video` did not write; see `files.check_writable`."""
    _av()
    ours = False
    if path.is_file():
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 4096))
            ours = _MARK in file.read()
    check_writable(path, mark=b"ftyp" if ours else _MARK)


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise InputError("videos need the package av; install it with pip install 'torchdlo[view]'.") from None
    return av


def write_video(
    frames: Frames,
    path: Path,
    *,
    speed: float = 1.0,
    size: tuple[int, int] = (960, 720),
    photo: bool = False,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> None:
    """Write a run as a video; nothing is left behind if it is stopped.

    Args:
        frames: the run.
        path: the file, ending in .mp4.
        speed: seconds of the run per second of the video.
        size: width and height in pixels, even numbers.
        photo: whether its pictures are photographs, which take minutes each.
        callback: told (stage, pictures done, in all, message) after every picture.
    """
    if not speed > 0:
        raise InputError(f"speed: expected a number above 0, given {speed:g}.")
    av = _av()
    codec = next((name for name in CODECS if name in av.codecs_available), None)
    if codec is None:
        raise InputError("videos need a build of the package av with H.264; pip install av has it.")
    count = max(1, round(float(frames.time[-1]) / speed * RATE) + 1)
    # The frame nearest in time: what is shown was computed.
    at = np.abs(frames.time[:, None] - np.arange(count) * speed / RATE).argmin(0)
    note = "" if speed == 1 else f"(speed {speed:g})"
    with replace_atomically(path) as temporary, drawing(frames, size=size, photo=photo) as picture:
        with av.open(str(temporary), "w", format="mp4") as container:
            container.metadata["comment"] = _MARK.decode()
            stream = container.add_stream(codec, rate=Fraction(RATE))
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"
            shown, image = -1, None
            for k, frame in enumerate(at):
                if frame != shown:
                    shown, image = frame, picture.image(int(frame), note)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
                if callback is not None:
                    callback("video", k + 1, count, f"{frames.time[frame]:.3g} s")
            container.mux(stream.encode())
