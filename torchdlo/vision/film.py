"""Films of a rope whose motion is known, by OpenCV alone: test data for everything that reads films.

Nothing of the differentiable rasteriser or of kornia is used here: points are projected by `cv2.projectPoints`, tubes
are filled polygons at four times the size, shrunk by area, so that a fault of one shows in the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchdlo.errors import InputError
from torchdlo.vision.camera import Camera, radial_limit, triple

__all__ = ["Film", "FilmLook", "film", "off_camera", "rope_coverage"]

_FINE = 4
"""How many times larger tubes are drawn."""

_SHIFT = 4
"""Fractional bits of OpenCV's coordinates."""

WRONG = ("black", "repeated", "other", "blob")
"""Kinds of wrong frames: black, the one before, one from another time, one with a second blob of the rope's colour."""


@dataclass(frozen=True)
class FilmLook:
    """What a film looks like, and what is wrong with it."""

    color: tuple[int, int, int] = (25, 150, 60)
    """Of the rope, RGB."""
    background: tuple[int, int, int] = (196, 194, 190)
    """Mean colour of what is behind it, RGB."""
    noise: float = 3.0
    """Standard deviation of the noise of a channel, of 255."""
    exposure: float = 4e-3
    """How long a picture is exposed [s]."""
    blur: float = 0.6
    """Blur of the lens [px]."""
    bar: tuple[float, float, float, float] | None = None
    """Left, top, right, bottom of a bar in front of the rope, as shares of the picture."""
    wrong: float = 0.0
    """Share of frames that are wrong."""
    seed: int = 0
    """Of noise, texture and wrong frames."""


@dataclass(frozen=True, eq=False)
class Film:
    """What a camera saw."""

    pictures: np.ndarray
    """RGB uint8, shape (F, H, W, 3)."""
    masks: np.ndarray
    """What it saw of the rope, shape (F, H, W) bool; those of wrong frames are wrong in the same way."""
    wrong: np.ndarray
    """Which frames are wrong, shape (F,) bool."""
    time: np.ndarray
    """Middles of exposures [s], shape (F,)."""
    kinds: tuple[str, ...] = field(default=())
    """What is wrong with those."""


def _projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) and depths [m] (N,) of points (N, 3); depth 0 beyond `radial_limit`."""
    import cv2

    turn, shift = np.array(camera.rotation), np.array(camera.translation)
    local = points @ turn.T + shift
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    lens = np.array(camera.distortion or [0.0] * 5)
    front = np.where(local[:, 2:] > 1e-2, local, [0.0, 0.0, 1.0])
    pixel, _ = cv2.projectPoints(front[:, None], np.zeros(3), np.zeros(3), matrix, lens)
    beyond = np.hypot(front[:, 0], front[:, 1]) > radial_limit(camera.distortion) * front[:, 2]
    return pixel[:, 0], np.where(beyond, 0.0, local[:, 2])


def rope_coverage(
    camera: Camera, points: np.ndarray, radius: float, hidden: Sequence[np.ndarray] = (), fine: int = _FINE
) -> np.ndarray:
    """Return how much of each pixel a rope covers [1], shape (H, W).

    Args:
        camera: the camera.
        points: vertices [m], shape (V, 3).
        radius: of the rope [m].
        hidden: convex polygons in front of the rope [px], shape (K, 2) each.
        fine: how many times larger it is drawn.
    """
    import cv2

    pixel, depth = _projected(camera, points)
    out = np.zeros((camera.height, camera.width), np.float32)
    # Only the part of the picture where the rope is, at a larger size.
    margin = 2 + radius * 0.5 * (camera.fx + camera.fy) / np.maximum(depth, 1e-2)[:, None]
    front, size = depth >= 1e-2, np.array([camera.width, camera.height])
    if not front.any():
        return out
    low = np.clip(np.floor((pixel - margin)[front].min(0)), 0, size).astype(int)
    high = np.clip(np.ceil((pixel + margin)[front].max(0)) + 1, 0, size).astype(int)
    if (high <= low).any():
        return out
    canvas = np.zeros(((high - low)[::-1] * fine), np.uint8)
    # The centre of the top left pixel is at (fine - 1) / 2 of the larger picture.
    place = (pixel - low + 0.5) * fine - 0.5
    # OpenCV fills the pixels on a polygon's border, too: half a pixel of the larger picture.
    wide = np.maximum(fine * radius * 0.5 * (camera.fx + camera.fy) / np.maximum(depth, 1e-2) - 0.5, 0.0)
    one = 1 << _SHIFT
    for k in range(len(points) - 1):
        if min(depth[k], depth[k + 1]) < 1e-2 or np.abs(place[k : k + 2]).max() > 1e5:
            continue
        along = place[k + 1] - place[k]
        normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
        corners = np.array(
            [
                place[k] + wide[k] * normal,
                place[k + 1] + wide[k + 1] * normal,
                place[k + 1] - wide[k + 1] * normal,
                place[k] - wide[k] * normal,
            ]
        )
        cv2.fillConvexPoly(canvas, np.round(corners * one).astype(np.int32), 1, cv2.LINE_8, _SHIFT)
        for j in (k, k + 1):
            middle = np.round(place[j] * one).astype(int)
            cv2.circle(canvas, middle.tolist(), round(float(wide[j]) * one), 1, -1, cv2.LINE_8, _SHIFT)
    for polygon in hidden:
        corners = np.round(((polygon - low + 0.5) * fine - 0.5) * one).astype(np.int32)
        cv2.fillConvexPoly(canvas, cv2.convexHull(corners), 0, cv2.LINE_8, _SHIFT)
    width, height = high - low
    shrunk = cv2.resize(canvas.astype(np.float32), (int(width), int(height)), interpolation=cv2.INTER_AREA)
    out[low[1] : high[1], low[0] : high[0]] = shrunk
    return out


def _texture(camera: Camera, look: FilmLook, rng: np.random.Generator) -> np.ndarray:
    """Return an uneven background, (H, W, 3) float."""
    import cv2

    rough = np.zeros((camera.height, camera.width), np.float32)
    for cells in (4, 12, 40, 120):
        grid = rng.normal(size=(cells * camera.height // camera.width + 2, cells)).astype(np.float32)
        fine = np.asarray(cv2.resize(grid, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC), np.float32)
        rough += fine * 5 / (1 + cells / 20)
    return np.array(look.background, np.float32) + rough[..., None]


def _blocks(camera: Camera, points: np.ndarray, held: Sequence[Sequence[int]], size: float) -> list[np.ndarray]:
    """Return the outlines of the blocks that hold runs of vertices, (K, 2) [px] each."""
    found = []
    for run in held:
        place = points[list(run)]
        corners = np.concatenate([place + size * np.array(s) for s in np.ndindex(2, 2, 2)])
        corners = corners - 0.5 * size
        pixel, depth = _projected(camera, corners)
        if depth.min() > 1e-2:
            found.append(pixel)
    return found


def _moments(camera: Camera, end: float, frames: int | None) -> np.ndarray:
    """Return when pictures are taken [s], (F,), as many as asked for or up to the end of the motion [s]."""
    if frames is None:
        if camera.start > end:
            raise InputError(
                f"camera {camera.name}: start: expected the first picture before the motion ends at {end:g} s, found "
                f"{camera.start:g}."
            )
        frames = int((end - camera.start) * camera.fps) + 1
    return camera.start + np.arange(frames) / camera.fps


def film(
    camera: Camera,
    time: np.ndarray,
    points: np.ndarray,
    radius: float,
    look: FilmLook | None = None,
    *,
    held: Sequence[Sequence[int]] = (),
    frames: int | None = None,
) -> Film:
    """Film a rope.

    Args:
        camera: what films; its first picture is taken at its `start`.
        time: of the motion [s], shape (T,).
        points: vertices of the rope [m], shape (T, V, 3).
        radius: of the rope [m].
        look: see `FilmLook`.
        held: runs of vertices within grippers, whose blocks hide them.
        frames: how many pictures; as many as until the motion ends if not given. Before it the rope rests.

    Raises:
        InputError: The camera starts after the motion, or there are too few pictures for wrong ones among them.
    """
    import cv2
    from scipy.interpolate import CubicSpline

    look = look or FilmLook()
    rng = np.random.default_rng(look.seed)
    motion = CubicSpline(time, points, axis=0)
    moments = _moments(camera, float(time[-1]), frames)
    frames = len(moments)
    back, samples = _texture(camera, look, rng), 3 if look.exposure > 0 else 1
    bar = np.zeros((camera.height, camera.width), bool)
    if look.bar is not None:
        left, top, right, bottom = np.array(look.bar) * (camera.width, camera.height, camera.width, camera.height)
        bar[int(top) : int(np.ceil(bottom)), int(left) : int(np.ceil(right))] = True
    pictures = np.empty((frames, camera.height, camera.width, 3), np.uint8)
    masks = np.empty((frames, camera.height, camera.width), bool)
    size = 5 * radius
    for k, middle in enumerate(moments):
        cover = np.zeros((camera.height, camera.width), np.float32)
        for t in middle + look.exposure * (np.arange(samples) - (samples - 1) / 2) / samples:
            now = motion(np.clip(t, time[0], time[-1]))
            cover += rope_coverage(camera, now, radius, _blocks(camera, now, held, size)) / samples
        now = motion(np.clip(middle, time[0], time[-1]))
        cover[bar] = 0.0
        picture = back + (np.array(look.color, np.float32) - back) * cover[..., None]
        for block in _blocks(camera, now, held, size):
            hull = cv2.convexHull(np.round(block * (1 << _SHIFT)).astype(np.int32))
            cv2.fillConvexPoly(picture, hull, (80, 80, 78), cv2.LINE_AA, _SHIFT)
        picture[bar] = (120, 118, 116)
        if look.blur > 0:
            picture = cv2.GaussianBlur(picture, (0, 0), look.blur)
        if look.noise > 0:
            picture = picture + look.noise * rng.standard_normal(picture.shape, dtype=np.float32)
        pictures[k] = np.clip(np.round(picture), 0, 255)
        masks[k] = cover > 0.5
    wrong, kinds = _spoil(pictures, masks, look, rng)
    return Film(pictures, masks, wrong, moments, kinds)


def _spoil(
    pictures: np.ndarray, masks: np.ndarray, look: FilmLook, rng: np.random.Generator
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Make a share of the pictures wrong, in place."""
    count, kinds = len(pictures), []
    wrong = np.zeros(count, bool)
    if not look.wrong:
        return wrong, ()
    if count < 3:
        raise InputError(
            f"wrong: expected at least 3 pictures in a film to spoil one, found {count}; film longer, or none wrong."
        )
    at = np.sort(rng.choice(np.arange(2, count), max(1, round(look.wrong * count)), replace=False))
    for k in at:
        kind = WRONG[int(rng.integers(len(WRONG)))]
        if kind == "black":
            pictures[k], masks[k] = 0, False
        elif kind == "repeated":
            pictures[k], masks[k] = pictures[k - 1], masks[k - 1]
        elif kind == "other":
            away = (k + count // 2) % count
            pictures[k], masks[k] = pictures[away], masks[away]
        else:
            height, width = masks.shape[1:]
            y, x = rng.integers(0, height * 3 // 4), rng.integers(0, width * 3 // 4)
            spot = np.s_[k, y : y + height // 5, x : x + width // 5]
            pictures[spot], masks[spot] = look.color, True
        wrong[k] = True
        kinds.append(kind)
    return wrong, tuple(kinds)


def off_camera(
    camera: Camera, rng: np.random.Generator, *, degrees: float = 1.0, zoom: float = 0.01, metres: float = 0.01
) -> Camera:
    """Return the camera as a calibration that is off might have it.

    Turned by up to `degrees` about each axis, moved by up to `metres` along each, its focal lengths by up to the share
    `zoom`, and its clock by up to half a frame.
    """
    from dataclasses import replace

    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.radians(rng.uniform(-degrees, degrees, 3))).as_matrix()
    rotation = turn @ np.array(camera.rotation)
    translation = turn @ np.array(camera.translation) + rng.uniform(-metres, metres, 3)
    factor = float(np.exp(rng.uniform(-zoom, zoom)))
    start = camera.start + float(rng.uniform(-0.5, 0.5)) / camera.fps
    rows, shift = tuple(map(triple, rotation)), triple(translation)
    return replace(camera, rotation=rows, translation=shift, fx=camera.fx * factor, fy=camera.fy * factor, start=start)


def check_inside(camera: Camera, points: np.ndarray) -> None:
    """Refuse a camera that sees nothing of a motion (T, V, 3)."""
    pixel, depth = _projected(camera, points.reshape(-1, 3))
    seen = (depth > 1e-2) & (pixel >= 0).all(1) & (pixel < [camera.width, camera.height]).all(1)
    if not seen.any():
        raise InputError(
            f"camera {camera.name}: expected it to see the rope, but no point of it is ever in its picture; check "
            "rotation and translation (world to camera)."
        )
