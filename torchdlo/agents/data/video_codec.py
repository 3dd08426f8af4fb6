"""Pictures as MP4: encoding, joining without encoding again, and decoding. Frame k is at k / fps exactly."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data.dataset_schema import CODECS, GROUP
from torchdlo.errors import InputError

__all__ = ["Clip", "concatenate_clips", "decode_video", "encode_video", "import_pyav"]

TICKS = 256
"""Units of time per frame: time stamps are whole numbers of them."""
_OPTIONS = {
    # One thread, no scene cuts, nothing that looks ahead: joined episodes have the same headers.
    "libx264": {
        "qp": "20",
        "preset": "veryfast",
        "bf": "0",
        "sc_threshold": "0",
        "threads": "1",
        "x264-params": "mbtree=0:rc-lookahead=0:weightp=0",
    },
    "libsvtav1": {"crf": "30", "preset": "10", "svtav1-params": "lp=1"},
}


def import_pyav() -> Any:
    """Return PyAV, or say how to get it."""
    try:
        import av
    except ImportError:
        raise InputError("data sets with pictures need av; install it with pip install 'torchdlo[dataset]'.") from None
    return av


def encode_video(path: Path, frames: np.ndarray, *, fps: int, codec: str) -> None:
    """Write pictures (T, H, W, 3), 8 bits, as a video; the same pictures make the same bytes."""
    name = CODECS[codec][0]
    av = import_pyav()
    if name not in av.codecs_available:
        others = [other for other, (encoder, _) in CODECS.items() if encoder in av.codecs_available]
        known = " or ".join(others) or "of another"
        raise InputError(f"this build of av cannot write {codec}; choose --codec {known}.")
    seen: set[bytes] = set()
    # In about one of a hundred first calls after heavy arithmetic x264 makes other bytes of the same pictures: what has
    # come out twice is kept.
    for _ in range(8):
        content = _encoded(frames, fps, name)
        if content in seen:
            break
        seen.add(content)
    path.write_bytes(content)


def _encoded(frames: np.ndarray, fps: int, name: str) -> bytes:
    av = import_pyav()
    file = io.BytesIO()
    with av.open(file, "w", format="mp4", options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream(name, rate=Fraction(fps), options={"g": str(GROUP), **_OPTIONS[name]})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.thread_count = 1
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return file.getvalue()


class Clip:
    """A part of a video: some frames in a row, of which the first needs no others."""

    def __init__(self, path: Path, first: int, count: int) -> None:
        """Name the frames `first` to `first + count` of a file."""
        self.path, self.first, self.count = path, first, count

    def packets(self, fps: int) -> Iterator[Any]:
        """Yield what is stored of its frames, with their numbers within the clip."""
        av = import_pyav()
        found = 0
        with _opened(av, self.path) as container:
            stream = container.streams.video[0]
            tick = 1 / (fps * stream.time_base)
            if self.first:
                container.seek(int(self.first * tick), stream=stream)
            for packet in container.demux(stream):
                if packet.pts is None or packet.pts < self.first * tick:
                    continue
                if packet.pts >= (self.first + self.count) * tick or found == self.count:
                    break
                if (not found and not packet.is_keyframe) or packet.dts != packet.pts:
                    raise InputError(
                        f"{self.path}: frame {self.first} cannot be cut out without encoding again; only videos that "
                        "torchdlo wrote can be merged and filtered."
                    )
                yield stream, packet
                found += 1
        if found != self.count:
            raise InputError(f"{self.path}: expected {self.first + self.count} frames, found {self.first + found}.")


def concatenate_clips(path: Path, clips: Sequence[Clip], *, fps: int) -> None:
    """Write clips one after the other as one video, as they are."""
    av = import_pyav()
    base = Fraction(1, fps * TICKS)
    with av.open(str(path), "w", format="mp4", options={"fflags": "+bitexact"}) as container:
        out, header, k = None, None, 0
        for clip in clips:
            for stream, packet in clip.packets(fps):
                own = (stream.codec_context.name, bytes(stream.codec_context.extradata or b""))
                if out is None:
                    out, header = container.add_stream_from_template(stream, opaque=True), own
                    out.time_base = base
                if own != header:
                    raise InputError(
                        f"{clip.path}: its videos are encoded otherwise than those before; they do not join."
                    )
                packet.time_base, packet.stream = base, out
                packet.pts = packet.dts = k * TICKS
                packet.duration = TICKS
                container.mux(packet)
                k += 1


def decode_video(path: Path, *, fps: int, first: int = 0, count: int | None = None) -> Iterator[np.ndarray]:
    """Yield pictures (H, W, 3), 8 bits, from frame `first` on, and check their time stamps.

    Raises:
        InputError: The file cannot be read, a frame is missing, or one is not at its time.
    """
    av = import_pyav()
    found = 0
    try:
        with _opened(av, path) as container:
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            if first:
                container.seek(round(first / (fps * stream.time_base)), stream=stream)
            for frame in container.decode(stream):
                at = frame.pts * stream.time_base * fps
                if at < first:
                    continue
                if count is not None and found == count:
                    break
                if at != first + found:
                    raise InputError(
                        f"{path}: frame {first + found} is at {float(at / fps):.6f} s; expected it at "
                        f"{(first + found) / fps:.6f} s, a multiple of 1/{fps} s."
                    )
                yield frame.to_ndarray(format="rgb24")
                found += 1
    except av.FFmpegError as error:
        raise InputError(f"{path}: frame {first + found} cannot be decoded ({error.strerror}).") from None
    if count is not None and found < count:
        raise InputError(f"{path}: expected frames {first} to {first + count - 1}, but it ends at {first + found - 1}.")


def _opened(av: Any, path: Path) -> Any:
    if not path.is_file():
        raise InputError(f"{path}: the video is missing.")
    try:
        container = av.open(str(path))
    except av.FFmpegError as error:
        raise InputError(f"{path}: it is not a video that can be read ({error.strerror}).") from None
    if not container.streams.video:
        container.close()
        raise InputError(f"{path}: there are no pictures in it.")
    return container
