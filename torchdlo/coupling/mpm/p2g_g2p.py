"""Sums from particles to grid nodes and back, with quadratic B-splines and affine fields.

A particle at x says c + S (x_i - x) at node i; `particles_to_grid` sums that over particles with the weights w_i(x),
`grid_to_particles` sums values of nodes with w_i and with w_i (x_i - x). Each is the other's transpose, so each is the
other's derivative;
`tilt` is the derivative by x of both. Weights: Jiang et al. 2016, The Material Point Method for Simulating Continuum
Materials, eq. 123, doi:10.1145/2897826.2927348.

These are tensor operations; on a GPU their sums come in the order in which threads arrive. On the CPU a C++ kernel does
the same, see `transfer_op`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing


def _stencil(at: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor, Tensor, Callable[[int], Tensor]]:
    """Return nodes (B, 27, P), distances (B, 3, 27, P), weights (B, 27, P), and their derivatives along an axis."""
    most = at.new_tensor(size).reshape(3, 1) - 3
    base = torch.minimum((at - 0.5).floor().nan_to_num(0.0).clamp(min=0.0), most)
    f = at - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], 2)
    g = torch.stack([f - 1.5, 2 - 2 * f, f - 0.5], 2)
    steps = torch.arange(3, device=at.device)
    grid = torch.cartesian_prod(steps, steps, steps)
    b = base.long()
    x, y, z = (b[:, a, None] + grid[:, a, None] for a in range(3))
    distance = grid.T[:, :, None] - f[:, :, None]

    def product(*factors: Tensor) -> Tensor:
        a, b, c = factors
        return (a[:, :, None, None] * b[:, None, :, None] * c[:, None, None, :]).flatten(1, 3)

    def along(axis: int) -> Tensor:
        return product(*((g if a == axis else w)[:, a] for a in range(3)))

    return (x * size[1] + y) * size[2] + z, distance, product(w[:, 0], w[:, 1], w[:, 2]), along


def _said(value: Tensor, slope: Tensor, distance: Tensor) -> Tensor:
    """Return c + S d at the nodes, shape (B, 4, 27, P)."""
    s = slope.unflatten(1, (3, 3))
    fields = torch.einsum("bkap,banp->bknp", s, distance)
    return value[:, :, None] + torch.cat([fields, torch.zeros_like(fields[:, :1])], 1)


def _reach(grid: Tensor, nodes: Tensor) -> Tensor:
    """Return the values of nodes, shape (B, 4, 27, P)."""
    flat = nodes.flatten(1)[:, None].expand(-1, 4, -1)
    return grid.mT.gather(2, flat).unflatten(2, nodes.shape[1:])


def _spread(at: Tensor, value: Tensor, slope: Tensor, size: Sequence[int]) -> Tensor:
    grid = at.new_zeros(at.shape[0], 4, size[0] * size[1] * size[2])
    nodes, distance, weight, _ = _stencil(at, size)
    said = (weight[:, None] * _said(value, slope, distance)).flatten(2)
    flat = nodes.flatten(1)[:, None].expand(-1, 4, -1)
    return grid.scatter_add_(2, flat, said).mT.contiguous()


def _collect(at: Tensor, grid: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    nodes, distance, weight, _ = _stencil(at, size)
    seen = weight[:, None] * _reach(grid, nodes)
    return seen.sum(2), torch.einsum("bknp,banp->bkap", seen[:, :3], distance).flatten(1, 2)


def _tilt(at: Tensor, value: Tensor, slope: Tensor, grid: Tensor, size: Sequence[int]) -> Tensor:
    nodes, distance, weight, along = _stencil(at, size)
    seen = _reach(grid, nodes)
    product = (_said(value, slope, distance) * seen).sum(1)
    tilted = torch.stack([(along(a) * product).sum(1) for a in range(3)], 1)
    means = (weight[:, None] * seen[:, :3]).sum(2)
    return tilted - torch.einsum("bkap,bkp->bap", slope.unflatten(1, (3, 3)), means)


_library = torch.library.Library("torchdlo", "FRAGMENT")
_OPS: dict[str, tuple[str, Callable, Callable]] = {
    "spread": (
        "(Tensor at, Tensor value, Tensor slope, int[] size) -> Tensor",
        _spread,
        lambda at, value, slope, size: at.new_empty(at.shape[0], size[0] * size[1] * size[2], 4),
    ),
    "collect": (
        "(Tensor at, Tensor grid, int[] size) -> (Tensor, Tensor)",
        _collect,
        lambda at, grid, size: tuple(at.new_empty(at.shape[0], k, at.shape[2]) for k in (4, 9)),
    ),
    "tilt": (
        "(Tensor at, Tensor value, Tensor slope, Tensor grid, int[] size) -> Tensor",
        _tilt,
        lambda at, value, slope, grid, size: at.new_empty(at.shape),
    ),
}
for _name, (_schema, _make, _fake) in _OPS.items():
    _library.define(_name + _schema, tags=(torch.Tag.needs_contiguous_strides,))
    _library.impl(_name, _make, "CompositeExplicitAutograd")
    _library.impl(_name, _fake, "Meta")


def _save_spread(ctx, inputs, output) -> None:
    *tensors, ctx.size = inputs
    ctx.save_for_backward(*tensors)


def _spread_backward(ctx, gradient: Tensor):
    at, value, slope = ctx.saved_tensors
    gradient = gradient.contiguous()
    moved = torch.ops.torchdlo.tilt(at, value, slope, gradient, ctx.size) if ctx.needs_input_grad[0] else None
    return moved, *torch.ops.torchdlo.collect(at, gradient, ctx.size), None


def _collect_backward(ctx, value: Tensor, slope: Tensor):
    at, grid = ctx.saved_tensors
    value, slope = value.contiguous(), slope.contiguous()
    moved = torch.ops.torchdlo.tilt(at, value, slope, grid, ctx.size) if ctx.needs_input_grad[0] else None
    return moved, torch.ops.torchdlo.spread(at, value, slope, ctx.size), None


torch.library.register_autograd("torchdlo::spread", _spread_backward, setup_context=_save_spread, lib=_library)
torch.library.register_autograd("torchdlo::collect", _collect_backward, setup_context=_save_spread, lib=_library)
torch.library.register_autograd("torchdlo::tilt", scene_packing.refuse_second_derivative, lib=_library)


def particles_to_grid(at: Tensor, value: Tensor, slope: Tensor, size: Sequence[int]) -> Tensor:
    """Return what particles say at the nodes, shape (B, X Y Z, 4); differentiable once.

    Args:
        at: places of particles in node spacings from the first node [1], shape (B, 3, P).
        value: four values, shape (B, 4, P).
        slope: slopes of the first three of them per node spacing, row by row, shape (B, 9, P).
        size: numbers of nodes (X, Y, Z), the last one fastest.
    """
    return torch.ops.torchdlo.spread(at.contiguous(), value.contiguous(), slope.contiguous(), list(size))


def grid_to_particles(at: Tensor, grid: Tensor, size: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Return the weighted sums of node values (B, 4, P), and of the first three times distance (B, 9, P).

    Args:
        at: as in `particles_to_grid`.
        grid: values of nodes, shape (B, X Y Z, 4).
        size: as in `particles_to_grid`.
    """
    return torch.ops.torchdlo.collect(at.contiguous(), grid.contiguous(), list(size))


def grid_velocities(grid: Tensor) -> tuple[Tensor, Tensor]:
    """Return velocities of nodes, zero where there is no mass [m/s] (B, N, 3), and masses [kg] (B, N).

    Args:
        grid: momentum [kg m/s] and mass [kg] of nodes, shape (B, N, 4).
    """
    there = grid[..., 3:] > 0
    return torch.where(there, grid[..., :3] / torch.where(there, grid[..., 3:], 1.0), 0.0), grid[..., 3]
