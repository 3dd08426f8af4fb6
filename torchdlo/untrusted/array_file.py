"""Arrays from strangers: .npz archives whose names, shapes and sizes are known before anything is inflated."""

from __future__ import annotations

import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from torchdlo.errors import InputError
from torchdlo.untrusted.names import one_line
from torchdlo.untrusted.regular_file import open_regular
from torchdlo.work_budget import size_text

__all__ = ["MOST", "ArrayFile", "Header", "read_arrays"]

MOST = 256 * 2**20
"""Most that all arrays of a file take [bytes]."""
_ENTRIES = 10_000
"""Most arrays in a file."""
_DIRECTORY = 2 * 2**20
"""Longest list of what is in an archive [bytes]."""
_KINDS = "biufcUS"
"""Kinds of arrays: truth values, numbers, texts."""
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    AttributeError,
    SyntaxError,
    RecursionError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
)
"""What reading a damaged archive can raise."""


@dataclass(frozen=True)
class Header:
    """What an archive says of an array."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        """What it takes [bytes]."""
        return math.prod(self.shape) * self.dtype.itemsize


class ArrayFile:
    """An opened .npz: headers at once, arrays when asked for. A context manager."""

    def __init__(self, path: str | Path, what: str, *, most: int = MOST, cure: str = "") -> None:
        """Open it, and read all headers.

        Args:
            path: the file.
            what: what it is to be, as in "a trial".
            most: most that all arrays may take [bytes].
            cure: what to do about a file that is not there.
        """
        self.where, self.what, self.most = one_line(path), what, most
        self._file = open_regular(path, what, most=most, cure=cure)
        try:
            self._check_start(self._file)
            self._archive = zipfile.ZipFile(self._file)
            self.headers: dict[str, Header] = self._headers()
        except InputError:
            self._file.close()
            raise
        except _DAMAGED as error:
            self._file.close()
            raise self._damaged(error) from None

    @property
    def files(self) -> list[str]:
        """Names of the arrays, as numpy calls them."""
        return list(self.headers)

    def __enter__(self) -> ArrayFile:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._archive.close()
        self._file.close()

    def check_size(self, names: Iterable[str] | None = None) -> None:
        """Refuse what would take more than it may, before it is inflated."""
        total = sum(self.headers[n].size for n in (self.headers if names is None else names))
        if total > self.most:
            raise InputError(
                f"{self.where}: expected arrays of at most {size_text(self.most)}, found {size_text(total)} once "
                "inflated; is it another file?"
            )

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an array."""
        if name not in self.headers:
            found = one_line(", ".join(self.headers), 200) or "none"
            raise InputError(f"{self.where}: {one_line(name, 60)}: expected this array in {self.what}, found {found}.")
        self.check_size([name])
        try:
            with self._archive.open(f"{name}.npy") as member:
                return np.lib.format.read_array(member, allow_pickle=False)
        except _DAMAGED as error:
            raise self._damaged(error, name) from None

    def _check_start(self, file: BinaryIO) -> None:
        """Refuse what is no archive, and one whose list of contents alone is too long."""
        start = file.read(8)
        if start[:6] == b"\x93NUMPY":
            raise InputError(
                f"{self.where}: expected {self.what}, an .npz archive, found a single array; use numpy.savez."
            )
        if start[:1] == b"\x80":
            raise InputError(
                f"{self.where}: expected {self.what}, an .npz archive, found a pickle, which is never loaded; use "
                "numpy.savez."
            )
        length = file.seek(0, os.SEEK_END)
        file.seek(max(0, length - 2**16 - 42))
        end = file.read()
        at = end.rfind(b"PK\x05\x06")
        if at < 0 or len(end) - at < 22:
            raise zipfile.BadZipFile("it is not an archive, or its end is missing")
        count, size = struct.unpack("<HI", end[at + 10 : at + 16])
        if count > _ENTRIES or size > _DIRECTORY or end[max(0, at - 20) : at][:4] == b"PK\x06\x07":
            raise InputError(
                f"{self.where}: expected {self.what} of at most {_ENTRIES} arrays, found more; is it another file?"
            )
        file.seek(0)

    def _headers(self) -> dict[str, Header]:
        found: dict[str, Header] = {}
        for info in self._archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name == info.filename:
                raise InputError(
                    f"{self.where}: {one_line(name, 60)}: expected an array, found another kind of file in the archive."
                )
            if name in found:
                raise InputError(f"{self.where}: {one_line(name, 60)}: expected each array once, found it twice.")
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(
                    f"{self.where}: {one_line(name, 60)}: expected it stored or deflated, found it packed in another "
                    "way; use numpy.savez_compressed."
                )
            found[name] = self._header(info, name)
        return found

    def _header(self, info: zipfile.ZipInfo, name: str) -> Header:
        with self._archive.open(info) as member:
            version = np.lib.format.read_magic(member)
            if version == (1, 0):
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
            else:
                shape, _, dtype = np.lib.format.read_array_header_2_0(member)
            begun = member.tell()
        here = f"{self.where}: {one_line(name, 60)}"
        if dtype.hasobject:
            raise InputError(
                f"{here}: expected an array of numbers, found pickled Python objects, which are never loaded; convert "
                "the array to float or bool before saving."
            )
        if dtype.kind not in _KINDS or dtype.subdtype is not None:
            raise InputError(f"{here}: expected an array of numbers or texts, found {one_line(dtype, 40)}.")
        if any(type(n) is not int or not 0 <= n <= 2**40 for n in shape):
            raise InputError(f"{here}: expected a shape of whole numbers, found {one_line(shape, 60)}.")
        header = Header(shape, dtype)
        if header.size != info.file_size - begun:
            raise InputError(
                f"{here}: expected {size_text(header.size)} for its shape {one_line(shape, 60)} of {dtype}, found "
                f"{size_text(info.file_size - begun)}; write or copy the file again."
            )
        return header

    def _damaged(self, error: BaseException, name: str = "") -> InputError:
        place = f"{one_line(name, 60)}: " if name else ""
        return InputError(
            f"{self.where}: {place}expected {self.what}, a complete .npz archive, found one that cannot be read "
            f"({one_line(error, 120)}); write or copy the file again."
        )


def read_arrays(
    path: str | Path,
    what: str,
    *,
    names: Iterable[str] | None = None,
    check: Callable[[Mapping[str, Header]], Any] | None = None,
    most: int = MOST,
    cure: str = "",
) -> dict[str, np.ndarray]:
    """Return arrays of an .npz without ever unpickling.

    Args:
        path: the file.
        what: what it is to be, as in "a trial".
        names: arrays to read, if not all; those that are not there are left out.
        check: told all headers before anything is inflated; raises what is wrong with them.
        most: most that the arrays may take [bytes].
        cure: what to do about a file that is not there.
    """
    with ArrayFile(path, what, most=most, cure=cure) as found:
        if check is not None:
            check(found.headers)
        chosen = None if names is None else set(names)
        wanted = [n for n in found.headers if chosen is None or n in chosen]
        found.check_size(wanted)
        return {name: found[name] for name in wanted}
