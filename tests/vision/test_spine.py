"""Spines lie in the middle of what is drawn, distance fields are exact, and distances of curves go both ways."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from tests.vision.scenes import front, hanging
from torchdlo.vision.camera import lens, project
from torchdlo.vision.film import rope_coverage
from torchdlo.vision.spine import curve_vectors, distance_field, half_width, sample_field, spine, thin


def test_the_spine_of_a_rope_is_its_projected_centre_line() -> None:
    camera, points = front(), hanging()
    mask = rope_coverage(camera, points, 0.006) > 0.5
    places, tangents = spine(mask, 60)
    assert np.isfinite(places).sum() > 80
    pixel, _ = project(lens([camera]), torch.as_tensor(points)[None])
    known = np.isfinite(places).all(1)
    away, at = curve_vectors(pixel, torch.as_tensor(places[known])[None])
    distance = away[0].norm(dim=-1)
    assert distance.median() < 0.15 and distance.max() < 1.0
    edge = at[0].long().clamp(max=59)
    along = torch.nn.functional.normalize(pixel[0, edge + 1] - pixel[0, edge], dim=-1)
    assert (np.abs((along.numpy() * tangents[known]).sum(1)) > 0.97).mean() > 0.95
    assert abs(half_width(mask) - 0.006 * 650 / 1.2) < 0.2


@pytest.mark.parametrize("degrees", [0, 12, 30, 45, 63, 90, 150])
@pytest.mark.parametrize("half", [0.5, 1.0, 1.5, 2.0, 2.5, 4.0])
def test_half_widths_of_bands_are_right(half: float, degrees: float) -> None:
    y, x = np.mgrid[:200, :200]
    across, along = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    away, far = np.abs((y - 100.2) * along - (x - 99.7) * across), np.abs((x - 99.7) * along + (y - 100.2) * across)
    band = (away < half) & (far < 80)
    # At 45 degrees pixels come in steps of 0.7 px: a mask is as wide as the pixels that it has.
    true = 0.5 * band.sum() / 160
    assert half_width(band) == pytest.approx(true, rel=0.05) and abs(true - half) < 0.36
    holes = band & (np.random.default_rng(0).random(band.shape) > 0.03)
    assert half_width(holes) == pytest.approx(true, rel=0.12)


@pytest.mark.parametrize("radius", [0.0008, 0.0015, 0.003, 0.006, 0.012])
def test_half_widths_of_ropes_are_right(radius: float) -> None:
    s = np.linspace(0, 1, 121)
    loop = np.stack([0.42 * (s - 0.5) + 0.12 * np.sin(3 * np.pi * s), 0 * s, 0.15 * np.cos(3 * np.pi * s) - 0.15], 1)
    for points in (hanging(121), loop):
        depth = project(lens([front()]), torch.as_tensor(points)[None])[1].numpy()
        found = half_width(rope_coverage(front(), points, radius) > 0.5)
        assert found == pytest.approx(radius * 650 * (1 / depth).mean(), rel=0.04, abs=0.06)


def test_thinning_leaves_one_pixel_and_an_empty_mask_has_no_spine() -> None:
    mask = np.zeros((20, 60), bool)
    mask[8:13, 5:55] = True
    line = thin(mask)
    assert line.sum(0).max() == 1 and line[:, 10:50].any(0).all() and (line & ~mask).sum() == 0
    assert np.isnan(spine(np.zeros((20, 60), bool), 10)[0]).all()


def test_distance_fields_are_exact() -> None:
    rng = np.random.default_rng(0)
    mask = rng.random((40, 60)) < 0.01
    field = distance_field(mask)
    np.testing.assert_allclose(field, distance_transform_edt(~mask), atol=1e-4)
    place = torch.tensor([[[3.0, 7.0], [10.5, 20.0], [-5.0, 2.0]]])
    seen = sample_field(torch.as_tensor(field)[None], place)[0].numpy()
    np.testing.assert_allclose(seen, [field[7, 3], 0.5 * (field[20, 10] + field[20, 11]), field[2, 0]], atol=1e-4)


def test_vectors_to_a_curve_by_brute_force() -> None:
    generator = torch.Generator().manual_seed(0)
    curve, places = (torch.rand(2, n, 2, generator=generator, dtype=torch.float64) * 50 for n in (9, 30))
    away, at = curve_vectors(curve, places)
    t = torch.linspace(0, 1, 401, dtype=torch.float64)[:, None]
    dense = (curve[:, :-1, None] * (1 - t) + curve[:, 1:, None] * t).flatten(1, 2)
    nearest = torch.cdist(places, dense).amin(-1)
    torch.testing.assert_close(away.norm(dim=-1), nearest, atol=1e-2, rtol=0)
    assert (at >= 0).all() and (at <= 8).all()
