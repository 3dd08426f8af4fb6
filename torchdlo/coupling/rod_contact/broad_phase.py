"""Which pairs of edges can touch before the next look: lists of fixed size, found in near-linear time.

Few edges: all pairs are tried. Many: the midpoints go into cubic cells as wide as two edges can be apart and still
meet, the edges are sorted by cell, and each edge is tried with the ones behind it in its own row of cells and with
those of the four rows that come after it; a row of three neighbouring cells is one run of the sorted list.

Nothing depends on data but the entries of the lists: what does not fit is counted, never dropped silently.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdlo.coupling.rod_contact.closest_points import closest_points
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.rod.kinematics import RodParams
from torchdlo.physics.rod.topology import Topology, following

FEW = 192
"""Number of slots up to which all pairs are tried."""
APART = 3
"""Pairs of edges of one rod with fewer steps between them are left out."""
_ROWS = ((1, 0), (-1, 1), (0, 1), (1, 1))
"""The rows of cells after a row, as steps in y and z; the other four come before it."""
_LIMIT = 1 << 20
"""Cells per axis."""


def _rods(topology: Topology) -> list[int]:
    return [k for k, count in enumerate(topology.counts) for _ in range(count)]


def take(mask: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the places of the first `count` true entries of each row.

    Args:
        mask: bool, shape (..., n).
        count: how many places there are, K.

    Returns:
        Places (..., K); 1 where there is an entry and 0 where the list has room left, (..., K); and how many true
        entries found no room, (..., 1).
    """
    running = mask.to(torch.int32).cumsum(-1, dtype=torch.int32)
    wanted = torch.arange(1, count + 1, dtype=torch.int32, device=mask.device).expand(*mask.shape[:-1], count)
    places = torch.searchsorted(running.contiguous(), wanted.contiguous())
    found = running[..., -1:]
    return places.clamp(max=mask.shape[-1] - 1), wanted <= found, (found - count).clamp(min=0)


def _column(x: Tensor, slots: Tensor) -> Tensor:
    """Return the values of `x`, shape (..., V), at slots (..., n)."""
    return torch.gather(x.expand(*slots.shape[:-1], x.shape[-1]), -1, slots)


def _points(x: Tensor, slots: Tensor) -> Tensor:
    """Return the values of `x`, shape (..., V, 3), at slots (..., n), shape (..., n, 3)."""
    return torch.gather(x, -2, slots.unsqueeze(-1).expand(*slots.shape, 3))


def _steps_apart(topology: Topology, first: Tensor, second: Tensor) -> Tensor:
    """Return whether edges are real, and of different rods or at least `APART` steps from each other."""
    device = first.device
    rod = torch.tensor(_rods(topology), device=device)
    real = torch.tensor(topology.edge_mask(), device=device) > 0
    count = torch.tensor(topology.counts, device=device)[rod]
    closed = torch.tensor(topology.closed, device=device)[rod]
    steps = second - first
    around = torch.where(closed[first], count[first] - steps, steps)
    far = torch.minimum(steps, around) >= APART
    return real[first] & real[second] & ((rod[first] != rod[second]) | far)


def _bend_apart(topology: Topology, params: RodParams, first: Tensor, second: Tensor, thick: Tensor) -> Tensor:
    """Return whether edges of one rod are far enough along it for the rod to come back to itself.

    A rod of radius r that is bent to a radius r, as far as it goes, meets itself after pi r.
    """
    rod = torch.tensor(_rods(topology), device=first.device)
    length = (params.rest.length * params.rest.edge_mask)[..., 0]
    start = length.cumsum(-1) - length
    ends = torch.tensor([s + c - 1 for s, c in zip(topology.starts, topology.counts, strict=True)], device=first.device)
    whole = (start + length)[..., ends] - start[..., torch.tensor(topology.starts, device=first.device)]
    between = _column(start, second) - _column(start, first) - _column(length, first)
    closed = torch.tensor(topology.closed, device=first.device)[rod]
    back = _column(whole[..., rod], first) - between - _column(length, first) - _column(length, second)
    between = torch.where(closed[first], torch.minimum(between, back), between)
    return (rod[first] != rod[second]) | (between >= 0.5 * math.pi * thick)


def _runs(middle: Tensor, cell: Tensor, real: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sort edges by cell.

    Args:
        middle: midpoints of the edges [m], shape (..., V, 3).
        cell: width of the cells [m], shape (..., 1, 1).
        real: whether the edge is one, shape (V,).

    Returns:
        The edges in the order of their cells (..., V), and for each of them and each of five rows of cells where the
        run begins and ends, (..., V, 5).
    """
    grid = ((middle - middle.amin(-2, keepdim=True)) / cell).floor().clamp(0, _LIMIT - 4).to(torch.int64) + 1
    key = (grid[..., 2] * _LIMIT + grid[..., 1]) * _LIMIT + grid[..., 0]
    key = torch.where(real, key, torch.iinfo(torch.int64).max // 2).contiguous()
    key, order = key.sort(dim=-1, stable=True)
    size = key.shape[-1]
    own = torch.arange(1, size + 1, device=key.device).expand_as(key)
    begins, ends = [own], [torch.searchsorted(key, key + 1, right=True)]
    for y, z in _ROWS:
        row = key + (z * _LIMIT + y) * _LIMIT
        begins.append(torch.searchsorted(key, row - 1))
        ends.append(torch.searchsorted(key, row + 1, right=True))
    there = real[order].unsqueeze(-1)
    begin, end = torch.stack(begins, -1), torch.stack(ends, -1)
    return order, begin, torch.where(there, torch.maximum(begin, end), begin)


def _by_cells(
    topology: Topology, middle: Tensor, reach: Tensor, row: int, rough: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return pairs whose midpoints are within the sum of their reaches, found by cells.

    Args:
        topology: the rods.
        middle: midpoints of the edges [m], shape (..., V, 3).
        reach: how far from its midpoint an edge can touch another [m], shape (..., V, 1).
        row: room for edges in a row of three cells.
        rough: room for pairs, P.

    Returns:
        First and second edges (..., P), whether they are a pair (..., P), and how many found no room (..., 1).
    """
    real = torch.tensor(topology.edge_mask(), device=middle.device) > 0
    wide = torch.where(real[:, None], reach, 0.0)
    cell = 2 * wide.amax(-2, keepdim=True)
    order, begin, end = _runs(middle, cell, real)
    place = begin.unsqueeze(-1) + torch.arange(row, device=middle.device)
    inside = place < end.unsqueeze(-1)
    lost = (end - begin - row).clamp(min=0).sum((-1, -2)).unsqueeze(-1)
    sorted_middle, sorted_wide = _points(middle, order), _column(wide[..., 0], order)
    shape = place.shape
    place = place.clamp(max=shape[-3] - 1).flatten(-3)
    other = _points(sorted_middle, place).unflatten(-2, shape[-3:])
    apart = (other - sorted_middle[..., :, None, None, :]).square().sum(-1)
    limit = sorted_wide[..., :, None, None] + _column(sorted_wide, place).unflatten(-1, shape[-3:])
    mask = (inside & (apart <= limit.square())).flatten(-3)
    where, there, dropped = take(mask, rough)
    a = torch.gather(order, -1, where // (shape[-2] * shape[-1]))
    b = torch.gather(order, -1, torch.gather(place, -1, where))
    return torch.minimum(a, b), torch.maximum(a, b), there, dropped + lost


def near_pairs(
    topology: Topology, params: RodParams, pos: Tensor, reach: Tensor, room: int, row: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return pairs of edges that touch if every vertex moves by `reach` in the worst direction.

    Args:
        topology: the rods.
        params: rest shape and material.
        pos: vertex positions [m], shape (..., V, 3).
        reach: how far vertices may move [m], shape (..., 1, 1).
        room: room for pairs, K.
        row: room for edges in a row of three cells.

    Returns:
        First and second edges, whether they are a pair, shape (..., K) each; how many pairs found no room, (..., 1).
    """
    batch, size = pos.shape[:-2], topology.size
    after = following(topology, pos)
    radius = params.material.radius.expand(*batch, size, 1)
    lost = torch.zeros(*batch, 1, dtype=torch.int64, device=pos.device)
    if size <= FEW:
        pairs = torch.triu_indices(size, size, APART, device=pos.device)
        if len(topology.counts) > 1:
            pairs = torch.triu_indices(size, size, 1, device=pos.device)
        some = pairs.shape[-1] > 0  # two edges touch no others; there is room for one pair that is none
        pairs = pairs if some else pairs.new_zeros(2, 1)
        first, second = pairs[0].expand(*batch, -1), pairs[1].expand(*batch, -1)
        there = torch.full_like(first, some, dtype=torch.bool)
    else:
        half = 0.5 * safe_norm(after - pos)
        first, second, there, lost = _by_cells(topology, 0.5 * (pos + after), half + radius + reach, row, _rough(room))
    thick = _column(radius[..., 0], first) + _column(radius[..., 0], second)
    mask = there & _steps_apart(topology, first, second) & _bend_apart(topology, params, first, second, thick)
    a = _points(pos, first), _points(after, first)
    b = _points(pos, second), _points(after, second)
    s, t = closest_points(a, b)
    apart = safe_norm(a[0] + s * (a[1] - a[0]) - b[0] - t * (b[1] - b[0]))[..., 0]
    places, there, dropped = take(mask & (apart <= thick + 2 * reach[..., 0]), room)
    return torch.gather(first, -1, places), torch.gather(second, -1, places), there, dropped + lost


def _rough(room: int) -> int:
    """Pairs whose midpoints are near, for each pair that is near: edges are longer than thick."""
    return 6 * room
