"""Operations whose derivative stays finite where the plain ones have none: the only home of small numbers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import tree


def tiny(x: Tensor) -> float:
    """Return a length far below any rope's and far above the underflow of a square, by dtype."""
    return 1e-12 if x.dtype == torch.float64 else 1e-8


def total(x: Tensor) -> Tensor:
    """Return the sum over the last axis, kept as size 1; shape (..., 1)."""
    # In the order of storage: otherwise the result would be stored batch-outermost, which makes what follows slow.
    return x.sum(-1, keepdim=True) if x.dim() < 2 else tree.logical(tree.stored(x).sum(0, keepdim=True))


def added(parts: Iterable[Tensor]) -> Tensor:
    """Return the sum of some tensors, one at least."""
    found: Any = sum(parts)  # which is 0, and no tensor, of none
    return found


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the scalar product over the last axis, kept as size 1; shape (..., 1)."""
    return total(a * b)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the vector product over the last axis, shape (..., 3)."""
    a, b = torch.broadcast_tensors(a, b)
    if a.dim() < 2:
        return torch.linalg.cross(a, b, dim=-1)
    a, b = tree.stored(a), tree.stored(b)
    if torch.jit.is_tracing():
        # Twice as fast as the operation made for it: components are moved as wholes, as (y, z, x).
        turn = torch.tensor([1, 2, 0], device=a.device)
        turned = a * b.index_select(0, turn) - a.index_select(0, turn) * b
        return tree.logical(turned.index_select(0, turn))
    return tree.logical(torch.linalg.cross(a, b, dim=0))


def safe_norm(x: Tensor) -> Tensor:
    """Return the length of vectors over the last axis, shape (..., 1); its gradient at zero is zero."""
    squared = dot(x, x)
    zero = squared <= tiny(x) ** 2
    return torch.where(zero, 0.0, torch.where(zero, 1.0, squared).sqrt())


def normalize(x: Tensor) -> Tensor:
    """Return unit vectors; zero vectors give zero with a zero gradient."""
    length = safe_norm(x)
    return x / torch.where(length == 0, 1.0, length)


def wrap(angle: Tensor) -> Tensor:
    """Return the angle [rad] in (-pi, pi] that differs by whole turns; derivative 1."""
    turns = torch.round(angle.detach() / (2 * torch.pi))
    return angle - 2 * torch.pi * turns
