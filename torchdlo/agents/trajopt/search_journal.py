"""What an optimisation writes down: how every batch of trajectories went, in the order in which they were played.

Optimisers draw from a seeded generator and look at nothing but results. One that is run again therefore asks for the
same batches, and comes to where it was stopped by reading instead of playing: to the last bit as if never stopped.
"""

from __future__ import annotations

import ast
import fcntl
import functools
import hashlib
import io
import json
import os
import shutil
import threading
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.envs import TASKS
from torchdlo.errors import InputError
from torchdlo.files import write_atomically

__all__ = ["SearchJournal", "program", "remove", "versions"]

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
    root = Path(__file__).parents[2]
    others = {"presets.py", "search_journal.py", *(f"{t}.py" for t in TASKS if t != name)}
    found = hashlib.sha256(json.dumps(versions(), sort_keys=True).encode())
    for part in ("physics", "coupling", "envs", "agents/trajopt", "data/robots", "scene.py"):
        files = [root / part] if part.endswith(".py") else sorted((root / part).rglob("*"))
        for file in files:
            if file.suffix in (".py", ".cpp", ".h", ".urdf") and file.name not in others:
                found.update(file.name.encode() + _code(file))
    return found.hexdigest()


_PARSING = threading.Lock()
"""Searches begin in threads, and Python 3.11 may fail where several parse at once (CPython issue 106905)."""


@functools.cache
def _code(file: Path) -> bytes:
    """Return what counts of a file: its syntax tree without docstrings, which depends on the version of Python."""
    if file.suffix != ".py":
        return file.read_bytes()
    with _PARSING:
        tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            node.body = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return ast.dump(tree).encode()


def remove(path: Path) -> None:
    """Delete a journal, whose search is over and written down: its mark last, so that what is left of it is known."""
    for file in path.glob("*.pt"):
        file.unlink()
    shutil.rmtree(path, ignore_errors=True)


class SearchJournal:
    """A folder with one file per batch, for one search at a time; None as folder keeps nothing."""

    def __init__(self, path: Path | None, options: dict[str, Any], *, resume: bool = False) -> None:
        """Open the journal.

        Args:
            path: its folder; one of an earlier search is emptied unless `resume`.
            options: all that the search depends on, as plain data.
            resume: go on from what is there.
        """
        self.path, self.count, self.resume, self._lock = path, 0, resume, None
        if path is None:
            return
        try:
            self._open(path, options, resume)
        except BaseException:
            self.close()
            raise

    def _open(self, path: Path, options: dict[str, Any], resume: bool) -> None:
        mark = {"generator": "torchdlo optimize", "options": options, "program": program(options["name"])}
        mark = json.loads(json.dumps(mark))
        found = self._found(path)
        if resume:
            self._check(path, found, mark)
        path.mkdir(parents=True, exist_ok=True)
        # Belongs to the process: it is free again however that ends.
        self._lock = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path}: another search is writing here; choose another --out.") from None
        except OSError:
            pass  # some network drives have no locks
        if resume:
            return
        for file in path.glob("*.pt"):
            file.unlink()
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

    def close(self) -> None:
        """Let others write here."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def recall(self, points: Tensor) -> dict[str, Any] | None:
        """Return what is written about the next batch, if these are its points; None if nothing is that can be read."""
        file = self.path / f"{self.count:06d}.pt" if self.path is not None and self.resume else None
        found = None if file is None else _whole(file)
        if found is None:
            return None
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
            # Torch hides what the system says of a full disk.
            written = io.BytesIO()
            torch.save(content | {"points": _digest(points)}, written)
            write_atomically(self.path / f"{self.count:06d}.pt", written.getvalue())
        self.count += 1


def _whole(file: Path) -> dict[str, Any] | None:
    """Return what is in a file; None if there is none, or if a bit of it is not what was written."""
    try:
        with zipfile.ZipFile(file) as archive:
            whole = archive.testzip() is None
    except (OSError, EOFError, ValueError, RuntimeError, zipfile.BadZipFile):
        return None
    return torch.load(file, weights_only=True) if whole else None


def _digest(points: Tensor) -> str:
    return hashlib.sha256(points.contiguous().numpy().tobytes()).hexdigest()
