"""Files with what a training or a search needs to go on: tensors and plain data, whole or not there."""

from __future__ import annotations

import hashlib
import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.files import write_atomically
from torchdlo.journal import pack, read_record

__all__ = ["ARCHIVE", "load_checkpoint", "packed", "save_checkpoint", "tensors_hash", "unpacked"]

ARCHIVE = (b"PK",)
"""How archives of torch begin; earlier versions wrote them without a hash."""


def packed(content: dict[str, Any]) -> bytes:
    """Return tensors and plain data as bytes."""
    # Torch hides what the system says of a full disk.
    written = io.BytesIO()
    torch.save(content, written)
    return written.getvalue()


def unpacked(content: bytes) -> dict[str, Any] | None:
    """Undo `packed`; None if a bit of it is not what was written."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:
                return None
        found = torch.load(io.BytesIO(content), weights_only=True)
    except (
        OSError,
        EOFError,
        ValueError,
        RuntimeError,
        KeyError,
        TypeError,
        AttributeError,
        IndexError,
        zipfile.BadZipFile,
        pickle.UnpicklingError,
    ):
        return None
    return found if isinstance(found, dict) else None


def save_checkpoint(file: Path, content: dict[str, Any]) -> None:
    """Write tensors and plain data with a hash of them."""
    write_atomically(file, pack(packed(content)))


def load_checkpoint(file: Path) -> dict[str, Any] | None:
    """Return what `save_checkpoint` wrote, None if it is not there whole."""
    content = read_record(file, old=ARCHIVE)
    return None if content is None else unpacked(content)


def tensors_hash(*tensors: Tensor) -> str:
    """Return what tells the numbers and shapes of tensors from others: 16 digits of their SHA-256."""
    found = hashlib.sha256()
    for x in tensors:
        found.update(str(tuple(x.shape)).encode() + x.detach().cpu().double().contiguous().numpy().tobytes())
    return found.hexdigest()[:16]
