"""The kernel for the faces of the box does what the tensor operations do, and so does its derivative."""

from __future__ import annotations

import itertools
import random

import pytest
import torch
from material_points import DOUBLE

from torchdlo.coupling.mpm import grid_boundaries
from torchdlo.coupling.mpm.particles import WALLS, Grid

pytestmark = pytest.mark.skipif(not grid_boundaries.ready("cpu", DOUBLE), reason="there is no C++ compiler")

FACES = [("separate",) * 6, *(tuple(random.Random(k).choices(WALLS, k=6)) for k in range(8))]


def shaken(faces, window):
    """A grid, its first nodes in three scenes, velocities of nodes, some of them at rest, and friction."""
    grid, g = Grid((0, 0, 0), (0.05, 0.06, 0.07), 0.01, faces, window), torch.Generator().manual_seed(0)
    room = torch.tensor([whole - n + 1 for whole, n in zip(grid.nodes, grid.size, strict=True)])
    origin = (torch.rand(3, 3, generator=g) * room).floor().to(DOUBLE)
    vel = torch.randn(3, grid.size[0] * grid.size[1] * grid.size[2], 3, generator=g, dtype=DOUBLE)
    vel[:, ::7] = 0.0
    return grid, origin, vel.requires_grad_(), torch.full((1, 1), 0.4, dtype=DOUBLE, requires_grad=True)


def bounded(grid, origin, vel, friction):
    found = grid_boundaries.walls(grid, origin, vel, friction)
    weight = torch.sin(torch.arange(found.numel(), dtype=DOUBLE)).reshape(found.shape)
    # Walls that hold matter along their normals only need no friction.
    by = torch.autograd.grad((weight * found).sum(), (vel, friction), allow_unused=True)
    return found.detach(), *(torch.zeros(1, 1, dtype=DOUBLE) if x is None else x for x in by)


@pytest.mark.parametrize(("faces", "window"), list(itertools.product(FACES, [None, (8, 9, 10)])))
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(faces, window, monkeypatch):
    given = shaken(faces, window)
    found = bounded(*given)
    monkeypatch.setattr(grid_boundaries, "ready", lambda *_: False)
    for mine, theirs in zip(found, bounded(*given), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    assert float((found[0][..., :3] - given[2].detach()).abs().max()) > 0


def test_what_is_not_a_number_stays_so():
    grid, origin, vel, friction = shaken(("separate",) * 6, None)
    broken = vel.detach().clone()
    broken[1, 500] = torch.nan
    found = grid_boundaries.walls(grid, origin, broken, friction.detach())
    assert bool(found[1, 500, :3].isnan().all()) and int(found.isnan().sum()) == 3
