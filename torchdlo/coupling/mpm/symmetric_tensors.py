"""Symmetric 3x3 tensors of many particles, as tuples of their components (xx, yy, zz, xy, xz, yz).

Components are tensors of one shape each, (..., N), so that one instruction works on many particles. Isotropic functions
are taken through the eigenvectors. Their derivative is exact and finite for every tensor, also where eigenvalues
coincide and eigenvectors have none: in the eigenbasis it multiplies by divided differences of the function
(Daleckii and Krein 1965; Higham 2008, Functions of Matrices, theorem 3.11, doi:10.1137/1.9780898717778).

On the CPU a C++ kernel does it, without a second derivative; elsewhere, and without a compiler, tensor operations do,
whose second derivatives are those of the linearised function and not exact.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.physics.linalg.numerics import added

Symmetric = tuple[Tensor, ...]
"""Six components xx, yy, zz, xy, xz, yz of a symmetric tensor, shape (..., N) each."""
Square = tuple[Tensor, ...]
"""Nine components of a tensor, row by row, shape (..., N) each."""

CRUSHED = 1e-6
"""Least eigenvalue of I + e that functions see: squares of stretches below it count as it."""

_AT = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of each component."""


def full(s: Symmetric) -> Square:
    """Return all nine components."""
    return tuple(s[_AT[i][j]] for i in range(3) for j in range(3))


def trace(s: Symmetric) -> Tensor:
    """Return the sum of the diagonal."""
    return s[0] + s[1] + s[2]


def second(s: Symmetric) -> Tensor:
    """Return the sum of the principal minors of order two."""
    return s[0] * s[1] + s[1] * s[2] + s[2] * s[0] - s[3] * s[3] - s[4] * s[4] - s[5] * s[5]


def determinant(s: Symmetric) -> Tensor:
    """Return the determinant."""
    return s[0] * (s[1] * s[2] - s[5] * s[5]) + s[3] * (s[4] * s[5] - s[3] * s[2]) + s[4] * (s[3] * s[5] - s[1] * s[4])


def add_diagonal(s: Symmetric, d: Tensor) -> Symmetric:
    """Return s + d I."""
    return (s[0] + d, s[1] + d, s[2] + d, *s[3:])


def deviator(s: Symmetric) -> Symmetric:
    """Return the part without trace."""
    return add_diagonal(s, -trace(s) / 3)


def squared(s: Symmetric) -> Tensor:
    """Return the sum of the squares of all nine components."""
    return s[0] * s[0] + s[1] * s[1] + s[2] * s[2] + 2 * (s[3] * s[3] + s[4] * s[4] + s[5] * s[5])


def select(condition: Tensor, yes: Symmetric, no: Symmetric) -> Symmetric:
    """Return `yes` where the condition holds, else `no`."""
    return tuple(torch.where(condition, a, b) for a, b in zip(yes, no, strict=True))


def deform(e: Symmetric, a: Square) -> Symmetric:
    """Return (I + a)(I + e)(I + a)^T - I.

    The identity is never added: strains of 1e-6 stay exact in single precision.
    """
    s = full(e)
    g = tuple(a[3 * i + j] + sum(a[3 * i + k] * s[3 * k + j] for k in range(3)) for i in range(3) for j in range(3))
    return tuple(
        e[n] + g[3 * i + j] + g[3 * j + i] + sum(g[3 * i + k] * a[3 * j + k] for k in range(3))
        for n, (i, j) in enumerate(PAIRS)
    )


def _jacobi(tensors: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `eigen` does, from (6, M) to (3, M) and (9, M)."""
    value = list(tensors.unbind(0))
    one, zero = torch.ones_like(value[0]), torch.zeros_like(value[0])
    vectors = [one, zero, zero, zero, one, zero, zero, zero, one]
    tiny = torch.finfo(tensors.dtype).tiny
    for _ in range(5 if tensors.dtype == torch.float64 else 4):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            r = 3 - p - q
            pq, pr, qr = _AT[p][q], _AT[p][r], _AT[q][r]
            gap, off = value[q] - value[p], 2 * value[pq]
            t = (off / (gap.abs() + (gap * gap + off * off).sqrt() + tiny)).clamp(-1.0, 1.0)
            t = t * torch.copysign(one, gap)
            c = torch.rsqrt(1 + t * t)
            n = t * c
            value[p], value[q] = value[p] - t * value[pq], value[q] + t * value[pq]
            value[pr], value[qr] = c * value[pr] - n * value[qr], n * value[pr] + c * value[qr]
            value[pq] = zero
            for i in (0, 3, 6):
                a, b = vectors[i + p], vectors[i + q]
                vectors[i + p], vectors[i + q] = c * a - n * b, n * a + c * b
    return torch.stack(value[:3]), torch.stack(vectors)


# An operator of its own: compilers take minutes to unroll the rotations.
_library = torch.library.Library("torchdlo", "FRAGMENT")
_library.define("eigen3(Tensor tensors) -> (Tensor, Tensor)", tags=(torch.Tag.needs_contiguous_strides,))
_library.impl("eigen3", _jacobi, "CompositeExplicitAutograd")
_library.impl("eigen3", lambda t: (t.new_empty(3, t.shape[1]), t.new_empty(9, t.shape[1])), "Meta")


def eigen(s: Symmetric) -> tuple[tuple[Tensor, ...], Square]:
    """Return eigenvalues and the matrix whose columns are eigenvectors, by cyclic Jacobi rotations; no derivative.

    Golub and Van Loan 2013, Matrix Computations, section 8.5. A fixed number of sweeps: errors shrink cubically.
    """
    shape = s[0].shape
    values, vectors = torch.ops.torchdlo.eigen3(torch.stack([x.detach().reshape(-1) for x in s]))
    return tuple(values.reshape(3, *shape).unbind(0)), tuple(vectors.reshape(9, *shape).unbind(0))


def _rotate(u: Square, s: Symmetric, back: bool) -> Symmetric:
    """Return U^T S U, or U S U^T if `back`."""
    x = full(s)

    def at(i: int, j: int) -> Tensor:
        return u[3 * i + j] if back else u[3 * j + i]

    left = [[added(at(i, k) * x[3 * k + j] for k in range(3)) for j in range(3)] for i in range(3)]
    return tuple(added(left[i][k] * at(j, k) for k in range(3)) for i, j in PAIRS)


def _plainly(
    e: Symmetric, value: Callable[[Tensor], Tensor], gradient: Callable[[Tensor, Tensor], Tensor], least: float | None
) -> Symmetric:
    """Return the function of a tensor that acts on its eigenvalues.

    Args:
        e: the tensor.
        value: the function of an eigenvalue.
        gradient: its divided difference (f(a) - f(b)) / (a - b), with the derivative where a = b.
        least: eigenvalues below it count as it; None if the function takes all.
    """
    with torch.no_grad():
        plain = tuple(x.detach() for x in e)
        l, u = eigen(plain)
        if least is not None:
            l = tuple(x.clamp(min=least) for x in l)
        zero = torch.zeros_like(l[0])
        found: Symmetric = (value(l[0]), value(l[1]), value(l[2]), zero, zero, zero)
    if torch.is_grad_enabled() and any(x.requires_grad for x in e):
        # x - x.detach() is zero and has the derivative of x.
        change = _rotate(u, tuple(x - y for x, y in zip(e, plain, strict=True)), back=False)
        with torch.no_grad():
            factors = [gradient(l[i], l[j]) for i, j in PAIRS]
        found = tuple(f + k * c for f, k, c in zip(found, factors, change, strict=True))
    return _rotate(u, found, back=True)


_FUNCTIONS = ("stretch", "hencky", "from_hencky")
kernel_function, ready = scene_packing.kernel("symmetric", "material points, their elastic laws")


def _run(tensors: Tensor, by: Tensor | None, which: str) -> Tensor:
    out = torch.empty_like(tensors)
    places = (None if x is None else ctypes.c_void_p(x.data_ptr()) for x in (tensors, by, out))
    call = kernel_function("act", tensors.dtype)
    call(_FUNCTIONS.index(which), *places, ctypes.c_int64(tensors.shape[1]), torch.get_num_threads())
    return out


for _schema, _make in (
    ("isotropic(Tensor tensors, str which) -> Tensor", lambda tensors, which: _run(tensors, None, which)),
    ("isotropic_back(Tensor tensors, Tensor by, str which) -> Tensor", _run),
):
    _name = _schema.partition("(")[0]
    _library.define(_schema, tags=(torch.Tag.needs_contiguous_strides,))
    _library.impl(_name, _make, "CPU")
    _library.impl(_name, lambda tensors, *others: torch.empty_like(tensors), "Meta")


def _save(ctx, inputs, output) -> None:
    tensors, ctx.which = inputs
    ctx.save_for_backward(tensors)


def _backward(ctx, by: Tensor):
    return torch.ops.torchdlo.isotropic_back(*ctx.saved_tensors, by.contiguous(), ctx.which), None


torch.library.register_autograd("torchdlo::isotropic", _backward, setup_context=_save, lib=_library)
torch.library.register_autograd("torchdlo::isotropic_back", scene_packing.refuse_second_derivative, lib=_library)


def _isotropic(e: Symmetric, which: str, *formulas) -> Symmetric:
    """Return a function of a tensor by its name in the kernel, or by its formulas as `_plainly` takes them."""
    if not ready(e[0].device.type, e[0].dtype):
        return _plainly(e, *formulas)
    parts = torch.broadcast_tensors(*e)
    found = torch.ops.torchdlo.isotropic(torch.stack([x.reshape(-1) for x in parts]), which)
    return tuple(found.reshape(6, *parts[0].shape).unbind(0))


def stretch(e: Symmetric) -> Symmetric:
    """Return sqrt(I + e) - I."""

    def gradient(a: Tensor, b: Tensor) -> Tensor:
        return 1 / ((1 + a).sqrt() + (1 + b).sqrt())

    return _isotropic(e, "stretch", lambda l: l / (1 + (1 + l).sqrt()), gradient, CRUSHED - 1)


def hencky(e: Symmetric) -> Symmetric:
    """Return log(I + e) / 2."""

    def gradient(a: Tensor, b: Tensor) -> Tensor:
        # log((1+a)/(1+b)) = 2 atanh(z); the quotient atanh(z) / z by its series where z is small.
        z = (a - b) / (2 + a + b)
        z2 = z * z
        small = z2 < 1e-4
        direct = torch.atanh(torch.where(small, 0.5, z)) / torch.where(small, 0.5, z)
        return torch.where(small, 1 + z2 * (1 / 3 + z2 * (1 / 5 + z2 * (1 / 7 + z2 / 9))), direct) / (2 + a + b)

    return _isotropic(e, "hencky", lambda l: 0.5 * torch.log1p(l), gradient, CRUSHED - 1)


def from_hencky(h: Symmetric) -> Symmetric:
    """Return exp(2 h) - I."""

    def gradient(a: Tensor, b: Tensor) -> Tensor:
        d = a - b
        small = d.abs() < 1e-2
        d2 = d * d
        direct = torch.sinh(d) / torch.where(small, 1.0, d)
        return 2 * torch.exp(a + b) * torch.where(small, 1 + d2 * (1 / 6 + d2 * (1 / 120 + d2 / 5040)), direct)

    return _isotropic(h, "from_hencky", lambda l: torch.expm1(2 * l), gradient, None)
