"""Reading and adding at the corners of pairs."""

from __future__ import annotations

import pytest
import torch
from touching import F64

from torchdlo.physics.linalg.gather_scatter import corners, drop, pick

pytestmark = pytest.mark.quick


def sample(batch: tuple[int, ...], v: int = 7, k: int = 5):
    g = torch.Generator().manual_seed(1)
    at = torch.randint(0, v, (*batch, 4, k), generator=g)
    return at, torch.randn(*batch, v, 3, generator=g, dtype=F64)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_pick_reads_the_right_vertices_and_drop_adds_to_them(batch):
    at, x = sample(batch)
    found = pick(x, corners(at))
    values = []
    for c in range(4):
        index = at[..., c, :, None].expand(*batch, 5, 3)
        assert torch.equal(found[c], torch.gather(x, -2, index))
        values.append(torch.zeros_like(x).scatter_add(-2, index, found[c]))
    assert torch.allclose(drop(found, corners(at), 7), sum(values), rtol=0, atol=1e-14)


def test_values_shared_by_all_scenes_are_read_for_each():
    at, x = sample((3,))
    assert torch.equal(pick(x[0], corners(at))[1], pick(x[:1].expand(3, 7, 3), corners(at))[1])


def test_they_are_transposes_of_each_other_and_differentiable_twice():
    at, x = sample((2,))
    places = corners(at)
    y = tuple(torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(k), dtype=F64) for k in range(4))
    left = sum((a * b).sum() for a, b in zip(pick(x, places), y, strict=True))
    assert float(left) == pytest.approx(float((x * drop(y, places, 7)).sum()), rel=1e-13)
    x.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: torch.stack(pick(x, places)), (x,))
    assert torch.autograd.gradgradcheck(lambda x: drop(tuple(p**2 for p in pick(x, places)), places, 7), (x,))
