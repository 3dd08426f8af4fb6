"""Films of a recording: the files beside its trials, and the places of the rope that a filmed trial is simulated at.

A filmed trial has markers at its grippers only; what cameras see of the rope stands in `TRIAL.CAMERA.mp4`, in masks
`TRIAL.CAMERA.npz`, or in a folder `TRIAL.CAMERA` of PNG files, and `cameras.json` tells where the cameras were.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchdlo.errors import InputError

if TYPE_CHECKING:
    from torchdlo.sysid.recordings.recording import Trial
    from torchdlo.vision.camera import Camera

__all__ = ["FILMS", "STATIONS", "FilmFile", "film_files", "held_still", "photographs", "with_stations"]

STATIONS = 41
"""Places along a filmed rope that are compared with its films."""

_PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
FILMS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
"""Endings of films, which say when their pictures were taken."""

_SUFFIXES = (*FILMS, *_PHOTOGRAPHS, ".npz")

_STILL_FRAMES, _STILL_STEP = 5, 5e-3
"""Frames of a simulated rope at rest, and the time between them [s]."""


@dataclass(frozen=True)
class FilmFile:
    """What one camera saw of one trial."""

    camera: Camera
    """The camera, as it was calibrated."""
    path: Path
    """Film, masks, or a folder of pictures."""
    rate_stated: bool = True
    """Whether `cameras.json` says how many pictures per second there are."""


def photographs(path: Path) -> list[Path]:
    """Return the photographs beside trials of a recording folder."""
    return sorted(f for f in path.glob("t*_*.*") if f.suffix.lower() in _PHOTOGRAPHS and f.is_file())


def held_still(trial: Trial) -> Trial:
    """Return a trial of one frame, a rope at rest, as one that lasts for a moment.

    Raises:
        InputError: It has a film that lasts, or one frame has been photographed of many.
    """
    still = len(trial.time) == 1
    for film in trial.films:
        photo = film.path.suffix.lower() in _PHOTOGRAPHS
        if photo and not still:
            raise InputError(
                f"{film.path}: expected one frame in {trial.name}.npz beside a photograph, a rope at rest, found "
                f"{len(trial.time)}."
            )
    if not still:
        return trial
    names = ("markers", "suspect", "gripper_quaternion", "wrench")
    parts: dict[str, Any] = {n: getattr(trial, n) for n in names if getattr(trial, n) is not None}
    repeated: dict[str, Any] = {n: np.repeat(x, _STILL_FRAMES, 0) for n, x in parts.items()}
    return replace(trial, time=_STILL_STEP * np.arange(_STILL_FRAMES), **repeated, still=True)


def film_files(path: Path, trials: Sequence[str]) -> dict[str, tuple[FilmFile, ...]]:
    """Return the films of each trial of a recording folder; none where it has markers.

    Raises:
        InputError: Films and cameras do not fit each other.
    """
    found = [
        f
        for f in sorted(path.iterdir())
        if f.name.startswith(("train_", "test_")) and "." in f.name.removesuffix("" if f.is_dir() else f.suffix)
        if f.is_dir() or f.suffix.lower() in _SUFFIXES
    ]
    bare = [
        f
        for f in sorted(path.iterdir())
        if f.name.startswith(("train_", "test_")) and f.suffix.lower() in _SUFFIXES[:-1] and f not in found
    ]
    if bare:
        raise InputError(
            f"{bare[0]}: expected the camera's name in the film's, as in {bare[0].stem}.a.mp4, found none."
        )
    if not found and not (path / "cameras.json").is_file():
        return {}
    # Only films need torch, which takes seconds to start.
    from torchdlo.vision.camera import check_starts, load_cameras, states_rate

    cameras = {c.name: c for c in load_cameras(path / "cameras.json")}
    stated = states_rate(path / "cameras.json")
    films: dict[str, list[FilmFile]] = {name: [] for name in trials}
    check_starts(list(cameras.values()), trials, f"{path / 'cameras.json'}: ")
    for file in found:
        trial, _, name = (file.name if file.is_dir() else file.stem).partition(".")
        if name not in cameras:
            raise InputError(
                f"{file}: expected the name of a camera of cameras.json ({', '.join(cameras)}), found {name!r}."
            )
        if trial not in films:
            raise InputError(f"{file}: expected {trial}.npz with the motion of the grippers beside it, found none.")
        if any(f.camera.name == name for f in films[trial]):
            raise InputError(f"{file}: expected one film of each trial and camera, found two.")
        camera = cameras[name]
        camera = replace(camera, start=camera.starts.get(trial, camera.start))
        films[trial].append(FilmFile(camera, file, name in stated))
    for trial, own in films.items():
        if not own:
            raise InputError(
                f"{path / trial}.npz: expected a film {trial}.{next(iter(cameras))}.mp4 of it, found none."
            )
    first = next(iter(films))
    names = {trial: sorted(f.camera.name for f in own) for trial, own in films.items()}
    for trial, seen in names.items():
        if seen != names[first]:
            raise InputError(
                f"{path / trial}.npz: expected films of the cameras {', '.join(names[first])} as {first} has, found "
                f"{', '.join(seen)}; trials are judged with the cameras that others were fitted with."
            )
    return {trial: tuple(sorted(own, key=lambda f: f.camera.name)) for trial, own in films.items()}


def with_stations(trial: Trial, length: float) -> Trial:
    """Return a filmed trial with free places along the rope, never seen as markers, that films are compared with."""
    held = trial.marker_arclength.astype(float)
    ends = [0.0, *held, length] if held[0] > 1e-6 * length else [*held, length]
    step, free = length / (STATIONS - 1), []
    # Clamps themselves are between neighbouring markers: those of one are closer than those of two.
    widest = max(b - a for a, b in itertools.pairwise(ends))
    for a, b in itertools.pairwise(ends):
        if b - a > max(1.5 * step, 0.2 * widest):
            count = max(2, round((b - a) / step))
            inner = np.linspace(a, b, count + 1)
            first = 0 if a == 0.0 and held[0] > 1e-6 * length else 1
            last = count + 1 if b == length and held[-1] < length * (1 - 1e-6) else count
            free += inner[first:last].tolist()
    place = np.concatenate([held, free])
    order = np.argsort(place, kind="stable")
    blank = np.full((len(trial.time), len(free), 3), np.nan)
    markers = np.concatenate([trial.markers.astype(float), blank], 1)[:, order]
    gripped = np.concatenate([trial.gripped, np.zeros(len(free), bool)])[order]
    clamp = trial.gripper_marker
    if clamp is not None:
        clamp = np.array([int(np.flatnonzero(order == m)[0]) for m in clamp])
    quaternion = trial.gripper_quaternion
    if quaternion is not None:
        quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return replace(
        trial,
        markers=markers,
        marker_arclength=place[order],
        gripped=gripped,
        gripper_marker=clamp,
        gripper_quaternion=quaternion,
    )
