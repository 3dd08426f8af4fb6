"""The search for the nearest points of edges as a C++ kernel, up to the last step of Newton's method.

The formulas stand in `segment_distance`, as tensor operations; these are used on a GPU, where there is no C++ compiler,
and for meshes that differ from scene to scene. What is found has no derivative: the last step gives it one.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import Body
from torchdlo.coupling.common import scene_packing

_function, ready = scene_packing.kernel("edge_search", "RodBody, the points of edges in implicit steps")


class _Sizes(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("vertices", "scenes", "shape", "pieces")),
        *((name, ctypes.c_void_p) for name in ("cells", "grid")),
    )


def _search(edges: list[Tensor], body: Tensor, grid: Tensor, shape: int, cells: list[int], pieces: int) -> Tensor:
    out = _search_meta(edges, body, grid, shape, cells, pieces)
    sizes = _Sizes(*out.shape[1:], shape, pieces, scene_packing.integers(tuple(cells)), grid.data_ptr())
    places = (scene_packing.fields(x) for x in (edges, [body], [out]))
    _function("search", out.dtype)(*places, ctypes.byref(sizes), torch.get_num_threads())
    return out


def _search_meta(edges: list[Tensor], body: Tensor, grid: Tensor, shape: int, cells: list[int], pieces: int) -> Tensor:
    return edges[0].new_empty(4 * pieces, *edges[0].shape[1:])


scene_packing.operator(
    "edge_search(Tensor[] edges, Tensor body, Tensor grid, int shape, int[] cells, int pieces) -> Tensor",
    _search,
    _search_meta,
)


def kernel_fits(body: Body, grid: Tensor) -> bool:
    """Return whether the kernel can look at edges near a body with these distances of its grid, (..., 1, n)."""
    alike = body.shape != "mesh" or grid.shape[:-2].numel() == 1
    return ready(grid.device.type, grid.dtype) and alike


@torch.no_grad()
def search(
    body: Body, size: Tensor, grid: Tensor, start: Tensor, edge: Tensor, pieces: int
) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Return for each piece of edges the share where they are nearest, the slope's rise there, and two bounds.

    Args:
        body: the body.
        size: its size [m], shape (..., 1, 3).
        grid: distances of its grid, if it is a mesh [m], shape (..., 1, n).
        start: first vertices in its frame [m], shape (..., V, 3).
        edge: edges in its frame [m], shape (..., V, 3).
        pieces: into how many equal pieces edges are cut.

    Returns:
        Share [1], rise [m], and least and largest share [1] for each piece, shape (..., V, 1) each.
    """
    batch, count = torch.broadcast_shapes(size.shape[:-2], start.shape[:-2]), start.shape[-2]
    first, third, fourth = size[..., :2], size[..., 2:], torch.zeros_like(size[..., 2:])
    if body.shape == "ring":
        start = torch.cat([start[..., :1] + shape_sdf.ring_centre(size), start[..., 1:]], -1)
        third, fourth = torch.cos(0.5 * third), torch.sin(0.5 * third)
    edges = scene_packing.pack_components([start, edge], batch, count)
    (numbers,) = scene_packing.pack_components([torch.cat([first, third, fourth], -1)], batch, 1)
    flat = grid.reshape(-1).contiguous() if body.shape == "mesh" else grid.new_zeros(1)
    shape, cells = tuple(shape_sdf.SIZES).index(body.shape), list(body.cells or (0, 0, 0))
    found = torch.ops.torchdlo.edge_search(edges, numbers, flat, shape, cells, pieces)
    parts = [x.reshape(count, *batch).movedim(0, -1).unsqueeze(-1) for x in found]
    return [tuple(parts[4 * j : 4 * j + 4]) for j in range(pieces)]
