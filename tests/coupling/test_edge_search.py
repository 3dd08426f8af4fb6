"""The kernel finds the nearest points of edges that tensor operations find."""

from __future__ import annotations

import pytest
import torch

from torchdlo.coupling.bodies import edge_search_op, segment_distance, shape_sdf
from torchdlo.coupling.bodies.dynamics import Body

SIZES = {
    "sphere": (0.04, 1.0, 1.0),
    "box": (0.05, 0.04, 0.03),
    "capsule": (0.02, 0.05, 1.0),
    "cylinder": (0.03, 0.05, 1.0),
    "cone": (0.05, 0.1, 1.0),
    "torus": (0.06, 0.02, 1.0),
    "ring": (0.06, 0.02, 4.0),
    "mesh": (0.1, 0.08, 0.06),
}


def edges(shape: str, dtype: torch.dtype, batch: tuple[int, ...]):
    """Random edges about a body whose size differs from scene to scene; a mesh samples a ball of 4 cm."""
    g = torch.Generator().manual_seed(0)
    size = torch.tensor([SIZES[shape]], dtype=dtype).expand(*batch, 1, 3)
    cells, grid = (), torch.zeros(1, 1, dtype=dtype)
    if shape == "mesh":
        cells = (6, 5, 4)
        axes = (h * torch.linspace(-1, 1, n + 1, dtype=dtype) for h, n in zip(SIZES[shape], cells, strict=True))
        grid = (torch.cartesian_prod(*axes).norm(dim=-1) - 0.04)[None]
    elif shape != "ring":
        size = size * (0.8 + 0.4 * torch.rand(*batch, 1, 3, generator=g, dtype=dtype))
    start = 0.1 * torch.randn(*batch, 37, 3, generator=g, dtype=dtype)
    edge = 0.05 * torch.randn(*batch, 37, 3, generator=g, dtype=dtype)
    return segment_distance._Line(Body(shape, "fixed", cells=cells), size, grid, start, edge)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("shape", SIZES)
def test_the_kernel_and_tensor_operations_find_the_same_points(shape, dtype, monkeypatch):
    assert set(SIZES) == set(shape_sdf.SIZES) - {"plane"}
    line = edges(shape, dtype, (3, 2))
    if not edge_search_op.kernel_fits(line.body, line.grid):
        pytest.skip("there is no C++ compiler")
    count = 1 if shape in shape_sdf.CONVEX else 2
    by_kernel = segment_distance._nearest(line, count)
    monkeypatch.setattr(edge_search_op, "ready", lambda *_: False)
    by_tensors = segment_distance._nearest(line, count)
    inside = [(s > 0.01) & (s < 0.99) for s in by_tensors]
    assert all(int(i.sum()) > 20 for i in inside[:1])
    for a, b in zip(by_kernel, by_tensors, strict=True):
        if dtype == torch.float64:
            assert float((a - b).abs().max()) < 1e-9
        else:  # nearly flat minima are found as well as slopes round: by their distances
            far = [line.probe(x)[0] for x in (a, b)]
            assert float((far[0] - far[1]).abs().max()) < 1e-5


def test_meshes_that_differ_from_scene_to_scene_are_left_to_tensor_operations():
    line = edges("mesh", torch.float64, ())
    assert not edge_search_op.kernel_fits(line.body, line.grid.expand(2, *line.grid.shape))
