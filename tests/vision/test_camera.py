"""Projection is OpenCV's, goes both ways, has gradients, says what is behind; wrong files are refused in sentences."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.vision.scenes import front, hanging
from torchdlo.errors import InputError
from torchdlo.vision.camera import NEAR, Lens, back_project, lens, load_cameras, project, radial_limit, save_cameras
from torchdlo.vision.film import rope_coverage
from torchdlo.vision.rasterizer import rope_masks


def test_projection_is_that_of_opencv() -> None:
    camera, points = front(), hanging()
    pixel, depth = project(lens([camera]), torch.as_tensor(points)[None])
    turn, _ = cv2.Rodrigues(np.array(camera.rotation))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(
        points[:, None], turn, np.array(camera.translation), matrix, np.array(camera.distortion)
    )
    np.testing.assert_allclose(pixel[0].numpy(), expected[:, 0], atol=1e-9)
    assert (depth > 1).all()


def test_points_are_found_again_from_pixels_and_depths() -> None:
    view, points = lens([front()]), torch.as_tensor(hanging())[None]
    pixel, depth = project(view, points)
    torch.testing.assert_close(back_project(view, pixel, depth), points, atol=1e-6, rtol=0)


def test_points_behind_the_camera_have_finite_pixels_gradients_and_negative_depths() -> None:
    points = torch.tensor(
        [[[0.0, 0.0, 0.0], [0.0, -5.0, 0.0], [0.1, -1.2, 0.1]]], dtype=torch.float64, requires_grad=True
    )
    pixel, depth = project(lens([front()]), points)
    (gradient,) = torch.autograd.grad(pixel.sum(), points)
    assert depth[0, 0] > 0 > depth[0, 1] and torch.isfinite(pixel).all() and torch.isfinite(gradient).all()
    assert not gradient[0, 1:].any()


LENSES = [
    ((), np.inf),
    ((-0.3, 0.0, 0.0, 0.0, 0.0), np.sqrt(1 / 0.9)),
    ((-0.15, 0.05, 1e-3, -5e-4, 0.0), np.inf),
    ((0.0, 0.0, 0.1, 0.1), np.inf),
    ((0.1, -0.05, 0.0, 0.0, -0.01), None),
    ((0.2, -0.4, 0.0, 0.0, 0.3), None),
    ((0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0), np.sqrt(1 / 0.3)),
    ((0.5, 0.1, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0), 2.0),
    ((-0.2, 0.01, 0.0, 0.0, 0.002, 0.1, -0.05, 0.001, 0.01, 0.0, 0.01, 0.0), None),
]


@pytest.mark.parametrize(("distortion", "limit"), LENSES)
def test_radial_distortion_keeps_the_order_up_to_its_limit(distortion: tuple[float, ...], limit: float | None) -> None:
    found = radial_limit(distortion)
    assert limit is None or found == pytest.approx(limit)
    k1, k2, k3, k4, k5, k6 = (*distortion[:2], *distortion[4:8], *[0.0] * 6)[:6]
    r = np.linspace(0, 10, 200_001)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    falls = np.flatnonzero(~(np.diff(seen) > 0))
    first = r[falls[0]] if len(falls) else np.inf
    assert found == pytest.approx(first, abs=1e-4) or (found > 10 and first == np.inf)


def test_points_beyond_what_a_lens_shows_are_not_folded_back_into_the_picture() -> None:
    bent = front(distortion=(-0.3, 0.0, 0.0, 0.0, 0.0), focal=600.0)
    view = lens([bent, front(distortion=())])
    # 57 degrees off the axis, and as far off as the corners of the picture.
    local = np.array([[1.55, 0.0, 1.0], [1.5, 0.3, 1.0], [0.6, 0.45, 1.0]])
    turn, shift = np.array(bent.rotation), np.array(bent.translation)
    points = torch.tensor((local - shift) @ turn, requires_grad=True)
    pixel, depth = project(view, points)
    assert (depth[0, :2] < NEAR).all() and (depth[1] > NEAR).all()
    assert float(depth[0, 2].detach()) == pytest.approx(1.0)
    # They stay beyond the picture, in their direction, and pull at nothing.
    assert (pixel[0, :2, 0] > bent.width).all() and torch.isfinite(pixel).all()
    (gradient,) = torch.autograd.grad(pixel[0].sum() + depth[0].sum(), points)
    assert not gradient[:2].any() and gradient[2].any()
    far = points.detach()[:2] + torch.linspace(0, 0.1, 2, dtype=torch.float64)[:, None]
    assert not rope_masks(lens([bent]), far[None], 0.01, (bent.height, bent.width)).any()
    assert not rope_coverage(bent, far.numpy(), 0.01).any()


def test_gradients_with_respect_to_points_and_pose() -> None:
    view, points = lens([front()]), torch.as_tensor(hanging(5))[None].requires_grad_()
    turn, shift = (torch.full((1, 3), 0.01, dtype=torch.float64, requires_grad=True) for _ in range(2))
    zoom = torch.full((1,), 0.01, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, a, b, c: project(view.moved(a, b, c), p)[0], (points, turn, shift, zoom))


@pytest.mark.parametrize("count", [5, 14])
def test_distortion_that_is_0_has_its_gradient(count: int) -> None:
    given, points = lens([front(distortion=())]), torch.as_tensor(hanging(5))[None]
    distortion = torch.zeros(1, count, dtype=torch.float64, requires_grad=True)
    own = Lens(given.intrinsics, distortion, given.rotation, given.translation)
    there, depth = project(own, points)
    torch.testing.assert_close(there, project(given, points)[0])
    (gradient,) = torch.autograd.grad(there.sum(), distortion)
    step = 1e-6 * torch.eye(count, dtype=torch.float64)
    many = [x.expand(count, *x.shape[1:]) for x in (given.intrinsics, given.rotation, given.translation)]
    ends = [project(Lens(many[0], sign * step, *many[1:]), points)[0].sum((-1, -2)) for sign in (1, -1)]
    torch.testing.assert_close(gradient[0], (ends[0] - ends[1]) / 2e-6, atol=1e-5, rtol=1e-5)
    (back,) = torch.autograd.grad(back_project(own, there.detach(), depth.detach()).sum(), distortion)
    assert torch.isfinite(back).all() and back[..., :4].all()


def test_what_is_written_is_read(tmp_path: Path) -> None:
    cameras = (front(fps=60.0, start=-0.01), replace(front(), name="b", starts={"train_0": 0.2, "test_1": -3.0}))
    save_cameras(cameras, tmp_path / "cameras.json")
    assert load_cameras(tmp_path / "cameras.json") == cameras


def _without(name: str) -> Callable[[dict], None]:
    return lambda entry: entry.pop(name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_without("fx"), "cameras\\[0\\].fx: expected this entry"),
        (lambda e: e.update(fx=-1), "above 0"),
        (lambda e: e.update(width="wide"), "finite number"),
        (lambda e: e.update(rotation=[[1, 0, 0], [0, 1, 0], [0, 0, 2]]), "rotation matrix"),
        (lambda e: e.update(rotation=[[1, 0], [0, 1]]), "3 rows"),
        (lambda e: e.update(distortion=[0.1]), "0, 4, 5, 8"),
        (lambda e: e.update(translation=[0, 0]), "3 numbers"),
        (lambda e: e.update(zoom=1), "unknown key"),
        (lambda e: e.update(name="../x"), "letters"),
        (lambda e: e.update(starts=[0.1]), "seconds by trial"),
        (lambda e: e.update(starts={"train_0": "late"}), "starts.train_0: expected a finite number"),
    ],
)
def test_wrong_files_are_refused_in_a_sentence(tmp_path: Path, change: Callable[[dict], None], message: str) -> None:
    path = tmp_path / "cameras.json"
    save_cameras([front()], path)
    content = json.loads(path.read_text())
    change(content["cameras"][0])
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message) as caught:
        load_cameras(path)
    assert str(caught.value).startswith(str(path)) and str(caught.value).endswith(".")


@pytest.mark.parametrize(
    ("text", "message"), [("{", "is not JSON"), ("[]", "at least one camera"), (None, "found none")]
)
def test_files_that_are_none(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "cameras.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_cameras(path)
