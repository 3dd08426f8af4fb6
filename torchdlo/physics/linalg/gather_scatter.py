"""Values of vertices at the corners of pairs of edges, and the sum of the corners' values over the vertices.

The two are transposes of each other, and each is the other's derivative. As operators of their own they add in the
same order in every run, compiled or not, on every device.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

Four = tuple[Tensor, ...]
"""Values at the four corners of every pair, shape (..., K, C) each."""


def _pick(rows: Tensor, at: Tensor) -> Tensor:
    return rows.index_select(1, at)


def _drop_cpu(values: Tensor, at: Tensor, size: int) -> Tensor:
    return values.new_zeros(values.shape[0], size).index_add_(1, at, values)


def _drop_cuda(values: Tensor, at: Tensor, size: int) -> Tensor:
    # Sorts by place; `index_add` would add in the order in which threads arrive.
    return values.new_zeros(size, values.shape[0]).index_put_((at,), values.T, accumulate=True).T.contiguous()


_library = torch.library.Library("torchdlo", "FRAGMENT")
_tags = (torch.Tag.needs_contiguous_strides,)
_library.define("pick_corners(Tensor rows, Tensor at) -> Tensor", tags=_tags)
_library.define("drop_corners(Tensor values, Tensor at, int size) -> Tensor", tags=_tags)
_library.impl("pick_corners", _pick, "CPU")
_library.impl("pick_corners", _pick, "CUDA")
_library.impl("pick_corners", lambda rows, at: rows.new_empty(rows.shape[0], at.shape[0]), "Meta")
_library.impl("drop_corners", _drop_cpu, "CPU")
_library.impl("drop_corners", _drop_cuda, "CUDA")
_library.impl("drop_corners", lambda values, at, size: values.new_empty(values.shape[0], size), "Meta")


def _save_pick(ctx, inputs, output) -> None:
    rows, at = inputs
    ctx.size = rows.shape[1]
    ctx.save_for_backward(at)


def _save_drop(ctx, inputs, output) -> None:
    ctx.save_for_backward(inputs[1])


def _pick_backward(ctx, gradient: Tensor):
    return torch.ops.torchdlo.drop_corners(gradient.contiguous(), ctx.saved_tensors[0], ctx.size), None


def _drop_backward(ctx, gradient: Tensor):
    return torch.ops.torchdlo.pick_corners(gradient.contiguous(), ctx.saved_tensors[0]), None, None


torch.library.register_autograd("torchdlo::pick_corners", _pick_backward, setup_context=_save_pick, lib=_library)
torch.library.register_autograd("torchdlo::drop_corners", _drop_backward, setup_context=_save_drop, lib=_library)


def corners(vertices: Tensor) -> Tensor:
    """Return vertex numbers (..., 4, K) as places on the axis on which all scenes' vertices stand, shape (..., 4, K).

    Vertex v of scene b of B stands at v B + b: the batch is innermost, as everywhere in storage.
    """
    batch = vertices.shape[:-2]
    count = batch.numel()
    scene = torch.arange(count, device=vertices.device).reshape(batch)[..., None, None]
    stored = _stored(vertices * count + scene).contiguous()
    return stored.permute(*range(2, vertices.dim()), 0, 1)


def _stored(x: Tensor) -> Tensor:
    """Return a (..., m, n) tensor as (m, n, ...)."""
    n = x.dim()
    return x.permute(n - 2, n - 1, *range(n - 2))


def columns(parts: Sequence[Tensor]) -> Tensor:
    """Join (..., n, c) tensors along their last axis; the result is stored batch-innermost."""
    stored = torch.cat([_stored(x.mT) for x in parts])
    return stored.permute(*range(2, stored.dim()), 1, 0)


def pick(x: Tensor, at: Tensor) -> Four:
    """Return the values of `x`, shape (..., V, C), at the four corners of every pair, shape (..., K, C) each.

    Args:
        x: values of vertices.
        at: what `corners` returned, shape (..., 4, K).
    """
    batch, count = at.shape[:-2], at.shape[-1]
    rows = _stored(x.expand(*batch, *x.shape[-2:]).mT).reshape(x.shape[-1], -1)
    found = torch.ops.torchdlo.pick_corners(rows.contiguous(), _stored(at).reshape(-1))
    found = found.reshape(x.shape[-1], 4, count, *batch)
    return tuple(found[:, k].permute(*range(2, 2 + len(batch)), 1, 0) for k in range(4))


def drop(values: Four, at: Tensor, size: int) -> Tensor:
    """Return for each of `size` vertices the sum of the values of its corners, shape (..., size, C).

    Args:
        values: values of the four corners of every pair, shape (..., K, C) each.
        at: what `corners` returned, shape (..., 4, K).
        size: number of vertices, V.
    """
    batch = at.shape[:-2]
    stacked = torch.stack([_stored(v.expand(*batch, *v.shape[-2:]).mT) for v in values], 1)
    rows = stacked.reshape(stacked.shape[0], -1).contiguous()
    found = torch.ops.torchdlo.drop_corners(rows, _stored(at).reshape(-1), size * batch.numel())
    return found.reshape(-1, size, *batch).permute(*range(2, 2 + len(batch)), 1, 0)
