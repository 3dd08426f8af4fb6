"""What an optimisation writes down: how every batch of trajectories went, in the order in which they were played.

Optimisers draw from a seeded generator and look at nothing but results. One that is run again therefore asks for the
same batches, and comes to where it was stopped by reading instead of playing: to the last bit as if never stopped.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import shutil
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.envs import TASKS
from torchdlo.errors import InputError
from torchdlo.files import replacing, write_atomically

__all__ = ["Journal", "program", "versions"]

_MARK = "journal.json"
"""The file that says what a journal belongs to."""


def versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    found = {"torchdlo": _package_version(), "torch": torch.__version__}
    for name in ("cma", "numpy"):
        try:
            found[name] = version(name)
        except ModuleNotFoundError:
            continue
    return found


def _package_version() -> str:
    from torchdlo import __version__

    return __version__


def program(name: str) -> str:
    """Return a hash of the code and the libraries that results of a problem depend on.

    Other tasks do not belong to it, nor do presets: settings are written down themselves. Nor does what Python does not
    run, such as comments.
    """
    root, others = Path(__file__).parents[1], {"presets.py", "journal.py", *(f"{t}.py" for t in TASKS if t != name)}
    found = hashlib.sha256(json.dumps(versions(), sort_keys=True).encode())
    for part in ("physics", "coupling", "envs", "agents", "data/robots", "scene.py"):
        files = [root / part] if part.endswith(".py") else sorted((root / part).rglob("*"))
        for file in files:
            if file.suffix in (".py", ".cpp", ".h", ".urdf") and file.name not in others:
                found.update(file.name.encode() + _code(file))
    return found.hexdigest()


@functools.cache
def _code(file: Path) -> bytes:
    """Return what counts of a file: its syntax tree without docstrings, which depends on the version of Python."""
    if file.suffix != ".py":
        return file.read_bytes()
    tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            node.body = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return ast.dump(tree).encode()


class Journal:
    """A folder with one file per batch; None as folder keeps nothing."""

    def __init__(self, path: Path | None, options: dict[str, Any], *, resume: bool = False) -> None:
        """Open the journal.

        Args:
            path: its folder; one of an earlier search is emptied unless `resume`.
            options: all that the search depends on, as plain data.
            resume: go on from what is there.
        """
        self.path, self.count = path, 0
        if path is None:
            return
        mark = {"generator": "torchdlo optimize", "options": options, "program": program(options["name"])}
        mark = json.loads(json.dumps(mark))
        found = self._found(path)
        if resume:
            self._check(path, found, mark)
            return
        if found is not None:
            self.remove()
        write_atomically(path / _MARK, json.dumps(mark, indent=1) + "\n")

    @staticmethod
    def _found(path: Path) -> dict[str, Any] | None:
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return None
        try:
            found = json.loads((path / _MARK).read_text(encoding="utf-8"))
            if found["generator"] == "torchdlo optimize":
                return found
        except (OSError, ValueError, KeyError, TypeError):
            pass
        raise InputError(f"{path}: expected a journal of torchdlo, found something else; choose another --out.")

    @staticmethod
    def _check(path: Path, found: dict[str, Any] | None, mark: dict[str, Any]) -> None:
        if found is None:
            raise InputError(f"{path}: expected the journal of a search to resume, found none; leave out --resume.")
        was, now = found.get("options", {}), mark["options"]
        other = sorted(k for k in {*was, *now} if was.get(k) != now.get(k))
        if other:
            said = ", ".join(f"{k} {was.get(k)} (now {now.get(k)})" for k in other)
            raise InputError(
                f"{path}: the journal belongs to a search with {said}; give the same, or leave out --resume."
            )
        if found.get("program") != mark["program"]:
            raise InputError(f"{path}: the journal was written by another version of torchdlo; leave out --resume.")

    def remove(self) -> None:
        """Delete the journal: the search is over."""
        if self.path is not None:
            shutil.rmtree(self.path, ignore_errors=True)

    def recall(self, points: Tensor) -> dict[str, Any] | None:
        """Return what is written about the next batch, if these are its points; None if nothing is."""
        file = None if self.path is None else self.path / f"{self.count:06d}.pt"
        if file is None or not file.is_file():
            return None
        # A file that is renamed when complete is a whole archive, or was damaged later.
        if not zipfile.is_zipfile(file):
            raise InputError(f"{file}: expected the results of a batch, found something else; leave out --resume.")
        found = torch.load(file, weights_only=True)
        if found["points"] != _digest(points):
            raise InputError(
                f"{file}: expected the results of batch {self.count} of this search, found those of another one; "
                "leave out --resume."
            )
        self.count += 1
        return found

    def keep(self, points: Tensor, content: dict[str, Any]) -> None:
        """Write down how the next batch went."""
        if self.path is not None:
            with replacing(self.path / f"{self.count:06d}.pt") as file:
                torch.save(content | {"points": _digest(points)}, file)
        self.count += 1


def _digest(points: Tensor) -> str:
    return hashlib.sha256(points.contiguous().numpy().tobytes()).hexdigest()
