"""The folder in which compiled code is kept: it belongs to the user, and nobody else can write there.

Code that another user put there would run with the rights of this one. A folder that is not private is not used: a
private one among the temporary files takes its place, with one warning.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

from torchdlo import notices

__all__ = ["cache_folder", "file_lock", "is_sound", "keep_for_torch", "privacy_problem", "seal_file", "wanted_folder"]

_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def cache_folder() -> Path | None:
    """Return the private folder, which exists then; None, with one warning, where there can be none.

    It is `TORCHDLO_CACHE` if that is set, else `torchdlo` in `XDG_CACHE_HOME` or in `~/.cache`.
    """
    return _private(wanted_folder())


def wanted_folder() -> Path:
    """Return where the folder is to be, private or not."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.environ.get("TORCHDLO_CACHE") or Path(base) / "torchdlo").expanduser()


@functools.cache
def _private(path: Path) -> Path | None:
    wrong = privacy_problem(path)
    if not wrong:
        return path
    temporary = Path(tempfile.gettempdir())
    used = temporary / f"torchdlo-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"
    if privacy_problem(used):
        try:
            used = Path(tempfile.mkdtemp(prefix="torchdlo-", dir=temporary))
        except OSError:
            notices.once(
                "cache", f"cache {path}: {wrong}, and {temporary} takes none; slower tensor operations are used."
            )
            return None
        atexit.register(shutil.rmtree, used, ignore_errors=True)
    notices.once(
        "cache",
        f"cache {path}: {wrong}; compiled code is kept in {used}. Mend that, or set TORCHDLO_CACHE to another folder.",
    )
    return used


def privacy_problem(path: Path) -> str:
    """Make a folder and return what keeps it from being private, "" if it is."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.stat()
        if os.name == "posix":
            if found.st_uid != os.geteuid():
                return f"it belongs to another user (number {found.st_uid})"
            if found.st_mode & _OTHERS:
                return f"other users can write there (mode {stat.S_IMODE(found.st_mode):o}; chmod 700 mends that)"
            loose = _replaceable(path.resolve())
            if loose:
                return f"other users can replace what lies in {loose}"
        with tempfile.TemporaryFile(dir=path):
            return ""
    except (OSError, RuntimeError) as error:
        return f"it cannot be written ({error})"


def _replaceable(path: Path) -> Path | None:
    """Return the first folder above one in which everybody may rename what belongs to others."""
    for above in path.parents:
        mode = above.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            return above
    return None


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold a lock that one process has at a time; a file system without locks has none."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def is_sound(path: Path) -> bool:
    """Return whether a file is the user's own and holds what `seal_file` saw."""
    content, seal = _own(path), _own(_seal(path))
    return content is not None and seal is not None and seal == _hash(content)


def seal_file(fresh: Path, path: Path) -> None:
    """Move a finished file to its place in one go, with the hash of its content beside it."""
    fresh.chmod(0o700)
    mark = _seal(fresh)
    mark.write_bytes(_hash(fresh.read_bytes()))
    mark.chmod(0o600)
    os.replace(fresh, path)
    os.replace(mark, _seal(path))


def keep_for_torch(vectors: str) -> None:
    """Let `torch.compile` keep its code in the private folder, unless the user chose another place.

    Torch's own choice is a folder among the temporary files that anybody can make beforehand. And torch does not look
    at the vector instructions that code was made for, in which machines that share a home may differ: code of one
    crashes on another, or computes what is not a number.

    Args:
        vectors: names these instructions, as `torch.backends.cpu.get_cpu_capability` does.
    """
    private = cache_folder()
    if private is not None:
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(private / f"inductor_{vectors.lower()}"))


def _seal(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _own(path: Path) -> bytes | None:
    """Return the content of a regular file of the user that nobody else can write, else None."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return None
    with open(handle, "rb") as file:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            return None
        if os.name == "posix" and (found.st_uid != os.geteuid() or found.st_mode & _OTHERS):
            return None
        return file.read()
