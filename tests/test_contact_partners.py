"""Forces of contact by who exerts them: bodies, each of them, and ropes; they add up to what contact exerts in all."""

from __future__ import annotations

import pytest
import torch

from torchdlo import measures, scene
from torchdlo.coupling import BodyContact, RodBody, RodContact
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64 = torch.float64
STEPS = {
    "sweeps": {"dt": 1e-3, "substeps": 5},
    "coupled": {"dt": 1e-3, "substeps": 2, "contact": "coupled"},
    "implicit": {"dt": 2e-3, "substeps": 1, "integrator": "implicit"},
}


def bridged(steps: str, batch: tuple[int, ...] = ()):
    """A rope that lies on two boxes, one of which is free and stands on the ground, with another rope across it."""
    s = torch.linspace(-0.1, 0.1, 9, dtype=F64)
    below = torch.stack([s, 0 * s, 0 * s + 0.043], -1)
    above = torch.stack([0 * s, 0.5 * s, 0 * s + 0.0488], -1)
    bodies = [
        RigidBody("plane", motion="fixed", name="ground"),
        RigidBody("box", (0.02, 0.02, 0.02), pos=(-0.08, 0.0, 0.02), motion="fixed"),
        RigidBody("box", (0.02, 0.02, 0.02), pos=(0.08, 0.0, 0.02), mass=0.5),
    ]
    ropes = [Rope(x.expand(*batch, 9, 3), radius=0.003, mass=0.01, bend=1e-3) for x in (below, above)]
    acting = [EFFECTS[name]() for name in ("gravity", "bend", "damping")]
    acting += [RodBody(), RodContact(), BodyContact()]
    made, params, state = make(ropes, acting, {"damping": {"rate": 20.0}}, bodies=bodies, **STEPS[steps])
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(60):
            state = scene.step(made, params, state, control)
    return made, params, state, control


@pytest.mark.parametrize("steps", list(STEPS))
def test_partners_add_up_to_what_contact_exerts(steps):
    given = bridged(steps)
    found, whole = measures.contact_partners(*given), measures.contact_forces(*given)
    parts = found.by_bodies + found.by_ropes + found.by_material_points
    torch.testing.assert_close(parts, whole.force, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.by_bodies.sum(-2), found.bodies.sum(-2), rtol=1e-9, atol=1e-9)
    # Ropes exert on each other what cancels; the lower one is pressed by the upper one's weight.
    assert float(found.by_ropes.sum(-2).norm()) < 1e-9
    assert float(found.by_ropes[:9, 2].sum()) == pytest.approx(-0.01 * 9.81, rel=0.5)  # not quite at rest
    # Two boxes share the weight of both ropes, and the ground has no part in it.
    up = found.bodies[:, 2].tolist()
    assert up[0] == 0 and up[1] == pytest.approx(up[2], rel=0.2) and sum(up) == pytest.approx(0.02 * 9.81, rel=0.2)


def test_batches_are_told_one_by_one():
    one, three = bridged("implicit"), bridged("implicit", (3,))
    alone, together = measures.contact_partners(*one), measures.contact_partners(*three)
    assert together.bodies.shape == (3, 3, 3) and together.by_ropes.shape == (3, 18, 3)
    torch.testing.assert_close(together.bodies[1], alone.bodies, rtol=1e-6, atol=1e-9)


def test_scenes_without_contact_have_no_partners():
    x = torch.zeros(5, 3, dtype=F64)
    x[:, 0] = torch.linspace(0, 0.1, 5, dtype=F64)
    made, params, state = make([Rope(x, radius=0.003, mass=0.01, bend=1e-4)], [EFFECTS["bend"]()])
    found = measures.contact_partners(made, params, state, scene.stationary_control(made, state))
    assert found.bodies.shape == (0, 3) and not found.by_ropes.any() and found.by_bodies.shape == (5, 3)
