"""What long commands write down while they run, so that they go on from there however they ended.

A record is a file that is renamed into place when it is on the disk, and begins with a hash of its content: what was
torn, or has one bit that is not what was written, is not there. The hash includes a key, which says what the record
belongs to. One process at a time writes into a folder. Files of versions without hashes are read as they are.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchdlo import untrusted
from torchdlo.errors import InputError
from torchdlo.files import write_atomically

__all__ = [
    "MARK",
    "Journal",
    "Records",
    "at_work",
    "locked",
    "pack",
    "read_json",
    "read_record",
    "sweep",
    "unpack",
    "write_json",
]

MARK = "journal.json"
"""The file that says what a journal belongs to."""

_HEAD = b"torchdlo record 1 "
_LOCK = ".torchdlo.lock"
_SEAL = "sha256"
_LARGEST = 2**31
_BEGINNINGS = (b'{\n "generator": "torchdlo', b'{"generator": "torchdlo')
"""How marks begin, those of earlier versions too."""
_STRAY = re.compile(r"\.[0-9a-f]{8}-(.+)", re.DOTALL)
"""What `torchdlo.files.replace_atomically` calls a file that is not complete."""


# Records


def pack(content: bytes, key: str = "") -> bytes:
    """Return a record of some content."""
    return _HEAD + _hash(content, key) + b"\n" + content


def unpack(record: bytes, key: str = "", *, old: tuple[bytes, ...] = ()) -> bytes | None:
    """Return the content of a record, None if it is not what was written, or has another key.

    Args:
        record: what is in the file.
        key: what it has to belong to.
        old: beginnings of content without a hash.
    """
    if old and record.startswith(old):
        return record
    size = len(_HEAD) + 64
    content = record[size + 1 :]
    whole = record.startswith(_HEAD) and record[size : size + 1] == b"\n" and len(record) > size
    return content if whole and record[len(_HEAD) : size] == _hash(content, key) else None


def read_record(file: Path, key: str = "", *, old: tuple[bytes, ...] = ()) -> bytes | None:
    """Return the content of a record, None if there is none that is whole; see `unpack`."""
    content = _bytes(file)
    return None if content is None else unpack(content, key, old=old)


def _hash(content: bytes, key: str) -> bytes:
    found = hashlib.sha256(key.encode() + b"\0")
    found.update(content)
    return found.hexdigest().encode()


def _bytes(file: Path) -> bytes | None:
    """Return what is in a file, None if there is none that can be read."""
    try:
        return untrusted.read_bytes(file, "a record", most=_LARGEST)
    except (InputError, OSError):
        return None


def write_json(file: Path, content: dict[str, Any], *, indent: int | None = 1) -> None:
    """Write plain data with a hash of it."""
    content = json.loads(json.dumps(content))
    write_atomically(file, json.dumps(content | {_SEAL: _seal(content)}, indent=indent) + "\n")


def read_json(file: Path) -> dict[str, Any] | None:
    """Return plain data, None if they are not there, or not as they were written."""
    try:
        found = untrusted.read_json(file, "a record", finite=False)
    except InputError:
        return None
    if not isinstance(found, dict):
        return None
    seal = found.pop(_SEAL, None)
    return found if seal is None or seal == _seal(found) else None


def _seal(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


# Folders


def sweep(folder: Path, *names: str) -> None:
    """Remove what a run that was killed had not finished of files or folders with these names, or of all."""
    with contextlib.suppress(OSError):
        for each in list(folder.iterdir()):
            stray = _STRAY.fullmatch(each.name)
            if stray is None or (names and stray[1] not in names):
                continue
            if each.is_dir() and not each.is_symlink():
                shutil.rmtree(each, ignore_errors=True)
            else:
                each.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(folder: Path, name: str = _LOCK) -> Iterator[None]:
    """Hold the lock of a folder, which is made if it is not there; it is free again however the process ends.

    Raises:
        InputError: Another process has it.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        handle = _held(folder, folder / name)
        try:
            yield
        finally:
            if handle is not None:
                (folder / name).unlink(missing_ok=True)
                os.close(handle)
    finally:
        # A folder that was made for nothing goes again.
        for each in made:
            try:
                each.rmdir()
            except OSError:
                break


@contextlib.contextmanager
def at_work(folder: Path, *names: str, lock: str = _LOCK) -> Iterator[None]:
    """Hold the lock of a folder that results go to, and remove what an earlier run had not finished of them."""
    with locked(folder, lock):
        if names:
            sweep(folder, *names)
        yield


def _held(folder: Path, file: Path) -> int | None:
    """Return a lock that is held, None where the file system has no locks."""
    try:
        import fcntl
    except ImportError:
        return None
    while True:
        handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _holder(handle)
            os.close(handle)
            raise InputError(f"{folder}: {holder} is at work here; wait for it, or choose another --out.") from None
        except OSError:  # some network drives
            os.close(handle)
            file.unlink(missing_ok=True)
            return None
        # One that had the lock may have removed its file meanwhile.
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(handle), file.stat()):
                os.ftruncate(handle, 0)
                os.pwrite(handle, json.dumps(_myself()).encode(), 0)
                return handle
        os.close(handle)


def _myself() -> dict[str, Any]:
    script = Path(sys.argv[0] or "python")
    own = "torchdlo" in (script.name, script.parent.name)
    words = ["torchdlo", *sys.argv[1:4]] if own else [script.name]
    return {"process": os.getpid(), "machine": os.uname().nodename, "command": shlex.join(words)[:100]}


def _holder(handle: int) -> str:
    """Return who holds a lock, in words."""
    for _ in range(20):  # it may be about to say so
        try:
            said = json.loads(os.pread(handle, 4096, 0))
            away = "" if said["machine"] == os.uname().nodename else f" on {said['machine']}"
            text = f"process {int(said['process'])}{away} ({said['command']})"
            return "".join(c if c.isprintable() else "?" for c in text)
        except (OSError, ValueError, KeyError, TypeError):
            time.sleep(0.01)
    return "another process"


@dataclass(frozen=True)
class Records:
    """Records of a journal: other processes may read and write them while they work for the one that has it."""

    path: Path
    """Its folder."""
    key: str
    """What they belong to."""
    suffix: str
    """How their names end."""
    old: tuple[bytes, ...] = ()
    """Beginnings of records without a hash, see `unpack`."""

    def read(self, name: str) -> bytes | None:
        """Return a record, None if it is not there whole."""
        return read_record(self.path / f"{name}{self.suffix}", self.key, old=self.old)

    def write(self, name: str, content: bytes) -> None:
        """Write a record."""
        write_atomically(self.path / f"{name}{self.suffix}", pack(content, self.key))


class Journal:
    """A folder with records of one piece of work, for one process at a time."""

    def __init__(
        self,
        path: Path,
        mark: dict[str, Any],
        *,
        suffix: str,
        other: Callable[[dict[str, Any]], str],
        resume: bool = False,
        old: tuple[bytes, ...] = (),
    ) -> None:
        """Open the journal.

        Args:
            path: its folder; one of earlier work is emptied unless `resume`.
            mark: what it belongs to, as plain data; "generator" says which kind of journal it is.
            suffix: how names of records end.
            other: returns what is wrong with the mark of a journal that is there, "" if it is of the same work.
            resume: go on from what is there.
            old: beginnings of records without a hash, see `unpack`.
        """
        self.path, self._suffix = path, suffix
        self._mark = json.loads(json.dumps(mark))
        self.records = Records(path, _seal(self._mark), suffix, old)
        self._open = contextlib.ExitStack()
        if path.exists() and not path.is_dir():
            raise self._foreign()
        self._found()  # nothing is written into folders of others
        with contextlib.ExitStack() as opening:
            opening.enter_context(locked(path))
            sweep(path)
            self._begin(resume, other)
            self._open = opening.pop_all()

    def _begin(self, resume: bool, other: Callable[[dict[str, Any]], str]) -> None:
        found = self._found()
        if resume:
            if found is None:
                raise InputError(
                    f"{self.path}: expected the journal of a search to resume, found none; leave out --resume."
                )
            wrong = self._lost() if not found else other(found)
            if wrong:
                raise InputError(f"{self.path}: {wrong}")
        else:
            self.empty()
        if not resume or not found:
            write_json(self.path / MARK, self._mark)

    def _found(self) -> dict[str, Any] | None:
        """Return the mark that is there, an empty one if it is damaged, None if there is no journal."""
        if not self.path.is_dir():
            return None
        names = {each.name for each in self.path.iterdir()}
        # A process that was killed at the beginning leaves these.
        names = {name for name in names if name != _LOCK and not _STRAY.fullmatch(name)}
        if not names:
            return None
        found = read_json(self.path / MARK) if MARK in names else None
        if found is not None and found.get("generator") == self._mark["generator"]:
            return found
        if found is None and self._own(names):
            return {}
        raise self._foreign()

    def _own(self, names: set[str]) -> bool:
        """Return whether a folder without a mark that can be read is a journal."""
        mark = b"" if MARK not in names else _bytes(self.path / MARK)
        others = [_bytes(self.path / name) for name in names - {MARK}]
        if mark is None or not all(n == MARK or n.endswith(self._suffix) for n in names):
            return False
        if others and all(x is not None and x.startswith(_HEAD) for x in others):
            return True
        # Torn, a bit of it flipped, or never written by the disk.
        known = any(word in mark for word in (b"torchdlo", b"generator", b"program")) or not mark.strip(b"\0")
        return MARK in names and (known or any(begin.startswith(mark) for begin in _BEGINNINGS))

    def _lost(self) -> str:
        """Return what is wrong with a journal whose mark is damaged, "" if its records belong here."""
        files = list(self.path.glob(f"*{self._suffix}"))
        known = not files or any(read_record(file, self.records.key) is not None for file in files)
        return "" if known else "the journal is damaged, or belongs to other work; leave out --resume."

    def _foreign(self) -> InputError:
        return InputError(f"{self.path}: expected a journal of torchdlo, found something else; choose another --out.")

    def read(self, name: str) -> bytes | None:
        """Return a record, None if it is not there whole."""
        return self.records.read(name)

    def write(self, name: str, content: bytes) -> None:
        """Write a record."""
        self.records.write(name, content)

    def empty(self) -> None:
        """Delete all records, then the mark, so that what is left is known if this is the end."""
        for file in self.path.glob(f"*{self._suffix}"):
            if file.name != MARK:
                file.unlink(missing_ok=True)
        (self.path / MARK).unlink(missing_ok=True)

    def close(self) -> None:
        """Let others write here."""
        self._open.close()

    def remove(self) -> None:
        """Delete it all: the work is over, and its result is written."""
        self.empty()
        self.close()
        shutil.rmtree(self.path, ignore_errors=True)
