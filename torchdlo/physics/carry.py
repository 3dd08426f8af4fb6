"""Reference directors carried from edges to where they are a substep later, as a C++ kernel without derivative.

The formulas stand in `rod.advance_frames`.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchdlo.physics import lanes


def _carry(fields: list[Tensor], topology: str) -> tuple[Tensor, ...]:
    batch, after = torch.broadcast_shapes(*(x.shape[:-2] for x in fields)), lanes.successor(topology)
    froms, _kept = lanes.fields(fields, batch)
    out = lanes.Results(fields[0], len(after), batch, 3, 1, 1)
    sizes = (ctypes.c_int64 * 2)(len(after), batch.numel())
    lanes.function("carry", fields[0].dtype)(froms, out.addresses, sizes, after, torch.get_num_threads())
    return out.logical()


_operators = torch.library.Library("torchdlo", "FRAGMENT")
_operators.define("carry(Tensor[] fields, str topology) -> (Tensor, Tensor, Tensor)")
_operators.impl("carry", _carry, "CPU")


def carry(topology: str, director: Tensor, tangent: Tensor, pos: Tensor, edge_mask: Tensor) -> tuple[Tensor, ...]:
    """Return directors after a substep, and sine and cosine of the angle across each hinge; only where `lanes.ready`.

    Args:
        topology: its name.
        director: of the edges before, shape (..., V, 3).
        tangent: of the edges before, shape (..., V, 3).
        pos: vertices after it [m], shape (..., V, 3).
        edge_mask: 1 for real edges, shape (V, 1).

    Returns:
        Directors (..., V, 3), and sines and cosines (..., V, 1), both times the same length.
    """
    return torch.ops.torchdlo.carry([director, tangent, pos, edge_mask], topology)
