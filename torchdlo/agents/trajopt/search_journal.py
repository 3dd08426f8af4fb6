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
import threading
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.torch_records import ARCHIVE, packed, unpacked
from torchdlo.envs import TASKS
from torchdlo.errors import InputError
from torchdlo.journal import Journal

__all__ = ["SearchJournal", "code_versions", "program_hash", "remove_journal"]


def code_versions() -> dict[str, str]:
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


def program_hash(name: str) -> str:
    """Return a hash of the code and the libraries that results of a problem depend on.

    Other tasks do not belong to it, nor do presets: settings are written down themselves. Nor does what Python does not
    run, such as comments.
    """
    root = Path(__file__).parents[2]
    others = {"presets.py", "search_journal.py", *(f"{t}.py" for t in TASKS if t != name)}
    found = hashlib.sha256(json.dumps(code_versions(), sort_keys=True).encode())
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


def remove_journal(path: Path) -> None:
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
        self.path, self.count, self.resume, self._journal = path, 0, resume, None
        if path is not None:
            mark = {"generator": "torchdlo optimize", "options": options, "program": program_hash(options["name"])}
            mark = json.loads(json.dumps(mark))
            other = functools.partial(_other, mark)
            self._journal = Journal(path, mark, suffix=".pt", other=other, resume=resume, old=ARCHIVE)

    def close(self) -> None:
        """Let others write here."""
        if self._journal is not None:
            self._journal.close()

    def recall(self, points: Tensor) -> dict[str, Any] | None:
        """Return what is written about the next batch, if these are its points; None if nothing is that can be read."""
        content = self._journal.read(f"{self.count:06d}") if self._journal is not None and self.resume else None
        found = None if content is None else unpacked(content)
        if found is None or "points" not in found:
            return None
        if found["points"] != _digest(points):
            raise InputError(
                f"{self.path}: expected the results of batch {self.count} of this search, found those of another one; "
                "leave out --resume."
            )
        self.count += 1
        return found

    def keep(self, points: Tensor, content: dict[str, Any]) -> None:
        """Write down how the next batch went."""
        if self._journal is not None:
            self._journal.write(f"{self.count:06d}", packed(content | {"points": _digest(points)}))
        self.count += 1


def _other(mark: dict[str, Any], found: dict[str, Any]) -> str:
    """Return why a journal does not belong to a search."""
    was, now = found.get("options", {}), mark["options"]
    other = sorted(k for k in {*was, *now} if was.get(k) != now.get(k))
    if other:
        said = ", ".join(f"{k} {was.get(k)} (now {now.get(k)})" for k in other)
        return f"the journal belongs to a search with {said}; give the same, or leave out --resume."
    if found.get("program") != mark["program"]:
        return "the journal was written by another version of torchdlo; leave out --resume."
    return ""


def _digest(points: Tensor) -> str:
    return hashlib.sha256(points.contiguous().numpy().tobytes()).hexdigest()
