"""Positions and tensions of an implicit substep as a C++ kernel, without derivative.

The formulas stand in `constrain.balance`: some three hundred operations on small tensors. The kernel does the same
without leaving the cache, several scenes per instruction.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdlo.physics import banded, lanes


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("slots", "scenes", "steps", "half", "count")),
        *((name, ctypes.c_void_p) for name in ("places", "order", "after")),
        *((name, ctypes.c_double) for name in ("turning", "most", "least", "shift")),
    )


def _solve(fields: list[Tensor], topology: str, steps: int, law: list[float]) -> tuple[Tensor, ...]:
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in fields))
    pattern, after = banded.pattern(f"saddle:{topology}"), lanes.successor(topology)
    places, order = pattern.places[0], pattern.order
    froms, _kept = lanes.fields(fields, batch)
    out = lanes.Results(fields[0], len(after), batch, 3, 1, 3)
    sizes = _Sizes(
        *(len(after), batch.numel(), steps, pattern.half_bandwidth, places.shape[0]),
        *(places.data_ptr(), order.data_ptr(), ctypes.addressof(after), *law),
    )
    call = lanes.function("balance", fields[0].dtype)
    call(froms, out.addresses, ctypes.byref(sizes), torch.get_num_threads())
    return out.logical()


_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define("balance(Tensor[] fields, str topology, int steps, float[] law) -> (Tensor, Tensor, Tensor)")
_operators.impl("balance", _solve, "CPU")


def solve(
    topology: str,
    scalars: Sequence[Tensor],
    vectors: Sequence[Tensor],
    scale: Tensor,
    steps: int,
    law: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `constrain.balance` does; only where `lanes.ready`.

    Args:
        topology: its name.
        scalars: rest lengths, compliance, activity, masks and giving of edges, weights of hinges, turning inertia of
            edges, freedom of vertices, and last tensions, shape (..., V or 1, 1) each.
        vectors: inertia of vertices, positions without force, forces, directions of edges, and how far they lead,
            shape (..., V, 3) each.
        scale: see `constrain.balance`.
        steps: Newton steps before the last one.
        law: how pulled edges turn, the most and the least tension, and the relative shift of edges.
    """
    return torch.ops.torchdlo.balance([*scalars, *vectors, scale], topology, steps, list(law))
