"""What mass edges of ropes may have to carry, by what ropes are held and what is joined to them.

Bounds from above: an edge is taken to carry all of its own rope, and all that is joined to it and not held elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics.rod.topology import Topology


@dataclass(frozen=True)
class Load:
    """Free bodies that are joined to ropes, and ropes that are joined to each other."""

    links: tuple[tuple[int, int], ...] = ()
    """What each joint joins: a slot of a rope, and a slot of another rope or -1 - k for body k."""
    mass: Any = ()
    """Masses of the bodies [kg], shape (..., K, 1); () if there are none."""


@dataclass(frozen=True)
class _Graph:
    """Ropes, 0 to R - 1, and bodies, R + k, with the joints between them."""

    topology: Topology
    held: frozenset[int]
    masses: Sequence[Any]
    ends: Sequence[tuple[int, int, int, int]]
    """Of each joint both nodes, and the slot on each, -1 in bodies."""

    @property
    def held_ropes(self) -> set[int]:
        spans = zip(self.topology.starts, self.topology.counts, strict=True)
        return {k for k, (start, count) in enumerate(spans) if self.held & set(range(start, start + count))}

    def pieces(self, rope: int) -> list[tuple[set[int], set[int], bool]]:
        """Return the pieces that are left without a rope: nodes, slots where they are joined to it, if any is held."""
        found: list[tuple[set[int], set[int]]] = []
        for a, b, _, _ in self.ends:
            for node in {a, b} - {rope}:
                if any(node in nodes for nodes, _ in found):
                    continue
                nodes, grown = {node}, True
                while grown:
                    pairs = [{x, y} for x, y, *_ in self.ends if rope not in (x, y) and {x, y} & nodes]
                    grown = bool(set().union(*pairs) - nodes)
                    nodes = nodes.union(*pairs)
                at = {s for x, y, s, _ in self.ends if x == rope and y in nodes}
                found.append((nodes, at | {s for x, y, _, s in self.ends if y == rope and x in nodes}))
        return [(nodes, at, bool(nodes & self.held_ropes)) for nodes, at in found if at]

    def mass(self, nodes: set[int]) -> Any:
        """Return their mass [kg], shape (..., 1, 1)."""
        return sum((self.masses[k] for k in sorted(nodes)), start=0.0)


def carried_mass(topology: Topology, prescribed: Sequence[int], mass: Tensor, load: Load) -> Tensor:
    """Return at each slot the mass that its edge may carry [kg], shape (..., V, 1).

    That is the mass of its rope with what is joined to it, of its own end with what is joined there if that is a free
    one, and 0 if nothing holds it.

    Args:
        topology: the ropes.
        prescribed: held vertices.
        mass: that of the vertices [kg], shape (..., V, 1).
        load: what is joined to the ropes.
    """
    spans = list(zip(topology.starts, topology.counts, topology.closed, strict=True))
    ropes = [mass[..., start : start + count, :].sum(-2, keepdim=True) for start, count, _ in spans]
    bodies = load.mass.split(1, -2) if isinstance(load.mass, Tensor) else ()
    of_slot = [k for k, (_, count, _) in enumerate(spans) for _ in range(count)]
    ends = [
        (of_slot[one], of_slot[other] if other >= 0 else len(spans) - 1 - other, one, max(-1, other))
        for one, other in load.links
    ]
    graph, parts = _Graph(topology, frozenset(prescribed), [*ropes, *bodies], ends), []
    for rope, (start, count, closed) in enumerate(spans):
        pieces = graph.pieces(rope)
        own_held = rope in graph.held_ropes
        holding = [p for p in pieces if p[2]]
        # What alone holds a rope does not hang from it.
        loading = pieces if own_held or len(holding) > 1 else [p for p in pieces if not p[2]]
        whole = ropes[rope] + graph.mass(set().union(*(nodes for nodes, _, _ in loading)))
        carried = [whole * float(own_held or bool(holding))] * count
        for edge, end in ((0, start), (count - 2, start + count - 1)) if not closed else ():
            there = [p for p in pieces if end in p[1]]
            if end not in graph.held and (own_held or holding) and all(p[1] == {end} and not p[2] for p in there):
                beyond = set().union(*(nodes for nodes, _, _ in there))
                carried[edge] = mass[..., end : end + 1, :] + graph.mass(beyond)
        batch = torch.broadcast_shapes(*(x.shape[:-2] for x in carried))
        parts.append(torch.cat([x.expand(*batch, 1, 1) for x in carried], -2))
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in parts))
    return torch.cat([x.expand(*batch, *x.shape[-2:]) for x in parts], -2)
