"""C++ kernels of rods, several scenes per instruction, that take the place of tensor operations without derivatives.

A substep is some eight hundred operations on small tensors; a kernel does dozens of them without leaving the cache. The
formulas stand beside the calls of `apply`, as the operations that are used where derivatives are asked for.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchdlo.physics import banded, native, tree
from torchdlo.physics.topology import parse

_DTYPES = {torch.float32: "float", torch.float64: "double"}


class _Place(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_int64) for name in ("input", "offset", "slot", "scene"))


class _Call(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("slots", "scenes", "fields")),
        *((name, ctypes.c_void_p) for name in ("places", "after", "numbers")),
        *((name, ctypes.c_int64) for name in ("half", "count")),
        *((name, ctypes.c_void_p) for name in ("pattern", "order")),
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    source = Path(__file__).with_name("rods.cpp")
    return native.library(source, "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")


def ready(like: Tensor) -> bool:
    """Return whether kernels may be used now, in place of the tensor operations that have derivatives.

    On a GPU and in compiled graphs, where operations are fused anyway, they are used as well.
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return False
    return like.device.type == "cpu" and like.dtype in _DTYPES and _library() is not None


@dataclass(frozen=True)
class _Plan:
    """How to call a kernel with inputs of given shapes."""

    run: Callable[..., None]
    call: _Call
    pointers: Callable[..., ctypes.Array]
    """Makes an array of addresses."""
    batch: tuple[int, ...]
    kept: tuple
    """What `call` points to."""


_Layout = tuple[tuple[torch.Size, tuple[int, ...]], ...]


@functools.lru_cache(maxsize=4096)
def _plan(
    kernel: str, topology: str, system: str, numbers: tuple[float, ...], dtype: torch.dtype, layout: _Layout
) -> _Plan:
    batch = torch.broadcast_shapes(*(shape[:-2] for shape, _ in layout))
    after = parse(topology).successor()
    places = []
    for k, (shape, stride) in enumerate(layout):
        slot = stride[-2] if shape[-2] > 1 else 0
        scene = 1 if len(shape) == 3 and shape[0] > 1 else 0
        places += [_Place(k, c * stride[-1], slot, scene) for c in range(shape[-1])]
    kept = (
        (_Place * len(places))(*places),
        (ctypes.c_int64 * len(after))(*after),
        (ctypes.c_double * len(numbers))(*numbers),
    )
    call = _Call(len(after), batch.numel(), len(places), *(ctypes.addressof(x) for x in kept))
    if system:
        pattern = banded.pattern(f"{system}:{topology}")
        entries = pattern.places[0]
        call.half, call.count = pattern.half_bandwidth, entries.shape[0]
        call.pattern, call.order = entries.data_ptr(), pattern.order.data_ptr()
        kept = (*kept, pattern)
    run = getattr(_library(), f"{kernel}_{_DTYPES[dtype]}")
    run.argtypes, run.restype = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int), None
    return _Plan(run, call, ctypes.c_void_p * len(layout), tuple(batch), kept)


def _flat(inputs: Sequence[Tensor]) -> list[Tensor]:
    """Return inputs of one dtype with at most one batch axis, stored innermost, as they are where they can be."""
    dtype, deep = inputs[0].dtype, max(x.dim() for x in inputs)
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in inputs)) if deep > 3 else ()
    found = []
    for x in inputs:
        x = x if x.dtype == dtype else x.to(dtype)
        if x.dim() > 2 and deep > 3:
            x = x.expand(*batch, *x.shape[-2:]).reshape(-1, *x.shape[-2:])
        if x.dim() == 3 and x.shape[0] > 1 and x.stride(0) != 1:
            x = tree.batch_innermost(x)
        found.append(x)
    return found


def _apply(
    inputs: list[Tensor], kernel: str, topology: str, components: int, system: str, numbers: list[float]
) -> Tensor:
    flat = _flat(inputs)
    layout = tuple([(x.shape, x.stride()) for x in flat])
    plan = _plan(kernel, topology, system, tuple(numbers), flat[0].dtype, layout)
    out = flat[0].new_empty(components, plan.call.slots, plan.call.scenes)
    addresses = plan.pointers(*[x.data_ptr() for x in flat])
    plan.run(addresses, out.data_ptr(), ctypes.addressof(plan.call), torch.get_num_threads())
    return out


_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define(
    "rods(Tensor[] inputs, str kernel, str topology, int components, str system, float[] numbers) -> Tensor"
)
_operators.impl("rods", _apply, "CPU")


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
        components: of the results.
        system: pattern of the linear system that it solves, if it does.
        numbers: what it needs to know besides.
    """
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in inputs))
    stored = torch.ops.torchdlo.rods(list(inputs), kernel, topology, sum(components), system, list(numbers))
    stored = stored.reshape(*stored.shape[:2], *batch)
    return [tree.logical(part) for part in stored.split(list(components))]
