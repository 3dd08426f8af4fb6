"""C++ kernels of rods, several scenes per instruction, that take the place of tensor operations in recorded steps.

A substep is some eight hundred operations on small tensors; a kernel does dozens of them without leaving the cache. The
formulas stand beside the calls of `apply`, as the operations that are used elsewhere.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.kernels import native
from torchdlo.physics.linalg import banded
from torchdlo.physics.rod.topology import parse

_DTYPES = {torch.float32: "float", torch.float64: "double"}


class _Place(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_int64) for name in ("input", "offset", "slot", "scene"))


class _Call(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("slots", "scenes")),
        *((name, ctypes.c_void_p) for name in ("places", "after", "numbers")),
        *((name, ctypes.c_int64) for name in ("half", "count")),
        *((name, ctypes.c_void_p) for name in ("pattern", "order")),
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    source = native.RODS / "rods.cpp"
    return native.library(source, "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")


native.KERNELS["rods"] = _library


def available(like: Tensor) -> bool:
    """Return whether there are kernels for tensors like this one."""
    here = native.works_on(like.device.type, "ropes in recorded steps, their forces and constraints")
    return here and like.dtype in _DTYPES and _library() is not None


def ready(like: Tensor) -> bool:
    """Return whether to use kernels now: only in steps that are being recorded (`traced`), without derivatives.

    They round in another way than the tensor operations, and motions are to be the same with and without derivatives.
    """
    return torch.jit.is_tracing() and not torch.is_grad_enabled() and available(like)


@dataclass(frozen=True)
class Plan:
    """How to call a kernel with inputs of given shapes."""

    run: Callable[..., None]
    call: int
    """Address of the description."""
    pointers: Callable[..., ctypes.Array]
    """Makes an array of addresses."""
    copied: tuple[int, ...]
    """Inputs that are not stored as kernels read them."""
    batch: tuple[int, ...]
    size: int
    """Numbers in all results."""
    views: tuple[tuple[tuple[int, ...], tuple[int, ...], int], ...]
    """Shape, strides and offset of each result among them."""
    kept: tuple
    """What `call` points to."""


_Layout = tuple[tuple[torch.Size, tuple[int, ...], torch.dtype], ...]


@functools.lru_cache(maxsize=4096)
def _plan(
    kernel: str,
    topology: str,
    components: tuple[int, ...],
    system: str,
    numbers: tuple[float, ...],
    layout: _Layout,
) -> Plan:
    batch, dtype = tuple(torch.broadcast_shapes(*(shape[:-2] for shape, *_ in layout))), layout[0][2]
    after, scenes = parse(topology).successor(), math.prod(batch)
    places, copied = [], []
    for k, (shape, stride, own) in enumerate(layout):
        many = len(shape) > 2 and math.prod(shape[:-2]) > 1
        if own != dtype or (many and (len(shape) > 3 or stride[0] != 1)):
            copied.append(k)
            stride = (1, scenes, scenes * shape[-2]) if len(shape) > 2 else (shape[-1], 1)
            many = len(shape) > 2 and scenes > 1
        slot = stride[-2] if shape[-2] > 1 else 0
        places += [_Place(k, c * stride[-1], slot, int(many)) for c in range(shape[-1])]
    kept: tuple[Any, ...] = (
        (_Place * len(places))(*places),
        (ctypes.c_int64 * len(after))(*after),
        (ctypes.c_double * len(numbers))(*numbers),
    )
    call = _Call(len(after), scenes, *(ctypes.addressof(x) for x in kept))
    if system:
        pattern = banded.pattern(f"{system}:{topology}")
        entries = pattern.places[0]
        call.half, call.count = pattern.half_bandwidth, entries.shape[0]
        call.pattern, call.order = entries.data_ptr(), pattern.order.data_ptr()
        kept = (*kept, pattern)
    run = getattr(_library(), f"{kernel}_{_DTYPES[dtype]}")
    run.argtypes, run.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int), None
    each, inner = len(after) * scenes, tuple(math.prod(batch[k + 1 :]) for k in range(len(batch)))
    starts = itertools.accumulate(components, initial=0)
    views = tuple(
        ((*batch, len(after), count), (*inner, scenes, each), start * each)
        for start, count in zip(starts, components, strict=False)
    )
    pointers = ctypes.c_void_p * len(layout)
    size = sum(components) * each
    return Plan(run, ctypes.addressof(call), pointers, tuple(copied), batch, size, views, (*kept, call))


def stored(x: Tensor, batch: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Return one of the inputs that are `copied` as a kernel reads it."""
    if x.dim() < 3:
        return x.to(dtype).contiguous()
    return tree.batch_innermost(x.to(dtype).expand(*batch, *x.shape[-2:]).reshape(-1, *x.shape[-2:]))


def plan_of(
    inputs: Sequence[Tensor],
    kernel: str,
    topology: str,
    components: Sequence[int],
    system: str,
    numbers: Sequence[float],
) -> Plan:
    """Return how to call a kernel, see `apply`, with these inputs or others of the same shapes and strides."""
    layout = tuple([(x.shape, x.stride(), x.dtype) for x in inputs])
    return _plan(kernel, topology, tuple(components), system, tuple(numbers), layout)


def run(
    inputs: list[Tensor],
    kernel: str,
    topology: str,
    components: list[int],
    system: str,
    numbers: list[float],
) -> list[Tensor]:
    """Return what `apply` does, also where nothing is recorded; only where kernels are `available`."""
    plan = plan_of(inputs, kernel, topology, components, system, numbers)
    out = inputs[0].new_empty(plan.size)
    if plan.copied:
        inputs = [stored(x, plan.batch, out.dtype) if k in plan.copied else x for k, x in enumerate(inputs)]
    addresses = plan.pointers(*[x.data_ptr() for x in inputs])
    plan.run(addresses, out.data_ptr(), plan.call, torch.get_num_threads())
    return [out.as_strided(*view) for view in plan.views]


_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define(
    "rods(Tensor[] inputs, str kernel, str topology, int[] components, str system, float[] numbers) -> Tensor[]"
)
_operators.impl("rods", run, "CPU")


def apply(
    kernel: str,
    topology: str,
    inputs: Sequence[Tensor],
    components: Sequence[int],
    system: str = "",
    numbers: Sequence[float] = (),
) -> list[Tensor]:
    """Return what a kernel of `rods.cpp` makes, shape (..., V, C) each; only where `ready`.

    Args:
        kernel: its name.
        topology: name of the topology.
        inputs: what it reads, shape (..., V or 1, C) each.
        components: C of the results.
        system: pattern of the linear system that it solves, if it does.
        numbers: what it needs to know besides.
    """
    return torch.ops.torchdlo.rods(list(inputs), kernel, topology, list(components), system, list(numbers))
