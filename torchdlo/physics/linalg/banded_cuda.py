"""The banded elimination of `banded` for CUDA devices, one scene per thread, written in Triton."""

from __future__ import annotations

import functools

import torch
import triton
import triton.language as tl
from torch import Tensor

from torchdlo.physics.linalg.banded import Pattern

_LANES = 32


@triton.jit
def _eliminate(
    entries,
    index,
    order,
    rhs,
    out,
    matrix,
    vector,
    n,
    batch,
    K: tl.constexpr,
    TRANSPOSE: tl.constexpr,
    LANES: tl.constexpr,
):
    lane = tl.program_id(0) * LANES + tl.arange(0, LANES)
    ok = lane < batch
    width: tl.constexpr = 2 * K + 1
    for i in range(n):
        # Row i of the matrix, or of its transpose; outside of the matrix the pattern says zero.
        for d in tl.static_range(width):
            row = i + d - K if TRANSPOSE else i
            col = 2 * K - d if TRANSPOSE else d
            inside = (row >= 0) & (row < n)
            which = tl.load(index + col * n + row, mask=inside, other=-1)
            value = tl.load(entries + which * batch + lane, mask=ok & (which >= 0), other=0.0)
            value = tl.where(which == -2, 1.0, value)
            tl.store(matrix + (i * width + d) * batch + lane, value, mask=ok)
        at = tl.load(order + i)
        tl.store(vector + i * batch + lane, tl.load(rhs + at * batch + lane, mask=ok, other=0.0), mask=ok)
    for i in range(n):
        base = matrix + i * width * batch + lane
        inverse = 1.0 / tl.load(base + K * batch, mask=ok, other=1.0)
        tl.store(base + K * batch, inverse, mask=ok)
        mine = tl.load(vector + i * batch + lane, mask=ok, other=0.0)
        for step in tl.static_range(1, K + 1):
            below = ok & (i + step < n)
            target = base + (step * width + K - step) * batch
            factor = tl.load(target, mask=below, other=0.0) * inverse
            for u in tl.static_range(1, K + 1):
                value = tl.load(target + u * batch, mask=below, other=0.0)
                value -= factor * tl.load(base + (K + u) * batch, mask=ok, other=0.0)
                tl.store(target + u * batch, value, mask=below)
            other = tl.load(vector + (i + step) * batch + lane, mask=below, other=0.0)
            tl.store(vector + (i + step) * batch + lane, other - factor * mine, mask=below)
    for j in range(n):
        i = n - 1 - j
        base = matrix + i * width * batch + lane
        value = tl.load(vector + i * batch + lane, mask=ok, other=0.0)
        for u in tl.static_range(1, K + 1):
            above = ok & (i + u < n)
            known = tl.load(vector + (i + u) * batch + lane, mask=above, other=0.0)
            value -= tl.load(base + (K + u) * batch, mask=above, other=0.0) * known
        value *= tl.load(base + K * batch, mask=ok, other=0.0)
        tl.store(vector + i * batch + lane, value, mask=ok)
        tl.store(out + tl.load(order + i) * batch + lane, value, mask=ok)


@functools.lru_cache(maxsize=256)
def _on_device(shape: Pattern, device: torch.device) -> tuple[Tensor, Tensor]:
    return shape.index.to(device), shape.order.to(device)


def solve_cuda(entries: Tensor, rhs: Tensor, shape: Pattern, transpose: bool) -> Tensor:
    """Solve as `banded.solve` does; `entries` (m, batch) and `rhs` (n, batch) contiguous on one CUDA device."""
    index, order = _on_device(shape, rhs.device)
    n, k, batch = shape.size, shape.half_bandwidth, rhs.shape[1]
    matrix = rhs.new_empty((n, 2 * k + 1, batch))
    vector, out = torch.empty_like(rhs), torch.empty_like(rhs)
    with torch.cuda.device(rhs.device):
        _eliminate[(triton.cdiv(batch, _LANES),)](
            entries, index, order, rhs, out, matrix, vector, n, batch, k, transpose, _LANES, num_warps=1
        )
    return out
