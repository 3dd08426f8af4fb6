"""What a recording folder must look like, and the sentence for each way in which it may not.

Every message names the file and the entry, then what was expected, what was found and, where it
is not obvious, how to mend it.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.recordings.trial_checks import check_clamps, check_markers, check_time, check_wrench
from torchdlo.sysid.recordings.wrench import FRAMES, ForceSensor
from torchdlo.sysid.video.films import photographs
from torchdlo.untrusted import check_path, one_line, read_json
from torchdlo.untrusted.array_file import Header, read_arrays

__all__ = ["OPTIONAL", "REQUIRED", "check_arrays", "check_rope", "read_trial", "trial_files"]

REQUIRED = ("length", "radius", "mass", "gravity", "table_height", "marker_noise_std")
"""Entries that every rope.json has."""
OPTIONAL = ("rest_positions", "marker_mass", "closed", "notes", "color", "fluid_density", "wrench")
"""Entries that a rope.json may have."""

_FRAMES = 5
"""Frames of a motion at least: what markers say of noise, lag and speed takes as many."""
_FILMED_FRAMES = 3
"""The same of films."""

_ARRAYS = ("time", "markers", "marker_arclength", "gripped")
_OPTIONAL_ARRAYS = ("gripper_quaternion", "gripper_marker", "suspect", "wrench", "wrench_marker")
_VIDEO_ARRAYS = ("masks", "mask", "video", "frames", "images")
_FLOATS = ("time", "markers", "marker_arclength", "gripper_quaternion", "wrench")


def trial_files(path: Path) -> dict[str, list[Path]]:
    """The trials of a recording folder by split."""
    if not path.exists():
        raise InputError(f"{path}: expected a recording folder, found nothing there.")
    if not path.is_dir():
        raise InputError(f"{path}: expected a recording folder with rope.json and .npz trials, found a file.")
    if not (path / "rope.json").is_file():
        raise InputError(
            f"{path / 'rope.json'}: expected this file with the rope's length, mass and so on, "
            "found none; is this a recording folder?"
        )
    # Those with a second part in their names are masks of a camera.
    files = {split: sorted(f for f in path.glob(f"{split}_*.npz") if "." not in f.stem) for split in ("train", "test")}
    for file in (f for split in files.values() for f in split):
        check_path(file.name, "name of a trial")
    for split, purpose in (("train", "fit on"), ("test", "judge on")):
        # Of a single photograph stretches of the rope are left out to judge on.
        if not files[split] and not (split == "test" and photographs(path)):
            raise InputError(
                f"{path}: expected at least one trial {split}_*.npz to {purpose}, found none; "
                f"rename one of your trials to {split}_0.npz."
            )
    return files


def check_rope(path: Path) -> dict[str, Any]:
    """Read rope.json; what is absent or null becomes None (closed: False, notes: "")."""
    rope = _read_object(path)
    _check_names(path, rope, REQUIRED, OPTIONAL, "key")
    checked: dict[str, Any] = {
        "length": _number(path, rope, "length", "m", positive=True, high=1e4),
        "mass": _number(path, rope, "mass", "kg", positive=True, high=1e5),
        "radius": _number(path, rope, "radius", "m", positive=True, high=1e3, optional=True),
        "table_height": _number(path, rope, "table_height", "m", low=-1e4, high=1e4, optional=True),
        "marker_mass": _number(path, rope, "marker_mass", "kg", low=0.0, high=1e3, optional=True),
        "marker_noise_std": _number(path, rope, "marker_noise_std", "m", low=0.0, high=1.0, optional=True),
        "fluid_density": _number(path, rope, "fluid_density", "kg/m^3", positive=True, high=2e4, optional=True),
        "gravity": _positions(path, rope, "gravity", (3,), "[gx, gy, gz] in m/s^2", most=1e3),
        "rest_positions": None,
        "closed": rope.get("closed") or False,
        "notes": rope.get("notes") or "",
    }
    if rope.get("rest_positions") is not None:
        wanted = "a list of [x, y, z] in m, one for each marker"
        checked["rest_positions"] = _positions(path, rope, "rest_positions", (-1, 3), wanted)
    checked["color"] = _color(path, rope.get("color"))
    checked["wrench"] = _sensor(path, rope.get("wrench"))
    for name, kind, said in (("closed", bool, "true or false"), ("notes", str, "a text")):
        if not isinstance(checked[name], kind):
            _refuse(path, name, said, repr(checked[name]))
    if checked["fluid_density"] is not None and checked["radius"] is None:
        _refuse(path, "radius", "a number in m, as the rope displaces a liquid", "none")
    if checked["radius"] is not None and checked["radius"] > 0.5 * checked["length"]:
        found = f"{checked['radius']:g} m for a rope of {checked['length']:g} m"
        _refuse(path, "radius", "at most half the length", f"{found}; the unit is metres")
    return checked


def _sensor(path: Path, value: Any) -> ForceSensor | None:
    """Return how forces were measured."""
    if value is None:
        return None
    if not isinstance(value, dict):
        _refuse(path, "wrench", "an object with frame and force_noise_std", _kind(value))
    _check_names(path, value, ("frame", "force_noise_std"), ("torque_noise_std", "force_bias_std"), "entry of wrench")
    if value["frame"] not in FRAMES:
        _refuse(path, "wrench.frame", " or ".join(FRAMES), repr(value["frame"]))
    force = _number(path, value, "force_noise_std", "N", positive=True, high=1e3)
    torque = _number(path, value, "torque_noise_std", "N m", positive=True, high=1e3, optional=True)
    bias = _number(path, value, "force_bias_std", "N", low=0.0, high=1e3, optional=True)
    return ForceSensor(value["frame"], force or 0.0, torque, bias or 0.0)


def _color(path: Path, value: Any) -> tuple[float, float, float] | None:
    """Return a colour given as [r, g, b] or as an object with `rgb`."""
    if value is None:
        return None
    rgb = value.get("rgb") if isinstance(value, dict) else value
    rgb = rgb if isinstance(rgb, list) else []
    good = all(isinstance(c, (int, float)) and not isinstance(c, bool) and 0 <= c <= 255 for c in rgb)
    if len(rgb) != 3 or not good:
        _refuse(path, "color", "[r, g, b] from 0 to 255", repr(value)[:60])
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


def read_trial(path: Path, *, filmed: bool = False) -> dict[str, np.ndarray]:
    """Read the arrays of a trial; names and shapes are checked before anything is inflated.

    Args:
        path: the file.
        filmed: whether cameras saw the rope: then markers are those at the grippers only.
    """

    def check(headers: Mapping[str, Header]) -> None:
        for name in _VIDEO_ARRAYS:
            if name in headers:
                raise InputError(
                    f"{path}: {name}: expected films and masks beside the trial, as {path.stem}.CAMERA.mp4, .npz or a "
                    "folder of PNG files, with cameras.json, found them in it."
                )
        _check_names(path, headers, _ARRAYS, _OPTIONAL_ARRAYS, "array")
        for name in _FLOATS:
            if name in headers and headers[name].dtype.kind not in "fiu":
                _refuse(path, name, "dtype float", f"{headers[name].dtype}")
        _check_shapes(path, headers, 1 if filmed else 3)

    return read_arrays(path, "a trial", check=check)


def check_arrays(path: Path, arrays: dict[str, np.ndarray], length: float, *, filmed: bool = False) -> dict[str, Any]:
    """Check the arrays of one trial, and return them by the names of Trial's fields.

    Args:
        path: the file.
        arrays: by their names.
        length: of the rope [m].
        filmed: whether cameras saw the rope: then markers are those at the grippers only.
    """
    for name in _FLOATS:
        if name in arrays:
            arrays[name] = _as_float(path, name, arrays[name])
    suspect = arrays.get("suspect", np.zeros(len(arrays["time"]), dtype=bool))
    check_time(path, arrays["time"])
    check_markers(path, arrays, suspect, length, filmed=filmed)
    check_clamps(path, arrays)
    check_wrench(path, arrays)
    optional = {name: arrays.get(name) for name in ("gripper_quaternion", "gripper_marker", "wrench", "wrench_marker")}
    return {name: arrays[name] for name in _ARRAYS} | optional | {"suspect": suspect}


def _check_shapes(path: Path, arrays: Mapping[str, Header], fewest: int) -> None:
    markers, time = arrays["markers"], arrays["time"]
    if len(markers.shape) != 3 or markers.shape[-1] != 3:
        _refuse(path, "markers", "shape (frames, markers, 3)", f"{markers.shape}")
    n_frames, n_markers = markers.shape[:2]
    if time.shape != (n_frames,):
        _refuse(path, "time", f"shape ({n_frames},), one for each frame", f"{time.shape}")
    filmed = fewest == 1
    least = _FILMED_FRAMES if filmed else _FRAMES
    if n_frames < least and not (filmed and n_frames == 1):
        _refuse(path, "markers", f"at least {least} frames" + ", or 1 of a rope at rest" * filmed, f"{n_frames}")
    if n_markers < fewest:
        _refuse(path, "markers", f"at least {fewest} marker{'s' if fewest > 1 else ''}", f"{n_markers}")
    for name, size, each in (
        ("marker_arclength", n_markers, "marker"),
        ("gripped", n_markers, "marker"),
        ("suspect", n_frames, "frame"),
    ):
        if name in arrays and arrays[name].shape != (size,):
            _refuse(path, name, f"shape ({size},), one for each {each}", f"{arrays[name].shape}")
    for name in ("gripped", "suspect"):
        if name in arrays and arrays[name].dtype != bool:
            _refuse(path, name, "dtype bool", f"{arrays[name].dtype}; use .astype(bool)")


def _as_float(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    array = array.astype(np.float64)
    if np.isinf(array).any():
        place = ", ".join(str(int(i)) for i in np.argwhere(np.isinf(array))[0])
        _refuse(path, name, "finite numbers", f"infinity at index ({place})")
    if name not in ("markers", "wrench") and np.isnan(array).any():
        place = ", ".join(str(int(i)) for i in np.argwhere(np.isnan(array))[0])
        _refuse(path, name, "finite numbers", f"NaN at index ({place})")
    return array


def _read_object(path: Path) -> dict[str, Any]:
    rope = read_json(path, "length, mass and so on of a rope")
    if not isinstance(rope, dict):
        raise InputError(f"{path}: expected a JSON object with length, mass and so on, found {_kind(rope)}.")
    return rope


def _check_names(
    path: Path,
    given: Collection[str],
    required: Collection[str],
    optional: Collection[str],
    kind: str,
) -> None:
    """Refuse unknown names, with a suggestion, and then missing ones."""
    known = [*required, *optional]
    for name in given:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}."
            raise InputError(f"{path}: {name}: unknown {kind}; {hint}")
    missing = [name for name in required if name not in given]
    if missing:
        raise InputError(
            f"{path}: {', '.join(missing)}: expected, but missing; {kind}s found: {', '.join(given) or 'none'}."
        )


def _number(
    path: Path,
    rope: dict[str, Any],
    name: str,
    unit: str,
    *,
    positive: bool = False,
    low: float = -math.inf,
    high: float = math.inf,
    optional: bool = False,
) -> float | None:
    value = rope.get(name)
    if value is None and optional:
        return None
    bound = " above 0" if positive else (f" of at least {low:g}" if low > -math.inf else "")
    above = isinstance(value, (int, float)) and value > high
    limit = f" and at most {high:g}" if above and bound else f" of at most {high:g}" if above else ""
    expected = f"a finite number{bound}{limit} in {unit}" + (" or null" if optional else "")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        _refuse(path, name, expected, _kind(value))
    number = float(value)
    if not math.isfinite(number) or not low <= number <= high or (positive and number <= 0):
        _refuse(path, name, expected, f"{number:g}")
    return number


def _positions(
    path: Path, rope: dict[str, Any], name: str, shape: tuple[int, ...], expected: str, *, most: float = 1e9
) -> np.ndarray:
    try:
        array = np.array(rope[name])
    except ValueError:
        _refuse(path, name, expected, "rows of different lengths")
    if array.dtype.kind not in "fiu":
        _refuse(path, name, expected, _kind(rope[name]) if array.ndim == 0 else "other values")
    if array.ndim != len(shape) or array.shape[-1] != shape[-1]:
        _refuse(path, name, expected, f"shape {array.shape}")
    if not np.isfinite(array).all():
        _refuse(path, name, expected, "a number that is not finite")
    if np.abs(array.astype(float)).max(initial=0.0) > most:
        _refuse(path, name, f"{expected}, at most {most:g}", f"{np.abs(array.astype(float)).max():g}")
    return array.astype(np.float64)


def _kind(value: object) -> str:
    if isinstance(value, str):
        return f"the text {value!r}"
    names = {dict: "an object", list: "a list", bool: "true or false", type(None): "null"}
    return names.get(type(value), f"{value!r}")


def _refuse(path: Path, name: str, expected: str, found: str) -> NoReturn:
    raise InputError(f"{path}: {name}: expected {expected}, found {one_line(found, 100)}.")
