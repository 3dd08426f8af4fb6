"""How plastic matter answers to deformation as a C++ kernel, with its derivative.

The formulas are those of `constitutive_models.Plastic`, as tensor operations; these are used elsewhere and without a
compiler. The kernel finds the eigenvectors of a strain once for all functions of it, and once more backward.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.mpm.symmetric_tensors import kernel_function, ready

__all__ = ["answer", "ready"]

_INPUTS = "Tensor strain, Tensor affine, Tensor history, Tensor numbers"


class _Sizes(ctypes.Structure):
    _fields_ = (*((name, ctypes.c_int64) for name in ("scenes", "count", "each")), ("dt", ctypes.c_double))


def _run(what: str, tensors: Sequence[Tensor], numbers: Tensor, dt: float) -> None:
    strain = tensors[0]
    sizes = _Sizes(strain.shape[0], strain.shape[2], numbers.shape[2] > 1, dt)
    places = (ctypes.c_void_p(x.data_ptr()) for x in tensors)
    kernel_function(what, strain.dtype)(*places, ctypes.byref(sizes), torch.get_num_threads())


def _answer(strain: Tensor, affine: Tensor, history: Tensor, numbers: Tensor, dt: float) -> tuple[Tensor, ...]:
    out = _answer_meta(strain, affine, history)
    _run("plastic", (strain, affine, history, numbers, *out), numbers, dt)
    return out


def _answer_meta(strain: Tensor, affine: Tensor, history: Tensor, *others) -> tuple[Tensor, ...]:
    return torch.empty_like(strain), torch.empty_like(strain), torch.empty_like(history)


def _back(strain, affine, numbers, stress_by, after_by, history_by, dt: float) -> tuple[Tensor, ...]:
    out = _back_meta(strain, affine, numbers)
    _run("plastic_back", (strain, affine, numbers, stress_by, after_by, history_by, *out), numbers, dt)
    return out


def _back_meta(strain, affine, numbers, *others) -> tuple[Tensor, ...]:
    return torch.empty_like(strain), torch.empty_like(affine), torch.empty_like(numbers)


def _save(ctx, inputs, output) -> None:
    strain, affine, _, numbers, ctx.dt = inputs
    ctx.save_for_backward(strain, affine, numbers)


def _backward(ctx, stress: Tensor, after: Tensor, history: Tensor):
    by = stress.contiguous(), after.contiguous(), history.contiguous()
    strain, affine, numbers = torch.ops.torchdlo.plastic_back(*ctx.saved_tensors, *by, ctx.dt)
    return strain, affine, history, numbers, None


scene_packing.operator(
    f"plastic({_INPUTS}, float dt) -> (Tensor, Tensor, Tensor)", _answer, _answer_meta, _save, _backward
)
scene_packing.operator(
    "plastic_back(Tensor strain, Tensor affine, Tensor numbers, Tensor stress_by, Tensor after_by, Tensor history_by, "
    "float dt) -> (Tensor, Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def answer(
    numbers: Sequence[Tensor], strain: Tensor, history: Tensor, affine: Tensor, dt: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return Kirchhoff stress [Pa] (..., 6, N), strain [1] (..., 6, N) and accumulated plastic strain [1] (..., N).

    Differentiable once.

    Args:
        numbers: Lame's constants lambda and mu, and the yield stress [Pa], shape (..., N or 1) each.
        strain: F F^T - I before the deformation [1], shape (..., 6, N).
        history: accumulated plastic strain before it [1], shape (..., N).
        affine: velocity gradients, row by row [1/s], shape (..., 9, N).
        dt: how long they act [s].
    """
    count, each = strain.shape[-1], max(x.shape[-1] for x in numbers)
    leads = (strain.shape[:-2], affine.shape[:-2], history.shape[:-1], *(x.shape[:-1] for x in numbers))
    batch = torch.broadcast_shapes(*leads)
    found = torch.ops.torchdlo.plastic(
        strain.expand(*batch, 6, count).reshape(-1, 6, count).contiguous(),
        affine.expand(*batch, 9, count).reshape(-1, 9, count).contiguous(),
        history.expand(*batch, count).reshape(-1, count).contiguous(),
        torch.stack([x.expand(*batch, each) for x in numbers], -2).reshape(-1, 3, each).contiguous(),
        dt,
    )
    stress, after, remembered = found
    return stress.reshape(*batch, 6, count), after.reshape(*batch, 6, count), remembered.reshape(*batch, count)
