"""What rigid bodies and nodes of the grid give each other as a C++ kernel, with its derivative.

The formulas stand in `body_coupling_effect`, as tensor operations; these are used on a GPU, where there is no C++
compiler, and for meshes that differ from scene to scene or are learned. The kernel does the same, several scenes per
instruction, and passes over nodes that no body reaches. For compilers of graphs it is one operation.
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import PredictedBodyMotion
from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.mpm.particles import Grid
from torchdlo.coupling.mpm.substep import Nodes
from torchdlo.physics.linalg.vector_components import axes

_INPUTS = "Tensor vel, Tensor mass, Tensor answer, Tensor solids"
_OTHERS = "Tensor origin, Tensor chosen, Tensor grids, int[] size, int[] shapes, int[] cells, int sweeps, float[] law"
_function, ready = scene_packing.kernel("body_nodes", "BodyMpmCoupling, what bodies and particles give each other")


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("scenes", "bodies", "room", "sweeps", "corners")),
        *((name, ctypes.c_void_p) for name in ("size", "shape", "cells", "grids")),
        ("first", 3 * ctypes.c_double),
        *((name, ctypes.c_double) for name in ("spacing", "reach", "recovery", "ramp")),
    )


def _run(what: str, given: Sequence[Tensor], others: Sequence, *more: Sequence[Tensor]) -> None:
    """Run the kernel; the last tensor of `given` and of each of `more` has the scenes last."""
    vel, mass, answer, solids = given
    origin, chosen, grids, size, shapes, cells, sweeps, law = others

    def places(tensors: Sequence[Tensor]) -> list:
        return [*(ctypes.c_void_p(x.data_ptr()) for x in tensors[:-1]), scene_packing.fields(tensors[-1:])]

    lists = (scene_packing.integers(tuple(x)) for x in (size, shapes, cells))
    counts = (mass.shape[0], solids.shape[1], mass.shape[1], sweeps, grids.shape[1])
    sizes = _Sizes(*counts, *lists, grids.data_ptr(), (*law[:3],), *law[3:])
    rows = [*places((vel, mass, answer, origin, chosen, solids)), *itertools.chain(*map(places, more))]
    _function(what, vel.dtype)(*rows, ctypes.byref(sizes), torch.get_num_threads())


def _exchange(vel, mass, answer, solids, *others) -> tuple[Tensor, Tensor]:
    out = _exchange_meta(vel, mass, answer, solids)
    _run("exchange", (vel, mass, answer, solids), others, out)
    return out


def _exchange_meta(vel, mass, answer, solids, *others) -> tuple[Tensor, Tensor]:
    return torch.empty_like(vel), solids.new_empty(6, *solids.shape[1:])


def _back(vel, mass, answer, solids, given_by, wrench_by, *others) -> tuple[Tensor, ...]:
    given = (vel, mass, answer, solids)
    out = _back_meta(*given)
    _run("back", given, others, (given_by, wrench_by), out)
    return out


def _back_meta(vel, mass, answer, solids, *others) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(x) for x in (vel, mass, answer, solids))


def _save(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs[:7])
    ctx.static = inputs[7:]


def _backward(ctx, given_by: Tensor, wrench_by: Tensor):
    vel, mass, answer, solids, *others = ctx.saved_tensors
    by = (given_by.contiguous(), wrench_by.contiguous())
    found = torch.ops.torchdlo.body_nodes_back(vel, mass, answer, solids, *by, *others, *ctx.static)
    return (*found, *(None for _ in range(len(others) + len(ctx.static))))


scene_packing.operator(
    f"body_nodes({_INPUTS}, {_OTHERS}) -> (Tensor, Tensor)", _exchange, _exchange_meta, _save, _backward
)
scene_packing.operator(
    f"body_nodes_back({_INPUTS}, Tensor given_by, Tensor wrench_by, {_OTHERS}) -> (Tensor, Tensor, Tensor, Tensor)",
    _back,
    _back_meta,
    backward=scene_packing.refuse_second_derivative,
)


def kernel_fits(motion: PredictedBodyMotion) -> bool:
    """Return whether the kernel can do what these bodies need."""
    like = motion.state.pos
    return ready(like.device.type, like.dtype) and scene_packing.alike(motion)


def exchange(
    motion: PredictedBodyMotion,
    grid: Grid,
    near: Nodes,
    chosen: Tensor,
    batch: Sequence[int],
    sweeps: int,
    law: tuple[float, float, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return impulses [N s] and angular impulses [N m s] on bodies (B, K, 3), and what nodes get [m/s], (B, R, 3).

    Args:
        motion: the bodies.
        grid: box and nodes.
        near: the chosen nodes; differentiable once by them and by the bodies.
        chosen: their numbers, shape (B, R).
        batch: axes of the scenes, B of them.
        sweeps: projected Jacobi sweeps.
        law: reach and ramp in node spacings, and rate of recovery [1/s].
    """
    state, params, dt, count = motion.state, motion.params, motion.dt, len(motion.bodies)
    offset, numbers = scene_packing.shape_sizes(motion)
    rates = [motion.change / dt, motion.turn / dt, motion.mobility / dt**2, motion.inverse_inertia / dt**2]
    parts = [state.pos, *itertools.chain(*axes(state.quat)), offset, *numbers, *rates, params.mu_s, params.mu_k]
    grids, cells = scene_packing.sampled_grids(motion)
    reach, ramp, recovery = law
    given, wrench = torch.ops.torchdlo.body_nodes(
        near.vel.contiguous(),
        near.mass.contiguous(),
        near.share.reshape(-1).expand(near.mass.shape[0]).contiguous(),
        scene_packing.join_components(parts, torch.Size(batch), count).contiguous(),
        near.origin.contiguous(),
        chosen.contiguous(),
        grids,
        list(grid.size),
        scene_packing.shape_numbers(motion),
        cells,
        sweeps,
        [*grid.first, grid.spacing, reach, recovery, ramp],
    )
    force, torque = wrench.permute(2, 1, 0).split(3, -1)
    return force, torque, given
