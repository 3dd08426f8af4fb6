"""Scenes at another scale: lengths times s, times and speeds times its root."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.coupling.rod_body import body_touch_op
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64 = torch.float64


def loop_on_rope(scale: float, steps: int, implicit: bool = False):
    """A rope of radius 5 mm and edges of 2 cm that falls on one held at its ends, times a scale."""
    s = torch.linspace(-0.2, 0.2, 21, dtype=F64)
    one = torch.stack([s, 0 * s, 0 * s], -1)
    other = torch.stack([0 * s + 0.003, s, 0 * s + 0.0102], -1)
    speed = torch.tensor([0.1, 0.0, -0.5], dtype=F64).expand(21, 3)
    # Weights go with s^3, bending moments with weight times length.
    numbers = {"radius": 0.005 * scale, "mass": 0.01 * scale**3, "bend": 1e-3 * scale**5}
    ropes = [Rope(one * scale, **numbers), Rope(other * scale, velocities=speed * scale**0.5, **numbers)]
    effects = [EFFECTS["bend"](), EFFECTS["gravity"](), RodContact(room=200)]
    dt = 1e-3 * scale**0.5
    choices = {"integrator": "implicit", "substeps": 1} if implicit else {"substeps": 10}
    made, params, state = make(ropes, effects, dt=dt, prescribed_vertices=(0, 20), **choices)
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(steps):
            state = scene.step(made, params, state, control)
    scene.check_state(state)
    return state.rods.pos / scale


@pytest.mark.parametrize("implicit", [False, True], ids=["explicit", "implicit"])
def test_the_same_scene_at_a_thousandth_of_the_scale_moves_the_same(implicit):
    big, small = (loop_on_rope(scale, 15, implicit) for scale in (1.0, 1e-3))
    assert float((big - small).abs().max()) < 1e-8
    assert float(big[31, 2]) < 0.0102  # it fell on the other


def test_a_suture_has_room_for_its_pairs_of_edges():
    # Radius 0.15 mm and edges of 1 mm: a step looked for pairs within 2 mm, found 2563, and had no room for them.
    s = torch.linspace(0, 1, 101, dtype=F64)
    turn = 10 * torch.pi * s
    x = torch.stack([0.003 * turn.cos(), 0.003 * turn.sin(), 0.006 * s], -1)
    rope = Rope(x, radius=0.15e-3, density=1100.0, bend=1e-9, rest="as_placed")
    effects = [EFFECTS["bend_frame"](), EFFECTS["gravity"](), RodContact()]
    made, params, state = make([rope], effects, dt=1e-3, substeps=20, prescribed_vertices=(0,))
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(10):
            state = scene.step(made, params, state, control)
    scene.check_state(state)


def slid(scale: float, kernel: bool, monkeypatch) -> tuple[float, float]:
    """Places down a slope, over the scale, of a rope that begins at rest, and its speed over the scale's root."""
    slope = 0.6
    down = torch.tensor([math.cos(slope), 0.0, -math.sin(slope)], dtype=F64)
    up = torch.tensor([math.sin(slope), 0.0, math.cos(slope)], dtype=F64)
    x = torch.linspace(-0.05, 0.05, 6, dtype=F64)[:, None] * (0.8 * down + 0.6 * down.new_tensor([0, 1.0, 0]))
    rope = Rope(scale * (x + 0.005 * up), radius=0.005 * scale, mass=0.01 * scale**3, bend=1e-3 * scale**5)
    turned = (math.cos(slope / 2), 0.0, math.sin(slope / 2), 0.0)
    plane = RigidBody("plane", quat=turned, motion="fixed", mu_s=0.5, mu_k=0.2)
    made, params, state = make(
        [rope],
        [EFFECTS["bend"](), EFFECTS["gravity"](), RodBody()],
        bodies=[plane],
        integrator="implicit",
        dt=2e-3 * scale**0.5,
        substeps=1,
    )
    control = scene.stationary_control(made, state)
    if not kernel:
        monkeypatch.setattr(body_touch_op, "ready", lambda *_: False)
    with torch.no_grad():
        for _ in range(40):
            state = scene.step(made, params, state, control)
    return float(state.rods.pos.mean(-2) @ down) / scale, float(state.rods.vel.mean(-2) @ down) / scale**0.5


@pytest.mark.parametrize("kernel", [True, False], ids=["kernel", "tensors"])
def test_ropes_begin_to_slide_alike_at_any_scale(kernel, monkeypatch):
    # Where friction turns from static to sliding goes with the speed of what falls by its own size.
    (place, speed), small = (slid(scale, kernel, monkeypatch) for scale in (1.0, 1e-3))
    assert speed > 0.1 and small == (pytest.approx(place, rel=1e-6), pytest.approx(speed, rel=1e-6))
