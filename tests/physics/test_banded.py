"""Banded systems against a dense solution."""

from __future__ import annotations

import pytest
import torch
from helpers import F64

from torchdlo.physics.linalg import banded

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("batch", [1, 3, 8, 19])
@pytest.mark.parametrize("name", ["tridiagonal:o7", "tridiagonal:o8", "tridiagonal:c6", "saddle:o9", "saddle:c8,o5"])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_solutions_are_those_of_the_dense_matrix(name, batch, dtype):
    g = torch.Generator().manual_seed(7)
    n = banded.pattern(name).size
    kind, topology = name.split(":")
    slots = sum(int(part[1:]) for part in topology.split(","))
    entries = torch.randn({"tridiagonal": 3, "saddle": 20}[kind] * slots, batch, generator=g, dtype=F64)
    # Pivots that exist: large entries on the diagonal.
    for first, count in [(0, 3 * slots), (19 * slots, slots)] if kind == "saddle" else [(0, slots)]:
        entries[first : first + count] += 20.0 * torch.sign(entries[first : first + count])
    rhs = torch.randn(n, batch, generator=g, dtype=F64)
    for transpose in (False, True):
        right = banded.solve_dense(entries, rhs, name, transpose)
        found = torch.ops.torchdlo.solve_banded(entries.to(dtype), rhs.to(dtype), name, transpose)
        torch.testing.assert_close(found.to(F64), right, rtol=0, atol=1e-12 if dtype == F64 else 1e-5)
