"""Opening files that may be anything: only regular ones are read, and not more of them than expected."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from torchdlo.errors import InputError
from torchdlo.untrusted.names import one_line
from torchdlo.work_budget import size_text

__all__ = ["MissingFile", "open_regular", "read_bytes", "read_text"]

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


class MissingFile(InputError):
    """There is no such file."""


def open_regular(path: str | Path, what: str, *, most: int, cure: str = "") -> BinaryIO:
    """Open a regular file of at most `most` bytes; a pipe or a device is refused at once.

    Args:
        path: the file.
        what: what it is to be, as in "a scene file".
        most: largest size [bytes].
        cure: what to do about a file that is not there.
    """
    where, hint = one_line(path), f"; {cure}" if cure else ""
    try:
        # A pipe without a writer would wait for one.
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0))
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFile(f"{where}: expected {what}, found none{hint}" + "." * (not hint.endswith("?"))) from None
    except (OSError, ValueError) as error:
        said = getattr(error, "strerror", None) or error
        raise InputError(f"{where}: expected {what}, but it cannot be opened ({said}){hint}.") from None
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            kind = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
            raise InputError(f"{where}: expected {what}, found {kind}; give a regular file.")
        if found.st_size > most:
            raise InputError(
                f"{where}: expected {what} of at most {size_text(most)}, found {size_text(found.st_size)}; is it "
                "another file?"
            )
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def read_bytes(path: str | Path, what: str, *, most: int, cure: str = "") -> bytes:
    """Return the content of a regular file, see `open_regular`."""
    with open_regular(path, what, most=most, cure=cure) as file:
        try:
            # Files of /proc say that they are empty and go on for ever.
            content = file.read(most + 1)
        except OSError as error:
            said = error.strerror or error
            raise InputError(f"{one_line(path)}: expected {what}, but reading failed ({said}).") from None
    if len(content) > most:
        raise InputError(f"{one_line(path)}: expected {what} of at most {size_text(most)}, found more.")
    return content


def read_text(path: str | Path, what: str, *, most: int, cure: str = "") -> str:
    """Return the text of a regular file in UTF-8, see `open_regular`."""
    content = read_bytes(path, what, most=most, cure=cure)
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise InputError(
            f"{one_line(path)}: expected {what} as text in UTF-8, found byte {content[error.start]:#04x} at position "
            f"{error.start}; save it as UTF-8."
        ) from None
