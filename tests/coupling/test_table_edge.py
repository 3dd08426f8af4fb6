"""A chain slides off a table without friction: right where its edges are short beside the radius in which it turns."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import RodBody
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64, G, LENGTH, OVER = torch.float64, 9.81, 1.0, 0.2
ON_Y = (math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0)


def slid(vertices: int, radius: float, rounding: float, **choices) -> tuple[float, float]:
    """Return how far the low and the high end have gone over what they have to, when this is 0.25 m.

    The centreline turns by a right angle on a quarter of a circle of radius a = radius + rounding. Its middle starts
    20 cm from the low end, which then pulls as a length x0 = 20 cm + (1 - pi/4) a does: x0 (cosh(t sqrt(g / L)) - 1).
    """
    a = radius + rounding
    s = torch.linspace(0, LENGTH, vertices, dtype=F64) - (LENGTH - OVER) + a * math.pi / 4
    turn = (s / a).clamp(0, math.pi / 2)
    down = (s - a * math.pi / 2).clamp(min=0)
    x = torch.stack([a * turn.sin() + s.clamp(max=0), 0 * s, a * turn.cos() - down], -1)
    smooth = {"motion": "fixed", "mu_s": 0.0, "mu_k": 0.0}
    if rounding:  # the table in two parts, and a cylinder along its edge
        bodies = [
            RigidBody("box", (1, 0.5, 0.5), pos=(-1, 0, rounding - 0.5), **smooth),
            RigidBody("box", (1, 0.5, 0.5), pos=(rounding - 1, 0, -0.5), **smooth),
            RigidBody("cylinder", (rounding, 0.5), quat=ON_Y, **smooth),
        ]
    else:
        bodies = [RigidBody("box", (1, 0.5, 0.5), pos=(-1, 0, -0.5), **smooth)]
    made, params, state = make(
        [Rope(x, radius=radius, mass=0.05, bend=1e-9)],
        [EFFECTS["gravity"](), EFFECTS["bend"](), RodBody(friction=False)],
        bodies=bodies,
        **choices,
    )
    step, control, start = scene.stepper(made, execution="recorded"), scene.stationary_control(made, state), state
    rate = math.sqrt(G / LENGTH)
    count = round(math.acosh(0.45 / OVER) / rate / made.dt)
    with torch.no_grad():
        for _ in range(count):
            state = step(params, state, control)
    scene.check_state(state)
    wanted = (OVER + (1 - math.pi / 4) * a) * (math.cosh(rate * count * made.dt) - 1)
    gone = state.rods.pos - start.rods.pos
    return float(-gone[-1, 2]) / wanted, float(gone[0, 0]) / wanted


IMPLICIT = {"integrator": "implicit", "substeps": 1}


@pytest.mark.parametrize(
    "vertices, choices",
    [
        (51, IMPLICIT),
        (51, IMPLICIT | {"dt": 5e-3}),
        (101, IMPLICIT | {"dt": 2e-3}),
        (51, {"contact": "coupled"}),
        pytest.param(51, {}, marks=pytest.mark.slow),
    ],
)
def test_a_chain_slides_off_a_rounded_edge_as_it_has_to(vertices, choices):
    # Edges are a third of the radius of the turn or less.
    ends = slid(vertices, 0.005, 0.055, **choices)
    assert ends == pytest.approx((1.0, 1.0), abs=0.015 if choices.get("dt", 0) > 2e-3 else 0.01)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_how_far_edges_of_a_table_brake_depends_on_edge_over_radius_alone(scale):
    # Edges as long as the radius, and four times as long: the latter are turned by a right angle one by one.
    vertices = 1 + round(50 / scale)
    _, long = slid(vertices, 0.005 * scale, 0.0, **IMPLICIT)
    _, even = slid(vertices, 0.02 * scale, 0.0, **IMPLICIT)
    assert 0.5 < long < 0.8 < 0.96 < even < 1.0
