"""Films as arrays: read and written through PyAV, with a sentence for each way in which a file cannot be used."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.files import replace_atomically

__all__ = ["CODECS", "check_sides", "film_rate", "frame_rate", "read_video", "some_pictures", "write_video"]

CODECS = ("libx264", "libopenh264", "h264")
"""Encoders, the first that is there is used."""

_UNEVEN = 0.25
"""Distance of a time from the line through all of them, in pictures, from which the frame rate varies."""

_LARGEST = 4 * 2**30
"""Most that the pictures of a film take [bytes]."""

_MOST = 20_000
"""Pictures that a film may have."""


def av() -> Any:
    """Return PyAV, which films need."""
    try:
        import av
    except ImportError:
        raise InputError("films need the package av; install it with pip install 'torchdlo[video]'.") from None
    return av


def read_video(path: str | Path, *, most: int = _MOST) -> tuple[np.ndarray, float]:
    """Return the pictures of a film, RGB (F, H, W, 3) uint8, and pictures per second [1/s].

    In the place of pictures that were dropped are those before, as in a film that was encoded at a constant rate.

    Raises:
        InputError: It cannot be read, or its pictures are turned or not evenly spaced in time.
    """
    path = Path(path)
    count = film_rate(path)[1]
    if count > most:
        raise InputError(f"{path}: expected at most {most} pictures, found {count}; cut the film.")
    out: np.ndarray | None = None
    times: list[float | None] = []
    for picture, time in _decoded(path):
        if out is None:
            _check_size(path, count, picture)
            # Memory counts once it is written to: what is too much, for pictures that were dropped, costs nothing.
            out = np.empty((count + count // 4 + 16, *picture.shape), np.uint8)
        elif len(times) == len(out):
            out = np.concatenate([out, np.empty_like(out)])
        out[len(times)] = picture
        times.append(time)
    if out is None:
        raise InputError(f"{path}: expected a film, found no picture in it; record or copy the file again.")
    slope, number = _clock(path, times)
    if number[-1] >= most:
        raise InputError(f"{path}: expected at most {most} pictures, found times for more; cut the film.")
    if number[-1] >= len(times):
        _check_size(path, int(number[-1]) + 1, out[0])
    return _filled(out, number), 1 / slope


def _check_size(path: Path, count: int, picture: np.ndarray) -> None:
    """Refuse as many pictures like one as memory should not hold."""
    if count * picture.nbytes > _LARGEST:
        raise InputError(
            f"{path}: expected at most {_LARGEST / 2**30:.3g} GiB of pictures, found {count} of {picture.shape[1]} x "
            f"{picture.shape[0]} pixels, {count * picture.nbytes / 2**30:.3g} GiB; cut the film to its trial, or film, "
            "and calibrate the camera, with fewer pixels."
        )


def _filled(out: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return an array whose first pictures are numbers (F,) of a film with all of them, in place where it has room."""
    last = int(number[-1])
    if last >= len(out):
        out = np.concatenate([out, np.empty((last + 1 - len(out), *out.shape[1:]), out.dtype)])
    # From the end on: pictures move to later places, or stay.
    for k in range(len(number) - 1, -1, -1):
        out[number[k] : number[k + 1] if k + 1 < len(number) else last + 1] = out[k]
    return out[: last + 1]


def some_pictures(path: str | Path, most: int) -> tuple[int, Iterator[tuple[int, np.ndarray]]]:
    """Return how many pictures are chosen evenly of a film, at most `most`, and these, one by one, with their numbers.

    Raises:
        InputError: It cannot be read, or its pictures are turned or not evenly spaced in time.
    """
    path = Path(path)
    count = film_rate(path)[1]
    chosen = set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist())
    return len(chosen), ((k, picture) for k, (picture, _) in enumerate(_decoded(path, chosen)) if k in chosen)


def frame_rate(path: Path, times: Sequence[float | None]) -> float:
    """Return pictures per second [1/s] of pictures at these times [s]; refuse uneven ones."""
    return 1 / _clock(path, times)[0]


def _clock(path: Path, times: Sequence[float | None]) -> tuple[float, np.ndarray]:
    """Return the time between pictures [s] and which picture each one is (F,): some may have been dropped.

    The time is the slope of a line through all of them: containers round times, some to whole milliseconds.
    """
    known = np.array([np.nan if t is None else t for t in times], dtype=float)
    if not np.isfinite(known).all():
        raise InputError(f"{path}: expected times of its pictures, found none; encode it again as an .mp4 file.")
    if len(known) < 2:
        return 1 / 30.0, np.arange(len(known))
    steps = np.diff(known)
    usual = float(np.sort(steps)[len(steps) // 2])
    if usual <= 0 or steps.min() <= 0:
        raise InputError(f"{path}: expected rising times of its pictures, found others; encode the film again.")
    whole = steps[np.round(steps / usual) == 1]
    usual = float(whole.mean())
    # A picture that was dropped leaves a whole gap, which `read_video` fills; a varying rate does not.
    number = np.concatenate([[0], np.cumsum(np.maximum(np.round(steps / usual), 1).astype(int))])
    slope, first = np.polyfit(number, known, 1)
    off = np.abs(known - first - slope * number) / slope
    if off.max() > _UNEVEN or len(whole) < 0.8 * len(steps):
        k = int(np.argmax(off))
        raise InputError(
            f"{path}: expected a constant frame rate, found times between pictures from {1e3 * steps.min():.1f} to "
            f"{1e3 * steps.max():.1f} ms, so that picture {k} is {1e3 * slope * off[k]:.1f} ms from where an even rate "
            "has it; film with the rate and the exposure locked, or cut what is uneven."
        )
    return float(slope), number


def film_rate(path: str | Path) -> tuple[float, int]:
    """Return pictures per second [1/s] of a film, and how many it has, without decoding them.

    Raises:
        InputError: It cannot be read, or its pictures are not evenly spaced in time.
    """
    path = Path(path)
    times: list[float | None] = []
    with _opened(path) as (container, stream):
        for packet in container.demux(stream):
            if packet.size:
                stamp = packet.dts if packet.pts is None else packet.pts
                times.append(None if stamp is None else float(stamp * packet.time_base))
    if not times:
        raise InputError(f"{path}: expected a film, found no picture in it; record or copy the file again.")
    # Packets come in the order in which they are decoded.
    known = sorted(t for t in times if t is not None)
    return frame_rate(path, known if len(known) == len(times) else times), len(times)


def _decoded(path: Path, chosen: Container[int] | None = None) -> Iterator[tuple[np.ndarray, float | None]]:
    """Give the pictures of a film and their times; those that are not chosen are empty arrays."""
    with _opened(path) as (container, stream):
        stream.thread_type = "AUTO"
        for k, frame in enumerate(container.decode(stream)):
            turned = int(getattr(frame, "rotation", 0) or 0)
            if turned % 360:
                raise InputError(
                    f"{path}: expected pictures as the sensor took them, found a tag that turns them by "
                    f"{abs(turned)} degrees; film with the phone held level, or encode the film again."
                )
            here = chosen is None or k in chosen
            yield frame.to_ndarray(format="rgb24") if here else np.empty((0, 0, 3), np.uint8), frame.time


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Give the container of a film and its first stream of pictures; refuse what is none."""
    if not path.is_file():
        raise InputError(f"{path}: expected a film, found nothing there.")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: expected a film, found an empty file; copy it again.")
    package = av()
    try:
        with package.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path}: expected a film, found a file without pictures.")
            yield container, container.streams.video[0]
    except package.error.FFmpegError as error:
        raise InputError(
            f"{path}: expected a film that can be decoded, but reading failed ({error.strerror or error}); "
            "encode it as H.264."
        ) from None


def check_sides(where: str, width: int, height: int) -> None:
    """Refuse pictures that the encoder cannot take; `where` begins the sentence."""
    if width % 2 or height % 2:
        raise InputError(
            f"{where}: expected even width and height for a film, which has hue at half of the size, found {width} x "
            f"{height} pixels; masks may have any."
        )


def write_video(path: Path, pictures: np.ndarray, fps: float, *, quality: int = 18) -> None:
    """Write pictures, RGB (F, H, W, 3) or grey (F, H, W) uint8, as an MP4 that appears complete or not at all.

    Raises:
        InputError: A side of them is odd: the encoder stores hue at half of their size.
    """
    package = av()
    codec = next((name for name in CODECS if name in package.codecs_available), None)
    if codec is None:
        raise InputError("films need a build of the package av with H.264; pip install av has it.")
    layout = "rgb24" if pictures.ndim == 4 else "gray"
    height, width = pictures.shape[1:3]
    check_sides(f"{path}", width, height)
    with replace_atomically(path) as temporary, package.open(str(temporary), "w", format="mp4") as container:
        container.metadata["comment"] = "torchdlo"
        stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": str(quality), "preset": "medium"} if codec == "libx264" else {}
        for picture in pictures:
            frame = package.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=layout)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
