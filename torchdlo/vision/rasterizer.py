"""Differentiable pictures of ropes: anti-aliased tubes between projected vertices.

A pixel's signed depth below the outline of an edge is d = r(t) - |p - c(t)|, with c(t) the point of the edge next to
the pixel and r(t) the radius there; tubes unite by the largest depth. It is covered by F(d) + F(2 r - d) - 1, where F
is the share of a box of one pixel on the inner side of a straight line at that signed distance, for the line's
direction: along the edge, and at right angles to the radius on round ends. F runs from 0 to 1 over the width of the box
across the line, 1 to 1.41 px. So areas of straight tubes of constant radius are exact in all directions, also of those
thinner than a pixel; each end has 0.1 to 0.2 square pixels too much.

`coverage` is a C++ operator with a backward pass of its own, which visits only pixels that are partly covered;
`coverage_reference` has the same formulas as tensor operations. kornia has no rasteriser: cameras, filters and pyramids
around this one are kornia's.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchdlo.physics.kernels import native
from torchdlo.vision.camera import NEAR, Lens, project

__all__ = ["coverage", "coverage_reference", "pyramid", "rope_masks", "successors"]

_LEAST = 1e-7
"""Least component of a normal, and distance [px] from which a pixel's direction from an end is told."""

_DTYPES = {torch.float32: "float", torch.float64: "double"}


def successors(counts: Sequence[int], closed: Sequence[bool] = ()) -> Tensor:
    """Return the vertex after each one, -1 after ends, of ropes with so many vertices; shape (V,) int64."""
    after: list[int] = []
    for count, loop in zip(counts, [*closed, *[False] * (len(counts) - len(closed))], strict=True):
        first = len(after)
        after += [first + k + 1 for k in range(count - 1)] + [first if loop else -1]
    return torch.tensor(after, dtype=torch.int64)


@functools.cache
def _library() -> ctypes.CDLL | None:
    found = native.library(Path(__file__).with_name("tubes.cpp"), "-fno-math-errno")
    for name in _DTYPES.values() if found is not None else ():
        pointers, sizes = [ctypes.c_void_p] * 4, [ctypes.c_int64] * 4
        for function, more in ((f"tubes_{name}", 1), (f"tubes_gradient_{name}", 3)):
            call = getattr(found, function)
            call.restype, call.argtypes = None, [*pointers, *sizes, *[ctypes.c_void_p] * more, ctypes.c_int]
    return found


def _inputs(*given: Tensor) -> list[Tensor]:
    return [x.contiguous() for x in given]


@torch.library.custom_op("torchdlo::tube_coverage", mutates_args=())
def _coverage(pixel: Tensor, radius: Tensor, real: Tensor, after: Tensor, height: int, width: int) -> Tensor:
    library = _library()
    if library is None or pixel.device.type != "cpu" or pixel.dtype not in _DTYPES:
        return coverage_reference(pixel, radius, real, after, (height, width))
    pixel, radius, real, after = _inputs(pixel, radius, real, after)
    count, vertices = pixel.shape[:2]
    out = pixel.new_zeros(count, height, width)
    call = getattr(library, f"tubes_{_DTYPES[pixel.dtype]}")
    addresses = (x.data_ptr() for x in (pixel, radius, real, after))
    call(*addresses, count, vertices, height, width, out.data_ptr(), torch.get_num_threads())
    return out


@_coverage.register_fake
def _(pixel: Tensor, radius: Tensor, real: Tensor, after: Tensor, height: int, width: int) -> Tensor:
    return pixel.new_empty(pixel.shape[0], height, width)


@torch.library.custom_op("torchdlo::tube_coverage_gradient", mutates_args=())
def _gradient(
    gradient: Tensor, pixel: Tensor, radius: Tensor, real: Tensor, after: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor]:
    library = _library()
    if library is None or pixel.device.type != "cpu" or pixel.dtype not in _DTYPES:
        with torch.enable_grad():
            own = [x.detach().requires_grad_() for x in (pixel, radius)]
            out = coverage_reference(own[0], own[1], real, after, (height, width))
        first, second = torch.autograd.grad(out, own, gradient)
        return first, second
    gradient, pixel, radius, real, after = _inputs(gradient, pixel, radius, real, after)
    count, vertices = pixel.shape[:2]
    to_pixel, to_radius = torch.zeros_like(pixel), torch.zeros_like(radius)
    call = getattr(library, f"tubes_gradient_{_DTYPES[pixel.dtype]}")
    addresses = (x.data_ptr() for x in (pixel, radius, real, after))
    results = (x.data_ptr() for x in (gradient, to_pixel, to_radius))
    call(*addresses, count, vertices, height, width, *results, torch.get_num_threads())
    return to_pixel, to_radius


@_gradient.register_fake
def _(
    gradient: Tensor, pixel: Tensor, radius: Tensor, real: Tensor, after: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(pixel), torch.empty_like(radius)


def _keep(ctx, inputs, output) -> None:
    pixel, radius, real, after, height, width = inputs
    ctx.save_for_backward(pixel, radius, real, after)
    ctx.size = height, width


def _backward(ctx, gradient: Tensor):
    found = torch.ops.torchdlo.tube_coverage_gradient(gradient, *ctx.saved_tensors, *ctx.size)
    return *found, None, None, None, None


torch.library.register_autograd("torchdlo::tube_coverage", _backward, setup_context=_keep)


def coverage(pixel: Tensor, radius: Tensor, real: Tensor, after: Tensor, size: tuple[int, int]) -> Tensor:
    """Return how much of each pixel tubes cover [1], shape (..., H, W).

    Args:
        pixel: projected vertices [px], shape (..., V, 2).
        radius: radii at the vertices [px], shape (..., V).
        real: which vertices can be seen, shape (..., V) bool; edges of others are left out.
        after: the vertex after each, see `successors`, shape (V,).
        size: H and W.
    """
    batch, (height, width) = pixel.shape[:-2], size
    count = pixel.shape[-2]
    flat = pixel.reshape(-1, count, 2)
    wide = radius.to(pixel.dtype).expand(*batch, count).reshape(-1, count)
    seen = real.expand(*batch, count).reshape(-1, count)
    out = torch.ops.torchdlo.tube_coverage(flat, wide, seen, after, height, width)
    return out.reshape(*batch, height, width)


def _half_plane(depth: Tensor, normal: Tensor) -> Tensor:
    """Return the shares (...) of a pixel that are within a straight line.

    Args:
        depth: signed distance of the pixel's centre from the line [px], positive inside, shape (...).
        normal: absolute values of the components of the line's unit normal, shape (..., 2).
    """
    # The box's shadow on the normal is a trapezoid: level over `major - minor`, with flanks as wide as `minor`.
    major, minor = normal.amax(-1), normal.amin(-1).clamp(min=_LEAST)
    far = depth.abs()
    flank = ((0.5 * (major + minor) - far) / minor).clamp(0.0, 1.0)
    rest = 0.5 * minor * flank.square() / major
    return torch.where(far <= 0.5 * (major - minor), 0.5 + depth / major, torch.where(depth > 0, 1 - rest, rest))


def _normals(off: Tensor, distance: Tensor, along: Tensor, inner: Tensor) -> Tensor:
    """Return the absolute values of the unit normals of outlines, shape (..., 2), see `coverage_reference`."""
    # A quarter turn swaps the components, and shares are the same for both orders.
    length = along.square().sum(-1, keepdim=True).clamp(min=1e-18).sqrt()
    level = torch.tensor([1.0, 0.0], dtype=along.dtype, device=along.device)
    across = torch.where(length > 1e-9, along / length, level)
    radial = off / distance.clamp(min=_LEAST)[..., None]
    outer = torch.where((distance > _LEAST)[..., None], radial, across.detach())
    return torch.where(inner[..., None], across, outer).abs()


def coverage_reference(pixel: Tensor, radius: Tensor, real: Tensor, after: Tensor, size: tuple[int, int]) -> Tensor:
    """Return what `coverage` does, by tensor operations: every edge against every pixel."""
    height, width = size
    first = torch.nonzero(after >= 0)[:, 0]
    last = after[first]
    known = torch.isfinite(pixel).all(-1) & torch.isfinite(radius)
    pixel, radius = torch.where(known[..., None], pixel, 0.0), torch.where(known, radius, 0.0)
    real = real & known
    y, x = (torch.arange(n, dtype=pixel.dtype, device=pixel.device) for n in (height, width))
    place = torch.stack(torch.broadcast_tensors(x, y[:, None]), -1).reshape(-1, 2)
    a, b = pixel[..., first, :], pixel[..., last, :]
    d = b - a
    square = d.square().sum(-1)
    inverse = torch.where(square > 1e-18, 1 / square.clamp(min=1e-18), 0.0)[..., None]
    p = place - a[..., None, :]
    t = ((p * d[..., None, :]).sum(-1) * inverse).clamp(0.0, 1.0)
    off = p - t[..., None] * d[..., None, :]
    squared = off.square().sum(-1)
    distance = torch.where(squared > 1e-24, squared.clamp(min=1e-24).sqrt(), 0.0)
    ra, rb = radius[..., first, None], radius[..., last, None]
    r = ra + t * (rb - ra)
    depth = torch.where((real[..., first] & real[..., last])[..., None], r - distance, -1.0)
    best = depth.argmax(-2, keepdim=True)
    depth, r, distance, t = (torch.gather(part, -2, best)[..., 0, :] for part in (depth, r, distance, t))
    off = torch.gather(off, -3, best[..., None].expand(*best.shape, 2))[..., 0, :, :]
    along = torch.gather(d, -2, best[..., 0, :, None].expand(*depth.shape, 2))
    normal = _normals(off, distance, along, (t > 0) & (t < 1))
    covered = (_half_plane(depth, normal) + _half_plane(2 * r - depth, normal) - 1).clamp(0.0, 1.0)
    return covered.reshape(*pixel.shape[:-2], height, width)


def rope_masks(
    view: Lens,
    points: Tensor,
    radius: Tensor | float,
    size: tuple[int, int],
    *,
    after: Tensor | None = None,
    occluder: Tensor | None = None,
    scale: float = 1.0,
) -> Tensor:
    """Return how much of each pixel ropes cover [1], shape (..., H, W).

    Args:
        view: the cameras; their leading axes broadcast with those of the points.
        points: vertices in the world [m], shape (..., V, 3); edges at those that are not finite are left out.
        radius: radii [m], shape (..., V), or one number.
        size: H and W of the pictures.
        after: the vertex after each, see `successors`; one open rope if not given.
        occluder: how much of each pixel hands and fixtures hide [1], shape (..., H, W).
        scale: size of the pictures over those that the cameras were calibrated for.
    """
    wide = torch.as_tensor(radius, dtype=points.dtype)
    # What is not a number goes before the camera: times 0 it would still spoil the gradients of all that share it.
    known = torch.isfinite(points).all(-1) & torch.isfinite(wide)
    pixel, depth = project(view, torch.where(known[..., None], points, 0.0))
    focal = 0.5 * (view.intrinsics[..., 0, 0] + view.intrinsics[..., 1, 1])[..., None]
    wide = torch.where(known, wide, 0.0) * focal / depth.clamp(min=NEAR)
    # The centre of the top left pixel is at 0 in every size.
    pixel = (pixel + 0.5) * scale - 0.5
    after = successors([points.shape[-2]]) if after is None else after
    covered = coverage(pixel, wide.expand(depth.shape) * scale, (depth >= NEAR) & known, after, size)
    return covered if occluder is None else covered * (1 - occluder)


def pyramid(masks: Tensor, levels: int, sigma: float = 2.0) -> list[Tensor]:
    """Return masks (..., H, W) blurred and halved again and again, the finest first; by kornia's Gaussian filter."""
    from kornia.filters import gaussian_blur2d

    batch, out = masks.shape[:-2], []
    here = masks.reshape(-1, 1, *masks.shape[-2:])
    size = 2 * round(3 * sigma) + 1
    for level in range(levels):
        if level:
            here = torch.nn.functional.avg_pool2d(here, 2)
        fits = min(here.shape[-2:]) > size // 2
        blurred = gaussian_blur2d(here, (size, size), (sigma, sigma), border_type="reflect" if fits else "replicate")
        out.append(blurred.reshape(*batch, *here.shape[-2:]))
    return out
