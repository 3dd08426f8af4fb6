"""Pairs of edges of ropes that may touch in implicit steps as a C++ kernel, with its derivative.

The formulas stand in `rod_contact_effect` and `closest_points`, as tensor operations; these are used on a GPU and where
there is no C++ compiler. For compilers of graphs it is one operation.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import coulomb_friction, scene_packing
from torchdlo.coupling.rod_contact import closest_points
from torchdlo.coupling.rod_contact.rod_contact_op import WEAK
from torchdlo.physics.constraints.contact_penalty import Pairs
from torchdlo.physics.effects.base import PredictedMotion, Values
from torchdlo.physics.rod.kinematics import View

_OPTIONS = (f"-DWEAK={WEAK}", f"-DROOT_WEAK={WEAK**0.5}", f"-DPULL={closest_points.PULL}")
_INPUTS = "Tensor[] vertices, Tensor laws, Tensor at, Tensor real"
_STATIC = "bool friction, float[] rule"
_function, ready = scene_packing.kernel("rod_touch", "RodContact, pairs of edges in implicit steps", *_OPTIONS)
_FIELDS = (1, 3, 1, 1, 1, 9, 9, 9, 9)
"""Numbers of real, normal, radius, wanted, mu and the four matrices."""


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("vertices", "scenes", "room", "friction")),
        *((name, ctypes.c_double) for name in ("recovery", "slowest", "fastest", "thick", "dt")),
    )


def _call(what: str, inputs: Sequence, others: Sequence, friction: bool, rule: Sequence[float]) -> None:
    vertices, laws, at, real = inputs
    places = scene_packing.fields(vertices), scene_packing.fields([laws]), at.data_ptr(), real.data_ptr()
    arrays = (ctypes.c_void_p(x) if isinstance(x, int) else x for x in (*places, *others))
    sizes = _Sizes(*vertices[0].shape[1:], real.shape[0], friction, *rule)
    _function(what, real.dtype)(*arrays, ctypes.byref(sizes), torch.get_num_threads())


def _find(vertices: list[Tensor], laws: Tensor, at: Tensor, real: Tensor, *static) -> Tensor:
    out = _find_meta(vertices, laws, at, real)
    _call("find", (vertices, laws, at, real), [out.data_ptr()], *static)
    return out


def _find_meta(vertices: list[Tensor], laws: Tensor, at: Tensor, real: Tensor, *others) -> Tensor:
    return real.new_empty(real.shape[1], real.shape[0], sum(_FIELDS))


def _back(vertices: list[Tensor], laws: Tensor, at: Tensor, real: Tensor, by: Tensor, *static) -> tuple[Tensor, Tensor]:
    found, law = (x.zero_() for x in _back_meta(vertices, laws))
    others = [by.data_ptr(), scene_packing.fields([found]), scene_packing.fields([law])]
    _call("back", (vertices, laws, at, real), others, *static)
    return found, law


def _back_meta(vertices: list[Tensor], laws: Tensor, *others) -> tuple[Tensor, Tensor]:
    return vertices[0].new_empty(sum(x.shape[0] for x in vertices), *vertices[0].shape[1:]), torch.empty_like(laws)


def _save(ctx, inputs, output) -> None:
    vertices, *others = inputs
    ctx.save_for_backward(*vertices, *others[:3])
    ctx.static = others[3:]


def _backward(ctx, by: Tensor):
    *vertices, laws, at, real = ctx.saved_tensors
    found, law = torch.ops.torchdlo.rod_touch_back(vertices, laws, at, real, by.contiguous(), *ctx.static)
    return list(found.split([x.shape[0] for x in vertices])), law, None, None, *(None for _ in ctx.static)


scene_packing.operator(f"rod_touch({_INPUTS}, {_STATIC}) -> Tensor", _find, _find_meta, _save, _backward)
scene_packing.operator(
    f"rod_touch_back({_INPUTS}, Tensor by, {_STATIC}) -> (Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def find_touches(
    view: View, motion: PredictedMotion, values: Values, *, friction: bool, law: tuple[float, float]
) -> Pairs:
    """Return the pairs of edges that may touch; differentiable once.

    Args:
        view: the rods.
        motion: where vertices would go.
        values: numbers of the effect, and the pairs that `RodContact.broad_phase` returned.
        friction: whether ropes rub.
        law: share of a shallow overlap that a substep removes, and approach below which nothing rebounds [m/s].
    """
    at, size = values["corners"], view.topology.size
    batch, count = at.shape[:-2], at.shape[-1]
    state, free = view.state, motion.mobility.amax(-1, keepdim=True)
    vertices = [state.pos, state.vel, motion.change, free, view.params.material.radius]
    laws = torch.cat([values[name].expand(*batch, 1, 1) for name in ("mu_s", "mu_k", "restitution")], -1)
    (laws,), (real,) = (
        scene_packing.pack_components([laws], batch, 1),
        scene_packing.pack_components([values["real"]], batch, count),
    )
    places = at.permute(at.dim() - 2, at.dim() - 1, *range(at.dim() - 2)).reshape(4, count, batch.numel()).contiguous()
    rule = [*law, coulomb_friction.FASTEST, coulomb_friction.THICK, view.dt]
    packed = [scene_packing.join_components(vertices, batch, size)]
    found = torch.ops.torchdlo.rod_touch(packed, laws, places, real[0], friction, rule)
    there, normal, radius, wanted, mu, *linear = found.reshape(*batch, *found.shape[1:]).split(_FIELDS, -1)
    return Pairs(at, there.detach(), normal, radius, wanted, mu, tuple(m.unflatten(-1, (3, 3)) for m in linear))
