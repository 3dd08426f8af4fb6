"""Trees of tensors: frozen dataclasses registered as pytrees, and the storage layout they share.

Logical shapes put the batch first, (..., V, C); storage puts it last, so that one instruction works on many
scenes and vertices of one scene sit a whole batch apart. `batch_innermost` is the only place that knows.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar, dataclass_transform

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def struct(cls: type[T]) -> type[T]:
    """Make a frozen dataclass whose fields are tensors or trees of tensors, known to torch's pytrees."""
    made: Any = dataclasses.dataclass(frozen=True)(cls)
    torch.export.register_dataclass(made, serialized_type_name=f"{made.__module__}.{made.__qualname__}")
    _FIELDS[made] = tuple(field.name for field in dataclasses.fields(made))
    return made


_FIELDS: dict[type, tuple[str, ...]] = {}
"""Structs, which steps walk through so often that torch's general way took half the time of a small one."""


def leaves(tree: Any) -> list[Tensor]:
    """Return the tensors of a tree in a fixed order."""
    found: list[Tensor] = []
    _collect(tree, found, [])
    return found


def described(tree: Any) -> tuple[list[Tensor], tuple[Any, ...]]:
    """Return the tensors of a tree in the order of `leaves`, and the keys of its dictionaries in theirs.

    Two trees of which all fields and keys are the same may still differ in the order of their tensors: that of keys.
    """
    found: list[Tensor] = []
    keys: list[Any] = []
    _collect(tree, found, keys)
    return found, tuple(keys)


def _collect(tree: Any, found: list[Tensor], keys: list[Any]) -> None:
    kind = type(tree)
    if kind in _FIELDS:
        for name in _FIELDS[kind]:
            part = getattr(tree, name)
            if type(part) is Tensor:  # half of the calls
                found.append(part)
            else:
                _collect(part, found, keys)
    elif kind is dict:
        keys.append(tuple(tree))
        for part in tree.values():
            _collect(part, found, keys)
    elif kind is tuple or kind is list:
        for part in tree:
            _collect(part, found, keys)
    elif isinstance(tree, Tensor):
        found.append(tree)
    elif tree is not None:
        found += pytree.tree_leaves(tree)


def map(fn: Callable[..., Tensor], tree: T, *others: Any) -> T:
    """Apply `fn` to matching leaves of one or several trees of the same structure."""
    kind: Any = type(tree)
    trees: tuple[Any, ...] = (tree, *others)
    made: Any = None
    if any(type(other) is not kind or (kind is dict and other.keys() != trees[0].keys()) for other in others):
        made = pytree.tree_map(fn, tree, *others)  # says what differs
    elif kind in _FIELDS:
        made = kind(*[map(fn, *[getattr(each, name) for each in trees]) for name in _FIELDS[kind]])
    elif kind is dict:
        made = {key: map(fn, *[each[key] for each in trees]) for key in trees[0]}
    elif kind is tuple or kind is list:
        made = kind([map(fn, *parts) for parts in zip(*trees, strict=True)])
    elif isinstance(tree, Tensor):
        made = fn(*trees)
    elif tree is not None:
        made = pytree.tree_map(fn, tree, *others)
    return made


def flatten(tree: T) -> tuple[list[Tensor], Callable[[Iterable[Tensor]], T]]:
    """Return the leaves and a function that rebuilds the tree from such leaves."""
    return leaves(tree), builder(tree)


def builder(tree: T) -> Callable[[Iterable[Tensor]], T]:
    """Return a function that makes such a tree of leaves in the order of `leaves`; it keeps none of this one."""
    build = _builder(tree)
    return lambda values: build(iter(values))


def _builder(tree: Any) -> Callable[[Iterator[Tensor]], Any]:
    kind = type(tree)
    if kind in _FIELDS:
        parts = [_builder(getattr(tree, name)) for name in _FIELDS[kind]]
        return lambda values: kind(*[part(values) for part in parts])
    if kind is tuple or kind is list:
        parts = [_builder(part) for part in tree]
        return lambda values: kind([part(values) for part in parts])
    if kind is dict:
        named = {key: _builder(part) for key, part in tree.items()}
        return lambda values: {key: part(values) for key, part in named.items()}
    if isinstance(tree, Tensor):
        return next
    if tree is None:
        return lambda values: None
    spec = pytree.tree_structure(tree)
    return lambda values: pytree.tree_unflatten([next(values) for _ in range(spec.num_leaves)], spec)


def replace(tree: T, **fields: Any) -> T:
    """Return a copy of a struct with some fields exchanged."""
    struct: Any = tree
    return dataclasses.replace(struct, **fields)


def part(found: T | tuple[()] | None) -> T:
    """Return a part of a tree that is known to be there; one that is not is () or None."""
    there: Any = found
    if there is None or (isinstance(there, tuple) and not there):
        raise ValueError("tree: a part was asked for that is not there; look whether there is one before it is used.")
    return there


def detach(tree: T) -> T:
    """Cut a tree from its gradient history."""
    return map(lambda leaf: leaf.detach() if leaf.requires_grad else leaf, tree)


def to(tree: T, *args: Any, **kwargs: Any) -> T:
    """Move floating-point leaves to another dtype, all leaves to another device; keeps the layout."""

    def move(leaf: Tensor) -> Tensor:
        if not leaf.is_floating_point():
            device = kwargs.get("device", next((a for a in args if not isinstance(a, torch.dtype)), None))
            return leaf if device is None else leaf.to(device)
        return leaf.to(*args, **kwargs)

    return map(move, tree)


def where(condition: Tensor, tree: T, other: T) -> T:
    """Choose per scene: leaves of `tree` where `condition` (batch,) holds, else those of `other`."""

    def choose(a: Tensor, b: Tensor) -> Tensor:
        extra = a.dim() - condition.dim()
        return torch.where(condition.reshape(condition.shape + (1,) * extra), a, b)

    return map(choose, tree, other)


def stack(trees: Sequence[T], dim: int = 0) -> T:
    """Stack equal trees along a new axis, e.g. the states of a trajectory along time."""
    return map(lambda *parts: torch.stack(parts, dim), trees[0], *trees[1:])


def stored(x: Tensor) -> Tensor:
    """Return a view of `x`, shape (..., V, C), with its axes in the order of storage, (C, V, ...)."""
    n = x.dim()
    return x.permute(n - 1, n - 2, *range(n - 2))


def logical(x: Tensor) -> Tensor:
    """Return a view of `x`, shape (C, V, ...), with its axes in the logical order, (..., V, C)."""
    return x.permute(*range(2, x.dim()), 1, 0)


def batch_innermost(x: Tensor) -> Tensor:
    """Return `x`, shape (..., V, C), with the same values stored as (C, V, ...)."""
    return x if x.dim() < 3 else logical(stored(x).contiguous())


def take_vertices(x: Tensor, slots: Sequence[int]) -> Tensor:
    """Return a copy of some slots of the vertex axis of (..., V, C)."""
    first = slots[0] if slots else 0
    if list(slots) == list(range(first, first + len(slots))):
        return x.narrow(-2, first, len(slots)).clone()  # several times as fast as looking up
    if x.is_cuda and not torch.compiler.is_compiling():
        # A list would be copied from the CPU each time, for which a CUDA graph has no place.
        return x.index_select(-2, _slots(tuple(slots), x.device))
    return x[..., list(slots), :]


@functools.cache  # recorded graphs read them for good
def _slots(slots: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.tensor(slots, dtype=torch.int64, device=device)


def cat_vertices(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate (..., v, C) pieces along the vertex axis; the result is stored batch-innermost."""
    return logical(torch.cat([stored(p) for p in parts], 1))


def cat_components(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate (..., V, c) pieces along the last axis; the result is stored batch-innermost."""
    return logical(torch.cat([stored(p) for p in parts]))
