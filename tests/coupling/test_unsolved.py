"""Implicit steps with contact that Newton's method does not solve end where least is left of the equations."""

from __future__ import annotations

import pytest
import torch

from torchdlo.coupling import RodBody
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.integrators import contact_kernel, contact_step
from torchdlo.scene import Rope, make, stationary_control, step

F64 = torch.float64


def test_unsolved_steps_end_where_least_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.zeros(9, 3, dtype=F64)
    x[:, 0], x[:, 2] = torch.linspace(-0.1, 0.1, 9, dtype=F64), 0.0335
    rope = Rope(
        x, radius=0.003, mass=0.02, bend=1e-5, velocities=torch.tensor([[0.0, 0.0, -3.0]], dtype=F64).expand(9, 3)
    )
    ball = RigidBody("sphere", (0.03,), motion="fixed", mu_s=0.5, mu_k=0.4)
    scene, params, state = make(
        [rope], [Gravity(), Bend(), RodBody()], bodies=[ball], integrator="implicit", dt=5e-3, substeps=1
    )
    seen: list[float] = []
    newton = contact_step.Touching.newton_step

    def watched(self, *given):
        found, left = newton(self, *given)
        seen.append(float(left))
        return found, left

    monkeypatch.setattr(contact_kernel, "available", lambda like: False)
    monkeypatch.setattr(contact_step.Touching, "newton_step", watched)
    monkeypatch.setattr(contact_step, "_solved", lambda like: 0.0)
    monkeypatch.setattr(contact_step, "TRIES", ((100.0, 7), (10.0, 7)))
    with torch.no_grad():
        step(scene, params, state, stationary_control(scene, state))
    tried, last = seen[:14], seen[-1]
    assert len(seen) == 16 and max(tried) > 1e-3  # contact took some steps to find
    assert last == pytest.approx(min(tried[3:7] + tried[10:]), rel=1e-6, abs=1e-12)
