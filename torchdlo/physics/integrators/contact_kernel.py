"""The Newton iteration of implicit substeps with contact as a C++ kernel: a scene at a time, without derivative.

The formulas stand in `contact_step`, `contact_penalty` and `edge_lengths`, as tensor operations; these are used on a
GPU, where there is no C++ compiler, and for the step that carries derivatives.
"""

from __future__ import annotations

import ctypes
import functools

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.constraints import contact_penalty as penalty
from torchdlo.physics.constraints.contact_penalty import Pairs, Touch
from torchdlo.physics.constraints.edge_lengths import LengthSystem
from torchdlo.physics.kernels import native
from torchdlo.physics.linalg import banded

_DTYPES = {torch.float32: "float", torch.float64: "double"}


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("slots", "scenes", "families", "bodies", "pairs", "half", "tries")),
        *((name, ctypes.c_void_p) for name in ("after", "of", "steps", "order", "hardness", "law")),
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    return native.library(native.RODS / "touching.cpp", "-fno-math-errno", "-fno-trapping-math")


native.KERNELS["touching"] = _library


def available(like: Tensor) -> bool:
    """Return whether there is a kernel for tensors like this one."""
    here = native.works_on(like.device.type, "contact of ropes in implicit steps")
    return here and like.dtype in _DTYPES and _library() is not None


def _rows(batch: torch.Size, middle: tuple[int, ...], *parts: Tensor) -> Tensor:
    """Join numbers (..., *middle, C) of scenes along the last axis, shape (B, *middle, C in all)."""
    joined = torch.cat([x.expand(*batch, *middle, x.shape[-1]) for x in parts], -1)
    return joined.reshape(batch.numel(), *middle, joined.shape[-1]).contiguous()


def _points(batch: torch.Size, touch: Touch, slots: int) -> Tensor:
    maps = (x.flatten(-2) for x in penalty.maps(touch))
    parts = touch.real, touch.normal, touch.radius, touch.wanted, touch.given, touch.mu, *maps
    return _rows(batch, (touch.of.shape[0], slots), *parts)


def _pairs(batch: torch.Size, pairs: Pairs | None, like: Tensor) -> tuple[Tensor, Tensor]:
    if pairs is None:
        return like.new_empty(0), torch.empty(0, dtype=torch.int64)
    count = pairs.at.shape[-1]
    parts = pairs.real, pairs.normal, pairs.radius, pairs.wanted, pairs.mu, *(x.flatten(-2) for x in pairs.linear)
    at = torch.div(pairs.at, pairs.at.shape[:-2].numel(), rounding_mode="floor")
    return _rows(batch, (count,), *parts), at.mT.expand(*batch, count, 4).reshape(batch.numel(), count, 4).contiguous()


def solve(
    system: LengthSystem,
    tension: Tensor,
    touch: Touch,
    pairs: Pairs | None,
    origin: Tensor,
    dt: float,
    tries: tuple[tuple[float, int], ...],
    solved: float,
) -> list[Tensor]:
    """Return what Newton's method finds, and what an exact step makes of it.

    Args:
        system: the equations without contact.
        tension: those of the last substep [N], shape (..., V, 1).
        touch: points on bodies.
        pairs: edges of ropes that may touch.
        origin: positions at the start of the substep [m], shape (..., V, 3).
        dt: substep [s].
        tries: how hard contact is, and Newton steps at most, one after the other.
        solved: what may be left of the equations.

    Returns:
        Positions (..., V, 3), tensions (..., V, 1), displacements of bodies (..., J, 6) and hardness (..., 1, 1);
        then, after the exact step, positions, tensions, forces and forces of contact (..., V, 3), wrenches (..., J, 6)
        and what is left (..., 1, 1).
    """
    lengths, inertia, topology = system.lengths, system.inertia, system.lengths.topology
    v, free_bodies = topology.size, touch.of.shape[-1]
    swing = inertia.turning if inertia.turning is not None else inertia.vertex.new_zeros(1, 1)
    give = tree.part(lengths.give)
    parts = [lengths.rest, lengths.compliance, lengths.active, lengths.edge_mask, give, inertia.hinge, swing]
    parts += [system.free, tension, inertia.vertex, system.moved, system.force, system.direction, system.ahead, origin]
    parts.append(system.scale)
    others = [touch.wanted.shape[:-3], touch.resist.shape[:-3]]
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in parts), *others)
    slots = _rows(batch, (v,), *parts)
    points, (between, corners) = _points(batch, touch, v), _pairs(batch, pairs, slots)
    resist = touch.resist.expand(*batch, free_bodies, 6, 6).reshape(batch.numel(), free_bodies, 36).contiguous()
    pattern = banded.pattern(f"touching:{topology.name}")
    law = [system.turning, lengths.most, lengths.least, lengths.shift, dt, solved]
    law += [penalty.ROUND, penalty.FAR, penalty.LEAVING]
    body = [row.index(1.0) if 1.0 in row else -1 for row in touch.of.tolist()]
    arrays = [
        (ctypes.c_int64 * v)(*topology.successor()),
        (ctypes.c_int64 * max(1, len(body)))(*body),
        (ctypes.c_int64 * len(tries))(*(steps for _, steps in tries)),
        ctypes.c_void_p(pattern.order.data_ptr()),
        (ctypes.c_double * len(tries))(*(hard for hard, _ in tries)),
        (ctypes.c_double * len(law))(*law),
    ]
    scenes, count = batch.numel(), between.shape[1] if between.dim() > 1 else 0
    sizes = _Sizes(v, scenes, len(body), free_bodies, count, pattern.half_bandwidth, len(tries))
    for name, array in zip(("after", "of", "steps", "order", "hardness", "law"), arrays, strict=True):
        setattr(sizes, name, ctypes.cast(array, ctypes.c_void_p))
    shapes = [(3, v), (1, v), (free_bodies, 6), (1, 1), (3, v), (1, v), (3, v), (3, v), (free_bodies, 6), (1, 1)]
    out = [slots.new_empty(*shape, scenes) for shape in shapes]
    places = (ctypes.c_void_p * len(out))(*(x.data_ptr() for x in out))
    inputs = (ctypes.c_void_p(x.data_ptr()) for x in (slots, points, between, corners, resist))
    run = getattr(_library(), f"touching_{_DTYPES[slots.dtype]}")
    run(*inputs, places, ctypes.byref(sizes), torch.get_num_threads())
    found = []
    for k, (x, shape) in enumerate(zip(out, shapes, strict=True)):
        x = x.reshape(*shape, *batch)
        found.append(x.permute(*range(2, x.dim()), 0, 1) if k in (2, 3, 8, 9) else tree.logical(x))
    return found
