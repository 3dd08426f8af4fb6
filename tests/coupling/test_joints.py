"""Joints of ropes with free bodies and with each other."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.physics import tree
from torchdlo.physics.effects import BendFrame, BendIsotropic, Gravity, Twist
from torchdlo.physics.linalg.free_rotation import spin_freely, spin_gradient
from torchdlo.physics.linalg.rotation import multiply, rotate
from torchdlo.scene import Joint, RigidBody, Rope

pytestmark = pytest.mark.quick
G = 9.81
STEPS = {"explicit": {"dt": 1e-3, "substeps": 5}, "implicit": {"dt": 2e-3, "substeps": 1}}


def line(n: int, length: float, start=(0.0, 0.0, 0.0), way=(0.0, 0.0, -1.0)) -> Tensor:
    along = torch.linspace(0, length, n, dtype=torch.float64)[:, None]
    return torch.tensor(start, dtype=torch.float64) + along * torch.tensor(way, dtype=torch.float64)


def hung(integrator: str, kind: str = "weld", n: int = 9, mass: float = 0.05, bend: float = 1e-4, tilt=0.0, **other):
    """A cable of 10 g and 0.4 m, held at its top, with a plug at its end; hangs at an angle."""
    way = (math.sin(tilt), 0.0, -math.cos(tilt))
    rope = Rope(line(n, 0.4, way=way), radius=0.004, mass=0.01, bend=bend)
    centre = [0.42 * x for x in way]
    quat = (math.cos(-tilt / 2), 0.0, math.sin(-tilt / 2), 0.0)
    plug = RigidBody("box", (0.01, 0.015, 0.02), pos=centre, quat=quat, mass=mass, name="plug")
    choices = STEPS[integrator] | {"integrator": integrator, "prescribed_vertices": [0]} | other
    effects = [Gravity(), BendIsotropic()]
    return scenes.make([rope], effects, bodies=[plug], joints=[Joint(body="plug", kind=kind)], **choices)


def ran(made, steps: int, step=scenes.step):
    scene, params, state = made
    control = scenes.stationary_control(scene, state)
    with torch.no_grad():
        for _ in range(steps):
            state = step(scene, params, state, control)
    return state


def test_the_end_of_a_rotation_turns_with_its_start_as_by_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    quat, omega = (torch.randn(2, n, generator=generator, dtype=torch.float64) for n in (4, 3))
    quat, omega, inertia = quat / quat.norm(dim=-1, keepdim=True), 5 * omega, torch.tensor([1.0, 2.0, 2.5]).double()
    end = spin_freely(quat, inertia, omega, 0.05)[0]
    found = spin_gradient(quat, inertia, omega, 0.05, end)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        one, two = (spin_freely(quat, inertia, omega + sign * step, 0.05)[0] for sign in (1, -1))
        turn = 2 * multiply(one - two, conjugate(end))[..., 1:] / 2e-6
        torch.testing.assert_close(found[..., axis], turn, atol=1e-8, rtol=1e-8)
