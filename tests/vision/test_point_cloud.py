"""The cloud lies on the rope, has its size, its noise, and says when nothing is seen."""

from __future__ import annotations

import torch

from tests.vision.scenes import front, hanging
from torchdlo.vision.camera import lens
from torchdlo.vision.point_cloud import POINTS, point_cloud


def test_points_lie_beside_the_rope_within_pixels_and_noise() -> None:
    points = torch.as_tensor(hanging()).repeat(3, 1, 1)
    points[2] += torch.tensor([0.0, -9.0, 0.0])
    generator = torch.Generator().manual_seed(0)
    cloud, seen = point_cloud(lens([front()]), points, (240, 320), noise=2e-3, generator=generator)
    assert cloud.shape == (3, POINTS, 3) and seen.tolist() == [True, True, False] and not cloud[2].any()
    away = torch.cdist(cloud[0], points[0]).amin(-1)
    assert away.max() < 0.02 and away.mean() > 1e-3  # two pixels of 2 mm, noise, and half an edge
    exact, _ = point_cloud(lens([front()]), points, (240, 320), noise=0.0, generator=generator)
    assert torch.cdist(exact[0], points[0]).amin(-1).mean() < away.mean()


def test_few_pixels_are_drawn_again_and_both_ends_are_covered() -> None:
    points = torch.as_tensor(hanging(9)).expand(1, 9, 3) * torch.tensor([0.1, 0.1, 0.1])
    view = lens([front()])
    cloud, seen = point_cloud(view, points, (480, 640), noise=0.0)
    assert seen.all() and len(torch.unique(cloud[0].round(decimals=6), dim=0)) < POINTS
    for end in (0, -1):
        assert (cloud[0] - points[0, end]).norm(dim=-1).min() < 4e-3
