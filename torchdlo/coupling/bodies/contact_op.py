"""Contact forces among bodies as a C++ kernel, with its derivative.

The formulas stand in `body_contact`, `balls` and `linked`, as tensor operations; these are used on a GPU, where there
is no C++ compiler, and for meshes that differ from scene to scene or are learned. The kernel does the same, several
scenes per instruction, and skips pairs of bodies that cannot meet even if they move twice as far as foreseen. For
compilers of graphs it is one operation.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.bodies import contact_points
from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion
from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.common.coulomb_friction import FASTEST
from torchdlo.physics.linalg.vector_components import axes

_FIRST = "Tensor[] bodies"
_LISTS = "int[] cells, int[] many, int[] shapes, int[] free, int[] pairs"
_OTHERS = f"Tensor grids, Tensor balls, {_LISTS}, int points, int steps, bool hold, float[] law"
HARD = 1e4
"""Stiffness of contact times the mobility of the two bodies: its inverse is the share of an impact that is let through.
Harder contact takes more rounds, and single precision has no digits for it."""
FIT = 1e-2
"""By how much forces may do more than is asked for before they are dropped."""
_NUMBERS = {"HARD": HARD, "FIT": FIT} | {
    n: getattr(contact_points, n) for n in ("ROUND", "FEET", "ARC", "SPREAD", "FLAT")
}
_OPTIONS = tuple(f"-D{name}={value}" for name, value in _NUMBERS.items())
_function, ready = scene_packing.kernel("body_pairs", "BodyContact, the forces of contact", *_OPTIONS)


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("bodies", "scenes", "pairs", "points", "steps", "hold")),
        *((name, ctypes.c_void_p) for name in ("shape", "free", "pair", "cells", "many", "grids", "balls")),
        *((name, ctypes.c_int64) for name in ("corners", "numbers")),
        *((name, ctypes.c_double) for name in ("recovery", "shallow", "slowest", "fastest", "dt")),
    )


def _sizes(like, grids, inscribed, cells, many, kinds, free, pairs, points, steps, hold, law):
    lists = (scene_packing.integers(tuple(x)) for x in (kinds, free, pairs, cells, many))
    fixed = (grids.data_ptr(), inscribed.data_ptr(), grids.shape[1], inscribed.shape[1])
    return ctypes.byref(_Sizes(*like.shape[1:], len(pairs) // 2, points, steps, hold, *lists, *fixed, *law))


def _exert(bodies: list[Tensor], *others) -> Tensor:
    out = _exert_meta(bodies, *others)
    places = (scene_packing.fields(bodies), scene_packing.fields([out]))
    _function("exert", out.dtype)(*places, _sizes(bodies[0], *others), torch.get_num_threads())
    return out


def _exert_meta(bodies: list[Tensor], *others) -> Tensor:
    return bodies[0].new_empty(42 if others[-2] else 6, *bodies[0].shape[1:])


def _back(bodies: list[Tensor], by: Tensor, *others) -> Tensor:
    out = _back_meta(bodies)
    places = (scene_packing.fields(x) for x in (bodies, [by], [out]))
    _function("back", out.dtype)(*places, _sizes(bodies[0], *others), torch.get_num_threads())
    return out


def _back_meta(bodies: list[Tensor], *others) -> Tensor:
    return bodies[0].new_empty(sum(x.shape[0] for x in bodies), *bodies[0].shape[1:])


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[0], *inputs[1:3])
    ctx.static = inputs[3:]


def _backward(ctx, by: Tensor):
    *bodies, grids, inscribed = ctx.saved_tensors
    found = torch.ops.torchdlo.body_pairs_back(bodies, by.contiguous(), grids, inscribed, *ctx.static)
    return list(found.split([x.shape[0] for x in bodies])), None, None, *(None for _ in ctx.static)


scene_packing.operator(f"body_pairs({_FIRST}, {_OTHERS}) -> Tensor", _exert, _exert_meta, _save, _backward)
scene_packing.operator(
    f"body_pairs_back({_FIRST}, Tensor by, {_OTHERS}) -> Tensor",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def _members(motion: PredictedBodyMotion) -> list[Tensor]:
    """Return the fields of bodies in the order of the kernel, shape (..., K, C) each."""
    state, params = motion.state, motion.params
    offset, numbers = scene_packing.shape_sizes(motion)
    numbers.append(params.size[..., 2:])
    moves = [state.vel, state.omega, motion.change, motion.turn, motion.mobility, motion.inverse_inertia]
    laws = [params.mu_s, params.mu_k, params.restitution]
    return [state.pos, *itertools.chain(*axes(state.quat)), offset, *numbers, *moves, *laws]


def contact_wrench(
    motion: PredictedBodyMotion,
    pairs: Sequence[tuple[int, int]],
    points: int,
    steps: int,
    law: tuple[float, float, float],
    hold: bool = False,
) -> tuple[Tensor, ...]:
    """Return forces [N] and torques [N m] of contact on bodies, shape (..., K, 3) each; differentiable once.

    If `hold`, also how they fall with the displacement of each free body alone, (..., F, 6, 6) [N/m, N m/rad].

    Args:
        motion: where bodies would go.
        pairs: which of them may touch.
        points: points per pair at most.
        steps: choices of the contacts that press and stick.
        law: share of a shallow overlap that a substep removes, overlap up to which only that share goes [m], and
            approach below which nothing rebounds [m/s].
        hold: whether to return the last one.
    """
    members, count = _members(motion), len(motion.bodies)
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in members))
    order = itertools.count()
    (grids, cells), (inscribed, many) = scene_packing.sampled_grids(motion), scene_packing.inscribed_balls(motion)
    found = torch.ops.torchdlo.body_pairs(
        scene_packing.pack_components(members, batch, count),
        grids,
        inscribed,
        cells,
        many,
        scene_packing.shape_numbers(motion),
        [next(order) if b.motion == "free" else -1 for b in motion.bodies],
        list(itertools.chain(*pairs)),
        points,
        steps,
        hold,
        [*law, FASTEST, motion.dt],
    )
    force, torque, *others = scene_packing.unpack_components(found, batch).split([3, 3, 36][: 3 if hold else 2], -1)
    free = [k for k, b in enumerate(motion.bodies) if b.motion == "free"]
    return force, torque, *(x[..., free, :].unflatten(-1, (6, 6)) for x in others)


def kernel_fits(motion: PredictedBodyMotion) -> bool:
    """Return whether the kernel can do what these bodies need."""
    like = motion.state.pos
    return ready(like.device.type, like.dtype) and scene_packing.alike(motion)
