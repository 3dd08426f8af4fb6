"""Effects between the rope and its recording against closed forms: delay and offset of markers."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from helpers import F64, rand, vec

from torchdlo.physics.effects.measurement import MarkerOffset, TimeDelay, Track, interpolate

pytestmark = pytest.mark.quick


def recorded(count: int = 12, dt: float = 0.01, motion=None, batch: tuple[int, ...] = ()) -> Track:
    """A track of three markers, the first of which is gripped, on a motion t -> (F, 1, 3)."""
    time = dt * torch.arange(count, dtype=F64)
    pos = motion(time[:, None, None]) * rand(3, 3, seed=1)
    pos = pos.expand(*batch, count, 3, 3)
    d1 = torch.nn.functional.normalize(rand(count, 3, 3, seed=2, low=-1), dim=-1).expand_as(pos)
    d2 = torch.linalg.cross(d1, rand(count, 3, 3, seed=3).expand_as(pos))
    return Track(time, pos, d1, torch.nn.functional.normalize(d2, dim=-1), torch.tensor([True, False, False]))


def cubic(t):
    return 0.2 - 3 * t + 40 * t**2 - 500 * t**3


@pytest.mark.parametrize("delay", [0.0, 0.0137, 0.04, -0.023])
def test_delayed_markers_of_a_cubic_motion_are_exact_and_grippers_are_not_delayed(delay):
    track = recorded(motion=cubic)
    seen = TimeDelay().observe(track, {"delay": vec(delay)[None]})
    asked = (track.time - delay)[:, None, None]
    at = asked.clamp(0, float(track.time[-1]))
    # Where nothing was recorded, it goes on evenly.
    wanted = (cubic(at) + (asked - at) * (-3 + 80 * at - 1500 * at**2)) * rand(3, 3, seed=1)
    assert torch.equal(seen[:, 0], track.pos[:, 0])
    assert torch.allclose(seen[:, 1:], wanted[:, 1:], rtol=0.0, atol=1e-14)


def test_interpolation_in_time_is_fourth_order_and_smooth():
    # sin(9 t): halving the step divides the error by 16, but for the next order: 9 h is 0.09 and less. Gradients do not
    # jump at frames.
    errors = []
    for count in (201, 401, 801):
        t = torch.linspace(0, 2, count, dtype=F64)
        x = torch.sin(9 * t)[:, None, None].expand(count, 1, 3)
        frame = (torch.arange(count, dtype=F64) - 0.43).clamp(min=0)
        at = 2 / (count - 1) * frame
        errors.append(float((interpolate(x, frame)[..., 0, 0] - torch.sin(9 * at))[3:-3].abs().max()))
    assert all(3.9 < math.log2(a / b) < 4.1 for a, b in pairwise(errors)), errors
    gradients = []
    for side in (-1e-9, 1e-9):
        frame = (torch.full((801,), 20.0, dtype=F64) + side).requires_grad_()
        gradients.append(torch.autograd.grad(interpolate(x, frame)[0, 0, 0], frame)[0][0])
    assert float(gradients[0]) == pytest.approx(float(gradients[1]), abs=1e-7)


@pytest.mark.parametrize("delay", [0.0137, -0.023])
def test_gradient_by_the_delay_equals_central_differences(delay):
    # Error of the difference h^2 20^2 / 6 = 7e-9 of the gradient with h = 1e-5 s.
    track = recorded(motion=lambda t: torch.sin(20 * t), batch=(2,))
    weights = rand(2, 12, 3, 3, seed=8, low=-1)

    def f(d):
        return (weights * TimeDelay().observe(track, {"delay": d})).sum()

    d = torch.tensor([[[delay]], [[0.5 * delay]]], dtype=F64, requires_grad=True)
    (g,) = torch.autograd.grad(f(d), d)
    d = d.detach()
    for k in range(2):
        h = torch.zeros_like(d)
        h[k] = 1e-5
        assert float(g[k]) == pytest.approx(float(f(d + h) - f(d - h)) / 2e-5, rel=1e-5)


def test_offset_markers_sit_beside_the_axis_along_the_directors():
    track = recorded(motion=cubic, batch=(2,))
    offset = torch.tensor([[[0.01, -0.02]], [[0.0, 0.005]]], dtype=F64, requires_grad=True)
    seen = MarkerOffset().observe(track, {"offset": offset})
    for k in range(2):
        beside = offset[k, 0, 0] * track.director1[k] + offset[k, 0, 1] * track.director2[k]
        assert torch.allclose((seen - track.pos)[k, :, 1:], beside[:, 1:], rtol=0.0, atol=1e-15)
    assert torch.equal(seen[..., 0, :], track.pos[..., 0, :])
    weights = rand(*seen.shape, seed=9, low=-1)
    (g,) = torch.autograd.grad((weights * seen).sum(), offset)
    wanted = (weights * track.director1)[1, :, 1:].sum()
    assert float(g[1, 0, 0]) == pytest.approx(float(wanted), rel=1e-12)
