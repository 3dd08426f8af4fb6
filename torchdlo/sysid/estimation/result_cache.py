"""What a long search writes down: the result of every finished job, by the content of the job.

A search that is run again with the same recording and the same options asks for the same jobs in the same order, so
that it comes to where it was stopped by reading instead of computing. Only plain numbers are written, no pickles.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.files import replacing, write_atomically
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.sysid.recordings.rope_schema import read_arrays

__all__ = ["ResultCache", "digest"]

_MARK = "journal.json"
"""The file that says what a journal belongs to."""

_LARGEST = 2**28
"""Results of more bytes are computed again: a disk is not to be filled by a search."""

_PACKAGE = __name__.split(".")[0]


def digest(*things: Any) -> str:
    """Return a hash of plain values, arrays and dataclasses of them."""
    found = hashlib.sha256()
    for thing in things:
        arrays: list[np.ndarray] = []
        found.update(json.dumps(_encode(thing, arrays), sort_keys=True).encode())
        for array in arrays:
            found.update(f"{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


class ResultCache:
    """A folder with the results of finished jobs."""

    def __init__(self, path: Path, recording: Recording, options: dict[str, Any], *, resume: bool = False) -> None:
        """Open the journal.

        Args:
            path: its folder; one of an earlier search is emptied unless `resume`.
            recording: what the search is about.
            options: all that it depends on besides.
            resume: go on from what is there.
        """
        self.path = path
        key = digest({f.name: getattr(recording, f.name) for f in fields(recording) if f.name != "path"}, options)
        mark = {"generator": "torchdlo diagnose", "key": key, "program": _program()}
        found = self._found()
        if resume and found is None:
            raise InputError(f"{path}: expected the journal of a search to resume, found none; leave out --resume.")
        if resume and found.get("key") != key:
            raise InputError(
                f"{path}: the journal belongs to another recording or to other options (budget, seed, vertices, "
                "model); give the same ones, or leave out --resume."
            )
        if resume and found.get("program") != mark["program"]:
            raise InputError(f"{path}: the journal was written by another version of torchdlo; leave out --resume.")
        if found is not None and not resume:
            self.remove()
        if not resume:
            write_atomically(path / _MARK, json.dumps(mark) + "\n")

    def _found(self) -> dict[str, Any] | None:
        """Return what a journal that is there belongs to, None if there is none; refuse what is not one."""
        if not self.path.exists() or (self.path.is_dir() and not any(self.path.iterdir())):
            return None
        try:
            found = json.loads((self.path / _MARK).read_text(encoding="utf-8"))
            if found["generator"] == "torchdlo diagnose":
                return found
        except (OSError, ValueError, KeyError, TypeError):
            pass
        raise InputError(f"{self.path}: expected a journal of torchdlo, found something else; choose another --out.")

    def remove(self) -> None:
        """Delete the journal: the search is over."""
        shutil.rmtree(self.path, ignore_errors=True)

    def through(
        self, jobs: Sequence[Any], compute: Callable[[Sequence[Any]], Iterator[tuple[int, Any]]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield index and result of every job, those that are written down first, the others as they are computed."""
        missing = []
        for k, job in enumerate(jobs):
            kept = self.recall(job)
            if kept is None:
                missing.append(k)
            else:
                yield k, kept
        for k, result in compute([jobs[k] for k in missing]) if missing else ():
            self.keep(jobs[missing[k]], result)
            yield missing[k], result

    def keep(self, job: Any, result: Any) -> None:
        """Write a result down."""
        arrays: list[np.ndarray] = []
        plain = json.dumps(_encode(result, arrays))
        if sum(a.nbytes for a in arrays) > _LARGEST:
            return
        with replacing(self._file(job)) as temporary:
            np.savez(temporary, plain=np.array(plain), **{f"a{k}": a for k, a in enumerate(arrays)})

    def recall(self, job: Any) -> Any:
        """Return the result of a job, None if it is not written down whole."""
        file = self._file(job)
        if not file.exists():
            return None
        try:
            arrays = read_arrays(file)
            return _decode(json.loads(str(arrays["plain"])), arrays)
        except (InputError, ValueError, KeyError, TypeError, AttributeError, ImportError):
            # A damaged file costs the time of its job, no more.
            return None

    def _file(self, job: Any) -> Path:
        return self.path / f"{digest(job)[:32]}.npz"


def _program() -> str:
    """Return a hash of the program itself: its version alone does not change with every edit of a law."""
    root, found = Path(__file__).parents[2], hashlib.sha256()
    parts = [root / "scene.py", *(f for name in ("physics", "coupling", "sysid") for f in (root / name).rglob("*.py"))]
    for file in sorted([*parts, *(root / "physics").rglob("*.cpp"), *(root / "physics").rglob("*.h")]):
        found.update(file.name.encode() + file.read_bytes())
    for library in ("numpy", "scipy", "torch"):
        found.update(importlib.metadata.version(library).encode())
    return found.hexdigest()


def _encode(value: Any, arrays: list[np.ndarray]) -> Any:
    """Return a value as objects of JSON; arrays are put aside."""
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            raise TypeError("a journal keeps numbers, no objects")
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        inner = {f.name: _encode(getattr(value, f.name), arrays) for f in fields(value)}
        return {"kind": [kind.__module__, kind.__qualname__], "fields": inner}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encode(item, arrays) for item in value]}
    if isinstance(value, dict):
        return {"dict": [[_encode(k, arrays), _encode(v, arrays)] for k, v in value.items()]}
    if isinstance(value, Path):
        # Where a file lies does not matter.
        return value.name
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a journal cannot keep a {type(value).__name__}")


def _decode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Undo `_encode`."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[f"a{value['array']}"]
    if "kind" in value:
        module, name = value["kind"]
        kind = getattr(importlib.import_module(module), name) if module.split(".")[0] == _PACKAGE else None
        if not is_dataclass(kind):
            raise TypeError(f"{module}.{name} is not ours")
        return kind(**{k: _decode(v, arrays) for k, v in value["fields"].items()})
    if "dict" in value:
        return {_decode(k, arrays): _decode(v, arrays) for k, v in value["dict"]}
    ((name, items),) = value.items()
    return {"tuple": tuple, "list": list}[name](_decode(item, arrays) for item in items)
