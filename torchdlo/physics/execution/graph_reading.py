"""What the operations of a recorded graph make new numbers of, and where: loops, kernels, and what torch has to do.

Shapes and strides are fixed, so the graph is done once, operation by operation, and what comes out says what is a view
of what: views need nothing to be done again. Numbers that do not depend on the inputs stay as they are.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics.kernels import lanes

__all__ = [
    "DIMS",
    "KINDS",
    "BufferView",
    "GraphReading",
    "Operation",
    "UnknownGraphError",
    "read",
    "tensors_in",
    "views_in",
]

DIMS = 4
"""Dimensions of a loop."""

KINDS = {torch.bool: 0, torch.float32: 1, torch.float64: 2}
"""Types of numbers that loops know."""

_FLOATS = (torch.float32, torch.float64)
"""Those that they calculate with."""

_OF_TRUTHS = ("copy", "where", "logical_and", "logical_or", "logical_xor", "logical_not")
"""Loops over truths; all others are over numbers."""

_MOST_INPUTS = 64
"""Most inputs of a kernel, as in `loops.cpp`."""

_FOLDED = 64
"""Most numbers that are summed one after the other: torch sums more of them in pairs."""

_APART = 4
"""Most of them that are added in loops of their own, each over all sums."""


class UnknownGraphError(Exception):
    """A graph that cannot be turned into loops."""


@dataclass(frozen=True)
class BufferView:
    """A part of a buffer."""

    buffer: int
    offset: int
    """In bytes."""
    size: tuple[int, ...]
    stride: tuple[int, ...]
    dtype: torch.dtype

    def of(self, base: Tensor) -> Tensor:
        """Return this part of a buffer that begins where a tensor does."""
        return base.as_strided(self.size, self.stride, base.storage_offset() + self.offset // self.dtype.itemsize)


@dataclass
class Operation:
    """A loop; what a kernel or torch does, if `what` is "kernel" or "torch"."""

    what: str
    dtype: torch.dtype
    size: list[int]
    out: list[BufferView]
    """One of a loop; of others the results."""
    given: list[BufferView]
    strides: list[list[int]] = field(default_factory=list)
    """Of `out` and `given` along `size`."""
    number: float = 1.0
    rows: Any = None
    plan: Any = None
    operator: Callable[..., Any] | None = None
    arguments: tuple[Any, ...] = ()
    named: dict[str, Any] = field(default_factory=dict)


class _Reader:
    """Does the operations of a graph once, and notes which of them make new numbers, of what, and where."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.constants: dict[int, Tensor] = {}
        self.sizes: list[int] = []
        self._buffers: dict[int, int] = {}
        self._alive: list[Tensor] = []

    def buffer(self, x: Tensor) -> int:
        """Return the buffer that a tensor is in, a new one if it is in none yet."""
        storage = x.untyped_storage()
        if storage.data_ptr() not in self._buffers:
            self._buffers[storage.data_ptr()] = len(self.sizes)
            self.sizes.append(storage.nbytes())
            self._alive.append(x)  # else its place would be taken by another one
        return self._buffers[storage.data_ptr()]

    def known(self, x: Tensor) -> bool:
        """Return whether a tensor is part of one that was there before."""
        return x.untyped_storage().data_ptr() in self._buffers

    def constant(self, x: Tensor) -> Tensor:
        """Note that a tensor is always the same."""
        if x.numel() and not self.known(x):
            self.constants[self.buffer(x)] = x
        return x

    def is_constant(self, x: Tensor) -> bool:
        """Return whether a tensor is always the same."""
        return not x.numel() or (self.known(x) and self.buffer(x) in self.constants)

    def view(self, x: Tensor) -> BufferView:
        """Return where a tensor is."""
        offset = x.data_ptr() - x.untyped_storage().data_ptr()
        return BufferView(self.buffer(x), offset, tuple(x.shape), tuple(x.stride()), x.dtype)

    def place(self, x: Tensor) -> BufferView | Tensor:
        """Return where a tensor is, or itself if it is empty."""
        return self.view(x) if x.numel() else x

    def operand(self, x: Any, dtype: torch.dtype) -> Tensor:
        """Return a number or tensor as one of a type."""
        if not isinstance(x, Tensor):
            return self.constant(torch.tensor(x, dtype=dtype))
        if x.dtype == dtype:
            return x
        if self.is_constant(x):
            return self.constant(x.to(dtype))
        if x.dtype != torch.bool or dtype not in _FLOATS:
            raise UnknownGraphError(f"{x.dtype} as {dtype}")
        out = x.to(dtype)
        self.loop("from_bool", out, [x])
        return out

    def loop(self, what: str, out: Tensor, given: Sequence[Tensor], number: float = 1.0) -> None:
        """Note a loop over all numbers of `out`; what is given is broadcast to its shape."""
        if not out.numel():
            return
        wide = [x.expand(out.shape) for x in given]
        kind = given[-1].dtype if out.dtype == torch.bool else out.dtype
        if kind not in (KINDS if what in _OF_TRUTHS else _FLOATS):
            raise UnknownGraphError(f"{what} of {kind}")
        size, strides = _collapsed(out.shape, [out.stride(), *(x.stride() for x in wide)])
        views = [self.view(x) for x in wide]
        self.operations.append(Operation(what, kind, size, [self.view(out)], views, strides, number))

    def along(self, what: str, out: Tensor, x: Tensor, size: list[int], strides: list[list[int]], rows: Any) -> None:
        """Note a loop in which one dimension is another one than the others."""
        if out.dtype not in KINDS:
            raise UnknownGraphError(f"{what} of {out.dtype}")
        views = [self.view(out)], [self.view(x)]
        self.operations.append(Operation(what, out.dtype, size, *views, strides, rows=rows))


def _collapsed(shape: Sequence[int], strides: Sequence[Sequence[int]]) -> tuple[list[int], list[list[int]]]:
    """Return sizes and strides of as few dimensions as do, the one in which the first moves least being the last."""
    dims = [(n, [s[k] for s in strides]) for k, n in enumerate(shape) if n > 1]
    dims.sort(key=lambda each: -abs(each[1][0]))
    out: list[tuple[int, list[int]]] = []
    for n, step in dims:
        if out and all(a == b * n for a, b in zip(out[-1][1], step, strict=True)):
            out[-1] = out[-1][0] * n, step
        else:
            out.append((n, step))
    if len(out) > DIMS:
        raise UnknownGraphError(f"{len(out)} dimensions")
    out = [(1, [0] * len(strides))] * (DIMS - len(out)) + out
    return [n for n, _ in out], [[step[k] for _, step in out] for k in range(len(strides))]


_BINARY = {
    "add": "add",
    "sub": "sub",
    "mul": "mul",
    "div": "div",
    "minimum": "minimum",
    "maximum": "maximum",
    "atan2": "atan2",
    "arctan2": "atan2",
    "eq": "eq",
    "ne": "ne",
    "lt": "lt",
    "le": "le",
    "gt": "gt",
    "ge": "ge",
}
_TRUTHS = {
    "logical_and": "logical_and",
    "logical_or": "logical_or",
    "logical_xor": "logical_xor",
    "bitwise_and": "logical_and",
    "bitwise_or": "logical_or",
    "bitwise_xor": "logical_xor",
    "__and__": "logical_and",
    "__or__": "logical_or",
    "__xor__": "logical_xor",
}
_UNARY = (
    *("neg", "abs", "sqrt", "square", "reciprocal", "round", "floor", "sign"),
    *("exp", "expm1", "log", "sin", "cos", "tanh", "asin"),
)
_MASKS = (torch.bool, torch.uint8)
_COPIES = ("clone", "contiguous", "reshape", "to", "_to_copy", "view", "flatten")
_FOLDS = {"sum": "add", "amax": "maximum", "amin": "minimum"}
_FILLED = ("new_zeros", "new_ones", "new_full", "zeros_like", "ones_like", "full_like")
_SIZES = ("aten::size", "aten::dim", "aten::numel", "aten::len")
_POWERS = {2.0: "square", 0.5: "sqrt", -1.0: "reciprocal", 1.0: "copy"}


def _note(reader: _Reader, name: str, out: Any, args: Sequence[Any]) -> None:
    """Note the loops of an operation of torch that made `out`; UnknownGraphError if there are none for it."""
    if name in _BINARY:
        _note_binary(reader, _BINARY[name], out, args)
    elif name == "rsub":
        _note_binary(reader, "sub", out, [args[1], args[0], *args[2:]])
    elif name in _TRUTHS and out.dtype == torch.bool:
        reader.loop(_TRUTHS[name], out, [reader.operand(x, torch.bool) for x in args[:2]])
    elif name in ("logical_not", "bitwise_not") and args[0].dtype == torch.bool:
        reader.loop("logical_not", out, args[:1])
    elif name in _UNARY and len(args) == 1 and out.dtype in _FLOATS:
        reader.loop(name, out, [reader.operand(args[0], out.dtype)])
    elif name == "pow" and isinstance(args[1], (int, float)) and isinstance(args[0], Tensor) and out.dtype in _FLOATS:
        x, power = reader.operand(args[0], out.dtype), float(args[1])
        what = _POWERS.get(power, "pow")
        reader.loop(what, out, [x] if what != "pow" else [x, reader.operand(power, out.dtype)])
    elif name == "lerp" and isinstance(args[2], (int, float)):
        reader.loop("lerp", out, [reader.operand(x, out.dtype) for x in args[:2]], float(args[2]))
    elif name in ("where", "masked_fill"):
        _note_choice(reader, name, out, args)
    elif name in ("clamp", "clamp_min", "clamp_max"):
        _note_clamp(reader, name, out, args)
    elif name in ("cat", "stack"):
        _note_joined(reader, name, out, args)
    elif name in ("index_select", "index"):
        _note_rows(reader, out, args[0], *_rows_of(reader, name, args))
    elif name == "flip" and len(args[1]) == 1 and out.dim():
        _note_rows(reader, out, args[0], args[1][0], torch.arange(out.shape[args[1][0]]).flip(0))
    elif name == "cumsum":
        _note_sums(reader, out, args)
    elif name in _FOLDS:
        _note_fold(reader, _FOLDS[name], out, args)
    elif name in _COPIES:
        if args[0].dtype not in (out.dtype, torch.bool):
            raise UnknownGraphError(f"{args[0].dtype} as {out.dtype}")
        what = "copy" if args[0].dtype == out.dtype else "from_bool"
        reader.loop(what, out.view(args[0].shape), args[:1])
    else:
        raise UnknownGraphError(name)


def _note_binary(reader: _Reader, what: str, out: Tensor, args: Sequence[Any]) -> None:
    if what == "div" and len(args) > 2 and args[2] is not None:
        raise UnknownGraphError("div with rounding")
    dtype = out.dtype
    if dtype == torch.bool:
        dtype = torch.result_type(*args[:2])
    if dtype not in _FLOATS:
        raise UnknownGraphError(f"{what} of {dtype}")
    number = float(args[2]) if what in ("add", "sub") and len(args) > 2 else 1.0
    reader.loop(what, out, [reader.operand(x, dtype) for x in args[:2]], number)


def _note_choice(reader: _Reader, name: str, out: Tensor, args: Sequence[Any]) -> None:
    mask, a, b = args if name == "where" else (args[1], args[2], args[0])
    if len(args) != 3 or mask.dtype != torch.bool:
        raise UnknownGraphError(name)
    a, b = (reader.operand(x, out.dtype) for x in (a, b))
    reader.loop("where", out, [mask, a, b])


def _note_clamp(reader: _Reader, name: str, out: Tensor, args: Sequence[Any]) -> None:
    low, high = {"clamp": (*args[1:], None)[:2], "clamp_min": (args[1], None), "clamp_max": (None, args[1])}[name]
    x = reader.operand(args[0], out.dtype)
    for what, bound in (("clamp_min", low), ("clamp_max", high)):
        if bound is not None:
            reader.loop(what, out, [x, reader.operand(bound, out.dtype)])
            x = out


def _note_joined(reader: _Reader, name: str, out: Tensor, args: Sequence[Any]) -> None:
    parts, dim, start = args[0], args[1] if len(args) > 1 else 0, 0
    for x in parts:
        if name == "stack":
            x = x.unsqueeze(dim)
        if x.dim() != out.dim() or x.dtype != out.dtype:
            raise UnknownGraphError(name)
        reader.loop("copy", out.narrow(dim, start, x.shape[dim]), [x])
        start += x.shape[dim]


def _rows_of(reader: _Reader, name: str, args: Sequence[Any]) -> tuple[int, Tensor]:
    """Return the dimension along which rows are taken, and which; they are always the same."""
    if name == "index_select":
        dim, rows = args[1], args[2]
    else:
        given = [(k, i) for k, i in enumerate(args[1]) if i is not None]
        if len(given) != 1:
            raise UnknownGraphError(name)
        dim, rows = given[0]
    if not reader.is_constant(rows) or rows.dim() != 1:
        raise UnknownGraphError(name)
    return dim, rows.nonzero()[:, 0] if rows.dtype in _MASKS else rows


def _note_rows(reader: _Reader, out: Tensor, x: Tensor, dim: int, rows: Tensor) -> None:
    """Note that rows of a tensor are taken."""
    (outer, between, inner), strides = _beside(out, x, dim)
    # The last dimension but one is that of the rows.
    size = [outer, between, out.shape[dim], inner]
    strides = [[*s[:2], each.stride(dim), s[2]] for s, each in zip(strides, (out, x), strict=True)]
    table = (ctypes.c_int64 * len(rows))(*(rows % x.shape[dim]).tolist())
    reader.along("gather", out, x, size, strides, table)


def _note_sums(reader: _Reader, out: Tensor, args: Sequence[Any]) -> None:
    """Note sums along a dimension."""
    x, dim = args[:2]
    if x.dtype != out.dtype or out.dtype not in _FLOATS:
        raise UnknownGraphError(f"cumsum of {x.dtype}")
    size, strides = _beside(out, x, dim)
    size = [*size, out.shape[dim]]
    strides = [[*s, each.stride(dim)] for s, each in zip(strides, (out, x), strict=True)]
    reader.along("cumsum", out, x, size, strides, None)


def _beside(out: Tensor, x: Tensor, dim: int) -> tuple[list[int], list[list[int]]]:
    """Return sizes, and strides of both, of three dimensions in place of all but one."""
    if not x.dim():
        raise UnknownGraphError("rows of a number")
    rest = [k for k in range(x.dim()) if k != dim % x.dim()]
    size, strides = _collapsed([out.shape[k] for k in rest], [[each.stride(k) for k in rest] for each in (out, x)])
    if size[0] > 1:
        raise UnknownGraphError("too many dimensions")
    return size[1:], [s[1:] for s in strides]


def _note_fold(reader: _Reader, what: str, out: Tensor, args: Sequence[Any]) -> None:
    """Note a sum as one addition after the other, each of which goes along all numbers."""
    # A sum of all numbers has its type there.
    x, dims = args[0], args[1] if len(args) > 2 else None
    if x.dtype != out.dtype or out.dtype not in _FLOATS or not x.dim():
        raise UnknownGraphError(what)
    dims = [dims] if isinstance(dims, int) else list(dims or range(x.dim()))
    dims = [d % x.dim() for d in dims]
    wide = out
    if out.dim() != x.dim():
        for d in sorted(dims):
            wide = wide.unsqueeze(d)
    count = math.prod(x.shape[d] for d in dims)
    if len(dims) != 1 or not 0 < count <= _FOLDED:
        raise UnknownGraphError(f"{what} over {dims}")
    if count > _APART:
        # All of them go into one number, the last dimension being the one that is summed over.
        reader.loop("copy", wide, [x.narrow(dims[0], 0, 1)])
        rest = x.narrow(dims[0], 1, count - 1)
        reader.loop(what, wide.expand(rest.shape), [wide, rest])
        return
    parts = x.split(1, dims[0])
    if count == 1:
        reader.loop("copy", wide, [x])
    for k, part in enumerate(parts[1:]):
        reader.loop(what, wide, [wide if k else parts[0], part])


def _note_kernel(reader: _Reader, out: Sequence[Tensor], args: Sequence[Any]) -> None:
    """Note a kernel of rods, and copies of what it reads in another order."""
    inputs, kernel, topology, components, system, numbers = args
    plan = lanes.plan_of(inputs, kernel, topology, components, system, numbers)
    given = []
    for k, x in enumerate(inputs):
        if k in plan.copied:
            x = reader.operand(x, out[0].dtype)
            stored = lanes.stored(x, plan.batch, out[0].dtype)
            if reader.is_constant(x):
                reader.constant(stored)
            elif not reader.known(stored):
                reader.loop("copy", stored.unflatten(0, plan.batch) if x.dim() > 2 else stored, [x])
            x = stored
        given.append(x)
    if len(given) > _MOST_INPUTS:
        raise UnknownGraphError(kernel)
    views = [reader.view(x) for x in given]
    reader.operations.append(
        Operation("kernel", out[0].dtype, [1] * DIMS, [reader.view(x) for x in out], views, plan=plan)
    )


def _argument(reader: _Reader, x: Any) -> Any:
    """Return an argument of an operation of torch, with places of tensors for tensors."""
    if isinstance(x, Tensor):
        return reader.place(x)
    return type(x)(_argument(reader, each) for each in x) if isinstance(x, (list, tuple)) else x


def tensors_in(x: Any) -> list[Tensor]:
    """Return the tensors among what an operation takes or makes."""
    if isinstance(x, Tensor):
        return [x]
    return [t for each in x for t in tensors_in(each)] if isinstance(x, (list, tuple)) else []


def _operator(node: Any) -> Any:
    """Return an operation, the very overload: finding it among others takes far longer than most of them do."""
    if node.schema() == "(no schema)":
        raise UnknownGraphError(f"{node.kind()} is not an operation of torch")
    schema = torch._C.parse_schema(node.schema())
    space, _, name = schema.name.partition("::")
    operator = getattr(getattr(getattr(torch.ops, space), name), schema.overload_name or "default")
    if operator._schema.is_mutable:
        raise UnknownGraphError(f"{node.kind()} changes what it is given")
    return operator


def _check_shapes(reader: _Reader, operator: Any, args: Sequence[Any]) -> None:
    """Refuse an operation if numbers decide how many there are in what it makes."""
    if torch.Tag.dynamic_output_shape not in operator.tags and operator is not torch.ops.aten.where.default:
        return
    deciding = tensors_in(args)
    if operator.overloadpacket is torch.ops.aten.index:
        deciding = [x for x in tensors_in(args[1]) if x.dtype in _MASKS]
    if not all(reader.is_constant(x) for x in deciding):
        raise UnknownGraphError(f"{operator} makes as many numbers as others say")


def _do(reader: _Reader, node: Any, args: list[Any]) -> Any:
    """Do an operation, and note what it takes to do it again."""
    kind, operator = node.kind(), _operator(node)
    arguments = operator._schema.arguments
    if len(arguments) != len(args):
        raise UnknownGraphError(f"{kind} has other arguments than its schema says")
    named = {a.name: v for a, v in zip(arguments, args, strict=True) if a.kwarg_only}
    plain = args[: len(args) - len(named)]
    given = tensors_in(args)
    for x in given:
        if not reader.known(x):
            reader.constant(x)
    _check_shapes(reader, operator, args)
    out = operator(*plain, **named)
    if any(x.is_conj() or x.is_neg() for x in tensors_in(out)):
        raise UnknownGraphError(f"{kind} leaves numbers to be turned later")
    made = [x for x in tensors_in(out) if x.numel() and not reader.known(x)]
    changing = any(not reader.is_constant(x) for x in given) or torch.Tag.nondeterministic_seeded in operator.tags
    name = kind.removeprefix("aten::")
    if not tensors_in(out):
        if changing and kind not in _SIZES:
            raise UnknownGraphError(f"{kind} reads numbers")
    elif made and (not changing or name in _FILLED):
        for x in made:
            reader.constant(x)
    elif made:
        _note_made(reader, operator, name, out, made, plain, named)
    return out


def _note_made(
    reader: _Reader,
    operator: Any,
    name: str,
    out: Any,
    made: Sequence[Tensor],
    plain: Sequence[Any],
    named: dict[str, Any],
) -> None:
    """Note the loops of an operation that made new numbers, or that torch has to do it."""
    before = len(reader.operations)
    for x in made:
        reader.buffer(x)
    try:
        if operator.overloadpacket is torch.ops.torchdlo.rods:
            _note_kernel(reader, out, plain)
        else:
            _note(reader, name, out, [*plain, *named.values()])
    except UnknownGraphError:
        del reader.operations[before:]
        arguments = tuple(_argument(reader, x) for x in plain)
        options = {key: _argument(reader, x) for key, x in named.items()}
        views = [reader.view(x) for x in made]
        reader.operations.append(
            Operation("torch", torch.bool, [], views, [], operator=operator, arguments=arguments, named=options)
        )


@dataclass(frozen=True, eq=False)
class GraphReading:
    """What a graph does."""

    operations: list[Operation]
    """In their order."""
    constants: dict[int, Tensor]
    """Buffers that are always the same."""
    sizes: list[int]
    """Of all buffers [bytes]."""
    inputs: list[BufferView | Tensor]
    """The inputs; empty ones are tensors."""
    outputs: list[BufferView | Tensor]
    """The results, likewise."""


def read(graph: Any, inputs: Sequence[Tensor], numbers: Sequence[Tensor]) -> GraphReading:
    """Do a graph once, and return what it does to inputs of these shapes and strides.

    Args:
        graph: of TorchScript, without control flow, that returns a tuple of tensors.
        inputs: its first inputs.
        numbers: its other ones, which are always the same.

    Raises:
        UnknownGraphError: it changes tensors in place, or what it does depends on numbers.
    """
    reader, known = _Reader(), dict[int, Any]()
    with torch.no_grad():
        if any(x.is_conj() or x.is_neg() for x in inputs):
            raise UnknownGraphError("numbers that are to be turned later")
        given = [_apart(x) for x in inputs]
        for value, x in zip(graph.inputs(), [*given, *numbers], strict=True):
            known[value.unique()] = x
        first = [reader.place(x) for x in given]
        for x in numbers:
            reader.constant(x)
        for node in graph.nodes():
            _follow(reader, node, known)
        found = known[next(iter(graph.outputs())).unique()]
        for x in found:
            reader.constant(x)
        outputs = [reader.place(x) for x in found]
    return GraphReading(reader.operations, reader.constants, reader.sizes, first, outputs)


def _apart(x: Tensor) -> Tensor:
    """Return a copy with the same strides, and nothing else in its storage."""
    if not x.numel():
        return x
    extent = 1 + sum((n - 1) * step for n, step in zip(x.shape, x.stride(), strict=True))
    return x.as_strided((extent,), (1,), x.storage_offset()).clone().as_strided(x.shape, x.stride(), 0)


def _follow(reader: _Reader, node: Any, known: dict[int, Any]) -> None:
    """Do a node of a graph, of which all values before are known."""
    kind, outputs = node.kind(), list(node.outputs())
    args = [known[x.unique()] for x in node.inputs()]
    if kind == "prim::Constant":
        value = outputs[0].toIValue()
        # What was captured stays as it is now.
        known[outputs[0].unique()] = _apart(value) if isinstance(value, Tensor) else value
    elif kind in ("prim::ListConstruct", "prim::TupleConstruct"):
        known[outputs[0].unique()] = args
    elif kind in ("prim::ListUnpack", "prim::TupleUnpack"):
        known.update({x.unique(): each for x, each in zip(outputs, args[0], strict=True)})
    else:
        out = _do(reader, node, args)
        results = [out] if len(outputs) == 1 else out
        known.update({x.unique(): each for x, each in zip(outputs, results, strict=True)})


def views_in(x: Any) -> list[BufferView]:
    """Return the parts of buffers among an operation's arguments."""
    if isinstance(x, BufferView):
        return [x]
    return [v for each in x for v in views_in(each)] if isinstance(x, (list, tuple)) else []
