"""The Newton iteration of implicit substeps with contact as a C++ kernel, a scene at a time, and its derivative.

The formulas stand in `contact_step`, `contact_penalty` and `edge_lengths`, as tensor operations; these are used on a
GPU and where there is no C++ compiler. The kernel reads tensors as they are stored.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics.constraints import contact_penalty as penalty
from torchdlo.physics.constraints.joint_points import JointPoints
from torchdlo.physics.kernels import native
from torchdlo.physics.linalg import banded
from torchdlo.physics.rod.topology import parse

_DTYPES = {torch.float32: "float", torch.float64: "double"}
_POINTS = 10
"""Numbers of points among the parts of `Touch`; behind them stand which body they are on, and how bodies resist."""
_SLOT, _POINT, _PAIR = 28, 18, 43
"""How many numbers slots, points and pairs have."""


class _Tied(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("first", "slot", "body", "weight")),
    )


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("slots", "scenes", "families", "bodies", "pairs", "half", "tries")),
        *((name, ctypes.c_void_p) for name in ("after", "of", "steps", "order", "hardness", "law")),
        ("tied", _Tied),
    )


class _Place(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_int64) for name in ("input", "offset", "slot", "family", "scene"))


class _Inputs(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("slots", "points", "pairs", "bodies")),
        ("joints", ctypes.c_int64),
        ("corner", ctypes.c_int64 * 4),
        ("scenes", ctypes.c_int64),
    )


@functools.cache
def _library() -> ctypes.CDLL | None:
    return native.library(native.RODS / "touching.cpp", "-fno-math-errno", "-fno-trapping-math")


native.KERNELS["touching"] = _library


def available(like: Tensor) -> bool:
    """Return whether there is a kernel for tensors like this one."""
    return _ready(like.device.type, like.dtype)


def _ready(device: str, dtype: torch.dtype) -> bool:
    here = native.works_on(device, "contact of ropes in implicit steps")
    return here and dtype in _DTYPES and _library() is not None


# For compilers what it returns is a constant: `torch.compiler.assume_constant_result`, without importing them.
_ready._dynamo_marked_constant = True  # type: ignore[attr-defined]  # a mark that no stub knows


_Layout = tuple[tuple[torch.Size, tuple[int, ...]], ...]


@dataclass(frozen=True)
class _Plan:
    """How to call the kernel with inputs of given shapes and strides."""

    batch: tuple[int, ...]
    sizes: _Sizes
    inputs: _Inputs
    shapes: tuple[tuple[int, ...], ...]
    """Shapes of what it returns, without the scenes, which come last."""
    kept: tuple
    """What these point to."""


def _flat(x: Tensor, batch: tuple[int, ...], core: int) -> Tensor:
    """Return a tensor with one axis for all scenes, or none, in front of the last `core` axes."""
    own = x.dim() - core
    if own == 0 or (own == 1 and (x.shape[0] == math.prod(batch))):
        return x
    if math.prod(x.shape[:own]) == 1:
        return x.reshape(x.shape[own:])
    return x.expand(*batch, *x.shape[own:]).reshape(-1, *x.shape[own:])


def _places(first: int, layout: Sequence, core: int) -> list[_Place]:
    """Return where numbers are: axes are scenes, if there are any, then `core` of (family,) slot and components."""
    found = []
    for k, (shape, stride) in enumerate(layout):
        many, shape, stride = len(shape) > core, shape[-core:], stride
        scene, stride = (stride[0] if many else 0), stride[-core:]
        family, shape, stride = (stride[0] * (shape[0] > 1), shape[1:], stride[1:]) if core == 3 else (0, shape, stride)
        slot = stride[0] * (shape[0] > 1)
        found += [_Place(first + k, c * stride[1], slot, family, scene) for c in range(shape[1])]
    return found


@functools.lru_cache(maxsize=1024)
def _plan(
    topology: str,
    batch: tuple[int, ...],
    layouts: tuple[_Layout, ...],
    of: tuple[int, ...],
    count: int,
    law: tuple[float, ...],
    tries: tuple[tuple[float, int], ...],
    tied: tuple[tuple[tuple[tuple[int, float], ...], ...], tuple[int, ...]],
) -> _Plan:
    shape = parse(topology)
    v, scenes, pattern = shape.size, math.prod(batch), banded.pattern(f"touching:{topology}")
    slots, points, resist, pairs, corners = layouts
    first = 0
    places = []
    for layout, core in ((slots, 2), (points, 3), (resist, 3)):
        places.append(_places(first, layout, core))
        first += len(layout)
    (_, stride), *_ = resist
    scene = stride[0] if len(stride) > 3 else 0
    bodies = [
        _Place(len(slots) + len(points), i * stride[-2] + j * stride[-1], stride[-3], 0, scene)
        for i in range(6)
        for j in range(6)
    ]
    between: list[_Place] = []
    if pairs:
        between = _places(first, pairs[:5], 2)
        for k, (wide, stride) in enumerate(pairs[5:]):
            scene = stride[0] if len(wide) > 3 else 0
            between += [
                _Place(first + 5 + k, i * stride[-2] + j * stride[-1], stride[-3], 0, scene)
                for i in range(3)
                for j in range(3)
            ]
    lists = [(_Place * max(1, len(x)))(*x) for x in (places[0], places[1], between, bodies)]
    inputs = _Inputs(*(ctypes.addressof(x) for x in lists))
    inputs.joints = first + len(pairs) if tied[0] else -1
    room = 0
    if corners:
        ((wide, stride),) = corners
        room, scene = wide[-1], stride[0] if len(wide) > 2 else 0
        inputs.corner[:] = [0, stride[-2], stride[-1], scene]
        inputs.scenes = wide[0] if len(wide) > 2 else 1
    arrays = [
        (ctypes.c_int64 * v)(*shape.successor()),
        (ctypes.c_int64 * max(1, len(of)))(*of),
        (ctypes.c_int64 * len(tries))(*(steps for _, steps in tries)),
        ctypes.c_void_p(pattern.order.data_ptr()),
        (ctypes.c_double * len(tries))(*(hard for hard, _ in tries)),
        (ctypes.c_double * len(law))(*law),
    ]
    joined, points_at = _tied(*tied), len(tied[0])
    sizes = _Sizes(v, scenes, len(of), count, room, pattern.half_bandwidth, len(tries))
    sizes.tied = _Tied(points_at, *(ctypes.addressof(x) for x in joined))
    for name, array in zip(("after", "of", "steps", "order", "hardness", "law"), arrays, strict=True):
        setattr(sizes, name, ctypes.cast(array, ctypes.c_void_p))
    before = (3, v), (1, v), (count, 6), (1, 1)
    after = (3, v), (1, v), (3, v), (3, v), (count, 6), (1, 1)
    shapes = *before, *after, (points_at, 3), (points_at, 3), (count, 6)
    return _Plan(batch, sizes, inputs, shapes, (lists, arrays, joined, pattern))


def _tied(points: Sequence[Sequence[tuple[int, float]]], bodies: Sequence[int]) -> list[ctypes.Array]:
    """Return the vertices of joined points, where each point's begin, their bodies, and the vertices' weights."""
    pairs = [pair for point in points for pair in point]
    first = [sum(len(x) for x in points[:k]) for k in range(len(points) + 1)]
    whole = [(ctypes.c_int64 * max(1, len(x)))(*x) for x in (first, [slot for slot, _ in pairs], bodies)]
    return [*whole, (ctypes.c_double * max(1, len(pairs)))(*(weight for _, weight in pairs))]


def _addresses(tensors: Sequence[Tensor]) -> ctypes.Array:
    return (ctypes.c_void_p * len(tensors))(*[x.data_ptr() for x in tensors])


@dataclass(frozen=True)
class _Call:
    """A plan, and the tensors that it is for."""

    plan: _Plan
    tensors: list[Tensor]
    corners: Tensor | None
    """Corners of pairs of edges [1], shape (..., 4, K); None without pairs."""

    def addresses(self) -> tuple[ctypes.Array, ctypes.c_void_p]:
        """Return where the tensors are."""
        corners = ctypes.c_void_p(None if self.corners is None else self.corners.data_ptr())
        return _addresses(self.tensors), corners


def _call(
    inputs: list[Tensor],
    parts: list[Tensor],
    pairs: list[Tensor],
    origin: Tensor,
    topology: str,
    law: Sequence[float],
    tries: tuple[tuple[float, int], ...],
    solved: float,
    stalled: tuple[float, float],
    joints: JointPoints | None = None,
) -> _Call:
    points, (of, resist) = parts[:_POINTS], parts[_POINTS : _POINTS + 2]
    slots, at, pairs = [*inputs, origin], pairs[:1], pairs[1:]
    groups = [(slots, 2), (points, 3), ([resist], 3), (pairs[:5], 2), (pairs[5:], 3), (at, 2)]
    leading = {x.shape[:-core] for group, core in groups for x in group}
    batch = tuple(torch.broadcast_shapes(*leading, () if joints is None else joints.batch))
    flat = [[_flat(x, batch, core) for x in group] for group, core in groups]
    flat = [*flat[:3], flat[3] + flat[4], flat[5]]
    layouts = tuple(tuple((x.shape, x.stride()) for x in group) for group in flat)
    body = tuple(row.index(1.0) if 1.0 in row else -1 for row in of.tolist())
    numbers = (*law, solved, penalty.ROUND, penalty.FAR, penalty.LEAVING, *stalled)
    tensors = [x for group in flat[:4] for x in group]
    if joints is None:
        tied: tuple[Any, tuple[int, ...]] = (), ()
    else:
        rows = [tuple((k, w) for k, w in enumerate(row) if w) for row in joints.weight.tolist()]
        tied = tuple(rows), tuple(row.index(1.0) if 1.0 in row else -1 for row in joints.on.tolist())
        given = joints.local, joints.arm, joints.force, joints.pos, joints.quat, joints.inertia, joints.omega
        wide = [x.expand(*batch, *x.shape[-2:]).reshape(math.prod(batch), -1) for x in given]
        tensors.append(torch.cat(wide, -1).contiguous())
    plan = _plan(topology, batch, layouts, body, of.shape[-1], numbers, tries, tied)
    return _Call(plan, tensors, flat[4][0] if at else None)


def solve(
    inputs: list[Tensor],
    parts: list[Tensor],
    pairs: list[Tensor],
    origin: Tensor,
    topology: str,
    law: Sequence[float],
    tries: tuple[tuple[float, int], ...],
    solved: float,
    stalled: tuple[float, float],
    joints: JointPoints | None = None,
) -> list[Tensor]:
    """Return what Newton's method finds, and what an exact step makes of it.

    Args:
        inputs: what `LengthSystem.inputs` returns.
        parts: those of `Touch`: points on bodies.
        pairs: those of `Pairs`: edges of ropes that may touch; none if no ropes do.
        origin: positions at the start of the substep [m], shape (..., V, 3).
        topology: name of the topology.
        law: numbers of the equations without contact, and the substep [s].
        tries: how hard contact is, and Newton steps at most, one after the other.
        solved: what may be left of the equations.
        stalled: what is left after an exact step, over what was left before it, from which on it falls no further, and
            up to how many times `solved` that is taken for rounding.
        joints: points that are joined, if any are.

    Returns:
        Positions (..., V, 3), tensions (..., V, 1), displacements of bodies (..., J, 6) and hardness (..., 1, 1);
        then, after the exact step, positions, tensions, forces and forces of contact (..., V, 3), wrenches (..., J, 6)
        and what is left (..., 1, 1); forces of joints before that step and after it (..., A, 3), and displacements of
        bodies after it (..., J, 6).
    """
    call = _call(inputs, parts, pairs, origin, topology, law, tries, solved, stalled, joints)
    plan = call.plan
    out = [origin.new_empty(*shape, plan.sizes.scenes) for shape in plan.shapes]
    run = getattr(_library(), f"touching_{_DTYPES[origin.dtype]}")
    threads = torch.get_num_threads()
    run(*call.addresses(), ctypes.byref(plan.inputs), _addresses(out), ctypes.byref(plan.sizes), threads)
    return [_logical(k, x, plan.batch) for k, x in enumerate(out)]


def _logical(k: int, x: Tensor, batch: tuple[int, ...]) -> Tensor:
    """Return what the kernel made with its scenes in front: of vertices (C, V, B), of bodies (J, C, B)."""
    x = x.reshape(*x.shape[:2], *batch)
    scenes = range(2, x.dim())
    return x.permute(*scenes, 0, 1) if k in (2, 3, 8, 9, 10, 11, 12) else x.permute(*scenes, 1, 0)


def derive(call: tuple, found: list[Tensor], by: list[Tensor]) -> tuple[Tensor, ...]:
    """Return derivatives of what `solve` returns: numbers of slots (28, V, B), of points (B, F, V, 18), of pairs
    (B, K, 43), and of how bodies resist (B, J, 36), in the order of the arguments of `solve`, positions at the start
    behind the other numbers of slots.

    Args:
        call: those arguments.
        found: the first four of what it returned.
        by: derivatives by the next five.
    """
    planned = _call(*call)
    sizes = planned.plan.sizes
    given = [x.reshape(sizes.scenes, -1).contiguous() for x in (*found, *by)]
    like = given[0]
    out = (
        like.new_empty(_SLOT, sizes.slots, sizes.scenes),
        like.new_zeros(sizes.scenes, sizes.families, sizes.slots, _POINT),
        like.new_zeros(sizes.scenes, sizes.pairs, _PAIR),
        like.new_zeros(sizes.scenes, sizes.bodies, 36),
    )
    run = getattr(_library(), f"touching_back_{_DTYPES[like.dtype]}")
    places, inputs = planned.addresses(), ctypes.byref(planned.plan.inputs)
    run(*places, inputs, _addresses(given), _addresses(out), ctypes.byref(sizes), torch.get_num_threads())
    return out
