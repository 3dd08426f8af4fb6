"""What a long search writes down: the result of every finished job, by the content of the job.

A search that is run again with the same recording and the same options asks for the same jobs in the same order, so
that it comes to where it was stopped by reading instead of computing. Only plain numbers are written, no pickles.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.journal import Journal, Records
from torchdlo.sysid.recordings.recording import Recording

__all__ = ["ResultCache", "Results", "decode", "digest", "encode", "program"]

_DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    ImportError,
    zipfile.BadZipFile,
    zlib.error,
)

_LARGEST = 2**28
"""Results of more bytes are computed again: a disk is not to be filled by a search."""

_PACKAGE = __name__.split(".")[0]


def digest(*things: Any) -> str:
    """Return a hash of plain values, arrays and dataclasses of them."""
    found = hashlib.sha256()
    for thing in things:
        arrays: list[np.ndarray] = []
        found.update(json.dumps(encode(thing, arrays), sort_keys=True).encode())
        for array in arrays:
            found.update(f"{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


@dataclass(frozen=True)
class Results:
    """Results of finished jobs, of which any process may read and write some; see `Records`."""

    records: Records

    def keep(self, job: Any, result: Any) -> None:
        """Write a result down."""
        arrays: list[np.ndarray] = []
        plain = json.dumps(encode(result, arrays))
        if sum(a.nbytes for a in arrays) > _LARGEST:
            return
        written = io.BytesIO()
        named: dict[str, Any] = {f"a{k}": a for k, a in enumerate(arrays)}
        np.savez(written, plain=np.array(plain), **named)
        self.records.write(_name(job), written.getvalue())

    def recall(self, job: Any) -> Any:
        """Return the result of a job, None if it is not written down whole."""
        content = self.records.read(_name(job))
        if content is None:
            return None
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as found:
                arrays = dict(found)
            return decode(json.loads(str(arrays["plain"])), arrays)
        except _DAMAGED:
            # A damaged file costs the time of its job, no more.
            return None


class ResultCache:
    """A folder with the results of finished jobs, that of this process."""

    def __init__(
        self,
        path: Path,
        recording: Recording,
        options: dict[str, Any],
        *,
        resume: bool = False,
        command: str = "diagnose",
    ) -> None:
        """Open the journal.

        Args:
            path: its folder; one of an earlier search is emptied unless `resume`.
            recording: what the search is about.
            options: all that it depends on besides.
            resume: go on from what is there.
            command: what it is a journal of.
        """
        self.path = path
        key = digest({f.name: getattr(recording, f.name) for f in fields(recording) if f.name != "path"}, options)
        mark = {"generator": f"torchdlo {command}", "key": key, "program": program()}

        def other(found: dict[str, Any]) -> str:
            if found.get("key") != key:
                return (
                    "the journal belongs to another recording or to other options (budget, seed, vertices, model); "
                    "give the same ones, or leave out --resume."
                )
            if found.get("program") != mark["program"]:
                return "the journal was written by another version of torchdlo; leave out --resume."
            return ""

        # Archives of numpy begin like this; earlier versions wrote them without a hash.
        self._journal = Journal(path, mark, suffix=".npz", other=other, resume=resume, old=(b"PK",))
        self.results = Results(self._journal.records)

    @property
    def begun(self) -> bool:
        """Whether any result is written down."""
        return any(self.path.glob("*.npz"))

    def close(self) -> None:
        """Let others write here."""
        self._journal.close()

    def remove(self) -> None:
        """Delete the journal: the search is over."""
        self._journal.remove()

    def through(
        self, jobs: Sequence[Any], compute: Callable[[Sequence[Any]], Iterator[tuple[int, Any]]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield index and result of every job, those that are written down first, the others as they are computed."""
        missing = []
        for k, job in enumerate(jobs):
            kept = self.results.recall(job)
            if kept is None:
                missing.append(k)
            else:
                yield k, kept
        for k, result in compute([jobs[k] for k in missing]) if missing else ():
            self.results.keep(jobs[missing[k]], result)
            yield missing[k], result


def _name(job: Any) -> str:
    return digest(job)[:32]


def program() -> str:
    """Return a hash of the program itself: its version alone does not change with every edit of a law."""
    root, found = Path(__file__).parents[2], hashlib.sha256()
    folders = ("physics", "coupling", "sysid", "vision")
    parts = [root / "scene.py", *(f for name in folders for f in (root / name).rglob("*.py"))]
    kernels = [f for name in ("physics", "coupling") for end in ("cpp", "h") for f in (root / name).rglob(f"*.{end}")]
    for file in sorted([*parts, *kernels]):
        found.update(file.name.encode() + file.read_bytes())
    for library in ("numpy", "scipy", "torch"):
        found.update(importlib.metadata.version(library).encode())
    return found.hexdigest()


def encode(value: Any, arrays: list[np.ndarray]) -> Any:
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
        inner = {f.name: encode(getattr(value, f.name), arrays) for f in fields(value)}
        return {"kind": [kind.__module__, kind.__qualname__], "fields": inner}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [encode(item, arrays) for item in value]}
    if isinstance(value, dict):
        return {"dict": [[encode(k, arrays), encode(v, arrays)] for k, v in value.items()]}
    if isinstance(value, Path):
        # Where a file lies does not matter.
        return value.name
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a journal cannot keep a {type(value).__name__}")


def decode(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Undo `encode`."""
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[f"a{value['array']}"]
    if "kind" in value:
        module, name = value["kind"]
        kind = getattr(importlib.import_module(module), name) if module.split(".")[0] == _PACKAGE else None
        if not (isinstance(kind, type) and is_dataclass(kind)):
            raise TypeError(f"{module}.{name} is not ours")
        return kind(**{k: decode(v, arrays) for k, v in value["fields"].items()})
    if "dict" in value:
        return {decode(k, arrays): decode(v, arrays) for k, v in value["dict"]}
    ((name, items),) = value.items()
    return {"tuple": tuple, "list": list}[name](decode(item, arrays) for item in items)
