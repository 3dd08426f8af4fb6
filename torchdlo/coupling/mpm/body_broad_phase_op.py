"""Which nodes of the grid are near rigid bodies as a C++ kernel.

The same choice as tensor operations in `body_mpm_coupling`, which are used on a GPU, where there is no C++ compiler,
and for meshes that differ from scene to scene or are learned. The kernel passes over nodes without mass. It has no
derivative, as no choice has.
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

_function, ready = scene_packing.kernel("body_near", "BodyMpmCoupling, which bodies are near particles")


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("scenes", "bodies", "room", "corners")),
        *((name, ctypes.c_void_p) for name in ("size", "shape", "cells", "grids")),
        ("first", 3 * ctypes.c_double),
        *((name, ctypes.c_double) for name in ("spacing", "reach")),
    )


def _choose(mass, origin, solids, grids, size, shape, cells, first, spacing: float, reach: float, room: int):
    out = _choose_meta(mass, origin, solids, grids, size, shape, cells, first, spacing, reach, room)
    lists = (scene_packing.integers(tuple(x)) for x in (size, shape, cells))
    numbers = (*solids.shape[:2], room, grids.shape[1], *lists, grids.data_ptr(), (*first,), spacing, reach)
    places = (ctypes.c_void_p(x.data_ptr()) for x in (mass, origin, solids, *out))
    _function("choose", mass.dtype)(*places, ctypes.byref(_Sizes(*numbers)), torch.get_num_threads())
    return out


def _choose_meta(mass: Tensor, *others) -> tuple[Tensor, Tensor]:
    scenes, room = mass.shape[0], others[-1]
    return mass.new_empty(scenes, room, dtype=torch.int64), mass.new_empty(scenes, 1, dtype=torch.int64)


scene_packing.operator(
    "body_near(Tensor mass, Tensor origin, Tensor solids, Tensor grids, int[] size, int[] shape, int[] cells, "
    "float[] first, float spacing, float reach, int room) -> (Tensor, Tensor)",
    _choose,
    _choose_meta,
)


def kernel_fits(motion: PredictedBodyMotion) -> bool:
    """Return whether the kernel can do what these bodies need."""
    like = motion.state.pos
    return ready(like.device.type, like.dtype) and scene_packing.alike(motion)


@torch.no_grad()
def choose(
    motion: PredictedBodyMotion, grid: Grid, nodes: Nodes, batch: Sequence[int], reach: float, room: int
) -> tuple[Tensor, Tensor]:
    """Return the numbers of the nodes nearest to bodies (B, R), and how many found no room (B, 1); no derivative.

    Args:
        motion: the bodies.
        grid: box and nodes.
        nodes: the grid.
        batch: axes of the scenes, B of them.
        reach: distance off the surface up to which nodes are near [m].
        room: how many are chosen, R.
    """
    offset, numbers = scene_packing.shape_sizes(motion)
    parts = [motion.state.pos, *itertools.chain(*axes(motion.state.quat)), offset, *numbers]
    count = len(motion.bodies)
    solids = torch.cat([x.expand(*batch, count, x.shape[-1]) for x in parts], -1).reshape(-1, count, 17)
    grids, cells = scene_packing.sampled_grids(motion)
    return torch.ops.torchdlo.body_near(
        nodes.mass.contiguous(),
        nodes.origin.contiguous(),
        solids.contiguous(),
        grids,
        list(grid.size),
        scene_packing.shape_numbers(motion),
        cells,
        list(grid.first),
        grid.spacing,
        reach,
        room,
    )
