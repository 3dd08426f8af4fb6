"""Tensors as the C++ kernels of rods want them: where each of their components stands, read where it is.

See `lanes.h`.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchdlo.physics import native, tree
from torchdlo.physics.topology import parse

_DTYPES = {torch.float32: "float", torch.float64: "double"}


class _Field(ctypes.Structure):
    _fields_ = (("at", ctypes.c_void_p), ("slot", ctypes.c_int64), ("scene", ctypes.c_int64))


@functools.cache
def _library(name: str) -> ctypes.CDLL | None:
    source = Path(__file__).with_name(f"{name}.cpp")
    return native.library(source, "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")


def ready(name: str, like: Tensor) -> bool:
    """Return whether a kernel may be used now, in place of the tensor operations that have derivatives.

    On a GPU and in compiled graphs, where operations are fused anyway, they are used as well.
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    return like.device.type == "cpu" and like.dtype in _DTYPES and _library(name) is not None


def function(name: str, dtype: torch.dtype) -> Callable:
    """Return the kernel for numbers of this type."""
    return getattr(_library(name), f"{name}_{_DTYPES[dtype]}")


@functools.cache
def successor(topology: str) -> ctypes.Array:
    """Return the next slot of every slot."""
    after = parse(topology).successor()
    return (ctypes.c_int64 * len(after))(*after)


def fields(tensors: Sequence[Tensor], batch: Sequence[int]) -> tuple[ctypes.Array, list[Tensor]]:
    """Return where the components of tensors (..., V or 1, C) stand, and what has to stay alive meanwhile."""
    found, kept = [], []
    for x in tensors:
        if x.dim() > 3:
            x = x.expand(*batch, *x.shape[-2:]).reshape(-1, *x.shape[-2:])
        if x.dim() == 3 and x.shape[0] > 1 and x.stride(0) != 1:
            x = tree.batch_innermost(x)
        kept.append(x)
        slot = x.stride(-2) if x.shape[-2] > 1 else 0
        scene = 1 if x.dim() == 3 and x.shape[0] > 1 else 0
        at, apart = x.data_ptr(), x.stride(-1) * x.element_size()
        found += [_Field(at + k * apart, slot, scene) for k in range(x.shape[-1])]
    return (_Field * len(found))(*found), kept


class Results:
    """Tensors (..., V, C) for a kernel to fill."""

    def __init__(self, like: Tensor, slots: int, batch: Sequence[int], *components: int) -> None:
        """Make room."""
        self._batch = tuple(batch)
        self._stored = [like.new_empty(n, slots, torch.Size(batch).numel()) for n in components]
        self.addresses = (ctypes.c_void_p * len(components))(*(x.data_ptr() for x in self._stored))
        """Where they stand."""

    def logical(self) -> tuple[Tensor, ...]:
        """Return the tensors."""
        return tuple(tree.logical(x.reshape(*x.shape[:2], *self._batch)) for x in self._stored)
