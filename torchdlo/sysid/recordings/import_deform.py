"""Conversion of the public DEFORM motion-capture data of cables into recording folders.

Chen et al., "Differentiable Discrete Elastic Rods for Real-Time Modeling of Deformable Linear
Objects", CoRL 2024, arXiv:2406.05931; data at github.com/roahmlab/DEFORM. The data carry no
licence, so they are converted from the user's own checkout: `data_set/DLO1/train/48.pkl` holds
500 frames at 100 Hz of (coordinate, marker) lists in metres, z up, both ends held by robots.
"""

from __future__ import annotations

import ast
import io
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.untrusted import one_line, read_bytes

__all__ = ["find_cables", "read_cable", "read_positions", "read_rest_shape", "suspect_frames"]

RATE = 100.0
"""Frames per second of the motion capture [Hz]."""
MASSES = {"DLO1": 0.03108, "DLO2": 0.05998, "DLO4": 0.02146}
"""Mass between the outer markers [kg]; not in the checkout, so known here by name."""
MARKER_MASS = 4e-4
"""Mass of one marker [kg]."""
NOISE_STD = 3e-4
"""Noise of the motion capture per coordinate [m]."""
JUMP = 0.015
"""Largest believable second difference of positions, and change of marker spacing [m]."""

_LARGEST_FILE = 64 * 2**20
_SPLITS = {"train": "train", "eval": "test"}


def find_cables(path: str | Path) -> dict[str, Path]:
    """The cables of a DEFORM checkout, of its data_set folder, or one cable's folder, by name."""
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path}: expected a checkout of the DEFORM data, found no folder there.")
    if (path / "train").is_dir() and (path / "eval").is_dir():
        return {path.resolve().name: path}
    root = path / "data_set" if (path / "data_set").is_dir() else path
    cables = {
        folder.name: folder
        for folder in sorted(root.iterdir())
        if (folder / "train").is_dir() and (folder / "eval").is_dir()
    }
    if not cables:
        raise InputError(
            f"{path}: expected data_set/DLO1/train and data_set/DLO1/eval as in a checkout of "
            "github.com/roahmlab/DEFORM, found no cable with both folders."
        )
    return cables


def read_cable(
    folder: Path,
    *,
    mass: float | None = None,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> Recording:
    """Read one cable, `folder` with train/ and eval/, as a recording.

    Args:
        folder: The cable's folder; its name tells which cable it is.
        mass: Mass between the outer markers [kg]; known for DLO1, DLO2 and DLO4.
        callback: Called with (stage, done, total, message) after each file.
    """
    cable = folder.resolve().name
    mass = MASSES.get(cable) if mass is None else mass
    if mass is None or not (np.isfinite(mass) and mass > 0):
        raise InputError(
            f"{folder}: the mass of {cable} is not known or not above 0; give the mass between its "
            "outer markers in kg with --mass."
        )
    positions = _read_trials(folder, callback)
    training = [p for name, p in positions.items() if name.startswith("train_")]
    spacing = np.median(np.linalg.norm(np.diff(np.concatenate(training), axis=1), axis=-1), axis=0)
    arclength = np.concatenate([[0.0], np.cumsum(spacing)])
    gripped = np.zeros(len(arclength), dtype=bool)
    gripped[[0, 1, -2, -1]] = True
    trials = [_trial(name, p, arclength, gripped) for name, p in positions.items()]
    return Recording(
        path=folder,
        length=float(arclength[-1]),
        radius=None,
        mass=float(mass),
        gravity=np.array([0.0, 0.0, -9.81]),
        table_height=None,
        marker_noise_std=NOISE_STD,
        rest_positions=read_rest_shape(folder, cable, len(arclength)),
        marker_mass=MARKER_MASS,
        closed=False,
        notes=f"{cable} of github.com/roahmlab/DEFORM (Chen et al., CoRL 2024), motion capture at "
        "100 Hz. Length and mass are those between the outer markers; the radius is unknown.",
        train=tuple(t for t in trials if t.name.startswith("train_")),
        test=tuple(t for t in trials if t.name.startswith("test_")),
    )


def read_positions(path: Path) -> np.ndarray:
    """Marker positions of one pickle of plain lists [m], shape (F, M, 3); code is never run."""
    pickled = read_bytes(path, "a pickle of lists of numbers", most=_LARGEST_FILE)
    try:
        _check_memo(path, pickled)
        content = _PlainUnpickler(io.BytesIO(pickled), path).load()
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(
            f"{path}: expected a pickle of lists of numbers, found one that cannot be read "
            f"({one_line(error, 200)}); is the checkout complete?"
        ) from None
    return _as_positions(path, content, len(pickled))


def read_rest_shape(folder: Path, cable: str, n_markers: int) -> np.ndarray | None:
    """The undeformed shape as tabulated in train_DEFORM.py [m], shape (M, 3); None if not found.

    The script is parsed, not run: the table is the first literal assigned to `rest_vert` where
    `DLO_type` is compared with the cable's name.
    """
    for parent in folder.resolve().parents[:2]:
        script = parent / "train_DEFORM.py"
        if script.is_file():
            break
    else:
        return None
    try:
        tree = ast.parse(script.read_text(encoding="utf-8", errors="replace"))
    except (SyntaxError, ValueError, RecursionError):
        return None
    for branch in ast.walk(tree):
        if isinstance(branch, ast.If) and _compares_with(branch.test, cable):
            for statement in branch.body:
                table = _literal_table(statement)
                if table is not None and table.shape == (n_markers, 3):
                    return table
    return None


def suspect_frames(positions: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Frames in which a marker jumps or leaves its place on the rope, shape (F,) bool.

    Args:
        positions: Marker positions [m], shape (F, M, 3).
        spacing: Distances of neighbouring markers along the rope [m], shape (M - 1,).
    """
    distance = np.linalg.norm(np.diff(positions, axis=1), axis=-1)
    suspect = (np.abs(distance - spacing) > JUMP).any(-1)
    jump = (np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1) > JUMP).any(-1)
    # A second difference is made of three frames, and any of them may be the wrong one.
    for shift in range(3):
        suspect[shift : len(jump) + shift] |= jump
    return suspect


_UNREADABLE = (
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    MemoryError,
    OSError,
    OverflowError,
    RecursionError,
    TypeError,
    ValueError,
)
"""What unpickling a damaged file can raise."""


class _PlainUnpickler(pickle.Unpickler):
    """Loads lists, tuples and numbers only: a pickle that names any class is refused."""

    def __init__(self, file: Any, path: Path) -> None:
        super().__init__(file)
        self._path = path

    def find_class(self, module: str, name: str) -> NoReturn:
        kind = "numpy arrays" if module.split(".")[0] == "numpy" else f"the object {module}.{name}"
        raise InputError(
            f"{self._path}: expected plain lists of numbers, found {kind}, and loading objects "
            "from a pickle could run code; save the positions with .tolist() first."
        )


def _check_memo(path: Path, pickled: bytes) -> None:
    """Refuse places of remembered objects that are far beyond what there is: room would be made for them."""
    if not any(op in pickled for op in (b"r", b"p")):  # LONG_BINPUT and PUT, which say a place
        return
    for op, arg, _ in pickletools.genops(pickled):
        if op.name in ("LONG_BINPUT", "PUT") and int(arg or 0) > len(pickled):
            raise InputError(f"{path}: expected a pickle of lists of numbers, found one that is not sound.")


def _check_nesting(path: Path, content: object, size: int) -> None:
    """Refuse what is not lists of lists of numbers, or holds more of them than its file has bytes.

    A small file may hold the same list over and over, in itself, too; it is counted before it is looked at.
    """
    wrong = InputError(f"{path}: expected lists of numbers of one size, found something else.")
    count = 0

    def rows(value: object) -> list | tuple:
        nonlocal count
        if not isinstance(value, (list, tuple)):
            raise wrong
        count += len(value)
        if count > size:
            raise InputError(f"{path}: expected as many numbers as fit into the file, found the same over and over.")
        return value

    for frame in rows(content):
        for row in rows(frame):
            if not all(isinstance(x, (int, float)) for x in rows(row)):
                raise wrong


def _as_positions(path: Path, content: Any, size: int) -> np.ndarray:
    _check_nesting(path, content, size)
    try:
        array = np.array(content, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: expected lists of numbers of one size, found something else.") from None
    if array.ndim == 3 and array.shape[1] == 3:
        array = array.transpose(0, 2, 1)
    if array.ndim != 3 or array.shape[2] != 3 or array.shape[1] < 5 or len(array) < 3:
        raise InputError(
            f"{path}: expected shape (frames, 3, markers) with at least 3 frames and 5 markers, "
            f"found {np.shape(content)}."
        )
    if not np.isfinite(array).all():
        raise InputError(f"{path}: expected finite positions in m, found NaN or infinity.")
    return array


def _read_trials(folder: Path, callback: Callable[..., None] | None) -> dict[str, np.ndarray]:
    """Positions by trial name, the numbers written with three digits so that they sort."""
    files = {split: sorted((folder / split).glob("*.pkl"), key=lambda f: (len(f.stem), f.stem)) for split in _SPLITS}
    for split, found in files.items():
        if not found:
            raise InputError(f"{folder / split}: expected .pkl files, found none.")
    positions: dict[str, np.ndarray] = {}
    total = sum(len(found) for found in files.values())
    for split, found in files.items():
        for file in found:
            trial = read_positions(file)
            first = next(iter(positions.values()), trial)
            if trial.shape[1] != first.shape[1]:
                raise InputError(
                    f"{file}: expected {first.shape[1]} markers as in the other files, found {trial.shape[1]}."
                )
            positions[f"{_SPLITS[split]}_{file.stem.zfill(3)}"] = trial
            if callback is not None:
                callback("read", len(positions), total, file.name)
    return positions


def _trial(name: str, positions: np.ndarray, arclength: np.ndarray, gripped: np.ndarray) -> Trial:
    return Trial(
        name=name,
        time=np.arange(len(positions)) / RATE,
        markers=positions,
        marker_arclength=arclength,
        gripped=gripped,
        gripper_quaternion=None,
        gripper_marker=None,
        suspect=suspect_frames(positions, np.diff(arclength)),
    )


def _compares_with(test: ast.expr, cable: str) -> bool:
    return isinstance(test, ast.Compare) and any(
        isinstance(side, ast.Constant) and side.value == cable for side in (test.left, *test.comparators)
    )


def _literal_table(statement: ast.stmt) -> np.ndarray | None:
    """The first nested tuple of numbers in an assignment to rest_vert, shape (M, 3)."""
    if not isinstance(statement, ast.Assign) or not any(
        isinstance(target, ast.Name) and target.id == "rest_vert" for target in statement.targets
    ):
        return None
    for node in ast.walk(statement.value):
        if isinstance(node, (ast.Tuple, ast.List)):
            try:
                table = np.array(ast.literal_eval(node), dtype=float)
            except (ValueError, TypeError):
                continue
            if table.ndim == 2:
                return table
    return None
