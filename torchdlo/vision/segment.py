"""Masks of ropes: by ranges of colour, by difference from an empty background, or made elsewhere.

Ranges are in degrees of hue and in shares of saturation and value. They come from a person (`torchdlo segment`), or
from the colour that is written down in `rope.json`.
"""

from __future__ import annotations

import colorsys
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.untrusted import one_line, read_json
from torchdlo.untrusted.array_file import Header, read_arrays
from torchdlo.vision.video_file import read_video

__all__ = [
    "Ranges",
    "background_masks",
    "color_masks",
    "left_out",
    "load_film",
    "load_ranges",
    "matted",
    "ranges_of",
    "read_picture",
    "save_masks",
    "save_ranges",
    "tidy",
]


_MATTE = 15
"""Side of the surroundings that colours within and outside of a mask are taken from [px]."""

_CONTRAST = 30.0
"""Least difference of the two, from 0 to 255."""


@dataclass(frozen=True)
class Ranges:
    """Colours that belong to a rope, and how masks are tidied."""

    hue: tuple[float, float] = (0.0, 360.0)
    """Lowest and highest hue [degrees]; the lowest may be the larger one: through 0, for reds."""
    saturation: tuple[float, float] = (0.0, 1.0)
    """Lowest and highest saturation [1]."""
    value: tuple[float, float] = (0.0, 1.0)
    """Lowest and highest value [1]."""
    close: int = 3
    """Gaps up to so many pixels are closed [px]."""
    smallest: int = 25
    """Blobs of fewer pixels are left out [px]."""
    ignore: tuple[tuple[float, float, float, float], ...] = ()
    """Left, top, right and bottom of rectangles that are left out, as shares of the picture [1]: clamps that have the
    rope's colour for instance."""


def ranges_of(rgb: Sequence[float]) -> Ranges:
    """Return ranges for a colour (R, G, B from 0 to 255) in uneven light.

    Raises:
        InputError: The colour is grey: light and shade have the same.
    """
    hue, saturation, value = colorsys.rgb_to_hsv(*(c / 255 for c in rgb))
    if saturation < 0.25 or value < 0.15:
        raise InputError(
            f"color: expected one that stands out from grey surroundings, found {[round(c) for c in rgb]}; set ranges "
            "with torchdlo segment, or paint the rope."
        )
    degrees = 360 * hue
    wide = 22.0
    return Ranges(
        ((degrees - wide) % 360, (degrees + wide) % 360), (max(0.2, 0.45 * saturation), 1.0), (max(0.1, 0.2 * value), 1)
    )


def color_masks(pictures: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return the masks of pictures, RGB (F, H, W, 3) uint8, tidied; shape (F, H, W) bool."""
    import cv2

    out = np.zeros(pictures.shape[:3], bool)
    low, high = (h / 2 for h in ranges.hue)  # OpenCV's hue goes up to 180
    rest_low, rest_high = ([255 * r[k] for r in (ranges.saturation, ranges.value)] for k in (0, 1))
    spans = [(low, high)] if low <= high else [(low, 180.0), (0.0, high)]
    for k, picture in enumerate(pictures):
        hsv = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)
        found = np.zeros(hsv.shape[:2], np.uint8)
        for a, b in spans:
            lower, upper = (np.array([np.round(v) for v in ends]) for ends in ((a, *rest_low), (b, *rest_high)))
            found |= cv2.inRange(hsv, lower, upper)
        out[k] = tidy(matted(picture, tidy(found > 0, ranges)), ranges)
    return out


def matted(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a mask (H, W) bool whose edge is where the rope covers half of a pixel.

    Films store hue at half of their size: a range of colours puts the edge up to a pixel off. Next to it a picture is a
    mixture of the colour within and that outside, which tells what is covered with all of the picture's sharpness.

    Args:
        picture: RGB (H, W, 3) uint8.
        mask: the pixels whose colour is the rope's, (H, W) bool.
    """
    import cv2

    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return mask
    cut = tuple(slice(max(0, k[0] - _MATTE), k[-1] + _MATTE + 1) for k in (rows, columns))
    here, colors = mask[cut].astype(np.uint8), picture[cut].astype(np.float32)
    within, grown = (step(here, np.ones((3, 3), np.uint8)) > 0 for step in (cv2.erode, cv2.dilate))
    outside = cv2.dilate(here, np.ones((5, 5), np.uint8)) == 0

    def usual(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean colour of a part around each pixel, and where there is any."""
        weight, side = part.astype(np.float32), (_MATTE, _MATTE)
        count = cv2.boxFilter(weight, -1, side, normalize=False)
        color = cv2.boxFilter(colors * weight[..., None], -1, side, normalize=False)
        return color / np.maximum(count, 1.0)[..., None], count > 0.5

    (rope, near), (ground, far) = usual(within), usual(outside)
    way = rope - ground
    square = (way**2).sum(-1)
    share = ((colors - ground) * way).sum(-1) / np.maximum(square, 1.0)
    out = mask.copy()
    # Where a rope is so thin that nothing is within, its colour is not known.
    out[cut] = np.where(grown & near & far & (square > _CONTRAST**2), share > 0.5, mask[cut])
    return out


def background_masks(pictures: np.ndarray, background: np.ndarray, least: float, ranges: Ranges) -> np.ndarray:
    """Return where pictures (F, H, W, 3) differ from the background (H, W, 3) by at least `least`, (F, H, W) bool.

    Args:
        pictures: RGB uint8.
        background: RGB uint8, the same view without the rope.
        least: largest difference of a channel [1], from 0 to 255.
        ranges: how masks are tidied.
    """
    import cv2

    return np.stack([tidy(cv2.absdiff(p, background).max(-1) >= least, ranges) for p in pictures])


def tidy(mask: np.ndarray, ranges: Ranges) -> np.ndarray:
    """Return a mask (H, W) bool with small gaps closed and small blobs left out."""
    import cv2

    here = mask.astype(np.uint8)
    if ranges.close > 1:
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (ranges.close, ranges.close))
        here = np.asarray(cv2.morphologyEx(here, cv2.MORPH_CLOSE, kernel), np.uint8)
    here[left_out(ranges, mask.shape)] = 0
    count, label, stats, _ = cv2.connectedComponentsWithStats(here, connectivity=8)
    if count <= 1:
        return here.astype(bool)
    area = stats[1:, cv2.CC_STAT_AREA]
    keep = np.concatenate([[False], area >= max(ranges.smallest, 0.02 * area.max())])
    return keep[label]


def left_out(ranges: Ranges, shape: Sequence[int]) -> np.ndarray:
    """Return which pixels of pictures of a shape (H, W) are left out, (H, W) bool."""
    out = np.zeros(tuple(shape), bool)
    for left, top, right, bottom in ranges.ignore:
        (y0, y1), (x0, x1) = (
            (round(a * n), round(b * n)) for n, a, b in zip(shape, (top, left), (bottom, right), strict=True)
        )
        out[y0:y1, x0:x1] = True
    return out


def save_ranges(ranges: Ranges, path: Path) -> None:
    """Write ranges as JSON."""
    write_atomically(path, json.dumps({"generator": "torchdlo segment", **asdict(ranges)}, indent=1) + "\n")


def load_ranges(path: str | Path) -> Ranges:
    """Read what `save_ranges` wrote."""
    return ranges_from(read_json(path, "ranges of colour", most=2**20), str(path))


_MASKS = 2 * 2**30
"""Most that the masks of a film take [bytes]."""
_LIMITS = {"hue": 360.0, "saturation": 1.0, "value": 1.0}


def ranges_from(content: Any, where: str) -> Ranges:
    """Return ranges from plain objects; `where` begins the sentence if they are wrong."""
    if not isinstance(content, dict):
        raise InputError(f"{where}: expected an object with hue, saturation and value, found something else.")
    given: dict[str, Any] = {}
    for name, value in content.items():
        if name == "generator":
            continue
        if name in _LIMITS:
            pair: Sequence[Any] = value if isinstance(value, (list, tuple)) and len(value) == 2 else (None, None)
            good = all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in pair)
            if not good or not all(0 <= v <= _LIMITS[name] for v in pair):
                limit = f"{_LIMITS[name]:g}"
                raise InputError(
                    f"{where}: {name}: expected [lowest, highest] from 0 to {limit}, found {one_line(repr(value), 60)}."
                )
            given[name] = (float(pair[0]), float(pair[1]))
        elif name in ("close", "smallest"):
            if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= 10_000:
                raise InputError(
                    f"{where}: {name}: expected a whole number from 0 to 10000, found {one_line(repr(value), 60)}."
                )
            given[name] = value
        elif name == "ignore":
            given[name] = _rectangles(value, where)
        else:
            raise InputError(f"{where}: {name}: unknown; known are hue, saturation, value, close, smallest, ignore.")
    return Ranges(**given)


def _rectangles(value: Any, where: str) -> tuple[tuple[float, float, float, float], ...]:
    """Return rectangles from plain objects."""
    found = []
    for each in value if isinstance(value, (list, tuple)) else [None]:
        four: Sequence[Any] = each if isinstance(each, (list, tuple)) and len(each) == 4 else [None]
        number = all(isinstance(x, (int, float)) and not isinstance(x, bool) and 0 <= x <= 1 for x in four)
        if not number or not (four[0] < four[2] and four[1] < four[3]):
            raise InputError(
                f"{where}: ignore: expected [[left, top, right, bottom], ...] as shares from 0 to 1, found "
                f"{one_line(repr(each), 60)}."
            )
        found.append((float(four[0]), float(four[1]), float(four[2]), float(four[3])))
    return tuple(found)


def load_film(path: Path) -> tuple[np.ndarray, float | None]:
    """Return a film as pictures, RGB (F, H, W, 3) uint8, or as masks (F, H, W) bool, and its frame rate if it says it.

    A film of masks is black and white. `path` is an .npz with an array `masks`, a folder of PNG files, or a film.

    Raises:
        InputError: It cannot be read.
    """
    if path.is_dir():
        return _from_folder(path), None
    if path.suffix == ".npz":
        return _from_archive(path), None
    if path.suffix.lower() in (".png", ".jpg", ".jpeg"):
        return _maybe_masks(np.stack([read_picture(path)])), None
    pictures, fps = read_video(path)
    return _maybe_masks(pictures), fps


def _maybe_masks(pictures: np.ndarray) -> np.ndarray:
    """Return black and white pictures (F, H, W, 3) as masks, others as they are."""
    some = pictures[:: max(1, len(pictures) // 8)].astype(np.int16)
    grey = np.ptp(some, axis=-1)
    extreme = (some[..., 1] < 40) | (some[..., 1] > 215)
    if (grey > 12).mean() > 1e-3 or extreme.mean() < 0.97:
        return pictures
    return pictures[..., 1] > 127


def _from_archive(path: Path) -> np.ndarray:
    def check(headers: Mapping[str, Header]) -> None:
        if "masks" not in headers:
            found = one_line(", ".join(headers)) or "none"
            raise InputError(f"{path}: masks: expected this array, found {found}.")
        shape, dtype = headers["masks"].shape, headers["masks"].dtype
        if len(shape) != 3 or dtype.kind not in "bui":
            raise InputError(f"{path}: masks: expected bool of shape (frames, height, width), found {dtype}, {shape}.")

    masks = read_arrays(path, "masks", names=("masks",), check=check, most=_MASKS)["masks"]
    return masks > (0 if masks.dtype == bool or masks.max(initial=0) <= 1 else 127)


def read_picture(file: Path) -> np.ndarray:
    """Return a picture as it is stored, RGB (H, W, 3) uint8: tags that turn it do not count, as cameras do not turn."""
    import cv2

    picture = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise InputError(f"{file}: expected a picture, PNG or JPEG, but it cannot be read.")
    return np.ascontiguousarray(picture[..., ::-1])


def _counted(file: Path) -> tuple[list[str | int], str]:
    """Return what sorts files by the numbers in their names: 2.png before 11.png."""
    # Every other part is of digits, so that parts at the same place are compared as the same kind.
    return [int(part) if part.isdecimal() else part for part in re.split(r"([0-9]+)", file.stem)], file.name


def _from_folder(path: Path) -> np.ndarray:
    files = sorted(path.glob("*.png"), key=_counted)
    if not files:
        raise InputError(f"{path}: expected PNG files, one for each frame, found none.")
    pictures: list[np.ndarray] = []
    for file in files:
        picture = read_picture(file)
        if pictures and picture.shape != pictures[0].shape:
            raise InputError(
                f"{file}: expected {pictures[0].shape[1]} x {pictures[0].shape[0]} pixels as {files[0].name} has, "
                f"found {picture.shape[1]} x {picture.shape[0]}."
            )
        pictures.append(picture)
    return _maybe_masks(np.stack(pictures))


def save_masks(masks: np.ndarray, path: Path) -> None:
    """Write masks (F, H, W) bool as .npz."""
    from torchdlo.files import replace_atomically

    with replace_atomically(path) as temporary:
        np.savez_compressed(temporary, masks=masks, torchdlo=np.array("torchdlo"))
