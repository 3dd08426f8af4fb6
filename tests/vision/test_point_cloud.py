"""The cloud lies on the rope, has its size, its noise, and says when nothing is seen."""

from __future__ import annotations

import torch

from tests.vision.scenes import front, hanging
from torchdlo.vision.camera import lens, project
from torchdlo.vision.point_cloud import POINTS, point_cloud, scene_cloud


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


def test_fixtures_hide_the_rope_behind_them_and_are_told_from_it() -> None:
    points, view, (height, width) = torch.as_tensor(hanging()).repeat(3, 1, 1), lens([front()]), (240, 320)
    alone, _ = point_cloud(view, points[:1], (height, width), noise=0.0)
    away = float((alone[0] - torch.linalg.inv(view.rotation[0]) @ -view.translation[0]).norm(dim=-1).min())
    wall = torch.full((3, height, width), torch.inf, dtype=torch.float64)
    wall[0, :, : width // 2] = 0.5 * away  # in front of the left half of the picture
    wall[1] = 9 * away  # far behind all of the rope
    cloud, fixed = scene_cloud(view, points, wall, noise=0.0)
    assert cloud.shape == (3, POINTS, 3) and fixed.sum(1).tolist() == [96, 96, 0]
    pixel, depth = (x[0] for x in project(view, cloud[:1]))
    left = pixel[:, 0] < width // 2 - 0.5
    assert torch.equal(left, fixed[0]) and torch.allclose(depth[fixed[0]], torch.tensor(0.5 * away).double())
    # Behind the rope its pixels are missing; without fixtures the cloud is the rope's.
    for b in (1, 2):
        assert torch.cdist(cloud[b][~fixed[b]], points[b].double()).amin(-1).max() < 0.02
    # Where a fixture hides all of the rope, nothing else is seen.
    hidden, fixed = scene_cloud(view, points, torch.full_like(wall, 0.5 * away), noise=0.0)
    assert fixed.all() and torch.isfinite(hidden).all()
    nothing, fixed = scene_cloud(view, points - 99.0, torch.full_like(wall, torch.inf))
    assert not nothing.any() and not fixed.any()
