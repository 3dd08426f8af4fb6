"""What a depth camera reports of a rope and of what stands about it: a cloud of a fixed number of noisy points.

The rope is projected into a grid of pixels, dilated to its four neighbours, given noise of depth and projected back:
the sensor of closed-loop manipulation with point clouds. What stands in front of it hides it. Nothing here is
differentiated.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdlo.vision.camera import NEAR, Lens, back_project, project

__all__ = ["POINTS", "point_cloud", "scene_cloud"]

POINTS = 384
"""Points of a cloud."""

_PER_EDGE = 4
"""Samples along each edge."""

_OF_FIXTURES = 4
"""One of so many points of a cloud is of fixtures, where there are some."""


@torch.no_grad()
def point_cloud(
    view: Lens,
    points: Tensor,
    size: tuple[int, int],
    *,
    count: int = POINTS,
    noise: float = 2e-3,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Return what one camera per scene sees of a rope.

    Args:
        view: the cameras, with the leading axes of the points or none.
        points: vertices of an open rope [m], shape (B, V, 3).
        size: H and W of the pictures.
        count: points of the cloud, P; pixels are drawn with replacement where there are fewer.
        noise: standard deviation of depths [m].
        generator: of the random numbers.

    Returns:
        Points in the world [m], (B, P, 3), and whether anything was seen, (B,) bool; without that, points are 0.
    """
    return _drawn(view, _rope_depth(view, points, size), size[1], count, noise, generator)


@torch.no_grad()
def scene_cloud(
    view: Lens,
    points: Tensor,
    fixtures: Tensor,
    *,
    count: int = POINTS,
    noise: float = 2e-3,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Return what one camera per scene sees of a rope and of fixtures, which hide each other.

    Args:
        view: the cameras, with the leading axes of the points or none.
        points: vertices of an open rope [m], shape (B, V, 3).
        fixtures: depths of fixtures [m], infinite where there are none, shape (B, H, W).
        count: points of the cloud, P, a quarter of them of fixtures; all of what is seen where the other is not.
        noise: standard deviation of depths [m].
        generator: of the random numbers.

    Returns:
        Points in the world [m], (B, P, 3), 0 where nothing is seen, and whether each is of a fixture, (B, P) bool.
    """
    width = fixtures.shape[-1]
    behind = fixtures.flatten(1).to(points)
    rope = _rope_depth(view, points, (fixtures.shape[-2], width))
    images = torch.where(rope < behind, rope, torch.inf), torch.where(rope < behind, torch.inf, behind)
    drawn = [_drawn(view, image, width, count, noise, generator) for image in images]
    (strand, strand_seen), (solid, solid_seen) = drawn
    most = count - count // _OF_FIXTURES
    some = torch.arange(count, device=points.device)
    fixed = (solid_seen & ~strand_seen)[:, None] | ((solid_seen & strand_seen)[:, None] & (some >= most))
    return torch.where(fixed[..., None], solid, strand), fixed


def _rope_depth(view: Lens, points: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the depths at which pixels show a rope, infinite where they do not [m], shape (B, H W)."""
    height, width = size
    t = torch.arange(_PER_EDGE, dtype=points.dtype, device=points.device) / _PER_EDGE
    along = points[:, :-1, None] + t[:, None] * (points[:, 1:, None] - points[:, :-1, None])
    dense = torch.cat([along.flatten(1, 2), points[:, -1:]], 1)
    pixel, depth = project(view, dense)
    step = torch.tensor([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], device=points.device)
    at = (pixel.round().long()[:, :, None] + step).flatten(1, 2)
    far = depth[:, :, None].expand(-1, -1, len(step)).flatten(1)
    inside = (far >= NEAR) & (at >= 0).all(-1) & (at[..., 0] < width) & (at[..., 1] < height)
    place = torch.where(inside, at[..., 1] * width + at[..., 0], height * width)
    # The nearest sample is what a pixel shows.
    image = points.new_full((len(points), height * width + 1), torch.inf)
    return image.scatter_reduce(1, place, torch.where(inside, far, torch.inf), "amin")[:, :-1]


def _drawn(
    view: Lens, image: Tensor, width: int, count: int, noise: float, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """Return points that are drawn among the pixels of depths (B, H W), (B, P, 3), and whether there are any, (B,)."""
    seen = torch.isfinite(image)
    some = seen.any(1)
    random: dict[str, Any] = {"generator": generator, "dtype": image.dtype, "device": image.device}
    # Each pixel once in a random order, as far as they go; then again from the first.
    order = torch.rand(seen.shape, **random) + 2.0 * ~seen
    ranked = order.topk(min(count, order.shape[1]), dim=1, largest=False).indices
    number = seen.sum(1).clamp(min=1)
    chosen = torch.gather(
        ranked, 1, torch.arange(count, device=image.device) % number.clamp(max=ranked.shape[1])[:, None]
    )
    picked = torch.gather(image, 1, chosen)
    noisy = picked + noise * torch.randn(picked.shape, **random)
    place = torch.stack([chosen % width, chosen // width], -1).to(image.dtype)
    cloud = back_project(view, place, noisy.nan_to_num(1.0, posinf=1.0))
    return torch.where(some[:, None, None], cloud, 0.0), some
