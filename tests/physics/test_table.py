"""A rope on a table: it rests, it does not creep, it sticks and it slides."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import effects, run, speed, straight, vec

from torchdlo.physics import tree
from torchdlo.scene import Rope, make

pytestmark = pytest.mark.quick

G, R = 9.81, 0.01


def lying(angle: float = 0.0, mu: float | None = None, height: float = 0.0, drop: float = 0.0, **choices):
    """Rope along x on a table with gravity tilted by an angle towards y or x."""
    choices = {"integrator": "implicit", "dt": 2e-3, "substeps": 1} | choices
    toward = choices.pop("toward", (0.0, 1.0))
    x = straight(8, 0.5) + vec(0, 0, height + R + drop)
    names = ["bend", "gravity", "table"] + (["table_friction"] if mu is not None else [])
    g = (G * math.sin(angle) * toward[0], G * math.sin(angle) * toward[1], -G * math.cos(angle))
    surface = {"height": height, "hardness": 300.0}
    values = {"gravity": {"acceleration": g}, "table": surface}
    if mu is not None:
        values["table_friction"] = {"mu": mu, "slip": 1e-4} | surface
    return make([Rope(x, radius=R, mass=0.1, bend=1e-4)], effects(*names), values, **choices)


@pytest.mark.parametrize("choices", [{}, {"integrator": "explicit", "substeps": 1}], ids=["implicit", "explicit"])
@pytest.mark.parametrize("drop", [0.0, 0.02])
def test_a_rope_comes_to_rest_on_the_table_at_the_height_of_its_radius(choices, drop):
    # C1: rests g / hardness^2 below first touch (each vertex: k = m hardness^2), 1.1 % of the radius here; then no
    # motion at all.
    scene, params, state = lying(height=0.3, drop=drop, **choices)
    state, _ = run(scene, params, state, 600)
    assert speed(state) < 1e-8, speed(state)
    assert float((state.rods.pos[:, 2] - (0.3 + R - G / 300.0**2)).abs().max()) < 1e-9
    moved = state.rods.pos
    state, _ = run(scene, params, state, 300)
    assert float((state.rods.pos - moved).abs().max()) < 1e-9


@pytest.mark.parametrize("toward", [(0.0, 1.0), (1.0, 0.0)], ids=["across", "along"])
@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_a_rope_on_an_incline_sticks_below_and_slides_above_the_friction_angle(integrator, toward):
    # C3: tan a < mu: only the declared creep, v = slip q / sqrt(1 - q^2) with q = tan a / mu; above: a = g (sin a -
    # mu cos a). Four gradients in a batch.
    # Friction is mu N v_new / |v_old|, so too large by a dt / v, first order: the mean of dt / t over the times that
    # count, 0.2 s to 0.6 s, is dt ln 3 / 0.4 s = 2.7 dt / s, times mu g cos a / a_slide: 0.7 % at tan a = 0.6: 1 %.
    mu, dt, count, tangents = 0.5, 5e-4, 1200, (0.25, 0.45, 0.6, 0.9)
    angles = torch.tensor([math.atan(t) for t in tangents], dtype=torch.float64)
    down = G * torch.stack([toward[0] * angles.sin(), toward[1] * angles.sin(), -angles.cos()], -1)[:, None]
    scene, params, state = lying(0.0, mu, integrator=integrator, dt=dt)
    params.effects["gravity"]["acceleration"] = down
    sunk = down / 300.0**2 * vec(0, 0, 1)
    pos = state.rods.pos + sunk
    rods = tree.map(lambda x: x.expand(4, *x.shape), state.rods)
    state = tree.replace(state, rods=tree.replace(rods, pos=pos), time=state.time.expand(4, 1, 1))
    mass = params.rods.material.mass
    _, seen = run(
        scene, params, state, count, seen=lambda s: (mass * s.rods.vel[..., :2]).sum(-2) @ vec(*toward) / mass.sum()
    )
    creep, slide = seen[-1][:2], ((seen[-1] - seen[399]) / (dt * (count - 400)))[2:]
    q = angles[:2].tan() / mu
    assert (creep / (1e-4 * q / (1 - q * q).sqrt())).tolist() == pytest.approx([1, 1], rel=0.01)
    assert (slide / (G * (angles.sin() - mu * angles.cos()))[2:]).tolist() == pytest.approx([1, 1], rel=0.01)


def test_a_sliding_rope_stops_after_the_coulomb_distance():
    # Slides v0^2 / (2 mu g) and stays. Friction that answers to the last speed lags by a step, which adds v0 dt; first
    # order, 2 mu g dt / v0 of the way: 0.4 % at this step, half of it allowed on top.
    mu, v0 = 0.4, 0.5
    dt = 2.5e-4
    scene, params, state = lying(0.0, mu, drop=-G / 300.0**2, dt=dt)
    start = state.rods.pos.clone()
    v = torch.zeros_like(start) + vec(0, v0, 0)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=v))
    state, _ = run(scene, params, state, round(0.3 / dt))
    assert speed(state) < 1e-6
    moved = float((state.rods.pos - start)[:, 1].mean())
    assert moved == pytest.approx(v0**2 / (2 * mu * G), rel=1.5 * 2 * mu * G * dt / v0)
