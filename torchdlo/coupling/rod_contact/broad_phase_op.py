"""Which pairs of edges of ropes can touch within a step as a C++ kernel.

The method and its reasons stand in `nearby`, as tensor operations; these are used on a GPU and where there is no C++
compiler. The kernel finds the same pairs, in time near-linear in their number, and has room for any number of edges in
a row of cells. It has no derivative, as no choice of pairs has.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.rod_contact import broad_phase, closest_points
from torchdlo.physics.effects.base import Values
from torchdlo.physics.rod.kinematics import View

_OPTIONS = (f"-DPULL={closest_points.PULL}",)
_function, ready = scene_packing.kernel(
    "rod_near", "RodContact, which parts of ropes are near each other", *_OPTIONS, gpu=True
)


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("vertices", "scenes", "held", "rods", "room", "few", "apart")),
        *((name, ctypes.c_void_p) for name in ("counts", "closed")),
        *((name, ctypes.c_double) for name in ("dt", "burst")),
    )


def _call(what: str, fields: list[Tensor], others: list[Tensor], out: Sequence[Tensor], sizes: _Sizes) -> None:
    like, places = fields[0], [scene_packing.fields(x) for x in (fields, others)]
    single = [x.data_ptr() for x in out]
    if scene_packing.uses_gpu(like):
        scene_packing.on_gpu("rod_near", what, sizes, [*places, *single], like, sizes.scenes, *_OPTIONS)
    else:
        arrays = (*places, *(ctypes.c_void_p(x) for x in single))
        _function(what, like.dtype)(*arrays, ctypes.byref(sizes), torch.get_num_threads())


def _look(rods: list[Tensor], carried: Tensor, counts: list[int], closed: list[int], room: int, few: int, *rule: float):
    out = _look_meta(rods, carried, counts, closed, room)
    lists = (scene_packing.numbers(x, carried) for x in (counts, closed))
    sizes = (*rods[0].shape[1:], carried.shape[1], len(counts), room, few, broad_phase.APART)
    _call("look", [*rods], [carried], out, _Sizes(*sizes, *lists, *rule))
    return out


def _look_meta(rods: list[Tensor], carried: Tensor, counts, closed, room: int, *others) -> tuple[Tensor, ...]:
    like, scenes = rods[0], rods[0].shape[2]
    at = like.new_empty(4, room, scenes, dtype=torch.int64)
    return at, like.new_empty(1, room, scenes), like.new_empty(1, 1, scenes), like.new_empty(1, 1, scenes)


def _outrun(pos: Tensor, origin: Tensor, reach: Tensor) -> Tensor:
    out = _outrun_meta(pos, origin, reach)
    _call("outrun", [pos], [origin], [reach, out], _Sizes(*pos.shape[1:]))
    return out


def _outrun_meta(pos: Tensor, origin: Tensor, reach: Tensor) -> Tensor:
    return torch.empty_like(reach)


_STATIC = "int[] counts, int[] closed, int room, int few, float dt, float burst"
scene_packing.operator(
    f"rod_near(Tensor[] rods, Tensor carried, {_STATIC}) -> (Tensor, Tensor, Tensor, Tensor)",
    _look,
    _look_meta,
    gpu=True,
)
scene_packing.operator("rod_outrun(Tensor pos, Tensor origin, Tensor reach) -> Tensor", _outrun, _outrun_meta, gpu=True)


def find_candidates(view: View, carried: Tensor, room: int, burst: float) -> Values:
    """Return what `RodContact.find_candidates` does.

    Args:
        view: the rods when the step begins; its dt is the whole step.
        carried: how far held vertices are moved in it [m], shape (..., H, 3).
        room: room for pairs.
        burst: by how much vertices may speed up, beside half their speed [m/s]; below 0 as if it were not given.
    """
    topology, state, params = view.topology, view.state, view.params
    batch, size = state.pos.shape[:-2], topology.size
    rods = scene_packing.pack_components(
        [state.pos, state.vel, params.material.radius, params.rest.length], batch, size
    )
    (moved,) = scene_packing.pack_components([carried], batch, carried.shape[-2])
    closed = [int(c) for c in topology.closed]
    at, real, lost, reach = torch.ops.torchdlo.rod_near(
        rods, moved, list(topology.counts), closed, room, broad_phase.FEW, view.dt, burst
    )
    found = {"real": real, "lost": lost, "reach": reach}
    at = at.reshape(4, room, *batch)
    return {
        "corners": at.permute(*range(2, at.dim()), 0, 1),
        "origin": state.pos,
        **{name: scene_packing.unpack_components(x, batch) for name, x in found.items()},
    }


def outrun_distance(pos: Tensor, values: Values) -> Tensor:
    """Return by how much vertices outran the find_candidates [m], shape (..., 1, 1), without derivative."""
    batch, size = values["corners"].shape[:-2], pos.shape[-2]
    both = scene_packing.pack_components([pos.detach(), values["origin"].detach()], batch, size)
    (reach,) = scene_packing.pack_components([values["reach"].detach()], batch, 1)
    return scene_packing.unpack_components(torch.ops.torchdlo.rod_outrun(*both, reach), batch)
