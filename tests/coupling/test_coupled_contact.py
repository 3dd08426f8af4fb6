"""Explicit steps that find contact and edge lengths in one solve."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import notices, scene
from torchdlo.coupling import RodBody, RodContact, scene_notices
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64, G = torch.float64, 9.81
ON_Y = (math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0)


def effects(*names: str):
    return [EFFECTS[name]() for name in names]


def capstan(mu: float, load: float, **choices) -> tuple[float, float]:
    """Return the coefficient that tensions on both sides of a post tell over the true one, and how pulls vary [1]."""
    big, r, count, tail, speed, dt = 0.05, 1e-3, 31, 5, 0.02, 1e-3
    a = math.pi / count
    outer = (big + r) / math.cos(a / 2)
    phi = math.pi - a * torch.arange(count + 1, dtype=F64)
    arc = torch.stack([outer * torch.cos(phi), 0 * phi, outer * torch.sin(phi)], -1)
    edge = 2 * outer * math.sin(a / 2)
    down = torch.tensor([0, 0, -edge], dtype=F64) * torch.arange(1, tail + 1, dtype=F64)[:, None]
    x = torch.cat([(arc[0] + down).flip(0), arc, arc[-1] + down])
    post = RigidBody("cylinder", (big, 0.1), motion="fixed", quat=ON_Y, mu_s=mu, mu_k=mu)
    made, params, state = make(
        [Rope(x, radius=r, mass=len(x) * 3e-5, bend=1e-9)],
        [*effects("gravity", "bend", "damping"), RodBody()],
        {"damping": {"rate": 1.0}},
        bodies=[post],
        dt=dt,
        prescribed_vertices=(len(x) - 1,),
        **choices,
    )
    mass = params.rods.material.mass.clone()
    mass[0] = load
    material = tree.replace(params.rods.material, mass=mass)
    params = tree.replace(params, rods=tree.replace(params.rods, material=material))
    control, step, seen = scene.stationary_control(made, state), scene.stepper(made, execution="recorded"), []
    with torch.no_grad():
        for k in range(80):
            way = x.new_tensor([0, 0, -speed * dt * (k + 1)])
            state = step(params, state, tree.replace(control, pos=control.pos + way))
            seen.append(state.rods.tension[[1, -4], 0])
    scene.check_state(state)
    late = torch.stack(seen[40:])
    low, high = late.mean(0).tolist()
    # Friction acts r below the centreline, which the tension follows at R + r.
    return math.log(high / low) / math.pi * (big + r) / big / mu, float((late.std(0) / late.mean(0)).max())


@pytest.mark.parametrize("load", [0.03, 0.1])
def test_friction_round_a_post_is_right_at_default_substeps(load):
    share, varies = capstan(0.3, load, contact="auto")
    assert share == pytest.approx(1.0, rel=0.02)
    assert varies < 0.005


def test_a_weight_that_hangs_over_a_post_stays_within_the_length_of_its_rope_however_heavy():
    # A weight of 80 times the rope: the bound of sweeps, which lets edges give way, is 20 times lower.
    share, _ = capstan(0.3, 0.1, contact="coupled", substeps=2)
    assert share == pytest.approx(1.0, rel=0.02)


def fall(dtype=F64, **choices):
    x = torch.zeros(9, 3, dtype=dtype)
    x[:, 0] = torch.linspace(-0.1, 0.1, 9, dtype=dtype)
    ball = RigidBody("sphere", 0.02, pos=(0.003, 0.004, -0.0235), mass=0.02)
    return make(
        [Rope(x, radius=0.003, mass=0.01, bend=1e-5, stretch=choices.pop("stretch", math.inf))],
        [*effects("bend"), RodBody(), RodContact(), *choices.pop("more", [])],
        bodies=[ball],
        contact="coupled",
        dt=1e-3,
        **choices,
    )


@pytest.mark.parametrize("stretched", [False, True])
def test_a_rope_that_hits_a_free_ball_keeps_momentum(stretched):
    choices = {"stretch": 500.0, "constrained": False, "more": effects("stretch_force")} if stretched else {}
    made, params, state = fall(**choices)
    state = tree.replace(
        state, rods=tree.replace(state.rods, vel=state.rods.vel - state.rods.vel.new_tensor([0, 0, 0.5]))
    )
    control, mass = scene.stationary_control(made, state), params.rods.material.mass

    def momentum(now) -> torch.Tensor:
        ball = 0.02 * now.bodies.vel[0]
        return (mass * now.rods.vel).sum(-2) + ball

    first = momentum(state)
    for _ in range(20):
        state = scene.step(made, params, state, control)
    assert float(state.bodies.vel[0, 2]) < -0.05
    assert float((momentum(state) - first).abs().max()) < 1e-12
    scene.check_state(state)


def test_gradients_are_those_of_the_step():
    made, params, state = fall(substeps=2)
    control = scene.stationary_control(made, state)

    def last(speed: torch.Tensor) -> torch.Tensor:
        now = tree.replace(state, rods=tree.replace(state.rods, vel=state.rods.vel + speed))
        for _ in range(4):
            now = scene.step(made, params, now, control)
        return now.bodies.vel[0, 2] + 3 * now.rods.pos[:, 2].sum()

    speed = torch.tensor([0.03, 0.02, -0.5], dtype=F64, requires_grad=True)
    (gradient,) = torch.autograd.grad(last(speed), speed)
    for k in range(3):
        way = torch.zeros(3, dtype=F64)
        way[k] = 1e-6
        with torch.no_grad():
            difference = (last(speed + way) - last(speed - way)) / 2e-6
        assert float(gradient[k]) == pytest.approx(float(difference), rel=1e-5, abs=1e-7)


def test_sweeps_under_a_rope_that_carries_something_are_mentioned(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(notices, "once", lambda key, text: said.append(key))
    made, _, _ = fall()
    scene_notices.mention_sweeps(made.settings, bodies=True)
    assert "sweeps" not in said
    sweeps = scene.Scene(made.topology, made.effects, bodies=made.bodies)
    scene_notices.mention_sweeps(sweeps.settings, bodies=True)
    assert "sweeps" in said


def falling(restitution: float = 0.8, **choices):
    x = torch.zeros(6, 3, dtype=F64)
    x[:, 0], x[:, 2] = torch.linspace(0, 0.1, 6, dtype=F64), 0.015
    plane = RigidBody("plane", motion="fixed", restitution=restitution, mu_s=0.0, mu_k=0.0)
    rope = Rope(x, radius=0.005, mass=0.02)
    made, params, state = make([rope], [*effects("gravity"), RodBody()], bodies=[plane], dt=1e-3, **choices)
    control, highest = scene.stationary_control(made, state), 0.0
    with torch.no_grad():
        for k in range(90):
            state = scene.step(made, params, state, control)
            highest = max(highest, float(state.rods.pos[:, 2].mean()) - 0.005) if k > 50 else 0.0
    return made, highest


def test_what_rebounds_is_found_by_sweeps_where_nothing_else_is_asked_for(caplog, monkeypatch):
    monkeypatch.setattr(notices, "_said", set())
    made, highest = falling(contact="auto")
    assert made.contact == "sweeps" and not caplog.text
    assert highest == pytest.approx(0.8**2 * 0.01, rel=0.02)
    assert falling(0.0, contact="auto")[0].contact == "coupled" and not caplog.text


def test_rebounds_that_short_steps_lose_are_mentioned(caplog, monkeypatch):
    monkeypatch.setattr(notices, "_said", set())
    _, highest = falling(contact="coupled")
    assert highest < 0.5 * 0.8**2 * 0.01 and caplog.text.count("rebound with less than their restitution") == 1
    _, highest = falling(integrator="implicit", substeps=1)
    assert highest == pytest.approx(0.8**2 * 0.01, rel=0.1) and caplog.text.count("restitution") == 1


def test_unknown_ways_of_contact_are_refused():
    with pytest.raises(ValueError, match="contact is 'gauss'"):
        make([Rope(torch.eye(3, dtype=F64), mass=0.01)], effects("gravity"), contact="gauss")
