"""Points of edges that may touch bodies in implicit steps as a C++ kernel, with its derivative.

The formulas stand in `rod_body_effect` and `segment_distance`, as tensor operations; these are used on a GPU, where
there is no C++ compiler, and for meshes that differ from scene to scene or are learned. For compilers of graphs it is
one operation.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion, axes
from torchdlo.coupling.common import coulomb_friction, scene_packing
from torchdlo.physics.effects.base import PredictedMotion
from torchdlo.physics.rod.kinematics import View

_INPUTS = "Tensor[] edges, Tensor[] vertices, Tensor[] bodies, Tensor grids"
_STATIC = "int[] cells, int[] shapes, int[] pieces, int[] after, bool friction, float[] law"
_function, ready = scene_packing.kernel("body_touch", "RodBody, the points of edges in implicit steps")
_FIELDS = (1, 3, 1, 3, 1, 3)
"""Numbers of share, normal, wanted, given, mu and arm."""


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("vertices", "scenes", "bodies", "families", "corners", "friction")),
        *((name, ctypes.c_void_p) for name in ("shape", "pieces", "after", "cells", "grids")),
        *((name, ctypes.c_double) for name in ("recovery", "slowest", "fastest", "thick", "dt")),
    )


def _sizes(like: Tensor, grids: Tensor, cells, shapes, pieces, after, friction: bool, law: Sequence[float]):
    (_, count, scenes), families = like.shape, sum(2 + n for n in pieces)
    lists = (scene_packing.integers(tuple(x)) for x in (shapes, pieces, after, cells))
    numbers = (len(after), scenes, count, families, grids.shape[1], friction)
    return ctypes.byref(_Sizes(*numbers, *lists, grids.data_ptr(), *law))


def _find(edges: list[Tensor], vertices: list[Tensor], bodies: list[Tensor], grids: Tensor, *static) -> Tensor:
    out = _find_meta(edges, vertices, bodies, grids, *static)
    places = (scene_packing.fields(x) for x in (edges, vertices, bodies))
    sizes = _sizes(bodies[0], grids, *static)
    _function("find", out.dtype)(*places, ctypes.c_void_p(out.data_ptr()), sizes, torch.get_num_threads())
    return out


def _find_meta(edges: list[Tensor], vertices, bodies, grids, cells, shapes, pieces, *others) -> Tensor:
    _, slots, scenes = edges[0].shape
    return edges[0].new_empty(scenes, sum(2 + n for n in pieces), slots, sum(_FIELDS))


def _back(
    edges: list[Tensor], vertices: list[Tensor], bodies: list[Tensor], grids: Tensor, by: Tensor, *static
) -> tuple[Tensor, ...]:
    out = tuple(x.zero_() for x in _back_meta(edges, vertices, bodies))
    places = (scene_packing.fields(x) for x in (edges, vertices, bodies))
    given, sizes = ctypes.c_void_p(by.data_ptr()), _sizes(bodies[0], grids, *static)
    found = (scene_packing.fields([x]) for x in out)
    _function("back", by.dtype)(*places, given, *found, sizes, torch.get_num_threads())
    return out


def _back_meta(edges: list[Tensor], vertices: list[Tensor], bodies: list[Tensor], *others) -> tuple[Tensor, ...]:
    wide = ((x[0], sum(t.shape[0] for t in x)) for x in (edges, vertices, bodies))
    return tuple(x.new_empty(n, *x.shape[1:]) for x, n in wide)


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[0], *inputs[1], *inputs[2], inputs[3])
    ctx.counts = [len(x) for x in inputs[:3]]
    ctx.static = inputs[4:]


def _backward(ctx, by: Tensor):
    groups, saved = [], list(ctx.saved_tensors)
    for count in ctx.counts:
        groups.append(saved[:count])
        saved = saved[count:]
    found = torch.ops.torchdlo.body_touch_back(*groups, *saved, by.contiguous(), *ctx.static)
    parts = [list(x.split([t.shape[0] for t in group])) for x, group in zip(found, groups, strict=True)]
    return *parts, None, *(None for _ in ctx.static)


scene_packing.operator(f"body_touch({_INPUTS}, {_STATIC}) -> Tensor", _find, _find_meta, _save, _backward)
scene_packing.operator(
    f"body_touch_back({_INPUTS}, Tensor by, {_STATIC}) -> (Tensor, Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def kernel_fits(bodies: PredictedBodyMotion) -> bool:
    """Return whether the kernel can do what these bodies need."""
    like = bodies.state.pos
    return ready(like.device.type, like.dtype) and scene_packing.alike(bodies)


def find_touches(
    view: View, motion: PredictedMotion, pieces: Sequence[int], *, friction: bool, law: tuple[float, float]
) -> tuple[Tensor, ...]:
    """Return numbers of points, F per edge; differentiable once.

    Args:
        view: the rods.
        motion: where they and the bodies would go.
        pieces: pieces of an edge that are searched for each body.
        friction: whether ropes rub.
        law: share of a shallow overlap that a substep removes, and approach below which nothing rebounds [m/s].

    Returns:
        Share, normal, by how much points have to part, by how much they part and slip if edges stay, coefficient of
        friction, and arm, as in `Touch`, shape (..., F, V, 1 or 3) each.
    """
    bodies, size, material = motion.bodies, view.topology.size, view.params.material
    state, params = bodies.state, bodies.params
    edges = [view.tangent, material.radius / view.length, material.radius, view.params.rest.edge_mask]
    vertices = [view.state.pos, view.state.vel, motion.change]
    offset, numbers = scene_packing.shape_sizes(bodies)
    moves = [state.vel, state.omega, bodies.change, bodies.turn]
    laws = [params.mu_s, params.mu_k, params.restitution]
    solids = [state.pos, *itertools.chain(*axes(state.quat)), offset, *numbers, *moves, *laws]
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in (*edges, *vertices, *solids)))
    inputs = (
        [scene_packing.join_components(x, batch, n)]
        for x, n in ((edges, size), (vertices, size), (solids, len(bodies.bodies)))
    )
    found = torch.ops.torchdlo.body_touch(
        *inputs,
        *scene_packing.sampled_grids(bodies),
        scene_packing.shape_numbers(bodies),
        list(pieces),
        view.topology.successor(),
        friction,
        [*law, coulomb_friction.FASTEST, coulomb_friction.THICK, view.dt],
    )
    return found.reshape(*batch, *found.shape[1:]).split(_FIELDS, -1)
