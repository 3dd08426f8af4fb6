"""Banded systems of ropes with a term of low rank: pairs of vertices' edges that touch, by Woodbury's formula.

With A banded and L R of rank 3 per pair, (A + L R) x = b has the solution x = a - W (1 + R W)^-1 R a, a = A^-1 b and
W = A^-1 L. Only pairs with a part in R are taken into it, as many as the scene of a batch with most of them has.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class LowRank:
    """L and R: how pairs of four vertices add to the matrix, K pairs in each of B scenes."""

    vertex: Tensor
    """The four vertices of each pair [1], shape (4, K, B)."""
    left: Tensor
    """By how much a part of the pair counts in the rows of its vertices: row, part [1], shape (4, 3, 3, K, B)."""
    right: Tensor
    """By how much the columns of its vertices count in a part: part, column [kg], shape (4, 3, 3, K, B)."""

    def repeat(self, count: int) -> LowRank:
        """Return the same for several right-hand sides, one after the other."""
        return LowRank(*(x.repeat(*[1] * (x.dim() - 1), count) for x in (self.vertex, self.left, self.right)))


def _solve(
    entries: Tensor, vertex: Tensor, left: Tensor, right: Tensor, rhs: Tensor, name: str, transpose: bool
) -> Tensor:
    active = (right != 0).flatten(0, 2).any(0)
    most = int(active.sum(0).max()) if active.numel() else 0
    if most == 0:
        return torch.ops.torchdlo.solve_banded_plain(entries, rhs, name, transpose)
    # Those with a part in it come first.
    chosen = torch.argsort(active.to(torch.int8), stable=True, dim=0, descending=True)[:most]
    vertex = torch.gather(vertex, 1, chosen.expand(4, -1, -1))
    left, right = (torch.gather(x, 3, chosen.expand(4, 3, 3, -1, -1)) for x in (left, right))
    left = left * torch.gather(active, 0, chosen)
    if transpose:
        left, right = right.transpose(1, 2), left.transpose(1, 2)
    n, scenes = rhs.shape
    slots = n // 4
    # Rows of the right-hand side: x of all vertices, then y, then z.
    rows = vertex.unsqueeze(1) + slots * torch.arange(3, device=rhs.device)[:, None, None]
    columns = rhs.new_zeros(n, most, 3, scenes)
    for k in range(4):
        for c in range(3):
            at = rows[k, c].unsqueeze(0).unsqueeze(2).expand(1, most, 3, scenes)
            columns.scatter_add_(0, at, left[k, c].transpose(0, 1).unsqueeze(0))
    both = torch.cat([rhs, columns.reshape(n, -1)], 1)
    solved = torch.ops.torchdlo.solve_banded_plain(entries.repeat(1, 1 + 3 * most), both, name, transpose)
    plain, answers = solved[:, :scenes], solved[:, scenes:].reshape(n, 3 * most, scenes)
    felt = torch.zeros(most, 3, 3 * most, scenes, dtype=rhs.dtype, device=rhs.device)
    known = torch.zeros(most, 3, scenes, dtype=rhs.dtype, device=rhs.device)
    for k in range(4):
        for c in range(3):
            at, part = rows[k, c], right[k, :, c].transpose(0, 1)
            mine = torch.gather(answers, 0, at.unsqueeze(1).expand(most, 3 * most, scenes))
            felt += part.unsqueeze(2) * mine.unsqueeze(1)
            known += part * torch.gather(plain, 0, at).unsqueeze(1)
    small = felt.reshape(3 * most, 3 * most, scenes).permute(2, 0, 1)
    small = small + torch.eye(3 * most, dtype=rhs.dtype, device=rhs.device)
    share = torch.linalg.solve(small, known.reshape(3 * most, scenes).T.unsqueeze(-1))
    return (plain - torch.einsum("njb,bj->nb", answers, share.squeeze(-1))).contiguous()


_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define(
    "solve_low_rank(Tensor entries, Tensor vertex, Tensor left, Tensor right, Tensor rhs, str pattern, bool transpose) "
    "-> Tensor"
)
for _device in ("CPU", "CUDA"):
    _operators.impl("solve_low_rank", _solve, _device)
_operators.impl(
    "solve_low_rank",
    lambda entries, vertex, left, right, rhs, pattern, transpose: rhs.new_empty(rhs.shape),
    "Meta",
)


def _save(ctx, inputs, output) -> None:
    *matrix, _, ctx.pattern, ctx.transpose = inputs
    ctx.save_for_backward(*matrix)


def _backward(ctx, gradient: Tensor):
    solved = torch.ops.torchdlo.solve_low_rank(
        *ctx.saved_tensors, gradient.contiguous(), ctx.pattern, not ctx.transpose
    )
    return None, None, None, None, solved, None, None


torch.library.register_autograd("torchdlo::solve_low_rank", _backward, setup_context=_save, lib=_operators)


def solve(entries: Tensor, rank: LowRank, rhs: Tensor, name: str) -> Tensor:
    """Solve (A + L R) y = rhs for every scene; differentiable in `rhs`, with the matrix as a constant.

    Args:
        entries: values of A, shape (m, B), without gradient.
        rank: L and R, without gradient.
        rhs: right-hand sides, shape (n, B), whose first three quarters are those of vertices.
        name: a registered pattern.
    """
    matrix = entries.detach(), rank.vertex, rank.left.detach(), rank.right.detach()
    return torch.ops.torchdlo.solve_low_rank(*matrix, rhs, name, False)
