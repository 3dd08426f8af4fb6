"""A rope on a table: it rests, it does not creep, it sticks and it slides."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import effects, run, speed, straight, vec

from torchdlo.physics import tree
from torchdlo.scene import Rope, make

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
    # mu cos a).
    # Friction is mu N v_new / |v_old|, so a / v dt too large: 2 % at these speeds.
    mu = 0.5
    for tangent, slides in ((0.25, False), (0.45, False), (0.6, True), (0.9, True)):
        angle = math.atan(tangent)
        dt, count = 1e-3, 600
        scene, params, state = lying(
            angle, mu, drop=-G * math.cos(angle) / 300.0**2, integrator=integrator, dt=dt, toward=toward
        )
        state, seen = run(
            scene,
            params,
            state,
            count,
            seen=lambda s, params=params: (
                float((params.rods.material.mass * s.rods.vel[:, :2]).sum(0) @ vec(*toward)) / 0.1
            ),
        )
        if slides:
            found = (seen[-1] - seen[199]) / (dt * (count - 200))
            assert found == pytest.approx(G * (math.sin(angle) - mu * math.cos(angle)), rel=0.02), tangent
        else:
            q = tangent / mu
            assert seen[-1] == pytest.approx(1e-4 * q / math.sqrt(1 - q * q), rel=0.01), tangent


def test_a_sliding_rope_stops_after_the_coulomb_distance():
    # Slides v0^2 / (2 mu g) and stays: friction lags by a step, v0 dt / 2; 2 %.
    mu, v0 = 0.4, 0.5
    scene, params, state = lying(0.0, mu, drop=-G / 300.0**2, dt=1e-3)
    start = state.rods.pos.clone()
    v = torch.zeros_like(start) + vec(0, v0, 0)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=v))
    state, _ = run(scene, params, state, 300)
    assert speed(state) < 1e-6
    moved = float((state.rods.pos - start)[:, 1].mean())
    assert moved == pytest.approx(v0**2 / (2 * mu * G), rel=0.02)
