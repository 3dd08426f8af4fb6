"""Loads on ropes that touch stay where they belong in implicit steps: contact is solved with the lengths."""

from __future__ import annotations

import math

import pytest
import torch
from loaded_ropes import F64, G, on_two_ropes, over_a_peg

from torchdlo import scene
from torchdlo.coupling import RodBody
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, check_gradients, make


@pytest.mark.parametrize(("load", "dt"), [(0.2, 2e-3), (2.0, 5e-3)])
def test_equal_weights_over_a_smooth_peg_stay_at_rest(load, dt):
    # They rose by half a metre in 0.5 s.
    made, params, state = over_a_peg(load, dt)
    control, start = scene.stationary_control(made, state), state.rods.pos
    with torch.no_grad():
        for _ in range(round(0.2 / dt)):
            state = scene.step(made, params, state, control)
    assert float((state.rods.pos - start)[[0, -1], 2].abs().max()) < 5e-4
    scene.check_state(state)


@pytest.mark.parametrize(("load", "dt"), [(0.3, 2e-3), (3.0, 5e-3)])
def test_a_box_comes_to_rest_on_two_slack_ropes(load, dt):
    # It left at 10.8 m/s.
    made, params, state = on_two_ropes(load, dt)
    control, heights, pulls, fastest = scene.stationary_control(made, state), [], [], 0.0
    with torch.no_grad():
        for _ in range(round(0.4 / dt)):
            state = scene.step(made, params, state, control)
            heights.append(float(state.bodies.pos[0, 2]))
            pulls.append(float(state.reaction.force[:, 2].sum()))
            fastest = max(fastest, float(state.bodies.vel.norm()))
    assert max(heights) <= -0.0475 and fastest < 0.5
    late = pulls[len(pulls) // 2 :]
    assert sum(late) / len(late) == pytest.approx(G * (load + 0.02), rel=0.03)
    scene.check_state(state)


def test_sliding_over_a_peg_follows_the_capstan_law_of_thick_ropes():
    # T2 / T1 = exp(mu pi R / (R + r)) for friction at the surface: below it stays, above it slides.
    mu, stationary_control = 0.3, 0.2
    ratio = math.exp(mu * math.pi * 0.03 / 0.033)
    drifts = []
    for share in (0.8, 1.3):
        heavier = stationary_control * (ratio**share - 1)
        made, params, state = over_a_peg(stationary_control, 2e-3, mu=mu, heavier=heavier)
        control, start = scene.stationary_control(made, state), state.rods.pos
        with torch.no_grad():
            for _ in range(100):
                state = scene.step(made, params, state, control)
        drifts.append(float(start[-1, 2] - state.rods.pos[-1, 2]))
    # Sliding: (m2 - m1 ratio) / (m2 + m1 ratio) g, half a t^2.
    heavy = stationary_control * ratio**1.3
    wanted = 0.5 * G * (heavy - stationary_control * ratio) / (heavy + stationary_control * ratio) * 0.2**2
    assert abs(drifts[0]) < 2e-3 and drifts[1] == pytest.approx(wanted, rel=0.2)


@pytest.mark.parametrize("mu", [0.0, 0.3])
def test_gradients_of_contact_in_implicit_steps_are_those_of_differences(mu):
    made, params, state = over_a_peg(0.2, 2e-3, n=25, mu=mu, heavier=0.3)

    def fall(mass: torch.Tensor) -> torch.Tensor:
        material = tree.replace(params.rods.material, mass=mass)
        given = tree.replace(params, rods=tree.replace(params.rods, material=material))
        now, control = state, scene.stationary_control(made, state)
        for _ in range(12):
            now = scene.step(made, given, now, control)
        return now.rods.pos[..., -1, 2].sum()

    found = check_gradients(fall, params.rods.material.mass, directions=2, span=1e-7)
    assert found.error < 1e-4, str(found)


def test_gradients_through_free_bodies_are_those_of_differences():
    made, params, state = on_two_ropes(0.3, 2e-3)

    def height(pos: torch.Tensor) -> torch.Tensor:
        now = tree.replace(state, bodies=tree.replace(state.bodies, pos=pos))
        control = scene.stationary_control(made, state)
        for _ in range(8):
            now = scene.step(made, params, now, control)
        return now.bodies.pos[0, 2] + now.rods.pos[20, 2]

    lower = state.bodies.pos - torch.tensor([0.0, 0.0, 0.002], dtype=F64)
    found = check_gradients(height, lower, directions=2, span=1e-6)
    assert found.error < 1e-3, str(found)


def test_a_batch_moves_as_its_scenes_do_alone_and_single_precision_agrees():
    made, params, state = over_a_peg(0.2, 2e-3, n=25, batch=(3,))
    pos = state.rods.pos + 1e-3 * torch.arange(3, dtype=F64)[:, None, None] * torch.tensor([1.0, 0, 0], dtype=F64)
    state = tree.replace(state, rods=tree.replace(state.rods, pos=pos))
    alone = []
    with torch.no_grad():
        for k in range(3):
            one = over_a_peg(0.2, 2e-3, n=25)
            now = tree.replace(one[2], rods=tree.replace(one[2].rods, pos=pos[k]))
            for _ in range(10):
                now = scene.step(one[0], one[1], now, scene.stationary_control(one[0], now))
            alone.append(now.rods.pos)
        for _ in range(10):
            state = scene.step(made, params, state, scene.stationary_control(made, state))
        single, numbers, now = over_a_peg(0.2, 2e-3, n=25, dtype=torch.float32)
        for _ in range(10):
            now = scene.step(single, numbers, now, scene.stationary_control(single, now))
    assert float((torch.stack(alone) - state.rods.pos).abs().max()) < 1e-9
    assert float((now.rods.pos - alone[0]).abs().max()) < 1e-4


def test_momentum_of_ropes_and_free_bodies_is_kept():
    s = torch.linspace(-0.2, 0.2, 21, dtype=F64)
    x = torch.stack([s, 0 * s, 0 * s + 0.0235], -1)
    rope = Rope(
        x, mass=0.02, radius=0.003, bend=1e-4, velocities=torch.tensor([0.3, 0.2, -1.0], dtype=F64).expand(21, 3)
    )
    ball = RigidBody("sphere", (0.02,), mass=0.05, mu_s=0.4, mu_k=0.4)
    made, params, state = make(
        [rope], [EFFECTS["bend"](), RodBody()], bodies=[ball], integrator="implicit", dt=2e-3, substeps=1
    )

    def momentum(now) -> torch.Tensor:
        ropes = (params.rods.material.mass * now.rods.vel).sum(-2)
        return ropes + (params.bodies.mass * now.bodies.vel).sum(-2)

    before, control = momentum(state), scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(30):
            state = scene.step(made, params, state, control)
    assert float(state.bodies.vel.norm()) > 0.1
    assert float((momentum(state) - before).abs().max()) < 1e-12
