"""Ropes that start inside of something are pushed out, not thrown."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64 = torch.float64


def highest(bodies, choices, seconds: float, depth: float) -> tuple[float, float]:
    """Greatest height of a rope of radius 3 mm that starts with its axis `depth` below z = 0, and its last one [m]."""
    x = torch.zeros(21, 3, dtype=F64)
    x[:, 0] = torch.linspace(-0.1, 0.1, 21, dtype=F64)
    x[:, 2] = -depth
    effects = [EFFECTS["bend"](), EFFECTS["gravity"](), RodBody()]
    made, params, state = make([Rope(x, radius=0.003, mass=0.01, bend=1e-4)], effects, bodies=bodies, **choices)
    step, control, most = scene.stepper(made, compiled=False, recorded=True), scene.stationary_control(made, state), 0.0
    with torch.no_grad():
        for _ in range(round(seconds / made.dt)):
            state = step(params, state, control)
            most = max(most, float(state.rods.pos[:, 2].max()))
    assert bool(scene.ok(state))
    return most, float(state.rods.pos[:, 2].mean())


@pytest.mark.parametrize(
    "choices", [{}, {"integrator": "implicit", "dt": 2e-3, "substeps": 1}], ids=["explicit", "implicit"]
)
def test_a_rope_inside_a_plane_is_pushed_out_without_being_thrown(choices):
    # Parting at 0.1 m/s it rises by 0.1^2 / 2 g = 0.5 mm above its radius at most; it was thrown 6.6 m up.
    most, last = highest([RigidBody("plane", motion="fixed")], choices, 0.3, 0.004)
    assert most < 0.003 + 0.0016 and last == pytest.approx(0.003, abs=2e-4)


def test_a_rope_inside_a_box_is_pushed_out_without_being_thrown():
    box = RigidBody("box", (0.15, 0.15, 0.05), pos=(0.0, 0.0, -0.05), motion="fixed")
    most, last = highest([box], {}, 0.4, 0.008)
    assert most < 0.003 + 0.0016 and last == pytest.approx(0.003, abs=2e-4)


def test_ropes_inside_each_other_part_slowly():
    def line(z: float, axis: int) -> torch.Tensor:
        x = torch.zeros(15, 3, dtype=F64)
        x[:, axis] = torch.linspace(-0.07, 0.07, 15, dtype=F64)
        x[:, 2] = z
        return x

    ropes = [Rope(line(0.001 * k, k), radius=0.003, mass=0.005, bend=1e-4) for k in (0, 1)]
    made, params, state = make(ropes, [EFFECTS["bend"](), RodContact()])
    step, control, fastest = (
        scene.stepper(made, compiled=False, recorded=True),
        scene.stationary_control(made, state),
        0.0,
    )
    with torch.no_grad():
        for _ in range(100):
            state = step(params, state, control)
            fastest = max(fastest, float(state.rods.vel.norm(dim=-1).max()))
    middle = state.rods.pos[[7, 22], 2]
    assert fastest < 0.3 and float(middle[1] - middle[0]) > 0.006
