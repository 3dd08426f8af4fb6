"""Tensors from strangers: files of `torch.save` that hold plain data, never code."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdlo.errors import InputError
from torchdlo.untrusted.names import one_line
from torchdlo.untrusted.regular_file import open_regular
from torchdlo.work_budget import size_text

if TYPE_CHECKING:
    import torch

__all__ = ["check_shapes", "read_tensors"]

MOST = 2 * 2**30
"""Largest file [bytes]."""


def read_tensors(path: str | Path, what: str, *, most: int = MOST, cure: str = "") -> Any:
    """Return plain data and tensors, on the CPU.

    Args:
        path: the file.
        what: what it is to be, as in "a policy of torchdlo train".
        most: largest size, packed and unpacked [bytes].
        cure: what to do about a file that is not there.
    """
    import torch

    where = one_line(path)
    wrong = InputError(f"{where}: expected {what}, found something else; is the file cut, or another one?")
    with open_regular(path, what, most=most, cure=cure) as file:
        try:
            # Only archives are of use, and what else there is would go through the reader of old files.
            with zipfile.ZipFile(file) as archive:
                size = sum(info.file_size for info in archive.infolist())
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, OverflowError):
            raise wrong from None
        if size > most:
            raise InputError(
                f"{where}: expected {what} of at most {size_text(most)}, found {size_text(size)} once unpacked."
            )
        file.seek(0)
        try:
            return torch.load(file, map_location="cpu", weights_only=True)
        except Exception:  # what torch's reader of plain data meets in a damaged file can be nearly anything
            raise wrong from None


def check_shapes(made: torch.nn.Module, stored: Any, where: str, what: str) -> None:
    """Refuse stored weights that are not those of a module, which may be on the device "meta"."""
    own = made.state_dict()
    fits = isinstance(stored, Mapping) and stored.keys() == own.keys()
    if not fits or any(getattr(stored[name], "shape", None) != own[name].shape for name in own):
        raise InputError(f"{where}: expected {what}, found weights of other shapes; is it of another version?")
