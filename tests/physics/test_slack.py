"""Implicit steps keep the energy and the length of slack ropes."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import F64, effects

from torchdlo import scene
from torchdlo.scene import Rope, make


def vee(n: int, dt: float, damping: float = 0.5, **choices):
    """A rope of 10 m, let go from a V of straight pieces between holds 8 m apart."""
    s = torch.linspace(0, 1, n, dtype=F64)
    x = torch.stack([8 * s, 0 * s, -3 * (1 - (2 * s - 1).abs())], -1)
    ends = (0, n - 1)
    return make(
        [Rope(x, mass=0.5, bend=1e-3)],
        effects("bend", "gravity", "damping"),
        {"damping": {"rate": damping}},
        integrator="implicit",
        dt=dt,
        substeps=1,
        prescribed_vertices=ends,
        **choices,
    )


@pytest.mark.parametrize(("n", "dt"), [(401, 5e-3), (1001, 2e-3)])
def test_a_slack_rope_of_straight_pieces_keeps_its_length(n, dt):
    # With gamma 0.3 it reached 700 and 4700 m within a second.
    made, params, state = vee(n, dt)
    step, control, worst = (
        scene.stepper(made, execution="recorded"),
        scene.stationary_control(made, state),
        0.0,
    )
    with torch.no_grad():
        for _ in range(round(0.4 / dt)):
            state = step(params, state, control)
            length = (state.rods.pos[1:] - state.rods.pos[:-1]).norm(dim=-1)
            worst = max(worst, float((length / params.rods.rest.length[:-1, 0] - 1).abs().max()))
    assert worst < 1e-9
    scene.check_state(state)


@pytest.mark.slow
def test_it_comes_to_rest_as_a_catenary():
    # 2 a sinh(d / 2a) = L; sag = a (cosh(d / 2a) - 1).
    made, params, state = vee(401, 5e-3, damping=2.0)
    step, control = scene.stepper(made, execution="recorded"), scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(1600):
            state = step(params, state, control)
    low, high = 1.0, 20.0
    for _ in range(100):
        a = 0.5 * (low + high)
        low, high = (a, high) if 2 * a * math.sinh(4 / a) > 10 else (low, a)
    assert float(-state.rods.pos[:, 2].min()) == pytest.approx(a * (math.cosh(4 / a) - 1), rel=2e-3)
