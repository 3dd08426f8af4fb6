"""Photographs show what pictures do; without the packages for them one sentence says so."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from test_render import scene

from torchdlo.errors import InputError
from torchdlo.report.render import photo
from torchdlo.report.render import picture as render
from torchdlo.report.render.run_surfaces import pieces
from torchdlo.scene_files.run import run

LIBRARIES = all(importlib.util.find_spec(name) for name in ("mitsuba", "pyoidn"))


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"mitsuba and pyoidn; install them with pip install 'torchdlo\[photo\]'"):
        photo.check_photo()


def test_ropes_are_laid_within_their_radius():
    frames = run(scene())
    (piece,) = pieces(frames)
    part = photo._rope(frames, piece, 0)
    # The rope lies along x at height 0.5; strands are ridges that reach its radius, 1 cm, and leave 72 % of it between.
    inside = (part["vertices"][:, 0] > 0.02) & (part["vertices"][:, 0] < 0.38)
    away = np.hypot(part["vertices"][inside, 1], part["vertices"][inside, 2] - 0.5)
    assert away.max() == pytest.approx(0.01, rel=0.03) and 0.0071 < away.min() < 0.009
    np.testing.assert_allclose(np.linalg.norm(part["normals"], axis=1), 1, atol=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(not LIBRARIES, reason="mitsuba and pyoidn are not installed")
def test_photographs_show_the_rope_where_it_is(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(photo, "mitsuba_variant", lambda: "scalar_rgb")
    frames = run(scene())
    with photo.Photo(frames, size=(64, 48), samples=4) as picture:
        image = picture.image(0).astype(float)
    assert image.shape == (48, 64, 3)
    # The rope, of one colour, lies in the middle of the picture from left to right.
    red = image[..., 0] - image[..., 2]
    assert red[20:28, 10:54].max(0).min() > 30 and image.std() > 5


def test_the_shadow_on_the_floor_is_below_the_rope():
    frames = run(scene())
    shadow = render.floor_shadow(frames, pieces(frames), (0.2, 0.0, 0.0), 1.0)(0)
    # The lamp is at (-4, -2.8, 8) from the middle: a point at height h goes to p + h (p - lamp) / (8 - h).
    y, x = np.nonzero(shadow > 0.5)
    lamp, p = np.array([0.2 - 4.0, -2.8, 8.0]), np.array([0.2, 0.0, 0.5])
    middle = p + (p - lamp) * p[2] / (lamp[2] - p[2])
    texel = 2.0 / 384
    assert 0.2 + (x.mean() - 191.5) * texel == pytest.approx(middle[0], abs=2 * texel)
    assert -(y.mean() - 191.5) * texel == pytest.approx(middle[1], abs=2 * texel)
