"""Writing files so that a reader never sees half of one, and nothing foreign is overwritten."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from torchdlo.errors import InputError
from torchdlo.untrusted.names import check_path

__all__ = ["check_writable", "replace_atomically", "write_atomically"]


@contextlib.contextmanager
def replace_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, and rename it to `path` if the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The name ends like the final one: writers such as numpy's choose the format by the suffix.
    temporary = path.with_name(f".{secrets.token_hex(4)}-{path.name}")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
    except OSError as error:
        # A full disk is named by what did not fit on it.
        if error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Have a file on the disk before it gets its name: after a power cut there is the old one or the new one."""
    if path.is_file():
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write `content` to `path` through a temporary file in the same folder."""
    with replace_atomically(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def check_writable(path: Path, *, mark: bytes = b"torchdlo") -> None:
    """Refuse a path that is a folder, lies below a file, or holds a file without our `mark`.

    Args:
        path: The file about to be written.
        mark: Bytes that every file written by torchdlo has near its start.
    """
    check_path(path.absolute(), "path to write to")
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise InputError(f"{path}: cannot be written because {parent} is a file; choose another --out.")
            if not os.access(parent, os.W_OK):
                raise InputError(f"{path}: the folder {parent} is not writable; choose another --out.")
            break
    if path.is_dir():
        raise InputError(f"{path}: expected a file name, found a folder; choose another --out.")
    if path.exists() and path.stat().st_size:
        with path.open("rb") as file:
            if mark not in file.read(4096):
                raise InputError(
                    f"{path}: exists and was not written by torchdlo, so it is not overwritten; "
                    "move it away or choose another --out."
                )
