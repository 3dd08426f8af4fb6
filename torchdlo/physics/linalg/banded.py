"""Direct solution of the banded linear systems of a rod, for all scenes of a batch at once.

A `Pattern` says where the entries of the matrix stand; `solve` eliminates without pivoting (the systems are
positive definite, or saddle points ordered so that every pivot exists). On the CPU a small C++ kernel runs one
scene per SIMD lane; it is compiled once per machine with the compiler that `torch.compile` needs as well. Without
a compiler a dense batched solve gives the same result more slowly. CUDA devices run one scene per thread.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.physics.kernels import native


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the entries of a sparse matrix stand, in an order of unknowns that keeps them near the diagonal."""

    half_bandwidth: int
    """How far from the diagonal entries reach, k."""
    index: Tensor
    """Entry that stands at A[i, i+d-k] (-1: zero, -2: one) [1], int32, shape (2k+1, n)."""
    places: tuple[Tensor, Tensor]
    """Entry and its place among rows of 2k+1 bands, of the matrix and of its transpose [1], int32, shape (m, 2)."""
    order: Tensor
    """Place in the right-hand side of the i-th unknown of the elimination order [1], int32, shape (n,)."""

    @property
    def size(self) -> int:
        """Number of unknowns, n."""
        return self.order.shape[0]


def make_pattern(size: int, places: Sequence[tuple[int, int, int]], order: Sequence[int]) -> Pattern:
    """Build a pattern.

    Args:
        size: number of unknowns.
        places: (row, column, entry) triples in the numbering of the right-hand side.
        order: elimination order, a permutation of range(size).
    """
    rank = [0] * size
    for position, unknown in enumerate(order):
        rank[unknown] = position
    k = max((abs(rank[r] - rank[c]) for r, c, _ in places), default=0)
    index = torch.full((2 * k + 1, size), -1, dtype=torch.int32)
    rows = torch.tensor([rank[r] for r, _, _ in places])
    cols = torch.tensor([rank[c] for _, c, _ in places])
    entry = torch.tensor([e for _, _, e in places], dtype=torch.int32)
    index[cols - rows + k, rows] = entry

    def stored(rows: Tensor, cols: Tensor) -> Tensor:
        return torch.stack([entry, (rows * 2 * k + cols + k).to(torch.int32)], -1).contiguous()

    both = stored(rows, cols), stored(cols, rows)
    return Pattern(k, index.contiguous(), both, torch.tensor(list(order), dtype=torch.int32))


# Patterns are found by name inside the operator, so that a compiled graph holds a string instead of big constants.
_FACTORIES: dict[str, Callable[[str], Pattern]] = {}


def register_pattern(kind: str, factory: Callable[[str], Pattern]) -> None:
    """Let names "kind:rest" stand for `factory(rest)`."""
    _FACTORIES[kind] = factory


@functools.lru_cache(maxsize=256)
def pattern(name: str) -> Pattern:
    """Return the pattern of a registered name."""
    kind, _, rest = name.partition(":")
    return _FACTORIES[kind](rest)


@functools.lru_cache(maxsize=1)
def kernel() -> ctypes.CDLL | None:
    """Return the compiled kernel, or None where no C++ compiler is at hand."""
    library = native.library(native.RODS / "banded.cpp", *native.FAST_MATH, "-Wno-psabi")
    if library is None:
        return None
    for name in ("solve_float", "solve_double"):
        getattr(library, name).argtypes = [
            *(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p),
            *(ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int),
        ]
        getattr(library, name).restype = None
    return library


native.KERNELS["banded"] = kernel


@functools.lru_cache(maxsize=1024)
def _prepared(name: str, transpose: bool, double: bool) -> Callable[..., None] | None:
    """Return the kernel for a pattern as a function of addresses (entries, rhs, out), batch and threads."""
    library = kernel()
    if library is None:
        return None
    shape = pattern(name)
    call, places = library.solve_double if double else library.solve_float, shape.places[int(transpose)]
    at, count, order = places.data_ptr(), places.shape[0], shape.order.data_ptr()
    n, k = shape.size, shape.half_bandwidth

    # The default argument keeps the tensors behind the addresses.
    def run(entries: int, rhs: int, out: int, batch: int, threads: int, _kept: Pattern = shape) -> None:
        call(entries, at, count, order, rhs, out, n, k, batch, threads)

    return run


def _solve_cpu(entries: Tensor, rhs: Tensor, name: str, transpose: bool) -> Tensor:
    dtype = rhs.dtype
    run = _prepared(name, transpose, dtype == torch.float64) if dtype in (torch.float32, torch.float64) else None
    if run is None:
        return solve_dense(entries, rhs, name, transpose)
    entries, rhs = entries.contiguous(), rhs.contiguous()
    out = rhs.new_empty(rhs.shape)
    run(entries.data_ptr(), rhs.data_ptr(), out.data_ptr(), rhs.shape[1], torch.get_num_threads())
    return out


def _solve_cuda(entries: Tensor, rhs: Tensor, name: str, transpose: bool) -> Tensor:
    # Triton comes with most CUDA builds of torch only.
    try:
        from torchdlo.physics.linalg.banded_cuda import solve_cuda
    except ImportError:
        return _solve_elsewhere(entries, rhs, name, transpose)
    return solve_cuda(entries.contiguous(), rhs.contiguous(), pattern(name), transpose)


def _solve_elsewhere(entries: Tensor, rhs: Tensor, name: str, transpose: bool) -> Tensor:
    native.works_on(rhs.device.type, "banded systems of ropes (edge lengths, twist, implicit steps)")
    return solve_dense(entries, rhs, name, transpose)


def dense_matrix(entries: Tensor, name: str) -> Tensor:
    """Return the matrices that a pattern and its entries describe, shape (batch, n, n)."""
    shape = pattern(name)
    n, k = shape.size, shape.half_bandwidth
    values = torch.cat([entries, torch.ones_like(entries[:1]), torch.zeros_like(entries[:1])])
    at = torch.where(shape.index >= 0, shape.index, shape.index + values.shape[0] + 0).to(entries.device).long()
    at = torch.where(shape.index.to(at.device) == -1, values.shape[0] - 1, at)
    at = torch.where(shape.index.to(at.device) == -2, values.shape[0] - 2, at)
    bands = values[at.reshape(-1)].reshape(2 * k + 1, n, -1)
    matrix = entries.new_zeros(n, n, entries.shape[1])
    order = shape.order.to(entries.device).long()
    for d in range(2 * k + 1):
        rows = torch.arange(max(0, k - d), min(n, n + k - d), device=entries.device)
        matrix[order[rows], order[rows + d - k]] = bands[d, rows]
    return matrix.permute(2, 0, 1)


def solve_dense(entries: Tensor, rhs: Tensor, name: str, transpose: bool) -> Tensor:
    """Solve with full matrices: the reference of the kernel, and the way without it."""
    matrix = dense_matrix(entries, name)
    matrix = matrix.mT if transpose else matrix
    return torch.linalg.solve(matrix, rhs.T.unsqueeze(-1)).squeeze(-1).T.contiguous()


_library = torch.library.Library("torchdlo", "FRAGMENT")
# Without derivative a call costs a third less.
for _op in ("solve_banded", "solve_banded_plain"):
    _library.define(
        f"{_op}(Tensor entries, Tensor rhs, str pattern, bool transpose) -> Tensor",
        tags=(torch.Tag.needs_contiguous_strides,),
    )
    _library.impl(_op, _solve_cpu, "CPU")
    _library.impl(_op, _solve_cuda, "CUDA")
    _library.impl(_op, _solve_elsewhere, "CompositeExplicitAutograd")
    _library.impl(_op, lambda entries, rhs, pattern, transpose: rhs.new_empty(rhs.shape), "Meta")


def _save(ctx, inputs, output) -> None:
    entries, _, ctx.pattern, ctx.transpose = inputs
    ctx.save_for_backward(entries)


def _backward(ctx, gradient: Tensor):
    if ctx.needs_input_grad[0]:
        raise RuntimeError("solve_banded: the matrix is a constant of the solve; detach its entries")
    (entries,) = ctx.saved_tensors
    solved = torch.ops.torchdlo.solve_banded(entries, gradient.contiguous(), ctx.pattern, not ctx.transpose)
    return None, solved, None, None


torch.library.register_autograd("torchdlo::solve_banded", _backward, setup_context=_save, lib=_library)


def solve(entries: Tensor, rhs: Tensor, name: str) -> Tensor:
    """Solve A y = rhs for every scene; differentiable in `rhs`, with A as a constant.

    Newton's method needs no more: with z = z* - A^-1 R(z*, inputs) and z* already a root, the derivative of z
    with respect to the inputs is the one of the implicit function theorem.

    Args:
        entries: values of the matrix, shape (m, batch), without gradient.
        rhs: right-hand sides, shape (n, batch).
        name: a registered pattern.
    """
    if torch.is_grad_enabled() and rhs.requires_grad:
        return torch.ops.torchdlo.solve_banded(entries.detach(), rhs, name, False)
    return torch.ops.torchdlo.solve_banded_plain(entries.detach(), rhs, name, False)
