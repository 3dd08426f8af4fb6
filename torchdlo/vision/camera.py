"""Cameras: where points of the world appear in pictures, with lens distortion, and the file `cameras.json`.

x right, y down, z forward in the frame of a camera; pixel (0, 0) is the centre of the top left one. Distortion has
OpenCV's coefficients. Projection and distortion are kornia's, so they are differentiable in everything.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.field_docs import with_field_docs
from torchdlo.files import write_atomically
from torchdlo.untrusted import one_line, read_json

__all__ = [
    "NEAR",
    "Camera",
    "Lens",
    "back_project",
    "check_name",
    "check_starts",
    "lens",
    "load_cameras",
    "looking_at",
    "project",
    "radial_limit",
    "save_cameras",
    "states_rate",
]

NEAR = 1e-2
"""Depth below which a point counts as behind the camera [m]."""

_DISTORTIONS = (0, 4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV knows."""


@with_field_docs
@dataclass(frozen=True)
class Camera:
    """One calibrated camera at its place."""

    name: str
    """Its name, which files of its films carry."""
    width: int
    """Width of its pictures [px]."""
    height: int
    """Height of its pictures [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    rotation: tuple[tuple[float, float, float], ...]
    """World to camera [1], 3 rows."""
    translation: tuple[float, float, float]
    """World to camera [m]."""
    distortion: tuple[float, ...] = ()
    """Coefficients k1 k2 p1 p2 k3 ... as OpenCV orders them, none for a pinhole."""
    fps: float = 30.0
    """Pictures per second [1/s]; films have their own rate, masks need it."""
    start: float = 0.0
    """When the first picture was taken, on the clock of the recording [s]."""
    starts: dict[str, float] = field(default_factory=dict, hash=False)
    """The same of trials whose films began at times of their own [s]."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Cameras as tensors, with any leading axes, those of views for instance."""

    intrinsics: Tensor
    """Camera matrices [px], shape (..., 3, 3)."""
    distortion: Tensor
    """OpenCV's coefficients [1], shape (..., 5) or more."""
    rotation: Tensor
    """World to camera [1], shape (..., 3, 3)."""
    translation: Tensor
    """World to camera [m], shape (..., 3)."""

    def moved(self, turn: Tensor, shift: Tensor, zoom: Tensor) -> Lens:
        """Return the cameras turned and shifted in their own frames, and zoomed.

        Args:
            turn: rotation vectors [rad], shape (..., 3).
            shift: translations [m], shape (..., 3).
            zoom: logarithms of the factors of focal lengths [1], shape (...).
        """
        from kornia.geometry.liegroup import So3

        turned = So3.exp(turn.reshape(-1, 3)).matrix().reshape(*turn.shape[:-1], 3, 3)
        factor = torch.ones((*zoom.shape, 3, 3), dtype=zoom.dtype)
        factor[..., 0, 0] = factor[..., 1, 1] = torch.exp(zoom)
        translation = (turned @ self.translation[..., None])[..., 0] + shift
        return Lens(self.intrinsics * factor, self.distortion, turned @ self.rotation, translation)


def lens(cameras: Sequence[Camera], dtype: torch.dtype = torch.float64) -> Lens:
    """Return cameras as tensors with one leading axis, shape (C, ...)."""
    most = max(5, *(len(c.distortion) for c in cameras))
    most = next(n for n in _DISTORTIONS if n >= most)
    matrices = [[[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]] for c in cameras]
    padded = [[*c.distortion, *[0.0] * (most - len(c.distortion))] for c in cameras]
    parts = (matrices, padded, [c.rotation for c in cameras], [c.translation for c in cameras])
    return Lens(*(torch.tensor(part, dtype=dtype) for part in parts))


@functools.lru_cache(4096)
def radial_limit(distortion: tuple[float, ...]) -> float:
    """Return how far from the axis a lens's radial distortion keeps the order of points, as a tangent [1].

    Beyond, the polynomial comes back and would show points again in the middle of the picture that no lens does;
    infinite where it never does.

    Args:
        distortion: OpenCV's coefficients.
    """
    k = [*distortion[:2], *distortion[4:8], *[0.0] * 6][:6] if len(distortion) > 2 else [0.0] * 6
    if not any(k):
        return math.inf
    if not all(map(math.isfinite, k)):
        return 0.0
    polynomial = np.polynomial.Polynomial
    over, under, square = polynomial([1.0, *k[:3]]), polynomial([1.0, *k[3:]]), polynomial([0.0, 1.0])
    # In the square of the tangent: where the radius has an extremum, and where it has a pole.
    slope = over * under + 2 * square * (over.deriv() * under - over * under.deriv())
    roots = np.concatenate([slope.trim().roots(), under.trim().roots()])
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return math.sqrt(real.min()) if len(real) else math.inf


def _distorts(view: Lens) -> bool:
    """Return whether distortion counts: where it is not 0, or has a gradient."""
    return view.distortion.requires_grad or bool((view.distortion != 0).any())


def _limits(distortion: Tensor) -> Tensor:
    """Return `radial_limit` of lenses with coefficients (..., n), shape (...)."""
    # Copies of one lens, as those of candidates of a fit, count once.
    rows, which = distortion.detach().reshape(-1, distortion.shape[-1]).unique(dim=0, return_inverse=True)
    limits = distortion.new_tensor([radial_limit(tuple(row)) for row in rows.tolist()])
    return limits[which].reshape(distortion.shape[:-1])


def project(view: Lens, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return where points appear.

    Args:
        view: the cameras, with leading axes (...) that broadcast with those of the points.
        points: in the world [m], shape (..., N, 3).

    Returns:
        Pixels (..., N, 2), and depths [m] (..., N). Depths below `NEAR` are of points that no picture shows: their
        pixels are finite and mean nothing. Points further off the axis than `radial_limit` have depth 0, and pixels in
        their direction.
    """
    from kornia.geometry.calibration import distort_points
    from kornia.geometry.camera.perspective import project_points

    local = points @ view.rotation.transpose(-1, -2) + view.translation[..., None, :]
    depth = local[..., 2]
    front = torch.where((depth < NEAR)[..., None], local.new_tensor([0.0, 0.0, 1.0]), local)
    distorted = _distorts(view)
    if distorted:
        front, depth = _within(front, depth, _limits(view.distortion)[..., None])
    matrix = view.intrinsics.expand(*front.shape[:-2], 3, 3)
    pixel = project_points(front, matrix[..., None, :, :].expand(*front.shape[:-1], 3, 3))
    if distorted:
        count = view.distortion.shape[-1]
        pixel = distort_points(pixel, matrix, view.distortion.expand(*front.shape[:-2], count))
    return pixel, depth


def _within(front: Tensor, depth: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (..., N, 3) drawn in to limits (..., 1), and their depths, 0 where they were beyond."""
    with torch.no_grad():
        off = front[..., :2].norm(dim=-1) / front[..., 2]
        beyond = off > limit
        # Not quite to the limit, which may be a pole.
        share = 0.99 * limit / off.clamp(min=1e-9) / front[..., 2]
        nearer = torch.cat([front[..., :2] * share[..., None], torch.ones_like(front[..., 2:])], -1)
    return torch.where(beyond[..., None], nearer, front), torch.where(beyond, 0.0, depth)


def back_project(view: Lens, pixel: Tensor, depth: Tensor) -> Tensor:
    """Return the points of the world [m], (..., N, 3), that appear at pixels (..., N, 2) with depths [m] (..., N)."""
    from kornia.geometry.calibration import undistort_points

    matrix = view.intrinsics.expand(*pixel.shape[:-2], 3, 3)
    if _distorts(view):
        count = view.distortion.shape[-1]
        pixel = undistort_points(pixel, matrix, view.distortion.expand(*pixel.shape[:-2], count))
    focal = torch.stack([matrix[..., 0, 0], matrix[..., 1, 1]], -1)[..., None, :]
    ray = (pixel - matrix[..., None, :2, 2]) / focal
    local = torch.cat([ray, torch.ones_like(ray[..., :1])], -1) * depth[..., None]
    return (local - view.translation[..., None, :]) @ view.rotation


def looking_at(
    name: str,
    eye: Sequence[float],
    target: Sequence[float],
    *,
    size: tuple[int, int] = (640, 480),
    focal: float = 600.0,
    **others: Any,
) -> Camera:
    """Return a camera at `eye` [m] that looks at `target` [m] with the world's z axis up in its pictures."""
    forward = torch.tensor(target, dtype=torch.float64) - torch.tensor(eye, dtype=torch.float64)
    forward = forward / forward.norm()
    up = torch.tensor([0.0, 0.0, 1.0] if abs(forward[2]) < 0.999 else [0.0, 1.0, 0.0], dtype=torch.float64)
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    translation = -rotation @ torch.tensor(eye, dtype=torch.float64)
    width, height = size
    place = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    turned = tuple(tuple(row) for row in rotation.tolist())
    return Camera(name, width, height, *place, turned, tuple(translation.tolist()), **others)


def save_cameras(cameras: Sequence[Camera], path: Path, *, unknown_rate: Collection[str] = ()) -> None:
    """Write `cameras.json`, without `fps` of cameras whose rate is not known."""
    entries = [
        {k: v for k, v in asdict(c).items() if (k != "starts" or v) and (k != "fps" or c.name not in unknown_rate)}
        for c in cameras
    ]
    content = {"generator": "torchdlo", "cameras": entries}
    write_atomically(path, json.dumps(content, indent=1) + "\n")


def load_cameras(path: str | Path) -> tuple[Camera, ...]:
    """Read `cameras.json`.

    Raises:
        InputError: It is missing, or not as it should be.
    """
    path = Path(path)
    content = read_json(
        path, "the file of the cameras that filmed", cure="torchdlo calibrate-camera writes one", most=2**20
    )
    entries = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not 0 < len(entries) <= 100:
        raise InputError(f'{path}: expected {{"cameras": [...]}} with at least one camera, found something else.')
    if unknown := sorted(set(content) - {"generator", "cameras"}):
        _refuse(path, one_line(unknown[0], 60), "generator and cameras", "an unknown key")
    cameras = tuple(_camera(path, k, entry) for k, entry in enumerate(entries))
    names = [c.name for c in cameras]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: cameras: expected a different name for each, found {', '.join(names)}.")
    return cameras


def check_starts(cameras: Sequence[Camera], trials: Sequence[str], where: str = "") -> None:
    """Refuse `starts` of other trials than these; `where` begins the sentence."""
    for camera in cameras:
        if unknown := sorted(set(camera.starts) - set(trials)):
            raise InputError(
                f"{where}starts of camera {camera.name}: expected names of trials ({', '.join(trials)}), found "
                f"{unknown[0]!r}."
            )


def states_rate(path: str | Path) -> frozenset[str]:
    """Return the names of the cameras of a `cameras.json`, as `load_cameras` reads it, for which `fps` is written."""
    content = read_json(path, "the file of the cameras that filmed", most=2**20)
    return frozenset(entry["name"] for entry in content["cameras"] if "fps" in entry)


_NUMBERS = {"fx": 0.0, "fy": 0.0, "cx": -math.inf, "cy": -math.inf}
_KNOWN = {"name", "width", "height", "fps", "start", "starts", "distortion", "rotation", "translation", *_NUMBERS}


def check_name(name: Any, where: str) -> None:
    """Refuse what cannot be the name of a camera, which names of files hold; `where` begins the sentence."""
    if not isinstance(name, str) or not name.replace("_", "").replace("-", "").isalnum():
        raise InputError(f"{where}: expected letters, digits, - and _, found {one_line(repr(name), 100)}.")


def _camera(path: Path, k: int, entry: Any) -> Camera:
    where = f"cameras[{k}]"
    if not isinstance(entry, dict):
        _refuse(path, where, "an object", repr(entry)[:40])
    for name in entry:
        if name not in _KNOWN:
            _refuse(path, f"{where}.{name}", f"one of {', '.join(sorted(_KNOWN))}", "an unknown key")
    for name in ("name", "width", "height", *_NUMBERS, "rotation", "translation"):
        if name not in entry:
            _refuse(path, f"{where}.{name}", "this entry", "none")
    name = entry["name"]
    check_name(name, f"{path}: {where}.name")
    sizes = [_number(path, f"{where}.{key}", entry[key], 0.0) for key in ("width", "height")]
    if any(s != int(s) or s > 2**15 for s in sizes):
        _refuse(path, f"{where}.width and height", "whole numbers of pixels", f"{sizes[0]:g} x {sizes[1]:g}")
    numbers = [_number(path, f"{where}.{key}", entry[key], low) for key, low in _NUMBERS.items()]
    distortion = tuple(_row(path, f"{where}.distortion", entry.get("distortion") or [], None))
    if len(distortion) not in _DISTORTIONS:
        _refuse(path, f"{where}.distortion", "0, 4, 5, 8, 12 or 14 numbers as OpenCV has them", f"{len(distortion)}")
    rotation = entry["rotation"]
    if not isinstance(rotation, list) or len(rotation) != 3:
        _refuse(path, f"{where}.rotation", "3 rows of 3 numbers", repr(rotation)[:60])
    rows = tuple(triple(_row(path, f"{where}.rotation", row, 3)) for row in rotation)
    turn = torch.tensor(rows, dtype=torch.float64)
    if float((turn @ turn.T - torch.eye(3, dtype=turn.dtype)).abs().max()) > 1e-3 or float(torch.linalg.det(turn)) < 0:
        _refuse(path, f"{where}.rotation", "a rotation matrix, world to camera", "one that is not a rotation")
    shift = triple(_row(path, f"{where}.translation", entry["translation"], 3))
    fps = _number(path, f"{where}.fps", entry.get("fps", 30.0), 0.0)
    start = _number(path, f"{where}.start", entry.get("start", 0.0), -math.inf)
    starts = entry.get("starts", {})
    if not isinstance(starts, dict):
        _refuse(path, f"{where}.starts", 'seconds by trial, as {"train_0": 0.2}', repr(starts)[:60])
    own = {trial: _number(path, f"{where}.starts.{trial}", value, -math.inf) for trial, value in starts.items()}
    fx, fy, cx, cy = numbers
    return Camera(name, int(sizes[0]), int(sizes[1]), fx, fy, cx, cy, rows, shift, distortion, fps, start, own)


def triple(numbers: Iterable[float]) -> tuple[float, float, float]:
    """Return three numbers as a tuple."""
    x, y, z = map(float, numbers)
    return x, y, z


def _row(path: Path, where: str, value: Any, count: int | None) -> list[float]:
    if not isinstance(value, list) or (count is not None and len(value) != count):
        _refuse(path, where, "a list of numbers" if count is None else f"{count} numbers", repr(value)[:60])
    return [_number(path, where, x, -math.inf) for x in value]


def _number(path: Path, where: str, value: Any, above: float) -> float:
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value) and value > above
    if not good:
        _refuse(path, where, "a finite number" + (f" above {above:g}" if above > -math.inf else ""), repr(value)[:40])
    return float(value)


def _refuse(path: Path, where: str, expected: str, found: str) -> NoReturn:
    raise InputError(f"{path}: {where}: expected {expected}, found {one_line(found, 100)}.")
