"""Contact forces among ropes as a C++ kernel, with its derivative.

The formulas stand in `contact`, `segments` and `coulomb`, as tensor operations; these are used on a GPU and where there
is no C++ compiler. The kernel does the same, several pairs per instruction, and leaves out friction and derivatives of
pairs that exert nothing. For compilers of graphs it is one operation.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.rod_contact import closest_points
from torchdlo.physics.effects.base import PredictedMotion, Values
from torchdlo.physics.rod.kinematics import View

WEAK = 0.01
"""Inertia of two edges against each other in the balance of friction's couple, over what it is."""
_OPTIONS = (f"-DWEAK={WEAK}", f"-DROOT_WEAK={WEAK**0.5}", f"-DPULL={closest_points.PULL}")
_INPUTS = "Tensor[] vertices, Tensor laws, Tensor at, Tensor real"
_STATIC = "int sweeps, bool friction, float[] rule"
_function, ready = scene_packing.kernel("rod_pairs", "RodContact, the forces of contact", *_OPTIONS, gpu=True)


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("vertices", "scenes", "room", "sweeps", "friction")),
        *((name, ctypes.c_double) for name in ("recovery", "slowest", "dt")),
    )


def _call(what: str, inputs: Sequence, others: Sequence[Tensor], sweeps: int, friction: bool, rule: Sequence[float]):
    vertices, laws, at, real = inputs
    fields = [scene_packing.fields(x) for x in (vertices, [laws], *([x] for x in others))]
    places = [*fields[:2], at.data_ptr(), real.data_ptr(), *fields[2:]]
    sizes = _Sizes(*vertices[0].shape[1:], real.shape[0], sweeps, friction, *rule)
    if scene_packing.uses_gpu(real):
        scene_packing.on_gpu("rod_pairs", what, sizes, places, real, sizes.scenes, *_OPTIONS)
    else:
        arrays = (ctypes.c_void_p(x) if isinstance(x, int) else x for x in places)
        _function(what, real.dtype)(*arrays, ctypes.byref(sizes), torch.get_num_threads())


def _sweep(vertices: list[Tensor], laws: Tensor, at: Tensor, real: Tensor, *static) -> Tensor:
    out = _sweep_meta(vertices)
    _call("sweep", (vertices, laws, at, real), [out], *static)
    return out


def _sweep_meta(vertices: list[Tensor], *others) -> Tensor:
    return vertices[0].new_empty(3, *vertices[0].shape[1:])


def _back(vertices: list[Tensor], laws: Tensor, at: Tensor, real: Tensor, by: Tensor, *static) -> tuple[Tensor, Tensor]:
    out = _back_meta(vertices, laws)
    _call("back", (vertices, laws, at, real), [by, *out], *static)
    return out


def _back_meta(vertices: list[Tensor], laws: Tensor, *others) -> tuple[Tensor, Tensor]:
    return vertices[0].new_empty(sum(x.shape[0] for x in vertices), *vertices[0].shape[1:]), torch.empty_like(laws)


def _save(ctx, inputs, output) -> None:
    vertices, *others = inputs
    ctx.save_for_backward(*vertices, *others[:3])
    ctx.static = others[3:]


def _backward(ctx, by: Tensor):
    *vertices, laws, at, real = ctx.saved_tensors
    found, law = torch.ops.torchdlo.rod_pairs_back(vertices, laws, at, real, by.contiguous(), *ctx.static)
    return list(found.split([x.shape[0] for x in vertices])), law, None, None, *(None for _ in ctx.static)


scene_packing.operator(f"rod_pairs({_INPUTS}, {_STATIC}) -> Tensor", _sweep, _sweep_meta, _save, _backward, gpu=True)
scene_packing.operator(
    f"rod_pairs_back({_INPUTS}, Tensor by, {_STATIC}) -> (Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
    gpu=True,
)


def contact_forces(
    view: View, motion: PredictedMotion, values: Values, *, sweeps: int, friction: bool, law: tuple[float, float]
) -> Tensor:
    """Return the forces of contact on vertices [N], shape (..., V, 3); differentiable once.

    Args:
        view: the rods.
        motion: where vertices would go.
        values: numbers of the effect, and the pairs that `RodContact.broad_phase` returned.
        sweeps: projected Jacobi sweeps.
        friction: whether ropes rub.
        law: share of a shallow overlap that a substep removes, and approach below which nothing rebounds [m/s].
    """
    at, size = values["corners"], view.topology.size
    batch, count = at.shape[:-2], at.shape[-1]
    state, radius = view.state, view.params.material.radius
    free = motion.mobility.amax(-1, keepdim=True)
    vertices = [state.pos, state.vel, motion.change, motion.answer, motion.give, free, radius]
    laws = torch.cat([values[name].expand(*batch, 1, 1) for name in ("mu_s", "mu_k", "restitution")], -1)
    (laws,), (real,) = (
        scene_packing.pack_components([laws], batch, 1),
        scene_packing.pack_components([values["real"]], batch, count),
    )
    at = at.permute(at.dim() - 2, at.dim() - 1, *range(at.dim() - 2)).reshape(4, count, batch.numel()).contiguous()
    rule = [*law, view.dt]
    found = torch.ops.torchdlo.rod_pairs(
        scene_packing.pack_components(vertices, batch, size), laws, at, real[0], sweeps, friction, rule
    )
    return scene_packing.unpack_components(found, batch)
