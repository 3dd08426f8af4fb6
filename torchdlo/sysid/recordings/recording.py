"""Measured recordings: the folder format, read and written; numpy's border to the outside.

A folder holds `rope.json` and one `.npz` per trial, `train_*.npz` to fit on and `test_*.npz` to
judge on. SI units, world frame with z up. What is wrong with a folder is said in one sentence.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchdlo.errors import InputError
from torchdlo.field_docs import with_field_docs
from torchdlo.files import replace_atomically
from torchdlo.physics import tree
from torchdlo.sysid.recordings import rope_schema
from torchdlo.sysid.recordings.wrench import ForceSensor
from torchdlo.sysid.video.films import FilmFile, film_files, held_still, with_stations
from torchdlo.untrusted import check_path

__all__ = [
    "Recording",
    "Trial",
    "check_new_folder",
    "load_recording",
    "save_recording",
    "save_trial",
]


@with_field_docs
@dataclass(frozen=True, eq=False)
class Trial:
    """One motion of the rope with its grippers, as measured."""

    name: str
    """Name of the file without suffix, for instance `train_0`."""
    time: np.ndarray
    """Times of the frames [s], starting at 0 in even steps, shape (F,)."""
    markers: np.ndarray
    """Marker positions in the world frame [m], NaN where not seen, shape (F, M, 3)."""
    marker_arclength: np.ndarray
    """Places of the markers along the undeformed rope from its first marker [m], shape (M,)."""
    gripped: np.ndarray
    """Markers on pieces held by a gripper, whose motion is the input, shape (M,) bool."""
    gripper_quaternion: np.ndarray | None
    """Orientations (w, x, y, z) of the clamps, clamp to world [-], shape (F, G, 4), if measured."""
    gripper_marker: np.ndarray | None
    """Index of the outermost marker of each clamp, shape (G,) int, given with the quaternions."""
    suspect: np.ndarray
    """Frames not to trust, shape (F,) bool."""
    films: tuple[FilmFile, ...] = ()
    """Films of it, if cameras saw the rope instead of markers: then free markers are places that were not seen."""
    wrench: np.ndarray | None = None
    """Force [N] and torque about its marker [N m] that each gripper exerts on the rope, in the frame that rope.json
    says, NaN where not measured, shape (F, W, 6)."""
    wrench_marker: np.ndarray | None = None
    """A gripped marker of each gripper whose force was measured, shape (W,) int."""
    still: bool = False
    """Whether it is a rope at rest, of which there are photographs: its frames are all the same."""
    stretches: Literal["all", "even", "odd"] = "all"
    """Which stretches along the rope count of its photographs: where there are no others, some are left out."""


@with_field_docs
@dataclass(frozen=True, eq=False)
class Recording:
    """A rope and all its trials."""

    path: Path
    """The folder it was read from."""
    length: float
    """Length of the rope [m]."""
    radius: float | None
    """Radius of the rope [m], None where not known."""
    mass: float
    """Mass of the rope [kg]."""
    gravity: np.ndarray
    """Acceleration of gravity in the world frame [m/s^2], shape (3,)."""
    table_height: float | None
    """Height of the table [m], None where there is none."""
    marker_noise_std: float | None
    """Standard deviation of the marker noise per coordinate [m], None where not known."""
    rest_positions: np.ndarray | None
    """Markers of the rope lying undeformed on a table [m], shape (M, 3), None: straight."""
    marker_mass: float | None
    """Mass of one marker [kg], None where not given."""
    closed: bool
    """Whether the rope is a loop."""
    notes: str
    """Free text."""
    train: tuple[Trial, ...]
    """Trials to fit on."""
    test: tuple[Trial, ...]
    """Trials to judge on, never to fit on."""
    color: tuple[float, float, float] | None = None
    """Colour of the rope, RGB from 0 to 255, None where not known."""
    fluid_density: float | None = None
    """Density of the liquid in which the rope moves [kg/m^3], None in air."""
    wrench: ForceSensor | None = None
    """How forces at the grippers were measured, None if they were not."""

    @property
    def filmed(self) -> bool:
        """Whether cameras saw the rope, not markers on it."""
        return bool(self.train[0].films)

    @property
    def still(self) -> bool:
        """Whether it is of ropes at rest, seen in photographs."""
        return self.train[0].still

    def trials(self, split: str | tuple[str, ...]) -> tuple[Trial, ...]:
        """Return the trials of a split: "train", "test", or "all", those to fit on first; or those of these names."""
        splits = {"train": self.train, "test": self.test, "all": self.train + self.test}
        if isinstance(split, str):
            return splits[split]
        named = {t.name: t for t in splits["all"]}
        return tuple(named[name] for name in split)


def load_recording(path: str | Path, *, films: bool = True) -> Recording:
    """Read and check a recording folder.

    Args:
        path: the folder.
        films: whether films will do in the place of markers.

    Raises:
        InputError: The folder or a file in it is not as the format says.
    """
    path = Path(path)
    files = rope_schema.trial_files(path)
    rope = rope_schema.check_rope(path / "rope.json")
    found = film_files(path, [f.stem for split in files.values() for f in split])
    if found and not films:
        raise InputError(
            f"{path}: expected markers, found films; this command does not take those yet, calibrate and diagnose do."
        )
    trials: dict[str, Any] = {
        split: tuple(_load_trial(f, rope["length"], found) for f in files[split]) for split in files
    }
    _check_together(path, rope, trials["train"] + trials["test"])
    if not trials["test"]:
        trials["test"] = tuple(replace(t, name=f"{t.name}_left_out", stretches="odd") for t in trials["train"])
        trials["train"] = tuple(replace(t, stretches="even") for t in trials["train"])
    return Recording(path=path, **rope, **trials)


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording as a new folder that appears complete or not at all."""
    path = Path(path)
    check_new_folder(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        # mkdtemp makes a private folder; a recording is as readable as any other file.
        temporary.chmod(0o755)
        rope = {name: _to_json(getattr(recording, name)) for name in rope_schema.REQUIRED}
        for name in rope_schema.OPTIONAL:
            value = _to_json(getattr(recording, name))
            if value not in (None, False, ""):
                rope[name] = value
        (temporary / "rope.json").write_text(json.dumps(rope, indent=1) + "\n")
        for trial in recording.train + recording.test:
            save_trial(temporary / f"{trial.name}.npz", trial)
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_new_folder(path: Path) -> None:
    """Refuse a path at which something is already, or that could not be written down."""
    check_path(path.absolute(), "path to write to")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path}: exists and is not an empty folder; choose a new one.")


def save_trial(path: str | Path, trial: Trial) -> None:
    """Write one trial; the file appears complete or not at all."""
    arrays: dict[str, Any] = {
        "time": trial.time,
        "markers": trial.markers,
        "marker_arclength": trial.marker_arclength,
        "gripped": trial.gripped,
        "suspect": trial.suspect,
    }
    if trial.gripper_quaternion is not None and trial.gripper_marker is not None:
        arrays["gripper_quaternion"] = trial.gripper_quaternion
        arrays["gripper_marker"] = trial.gripper_marker
    if trial.wrench is not None and trial.wrench_marker is not None:
        arrays |= {"wrench": trial.wrench, "wrench_marker": trial.wrench_marker}
    with replace_atomically(Path(path)) as temporary:
        np.savez_compressed(temporary, **arrays)


def _load_trial(path: Path, length: float, films: Mapping[str, tuple[FilmFile, ...]]) -> Trial:
    own = films.get(path.stem, ())
    read = rope_schema.read_trial(path, filmed=bool(own))
    arrays: dict[str, Any] = rope_schema.check_arrays(path, read, length, filmed=bool(own))
    trial = Trial(name=path.stem, **arrays, films=own)
    return with_stations(held_still(trial), length) if own else trial


def _check_together(path: Path, rope: dict, trials: tuple[Trial, ...]) -> None:
    """What only several files together can tell: they must be of the same rope."""
    first = trials[0]
    moving = [t.name for t in trials if not t.still]
    if moving and len(moving) < len(trials):
        raise InputError(f"{path}: expected films or photographs, found both; {moving[0]} is no rope at rest.")
    n_markers = len(first.marker_arclength)
    for trial in trials[1:]:
        if len(trial.marker_arclength) != n_markers:
            raise InputError(
                f"{path / trial.name}.npz: markers: expected {n_markers} markers as in "
                f"{first.name}.npz, found {len(trial.marker_arclength)}; all trials of a recording "
                "must be of the same rope and markers."
            )
        for name in ("gripped", "marker_arclength"):
            if not np.allclose(getattr(trial, name), getattr(first, name)):
                raise InputError(
                    f"{path / trial.name}.npz: {name}: expected the same as in {first.name}.npz, found other values; "
                    "put trials with other grips into a recording of their own."
                )
    if rope["closed"]:
        raise InputError(
            f"{path / 'rope.json'}: closed: expected false or none, found true; loops cannot be calibrated yet."
        )
    _check_sensors(path, rope, trials)
    rest = rope["rest_positions"]
    if rest is not None and len(rest) != n_markers:
        raise InputError(
            f"{path / 'rope.json'}: rest_positions: expected one position for each of the "
            f"{n_markers} markers, found {len(rest)}."
        )
    if rest is not None and np.ptp(rest, axis=0).max() > 2 * rope["length"]:
        raise InputError(
            f"{path / 'rope.json'}: rest_positions: expected metres, found positions "
            f"{np.ptp(rest, axis=0).max():g} apart for a rope of {rope['length']:g} m."
        )


def _check_sensors(path: Path, rope: dict, trials: tuple[Trial, ...]) -> None:
    """Forces must say how they were measured, and be of the same grippers in the same order."""
    for trial in trials:
        if trial.wrench is not None and rope["wrench"] is None:
            raise InputError(
                f"{path / 'rope.json'}: wrench: expected frame and noise of the forces in {trial.name}.npz, found none."
            )
        if trial.wrench is not None and rope["wrench"].frame == "gripper":
            known = () if trial.gripper_marker is None else trial.gripper_marker
            lacking = np.setdiff1d(tree.part(trial.wrench_marker), known)
            if len(lacking):
                raise InputError(
                    f"{path / trial.name}.npz: gripper_quaternion: expected orientations of all grippers, as forces "
                    f"are in their frames, found none for marker {lacking[0]}; give it, or forces in the world frame."
                )
    felt = [t for t in trials if t.wrench is not None]
    for trial in felt[1:]:
        first, own = (tree.part(t.wrench_marker).tolist() for t in (felt[0], trial))
        if own != first:
            raise InputError(
                f"{path / trial.name}.npz: wrench_marker: expected {first} as in {felt[0].name}.npz, found {own}; "
                "give the forces of the same grippers in the same order, NaN where one was not measured."
            )


def _to_json(value: object) -> object:
    if isinstance(value, ForceSensor):
        return asdict(value)
    return value.tolist() if isinstance(value, np.ndarray) else value
