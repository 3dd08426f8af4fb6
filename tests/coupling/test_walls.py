"""The kernel for the faces of the box does what the tensor operations do, and so does its derivative."""

from __future__ import annotations

import dataclasses
import itertools
import random

import pytest
import torch
from material_points import DOUBLE

from torchdlo.coupling.mpm import transfer_op
from torchdlo.coupling.mpm.particles import WALLS, Grid

pytestmark = pytest.mark.skipif(not transfer_op.ready("cpu", DOUBLE), reason="there is no C++ compiler")

FACES = [("separate",) * 6, *(tuple(random.Random(k).choices(WALLS, k=6)) for k in range(8))]


def shaken(faces, window):
    """A grid, its first nodes in three scenes, velocities of nodes, some of them at rest, friction, and particles."""
    grid, g = Grid((0, 0, 0), (0.05, 0.06, 0.07), 0.01, faces, window), torch.Generator().manual_seed(0)
    room = torch.tensor([whole - n + 1 for whole, n in zip(grid.nodes, grid.size, strict=True)])
    origin = (torch.rand(3, 3, generator=g) * room).floor().to(DOUBLE)
    vel = torch.randn(3, grid.size[0] * grid.size[1] * grid.size[2], 3, generator=g, dtype=DOUBLE)
    vel[:, ::7] = 0.0
    # One at every node, off its middle.
    axes = [torch.arange(1, n - 1, dtype=DOUBLE) for n in grid.size]
    at = torch.cartesian_prod(*axes).T + 0.4 * torch.rand(3, 3, 1, generator=g, dtype=DOUBLE)
    friction = torch.full((1, 1), 0.4, dtype=DOUBLE, requires_grad=True)
    return grid, origin, vel.requires_grad_(), friction, at.requires_grad_()


def bounded(grid, origin, vel, friction, at):
    value, slope = transfer_op.take_from_nodes(grid, at, vel, origin, friction)
    found = torch.cat([value, slope], 1)
    weight = torch.sin(torch.arange(found.numel(), dtype=DOUBLE)).reshape(found.shape)
    # Walls that hold matter along their normals only need no friction.
    by = torch.autograd.grad((weight * found).sum(), (vel, friction, at), allow_unused=True)
    return found.detach(), *(torch.zeros(1, 1, dtype=DOUBLE) if x is None else x for x in by)


@pytest.mark.parametrize(("faces", "window"), list(itertools.product(FACES, [None, (8, 9, 10)])))
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(faces, window, monkeypatch):
    given = shaken(faces, window)
    found = bounded(*given)
    monkeypatch.setattr(transfer_op, "ready", lambda *_: False)
    for mine, theirs in zip(found, bounded(*given), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    free = dataclasses.replace(given[0], walls=("open",) * 6)
    assert float((found[0] - bounded(free, *given[1:])[0]).abs().max()) > 0


def test_what_is_not_a_number_stays_so():
    grid, origin, vel, friction, at = shaken(("separate",) * 6, None)
    broken = vel.detach().clone()
    broken[1, 500] = torch.nan
    value, _ = transfer_op.take_from_nodes(grid, at.detach(), broken, origin, friction.detach())
    near = value.isnan().any(1)
    assert int(near[1].sum()) == 27 and not near[0].any() and not near[2].any()
