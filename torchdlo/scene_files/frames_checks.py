"""Whether the arrays of a frames file are a run: shapes that fit each other, and numbers that can be drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from torchdlo.coupling.bodies.shape_sdf import SIZES
from torchdlo.errors import InputError
from torchdlo.untrusted import one_line
from torchdlo.untrusted.array_file import Header

__all__ = ["check_headers", "check_values", "none_of"]

_SHAPES: dict[str, tuple[str | int, ...]] = {
    "time": ("frames",),
    "pos": ("frames", "vertices", 3),
    "twist": ("frames", "vertices"),
    "force": ("frames", "held vertices", 3),
    "joint_force": ("frames", "joints", 3),
    "body_pos": ("frames", "bodies", 3),
    "body_quat": ("frames", "bodies", 4),
    "material_points": ("frames", "material points", 3),
    "rope": ("vertices",),
    "closed": ("ropes",),
    "radius": ("vertices",),
    "weight": ("vertices",),
    "body_shape": ("bodies",),
    "body_size": ("bodies", 3),
    "body_motion": ("bodies",),
    "mesh_vertices": ("vertices of meshes", 3),
    "mesh_faces": ("triangles", 3),
    "mesh_body": ("triangles",),
    "constitutive_model": ("material points",),
    "table": ("tables",),
    "camera_direction": (3,),
    "tension": ("frames", "vertices"),
    "curvature": ("frames", "vertices", 3),
    "twist_density": ("frames", "vertices"),
    "bending_moment": ("frames", "vertices", 3),
    "contact_force": ("frames", "vertices", 3),
    "body_contact_force": ("frames", "bodies", 3),
    "kinetic_energy": ("frames",),
    "gravitational_energy": ("frames",),
    "bending_energy": ("frames",),
    "twisting_energy": ("frames",),
    "body_kinetic_energy": ("frames",),
    "body_gravitational_energy": ("frames",),
}
_KINDS = {
    "rope": "iu",
    "mesh_faces": "iu",
    "mesh_body": "iu",
    "closed": "b",
    "body_shape": "U",
    "body_motion": "U",
    "constitutive_model": "U",
}
"""Kinds of types of arrays that are not of floats."""
_WORDS = {
    "body_shape": (*SIZES, "plane", "mesh"),
    "body_motion": ("free", "fixed", "kinematic", "robot"),
    "constitutive_model": ("elastic", "plastic", "liquid", "sand"),
}
_FARTHEST = 1e6
"""Largest number that can be drawn [m]."""
_LARGEST = 1e30
"""Largest number of what is only read, forces and energies among it."""
_READ = ("force", "joint_force", *list(_SHAPES)[list(_SHAPES).index("tension") :])
"""What is only read."""


def none_of(name: str, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return an array that a file lacks: no frames of it, or all frames of nothing."""
    counts = {"vertices": len(arrays["rope"]), "bodies": len(arrays["body_shape"]), "joints": 0}
    shape = [said if isinstance(said, int) else counts[said] for said in _SHAPES[name][1:]]
    return np.zeros((0 if all(shape) else len(arrays["time"]), *shape))


def check_headers(file: Path, headers: Mapping[str, Header], stored: Mapping[str, str]) -> None:
    """Check types and shapes before anything is read.

    Args:
        file: the file.
        headers: what it says of its arrays.
        stored: names in the file by those of today.
    """
    counts: dict[str, int] = {}
    for name, shape in ((name, _SHAPES[name]) for name in _SHAPES if name in stored):
        found, here = headers[stored[name]], f"{file}: {stored[name]}"
        kinds = _KINDS.get(name, "f")
        if found.dtype.kind not in kinds:
            what = {"iu": "whole numbers", "b": "true or false", "U": "texts", "f": "numbers with a point"}[kinds]
            raise InputError(f"{here}: expected {what}, found {found.dtype}; simulate the scene again.")
        expected = ", ".join(str(counts.get(str(n), n)) for n in shape)
        if len(found.shape) != len(shape):
            raise InputError(f"{here}: expected shape ({expected}), found {found.shape}; simulate the scene again.")
        for said, count in zip(shape, found.shape, strict=True):
            wanted = said if isinstance(said, int) else counts.setdefault(said, count)
            if count != wanted:
                raise InputError(f"{here}: expected shape ({expected}), found {found.shape}; simulate the scene again.")
    for name in ("frames", "vertices", "ropes"):
        if not counts[name]:
            raise InputError(f"{file}: expected at least one of {name}, found none; simulate the scene again.")


def check_values(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Check what the arrays hold: finite numbers, words that are known, and indices of what there is."""
    for name, array in arrays.items():
        most = _LARGEST if name in _READ else _FARTHEST
        if array.dtype.kind == "f" and array.size and not np.abs(array).max() <= most:
            place = np.argwhere(~(np.abs(array) <= most))[0].tolist()
            value = float(array[tuple(place)])
            raise InputError(
                f"{file}: {name}: expected finite numbers up to {most:g}, found {value:g} at index {place}; "
                "simulate the scene again."
            )
    for name, known in _WORDS.items():
        for word in np.unique(arrays[name]):
            if word not in known:
                raise InputError(
                    f"{file}: {name}: expected one of {', '.join(known)}, found {one_line(word, 40)!r}; simulate the "
                    "scene again."
                )
    bodies, ropes = len(arrays["body_shape"]), len(arrays["closed"])
    for name, count in (("rope", ropes), ("mesh_faces", len(arrays["mesh_vertices"])), ("mesh_body", bodies)):
        array = arrays[name]
        if array.size and not (0 <= int(array.min()) and int(array.max()) < count):
            wrong = int(array.max()) if int(array.max()) >= count else int(array.min())
            raise InputError(
                f"{file}: {name}: expected numbers from 0 to {count - 1}, found {wrong}; simulate the scene again."
            )
    _check_parts(file, arrays, range(ropes))


def _check_parts(file: Path, arrays: Mapping[str, np.ndarray], ropes: Sequence[int]) -> None:
    time, rope = arrays["time"], arrays["rope"]
    if (np.diff(time) <= 0).any():
        frame = int(np.argmax(np.diff(time) <= 0)) + 1
        raise InputError(
            f"{file}: time: expected rising times, found {time[frame]:g} s after {time[frame - 1]:g} s at frame "
            f"{frame}; simulate the scene again."
        )
    few = [k for k in ropes if int((rope == k).sum()) < 2] if len(ropes) <= len(rope) else [len(rope)]
    if few:
        raise InputError(f"{file}: rope: expected at least 2 vertices of each rope, found fewer of rope {few[0]}.")
    turned = np.linalg.norm(arrays["body_quat"], axis=-1)
    if turned.size and float(np.abs(turned - 1).max()) > 1e-3:
        raise InputError(f"{file}: body_quat: expected unit quaternions, found another; simulate the scene again.")
    own = {k for k, shape in enumerate(arrays["body_shape"]) if shape == "mesh"}
    empty = own - set(np.unique(arrays["mesh_body"]).tolist())
    if empty:
        raise InputError(f"{file}: mesh_body: expected triangles of body {min(empty)}, a mesh, found none.")
    for name in ("radius", "weight", "body_size"):
        if arrays[name].size and float(arrays[name].min()) < 0:
            raise InputError(f"{file}: {name}: expected no negative numbers, found {float(arrays[name].min()):g}.")
    if not np.linalg.norm(arrays["camera_direction"]) > 0:
        raise InputError(f"{file}: camera_direction: expected a direction, found zeros.")
