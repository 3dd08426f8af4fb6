"""Kernels of GPUs run by the CPU: threads take the place of a warp's lanes, see simt.h."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

import torch

from torchdlo.coupling.common import scene_packing
from torchdlo.physics.kernels import cuda, native

LANES = 3
"""Threads; no power of two, and fewer than there are edges."""


@functools.cache
def launcher(
    source: Path, options: tuple[str, ...], dtype: torch.dtype, derive: bool, device: torch.device
) -> cuda.Launch:
    """Return what `cuda.launcher` does, for the CPU."""
    words = ("-O1", "-DSIMT", "-DEMULATED", f"-DWARP={LANES}", "-pthread", *cuda.definitions(dtype, options, derive))
    library = native.library(source, *words)
    assert library is not None, "it could not be compiled"

    def launch(entry: str, sizes, fields, room, blocks: int, shared: int) -> None:
        given = (ctypes.byref(x) for x in (sizes, fields, room))
        getattr(library, entry)(*given, ctypes.c_int64(blocks), ctypes.c_int64(shared))

    return launch


def use(monkeypatch) -> None:
    """Let operators that have a kernel for GPUs run it here, on tensors of the CPU."""
    monkeypatch.setattr(cuda, "launcher", launcher)
    monkeypatch.setattr(scene_packing, "uses_gpu", lambda _: True)
