"""Contact forces of ropes on bodies as a C++ kernel, with its derivative.

The formulas stand in `rod_body` and `edge_points`, as tensor operations; these are used on a GPU, where there is no C++
compiler, and for meshes that differ from scene to scene or are learned. The kernel does the same, several scenes per
instruction, skips what touches in none of them, and looks for the nearest point of an edge only where it may come
within a radius of the body if the edge moves twice as far as foreseen. Compilers of graphs take minutes to unroll the
sweeps; for them the kernel is one operation.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion
from torchdlo.coupling.common import scene_packing
from torchdlo.physics.effects.base import ContactForces, PredictedMotion
from torchdlo.physics.linalg.vector_components import axes
from torchdlo.physics.rod.kinematics import View

_INPUTS = "Tensor[] edges, Tensor[] vertices, Tensor[] bodies, Tensor grids"
_STATIC = "int[] cells, int[] shapes, int[] pieces, int[] after, int sweeps, bool friction, float[] law"
_function, ready = scene_packing.kernel("body_sweeps", "RodBody, the forces of contact", gpu=True)


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("families", "vertices", "bodies", "scenes", "sweeps", "friction")),
        *((name, ctypes.c_void_p) for name in ("shape", "pieces", "after", "cells", "grids")),
        ("corners", ctypes.c_int64),
        *((name, ctypes.c_double) for name in ("recovery", "slowest", "dt")),
    )


def _sizes(like: Tensor, grids: Tensor, cells, kinds, pieces, after, sweeps: int, friction: bool, law: Sequence[float]):
    families, (_, count, scenes) = sum(2 + n for n in pieces), like.shape
    lists = (scene_packing.numbers(x, like) for x in (kinds, pieces, after, cells))
    sizes = (families, len(after), count, scenes, sweeps, friction, *lists, grids.data_ptr(), grids.shape[1], *law)
    return _Sizes(*sizes)


def _call(what: str, places: list, sizes: _Sizes, like: Tensor) -> None:
    if scene_packing.uses_gpu(like):
        scene_packing.on_gpu("body_sweeps", what, sizes, places, like, sizes.scenes)
    else:
        _function(what, like.dtype)(*places, ctypes.byref(sizes), torch.get_num_threads())


def _sweep(
    edges: list[Tensor], vertices: list[Tensor], bodies: list[Tensor], grids: Tensor, *static
) -> tuple[Tensor, Tensor]:
    out = _sweep_meta(edges, vertices, bodies)
    places = [scene_packing.fields(x) for x in (edges, vertices, bodies, *([x] for x in out))]
    _call("sweep", places, _sizes(bodies[0], grids, *static), out[0])
    return out


def _sweep_meta(edges: list[Tensor], vertices: list[Tensor], bodies: list[Tensor], *others) -> tuple[Tensor, Tensor]:
    push, wrench = (x[0].new_empty(n, *x[0].shape[1:]) for x, n in ((vertices, 3), (bodies, 6)))
    return push, wrench


def _back(
    edges: list[Tensor],
    vertices: list[Tensor],
    bodies: list[Tensor],
    grids: Tensor,
    force: Tensor,
    push: Tensor,
    *static,
):
    out = _back_meta(edges, vertices, bodies)
    places = [scene_packing.fields(x) for x in (edges, vertices, bodies, [force], [push], *([x] for x in out))]
    _call("back", places, _sizes(bodies[0], grids, *static), force)
    return out


def _back_meta(edges: list[Tensor], vertices: list[Tensor], bodies: list[Tensor], *others):
    wide = ((x[0], sum(t.shape[0] for t in x)) for x in (edges, vertices, bodies))
    return tuple(x.new_empty(n, *x.shape[1:]) for x, n in wide)


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[0], *inputs[1], *inputs[2], inputs[3])
    ctx.counts = [len(x) for x in inputs[:3]]
    ctx.static = inputs[4:]


def _backward(ctx, force: Tensor, push: Tensor):
    groups, saved = [], list(ctx.saved_tensors)
    for count in ctx.counts:
        groups.append(saved[:count])
        saved = saved[count:]
    both = (force.contiguous(), push.contiguous())
    found = torch.ops.torchdlo.body_sweeps_back(*groups, *saved, *both, *ctx.static)
    parts = [list(x.split([t.shape[0] for t in group])) for x, group in zip(found, groups, strict=True)]
    return *parts, None, *(None for _ in ctx.static)


scene_packing.operator(
    f"body_sweeps({_INPUTS}, {_STATIC}) -> (Tensor, Tensor)", _sweep, _sweep_meta, _save, _backward, gpu=True
)
scene_packing.operator(
    f"body_sweeps_back({_INPUTS}, Tensor force, Tensor push, {_STATIC}) -> (Tensor, Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
    gpu=True,
)


def _solids(bodies: PredictedBodyMotion) -> list[Tensor]:
    """Return the fields of bodies in the order of the kernel, shape (..., K, C) each."""
    state, params, inverse_inertia = bodies.state, bodies.params, bodies.inverse_inertia
    columns, turning = axes(state.quat), inverse_inertia.split(1, -1)
    answers = [
        sum(a * c[i] * c[j] for a, c in zip(turning, columns, strict=True))
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ]
    offset, numbers = scene_packing.shape_sizes(bodies)
    zero = torch.zeros_like(offset)
    moves = [state.vel, state.omega, bodies.change, bodies.turn, bodies.mobility]
    laws = [inverse_inertia.amax(-1, keepdim=True), params.mu_s, params.mu_k, params.restitution]
    return [state.pos, *itertools.chain(*columns), offset, zero, zero, *numbers, *moves, *answers, *laws]


def contact_wrenches(
    view: View,
    motion: PredictedMotion,
    pieces: Sequence[int],
    *,
    sweeps: int,
    friction: bool,
    law: tuple[float, float],
) -> ContactForces:
    """Return what contact exerts; differentiable once.

    Args:
        view: the rods.
        motion: where they and the bodies would go.
        pieces: pieces of an edge that are searched for each body.
        sweeps: projected Jacobi sweeps.
        friction: whether ropes rub.
        law: share of a shallow overlap that a substep removes, and approach below which nothing rebounds [m/s].
    """
    bodies, size, material = motion.bodies, view.topology.size, view.params.material
    edges = [view.tangent, material.radius / view.length, material.radius, view.params.rest.edge_mask]
    vertices = [view.state.pos, view.state.vel, motion.change, motion.answer, motion.give]
    solids = _solids(bodies)
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in (*edges, *vertices, *solids)))
    inputs = (
        scene_packing.pack_components(x, batch, n)
        for x, n in ((edges, size), (vertices, size), (solids, len(bodies.bodies)))
    )
    force, wrench = torch.ops.torchdlo.body_sweeps(
        *inputs,
        *scene_packing.sampled_grids(bodies),
        scene_packing.shape_numbers(bodies),
        list(pieces),
        view.topology.successor(),
        sweeps,
        friction,
        [*law, view.dt],
    )
    return ContactForces(
        scene_packing.unpack_components(force, batch), *scene_packing.unpack_components(wrench, batch).split(3, -1)
    )


def kernel_fits(bodies: PredictedBodyMotion) -> bool:
    """Return whether the kernel can do what these bodies need."""
    like = bodies.state.pos
    return ready(like.device.type, like.dtype) and scene_packing.alike(bodies)
