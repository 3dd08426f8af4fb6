"""Which vertices belong to which rod: several rods, open and closed, packed on one vertex axis.

Every rod is a cycle of slots. Slot i holds vertex i, the edge from vertex i to its successor, and the hinge at
vertex i between the edges of slots i-1 and i. The seam edge of an open rod (from its last vertex to its first) and
the hinges at its two ends are dummies, switched off by masks. So edge and hinge quantities have the shape of vertex
quantities, neighbours are one shift away, and a closed rod is an open one whose seam is real.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.linalg import banded


@dataclass(frozen=True)
class Topology:
    """Vertex counts of the rods on the packed axis, and which of them are closed loops."""

    counts: tuple[int, ...]
    closed: tuple[bool, ...]

    def __post_init__(self) -> None:
        if len(self.counts) != len(self.closed) or not self.counts:
            raise ValueError(
                f"topology: {len(self.counts)} counts and {len(self.closed)} closed flags; give one flag per rod"
            )
        for rod, (count, loop) in enumerate(zip(self.counts, self.closed, strict=True)):
            if count < 3:
                kind = "closed" if loop else "open"
                raise ValueError(f"rod {rod}: {count} vertices given, a {kind} rod needs at least 3")

    @property
    def size(self) -> int:
        """Number of slots, V."""
        return sum(self.counts)

    @property
    def starts(self) -> tuple[int, ...]:
        """First slot of each rod."""
        return tuple(sum(self.counts[:rod]) for rod in range(len(self.counts)))

    @property
    def name(self) -> str:
        """The topology as text, e.g. "o60,c24"; the patterns of linear systems are named by it."""
        return ",".join(f"{'c' if loop else 'o'}{count}" for count, loop in zip(self.counts, self.closed, strict=True))

    def successor(self) -> list[int]:
        """Return the next slot of every slot, cyclic within its rod."""
        following = list(range(1, self.size + 1))
        for start, count in zip(self.starts, self.counts, strict=True):
            following[start + count - 1] = start
        return following

    def edge_mask(self) -> list[float]:
        """Return 1 for real edges and 0 for the seams of open rods."""
        mask = [1.0] * self.size
        for start, count, loop in zip(self.starts, self.counts, self.closed, strict=True):
            mask[start + count - 1] = float(loop)
        return mask

    def hinge_mask(self) -> list[float]:
        """Return 1 for real hinges and 0 for the ends of open rods."""
        mask = self.edge_mask()
        for start, count, loop in zip(self.starts, self.counts, self.closed, strict=True):
            mask[start] = float(loop)
            mask[start + count - 1] = float(loop)
        return mask


def parse(name: str) -> Topology:
    """Return the topology of a name such as "o60,c24"."""
    parts = name.split(",")
    return Topology(tuple(int(part[1:]) for part in parts), tuple(part[0] == "c" for part in parts))


def _runs(topology: Topology, forward: bool) -> Sequence[tuple[int, int]]:
    """Return the pieces [a, b) whose concatenation shifts an axis by one slot within each rod."""
    if len(topology.counts) == 1 or not any(topology.closed):
        # With open rods only, dummies may take their value from the neighbouring rod: one roll does for all.
        return ((1, topology.size), (0, 1)) if forward else ((topology.size - 1, topology.size), (0, topology.size - 1))
    pieces: list[tuple[int, int]] = []
    for start, count in zip(topology.starts, topology.counts, strict=True):
        end = start + count
        pieces += [(start + 1, end), (start, start + 1)] if forward else [(end - 1, end), (start, end - 1)]
    return pieces


def following(topology: Topology, x: Tensor) -> Tensor:
    """Return at slot i the value of the next slot; x has shape (..., V, C) or (..., 1, C)."""
    if x.shape[-2] == 1:
        return x
    return _shifted(x, _runs(topology, True))


def preceding(topology: Topology, x: Tensor) -> Tensor:
    """Return at slot i the value of the slot before; x has shape (..., V, C) or (..., 1, C)."""
    if x.shape[-2] == 1:
        return x
    return _shifted(x, _runs(topology, False))


_MANY = 16
"""Pieces from which each of them costs more than to look up all slots."""


def _shifted(x: Tensor, runs: Sequence[tuple[int, int]]) -> Tensor:
    """Return pieces [a, b) of the vertices of x (..., V, C), put together."""
    many = len(runs) > _MANY and not x.requires_grad and not torch.compiler.is_compiling()
    if many or torch.jit.is_tracing():
        # Several times as fast as to put pieces together; but its derivative is slow.
        slots = torch.tensor([slot for run in runs for slot in range(*run)], device=x.device)
        return tree.logical(tree.stored(x).index_select(1, slots))
    return tree.cat_vertices([x[..., a:b, :] for a, b in runs])


def elimination_order(topology: Topology) -> list[int]:
    """Return the slots in an order that keeps neighbours near each other; loops are folded (0, n-1, 1, n-2, ...)."""
    order: list[int] = []
    for start, count, loop in zip(topology.starts, topology.counts, topology.closed, strict=True):
        slots = list(range(start, start + count))
        if loop:
            slots = [slots[k // 2] if k % 2 == 0 else slots[count - 1 - k // 2] for k in range(count)]
        order += slots
    return order


def _tridiagonal(name: str) -> banded.Pattern:
    """Pattern of a system that couples neighbouring slots; entries are [diagonal, to next, to previous], V each."""
    topology = parse(name)
    v, after = topology.size, topology.successor()
    places = [(i, i, i) for i in range(v)]
    for i in range(v):
        # On a loop of three, next and previous of a slot differ, so no place is named twice.
        places += [(i, after[i], v + i), (after[i], i, 2 * v + after[i])]
    return banded.make_pattern(v, _real(topology, places), elimination_order(topology))


def _real(topology: Topology, places: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Drop the couplings across the seams of open rods, which are zero and would widen the band."""
    seams = {
        frozenset((start, start + count - 1))
        for start, count, loop in zip(topology.starts, topology.counts, topology.closed, strict=True)
        if not loop
    }
    return [place for place in places if frozenset(place[:2]) not in seams]


banded.register_pattern("tridiagonal", functools.cache(_tridiagonal))
