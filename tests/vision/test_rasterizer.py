"""The operator agrees with its reference, with finite differences, with area, and with another rasteriser."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.vision.scenes import front, hanging
from torchdlo.vision.camera import lens
from torchdlo.vision.film import rope_coverage
from torchdlo.vision.rasterizer import coverage, coverage_reference, pyramid, rope_masks, successors

SIZE = (48, 64)


def curves(count: int, vertices: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Curves that cross themselves, their radii from thinner than a pixel on, and all of it visible."""
    generator = torch.Generator().manual_seed(seed)
    s = torch.linspace(0, 2 * torch.pi, vertices, dtype=torch.float64)
    a, b = torch.rand(2, count, 1, generator=generator, dtype=torch.float64) * 6
    pixel = torch.stack([32 + 25 * torch.sin(s + a), 24 + 18 * torch.sin(2 * s + b)], -1)
    radius = 0.2 + 3 * torch.rand(count, vertices, generator=generator, dtype=torch.float64)
    return pixel, radius, torch.ones(count, vertices, dtype=torch.bool)


def test_operator_and_reference_agree_with_their_gradients() -> None:
    pixel, radius, real = curves(3, 21)
    real[1, 4] = False
    pixel[2, 9] = torch.nan
    weight = torch.randn(3, *SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = []
    for draw in (coverage, coverage_reference):
        own = [x.clone().requires_grad_() for x in (pixel, radius)]
        out = draw(*own, real, successors([21]), SIZE)
        found.append((out.detach(), *torch.autograd.grad((out * weight).sum(), own)))
    for one, two in zip(*found, strict=True):
        torch.testing.assert_close(one, two, atol=1e-12, rtol=1e-10)
    assert 0 < found[0][0][0].mean() < 1


def test_gradients_are_those_of_finite_differences() -> None:
    pixel, radius, real = curves(2, 15, 3)
    weight = torch.randn(2, *SIZE, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    after = successors([9, 6], [True, False])

    def loss(p: torch.Tensor, r: torch.Tensor) -> torch.Tensor:
        return (coverage(p, r, real, after, SIZE) * weight).sum()

    own = [x.clone().requires_grad_() for x in (pixel, radius)]
    gradients = torch.autograd.grad(loss(*own), own)
    h, worst, size = 1e-6, 0.0, max(float(g.abs().max()) for g in gradients)
    for which, gradient in enumerate(gradients):
        for place in np.ndindex(*gradient.shape):
            ends = []
            for sign in (1, -1):
                moved = [pixel.clone(), radius.clone()]
                moved[which][place] += sign * h
                ends.append(float(loss(*moved)))
            worst = max(worst, abs((ends[0] - ends[1]) / (2 * h) - float(gradient[place])))
    assert worst / size < 1e-6


def test_a_straight_rope_along_the_pixels_has_shared_joints() -> None:
    # Perpendiculars at joints run through centres of pixels: each of them is next to two edges at once.
    pixel = torch.stack([torch.arange(8.0, 57, 4), torch.full((13,), 20.25)], -1).double()[None].requires_grad_()
    out = coverage(
        pixel, torch.full((1, 13), 2.0).double(), torch.ones(1, 13, dtype=torch.bool), successors([13]), SIZE
    )
    weight = torch.linspace(0, 1, SIZE[0], dtype=torch.float64)[:, None]
    (gradient,) = torch.autograd.grad((out * weight).sum(), pixel)
    inner = gradient[0, 1:-1, 1]
    torch.testing.assert_close(inner, inner[:1].expand_as(inner), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("radius", "share"), [(0.3, 0.02), (0.8, 5e-3), (2.0, 5e-3), (4.0, 5e-3)])
def test_area_is_that_of_a_much_finer_picture(radius: float, share: float) -> None:
    pixel = torch.stack([10 + 40 * torch.linspace(0, 1, 31), 8 + 30 * torch.linspace(0, 1, 31) ** 2], -1).double()[None]
    args = (torch.ones(1, 31, dtype=torch.bool), successors([31]))
    coarse = coverage(pixel, torch.full((1, 31), radius).double(), *args, SIZE).sum()
    fine = coverage((pixel + 0.5) * 16 - 0.5, torch.full((1, 31), 16.0 * radius).double(), *args, (48 * 16, 64 * 16))
    assert float(coarse) == pytest.approx(float((fine > 0.5).sum()) / 256, rel=share)


def straight(way: tuple[int, int], steps: int, radius: float, shift: float, draw=coverage):
    """Area of a straight tube of so many steps from a place that is the same on its pixel for all, and its picture."""
    direction = torch.tensor(way, dtype=torch.float64)
    across = direction.flip(0) * torch.tensor([-1.0, 1.0]) / direction.norm()
    start = torch.tensor([6.2, 5.7], dtype=torch.float64) + shift * across
    pixel = start + direction * torch.arange(steps + 1, dtype=torch.float64)[:, None]
    seen = torch.ones(1, steps + 1, dtype=torch.bool)
    wide = torch.full((1, steps + 1), radius, dtype=torch.float64)
    out = draw(pixel[None], wide, seen, successors([steps + 1]), SIZE)[0]
    return float(out.sum()), out


@pytest.mark.parametrize("way", [(1, 0), (0, 1), (1, 1), (2, 1), (1, 3), (7, 1)])
@pytest.mark.parametrize("radius", [0.05, 0.2, 0.5, 1.0, 2.0])
def test_straight_tubes_have_the_same_area_wherever_they_lie(way: tuple[int, int], radius: float) -> None:
    fewer, more = 3, 3 + 21 // max(way)
    for draw in (coverage, coverage_reference):
        for shift in np.linspace(0, 1, 6):
            # Ends are at the same places of pixels: what they add goes out of the difference.
            area = straight(way, more, radius, shift, draw)[0] - straight(way, fewer, radius, shift, draw)[0]
            assert area == pytest.approx(2 * radius * (more - fewer) * np.hypot(*way), rel=1e-6)


def test_pixels_see_what_a_finer_picture_of_a_slanted_tube_does() -> None:
    _, out = straight((2, 1), 14, 0.7, 0.3)
    y, x = np.mgrid[: 40 * SIZE[0], : 40 * SIZE[1]] / 40 + 0.5 / 40 - 0.5
    ux, uy = np.array([2.0, 1.0]) / np.sqrt(5)
    x, y = x - 6.2 + 0.3 * uy, y - 5.7 - 0.3 * ux
    along, away = x * ux + y * uy, np.abs(y * ux - x * uy)
    fine = (away < 0.7).reshape(SIZE[0], 40, SIZE[1], 40).mean((1, 3))
    middle = ((along > 3) & (along < 28)).reshape(SIZE[0], 40, SIZE[1], 40).all((1, 3))
    assert (middle & (fine > 0) & (fine < 1)).sum() > 50
    assert np.abs(out.numpy() - fine)[middle].max() < 0.01


def test_another_rasteriser_sees_the_same() -> None:
    camera, points = front(), hanging()
    other = rope_coverage(camera, points, 0.006, fine=8)
    own = rope_masks(lens([camera]), torch.as_tensor(points)[None], 0.006, (480, 640))[0].numpy()
    assert own.sum() == pytest.approx(other.sum(), rel=0.01)
    assert np.abs(own - other)[(own > 0) & (own < 1)].mean() < 0.03 and np.minimum(own, other).sum() > 0.97 * own.sum()


def test_views_frames_and_scenes_are_one_batch_and_occluders_hide() -> None:
    points = torch.as_tensor(hanging(21)).expand(2, 3, 1, 21, 3)
    view = lens([front(), front()])
    hidden = torch.zeros(480, 640, dtype=torch.float64)
    hidden[:, :320] = 1.0
    out = rope_masks(view, points, 0.006, (480, 640), occluder=hidden)
    assert out.shape == (2, 3, 2, 480, 640) and not out[..., :320].any() and out[..., 320:].any()


def test_a_rope_behind_the_camera_leaves_no_trace() -> None:
    points = torch.as_tensor(hanging(11) + np.array([0.0, -3.0, 0.0]))[None].requires_grad_()
    out = rope_masks(lens([front()]), points, 0.006, (480, 640))
    (gradient,) = torch.autograd.grad(out.sum(), points)
    assert not out.any() and not gradient.any()


def test_a_vertex_that_is_not_a_number_spoils_no_gradient() -> None:
    points = torch.as_tensor(hanging(11)).repeat(2, 1, 1)
    points[1, 4] = torch.nan
    points.requires_grad_()
    radius = torch.full((2, 11), 0.006, dtype=torch.float64)
    radius[1, 9] = torch.nan
    radius.requires_grad_()
    pose = [torch.zeros(1, n, dtype=torch.float64, requires_grad=True) for n in (3, 3)]
    zoom = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    out = rope_masks(lens([front()]).moved(*pose, zoom), points, radius, (480, 640))
    weight = torch.linspace(0, 1, 640, dtype=torch.float64)
    found = torch.autograd.grad((out * weight).sum(), (points, radius, *pose, zoom))
    assert torch.isfinite(out).all() and all(torch.isfinite(g).all() and g.any() for g in found)
    assert 0 < out[1].sum() < 0.9 * out[0].sum() and found[0][1, 0].any() and not found[0][1, 4].any()


def test_the_pyramid_keeps_what_there_is_and_has_gradients() -> None:
    mask = torch.zeros(2, 96, 128, dtype=torch.float64)
    mask[:, 40:48, 50:70] = 1.0
    mask.requires_grad_()
    levels = pyramid(mask, 3)
    assert [x.shape[-1] for x in levels] == [128, 64, 32]
    for k, level in enumerate(levels):
        assert float(level.detach().sum()) * 4**k == pytest.approx(320, rel=0.02)
    assert torch.autograd.grad(levels[-1].sum(), mask)[0].any()
