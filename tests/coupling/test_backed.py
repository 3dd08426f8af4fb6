"""Ropes feel what stands behind a free body in implicit steps: the ground under it, also if the ropes are heavier."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import BodyContact, RodBody
from torchdlo.coupling.bodies import contact_op
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, RopeJoint, check_gradients, make

F64 = torch.float64
G = 9.81
HALF = 0.02
"""Half the height of the box [m]."""


def on_a_box(dt: float, slope: float, *, n: int = 9, drop: float = 0.0, damping: float = 0.5):
    """A rope of 0.5 kg that lies on a box of 50 g on the ground; gravity as on a slope, given by its angle."""
    radius = 0.003
    s = torch.linspace(-0.04, 0.04, n, dtype=F64)
    x = torch.stack([s, 0 * s, torch.full_like(s, 2 * HALF + radius + drop)], -1)
    rub = {"mu_s": 0.5, "mu_k": 0.4}
    solids = [
        RigidBody("plane", motion="fixed", **rub),
        RigidBody("box", (0.05, 0.03, HALF), pos=(0.0, 0.0, HALF), mass=0.05, **rub),
    ]
    return make(
        [Rope(x, mass=0.5, radius=radius, bend=1e-4, rest="straight")],
        [EFFECTS[name]() for name in ("bend", "gravity", "damping")] + [RodBody(), BodyContact()],
        {
            "damping": {"rate": damping},
            "gravity": {"acceleration": (G * math.sin(slope), 0.0, -G * math.cos(slope))},
        },
        bodies=solids,
        integrator="implicit",
        dt=dt,
        substeps=1,
        check=False,
    )


@pytest.mark.parametrize("slope", [0.0, 0.2])
@pytest.mark.parametrize("dt", [1e-3, 2e-3, 5e-3])
def test_a_heavy_rope_does_not_press_a_light_box_into_the_ground(dt: float, slope: float) -> None:
    # The friction that is needed, tan 0.2 = 0.2, is less than there is: the box stays where it is.
    made, params, state = on_a_box(dt, slope)
    control, step, lowest = scene.stationary_control(made, state), scene.stepper(made, execution="eager"), HALF
    half = round(0.1 / dt)
    with torch.no_grad():
        for k in range(2 * half):
            if k == half:
                before = state.bodies.pos[..., 1, 0].clone()
            state = step(params, state, control)
            lowest = min(lowest, float(state.bodies.pos[..., 1, 2]))
    assert HALF - lowest < 1e-6
    assert abs(float(state.bodies.pos[..., 1, 0] - before)) / 0.1 < 1e-5  # m/s
    assert abs(float(state.bodies.pos[..., 1, 2]) - HALF) < 1e-6
    assert float(state.rods.vel.norm(dim=-1).max()) < 1e-3


def test_a_box_that_stands_on_the_ground_is_lifted_by_its_rope_without_a_jerk() -> None:
    dt, up, light = 2e-3, 0.1, 0.05
    s = torch.linspace(0, 0.2, 9, dtype=F64)
    x = torch.stack([0 * s, 0 * s, 0.24 - s], -1)
    solids = [RigidBody("plane", motion="fixed"), RigidBody("box", (0.02, 0.02, HALF), pos=(0, 0, HALF), mass=light)]
    made, params, state = make(
        [Rope(x, mass=0.01, radius=0.002, bend=1e-5)],
        [EFFECTS[name]() for name in ("bend", "gravity", "damping")] + [RodBody(), BodyContact()],
        {"damping": {"rate": 0.5}},
        bodies=solids,
        joints=[RopeJoint(body=1, kind="ball", anchor=(0.0, 0.0, HALF))],
        prescribed_vertices=[0],
        integrator="implicit",
        dt=dt,
        substeps=1,
        check=False,
    )
    control, step, fastest = scene.stationary_control(made, state), scene.stepper(made, execution="eager"), 0.0
    with torch.no_grad():
        for k in range(150):
            way = up * dt * max(0, k - 10)
            pos = control.pos + control.pos.new_tensor([0.0, 0.0, way])
            state = step(params, state, tree.replace(control, pos=pos))
            fastest = max(fastest, float(state.bodies.vel[..., 1, :].norm()))
    assert float(state.bodies.pos[..., 1, 2]) == pytest.approx(HALF + up * dt * 139, abs=2e-4)
    assert fastest < 2.2 * up  # a jerk of an inextensible rope at rest can double it
    force = scene.joint_forces(made, state)[0]
    assert float(force[..., 2].abs().max()) == pytest.approx(light * G, rel=0.05)


@pytest.mark.parametrize("kernel", [True, False])
def test_gradients_through_what_stands_behind_a_body_are_those_of_differences(kernel: bool, monkeypatch) -> None:
    if kernel and not contact_op.ready("cpu", F64):
        pytest.skip("there is no C++ compiler")
    if not kernel:
        monkeypatch.setattr(contact_op, "ready", lambda *_: False)
    made, params, state = on_a_box(2e-3, 0.2, n=5, drop=-1e-4)

    def place(mass: torch.Tensor) -> torch.Tensor:
        material = tree.replace(params.rods.material, mass=mass)
        given = tree.replace(params, rods=tree.replace(params.rods, material=material))
        now, control = state, scene.stationary_control(made, state)
        for _ in range(6):
            now = scene.step(made, given, now, control)
        return (now.rods.pos[..., 2, :].sum() + now.bodies.pos[..., 1, :].sum()).sum()

    found = check_gradients(place, params.rods.material.mass, directions=2, span=1e-5)
    assert found.error < 1e-4, str(found)
