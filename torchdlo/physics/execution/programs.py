"""Recorded graphs as loops over numbers, all done in one call of a kernel (`kernels/loops.cpp`).

Between the operations of a small step nearly all of its time goes: a tensor operation on a rope of 40 vertices takes
two microseconds before it begins. Operations that there is no loop for are done by torch in between.
"""

from __future__ import annotations

import ctypes
import functools
import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics.execution.graph_reading import (
    DIMS,
    KINDS,
    BufferView,
    GraphReading,
    Operation,
    UnknownGraphError,
    read,
    tensors_in,
    views_in,
)
from torchdlo.physics.kernels import native

__all__ = ["Program", "program", "ready"]

_ALIGNED = 64
"""What addresses of buffers are multiples of [bytes]."""


class _Place(ctypes.Structure):
    _fields_ = (("buffer", ctypes.c_int64), ("offset", ctypes.c_int64), ("stride", ctypes.c_int64 * DIMS))


class _Loop(ctypes.Structure):
    _fields_ = (
        ("what", ctypes.c_int64),
        ("kind", ctypes.c_int64),
        ("size", ctypes.c_int64 * DIMS),
        ("out", _Place),
        ("given", _Place * 3),
        ("number", ctypes.c_double),
        ("rows", ctypes.c_void_p),
        ("run", ctypes.c_void_p),
        ("call", ctypes.c_void_p),
        ("inputs", ctypes.c_void_p),
        ("count", ctypes.c_int64),
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    found = native.library(native.RODS / "loops.cpp", "-fno-math-errno", "-fno-trapping-math")
    if found is not None:
        found.loop_names.restype = ctypes.POINTER(ctypes.c_char_p)
        found.run_loops.argtypes = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int)
        found.run_loops.restype = None
    return found


native.KERNELS["loops"] = _library


@functools.cache
def _codes() -> dict[str, int]:
    library, out = _library(), dict[str, int]()
    names = library.loop_names() if library else []
    while names and names[len(out)]:
        out[names[len(out)].decode()] = len(out)
    return out


def ready(tensors: Sequence[Tensor]) -> bool:
    """Return whether programs run on tensors like these."""
    return all(x.device.type == "cpu" for x in tensors) and _library() is not None


def program(graph: Any, inputs: Sequence[Tensor], numbers: Sequence[Tensor]) -> Program | None:
    """Return what a graph does to inputs of these shapes and strides, or None where that cannot be said; see `read`."""
    try:
        return Program(read(graph, inputs, numbers))
    except UnknownGraphError:
        return None


class Program:
    """What a graph does to inputs of given shapes and strides."""

    def __init__(self, own: GraphReading) -> None:
        """Prepare what was read."""
        operations, inputs, outputs, self._lock = own.operations, own.inputs, own.outputs, threading.Lock()
        given = [x.buffer for x in inputs if isinstance(x, BufferView)]
        foreign = {v.buffer for o in operations if o.what == "torch" for v in o.out}
        other = foreign | {*given, *own.constants}
        told = sorted({v.buffer for v in outputs if isinstance(v, BufferView)} - other)
        fresh = {buffer: _fresh(own, buffer) for buffer in told}
        self._fresh = [(v.size, v.stride, v.dtype) for v in fresh.values()]
        self._filled = [isinstance(x, BufferView) for x in inputs]
        # Those that are others in each call come first.
        order = [*given, *told, *sorted(foreign), *sorted(set(range(len(own.sizes))) - other - set(told))]
        order += list(own.constants)
        self._slot = {buffer: k for k, buffer in enumerate(order)}
        self._bases = (ctypes.c_void_p * len(order))()
        self._kept = {k: x.as_strided((own.sizes[k] // x.itemsize,), (1,), 0) for k, x in own.constants.items()}
        self._others, self._alive = len(given) + len(told) + len(foreign), list[Any]()
        self._give_room(own, set(order[self._others : len(order) - len(own.constants)]))
        whole = {**{x.buffer: x for x in inputs if isinstance(x, BufferView)}, **fresh}
        self._outputs = [
            (self._slot[v.buffer], None if whole.get(v.buffer) == v else v) if isinstance(v, BufferView) else (-1, v)
            for v in outputs
        ]
        self._parts = self._cut(operations)

    def _give_room(self, own: GraphReading, scratch: set[int]) -> None:
        """Set where buffers are that stay where they are."""
        places, size = _arranged(own.operations, scratch, own.sizes)
        arena = torch.empty(size + _ALIGNED, dtype=torch.uint8)
        first = -arena.data_ptr() % _ALIGNED
        for buffer, offset in places.items():
            self._kept[buffer] = arena[first + offset : first + offset + own.sizes[buffer]]
        for buffer, x in self._kept.items():
            self._bases[self._slot[buffer]] = x.data_ptr()

    def _cut(self, operations: Sequence[Operation]) -> list[tuple[Any, int] | Operation]:
        """Return loops that one call does, and operations of torch between them."""
        parts: list[tuple[Any, int] | Operation] = []
        loops: list[_Loop] = []
        for own in [*operations, None]:
            if own is not None and own.what != "torch":
                loops.append(self._loop(own))
                continue
            if loops:
                parts.append(((_Loop * len(loops))(*loops), len(loops)))
                loops = []
            if own is not None:
                named = {key: self._fixed(x) for key, x in own.named.items()}
                parts.append(replace(own, arguments=self._fixed(own.arguments), named=named))
        return parts

    def _fixed(self, x: Any) -> Any:
        """Return an argument of an operation of torch, with tensors for buffers that stay where they are."""
        if isinstance(x, (list, tuple)):
            return type(x)(self._fixed(each) for each in x)
        return self._tensor(x, []) if isinstance(x, BufferView) and self._slot[x.buffer] >= self._others else x

    def _loop(self, own: Operation) -> _Loop:
        """Return an operation as a kernel reads it."""
        loop = _Loop(what=_codes()[own.what], kind=KINDS[own.dtype], number=own.number)
        loop.out, *given = (
            _Place(self._slot[v.buffer], v.offset, tuple(s))
            for v, s in zip((own.out[0], *own.given), own.strides or [[]] * (1 + len(own.given)), strict=True)
        )
        loop.size[:] = own.size
        if own.what == "kernel":
            places = (_Place * len(given))(*given)
            loop.run = ctypes.cast(own.plan.run, ctypes.c_void_p)
            loop.call, loop.inputs, loop.count = own.plan.call, ctypes.addressof(places), len(places)
            self._alive += [places, own.plan]
        else:
            loop.given[: len(given)] = given
        if own.rows is not None:
            loop.rows = ctypes.addressof(own.rows)
            self._alive.append(own.rows)
        return loop

    def __call__(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Return what the graph makes of inputs, which have the strides that it was read with."""
        run, bases = _library().run_loops, self._bases  # type: ignore[union-attr]
        now = [x for x, filled in zip(inputs, self._filled, strict=True) if filled]
        now += [torch.empty_strided(size, stride, dtype=dtype) for size, stride, dtype in self._fresh]
        with self._lock:
            bases[: len(now)] = [x.data_ptr() for x in now]
            for part in self._parts:
                if isinstance(part, tuple):
                    run(part[0], part[1], bases, torch.get_num_threads())
                else:
                    self._do(part, now)
            return [self._output(slot, view, now) for slot, view in self._outputs]

    def _output(self, slot: int, view: Any, now: list[Tensor]) -> Tensor:
        if view is None:
            return now[slot]
        found = view if slot < 0 else self._tensor(view, now)
        # Who is given constants may change them.
        return found.clone() if slot >= self._others else found

    def _tensor(self, x: Any, now: list[Tensor]) -> Any:
        """Return an argument of an operation of torch, with tensors for parts of buffers."""
        if isinstance(x, (list, tuple)):
            return type(x)(self._tensor(each, now) for each in x)
        if not isinstance(x, BufferView):
            return x
        slot = self._slot[x.buffer]
        base = now[slot] if slot < self._others else self._kept[x.buffer]
        if base.dtype != x.dtype:
            base = base.view(x.dtype)
        return x.of(base)

    def _do(self, own: Operation, now: list[Tensor]) -> None:
        """Let torch do an operation."""
        assert own.operator is not None
        named = {key: self._tensor(x, now) for key, x in own.named.items()}
        # Nothing here has a gradient.
        with torch._C._AutoDispatchBelowAutograd():
            made = tensors_in(own.operator(*[self._tensor(x, now) for x in own.arguments], **named))
        for view, x in zip(own.out, [x for x in made if x.numel()], strict=True):
            if x.shape != view.size or x.stride() != view.stride or x.storage_offset() * x.itemsize != view.offset:
                raise RuntimeError(f"{own.operator} stores what it makes in another way than when it was recorded")
            slot = self._slot[view.buffer]
            now += [x] * (slot + 1 - len(now))
            now[slot] = x.as_strided((x.untyped_storage().nbytes() // x.itemsize,), (1,), 0)
            self._bases[slot] = now[slot].data_ptr()


def _fresh(own: GraphReading, buffer: int) -> BufferView:
    """Return the whole of a buffer that is made anew each time."""
    views = [v for v in own.outputs if isinstance(v, BufferView) and v.buffer == buffer]
    if len({v.dtype for v in views}) > 1:
        raise UnknownGraphError("parts of one tensor as numbers of several types")
    size = own.sizes[buffer] // views[0].dtype.itemsize
    whole = [v for v in views if not v.offset and math.prod(v.size) == size == _extent(v)]
    return whole[0] if whole else BufferView(buffer, 0, (size,), (1,), views[0].dtype)


def _extent(own: BufferView) -> int:
    """Return how many numbers there are from the first to the last one of a part of a buffer."""
    return 1 + sum((n - 1) * step for n, step in zip(own.size, own.stride, strict=True))


def _arranged(operations: Sequence[Operation], scratch: set[int], sizes: Sequence[int]) -> tuple[dict[int, int], int]:
    """Return where buffers are that live from one operation to another, and how much memory they take together."""
    used: dict[int, list[int]] = {}
    for k, own in enumerate(operations):
        for view in (*own.out, *own.given, *views_in(own.arguments), *views_in(list(own.named.values()))):
            if isinstance(view, BufferView) and view.buffer in scratch:
                used.setdefault(view.buffer, []).append(k)
    begins: dict[int, list[int]] = {}
    ends: dict[int, list[int]] = {}
    for buffer, at in used.items():
        begins.setdefault(at[0], []).append(buffer)
        ends.setdefault(at[-1], []).append(buffer)
    places: dict[int, int] = {}
    free: dict[int, list[int]] = {}
    size = 0
    for k in range(len(operations)):
        for buffer in begins.get(k, ()):
            wide = -(-sizes[buffer] // _ALIGNED) * _ALIGNED
            if free.get(wide):
                places[buffer] = free[wide].pop()
            else:
                places[buffer], size = size, size + wide
        for buffer in ends.get(k, ()):
            free.setdefault(-(-sizes[buffer] // _ALIGNED) * _ALIGNED, []).append(places[buffer])
    return places, size
