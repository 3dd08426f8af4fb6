"""Ropes held by friction between two pads: where they start to slip, and what they then do."""

from __future__ import annotations

import pytest
import torch

from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.coupling.rod_body.finger_pads import FingerPads
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import Rope, make, stationary_control, step

F64 = torch.float64
MASS, G, MU = 0.1, 9.81, 0.4
LIMIT = MASS * G / (2 * MU)
"""Force of a finger at which friction of both pads carries the weight: m g = 2 mu N."""


def vec(*xyz: float) -> torch.Tensor:
    return torch.tensor(xyz, dtype=F64)


def hanging(squeeze, integrator="explicit", **fields):
    """A rope that hangs from between two pads; the hand is a small box beside it."""
    n = 11
    x = torch.linspace(0.05, -0.35, n, dtype=F64)[:, None] * vec(0, 0, 1)
    hand = RigidBody("box", (0.01, 0.01, 0.01), pos=(-0.1, 0.0, 0.0), motion="kinematic")
    pads = FingerPads(place=(0.1, 0.0, 0.0), reach=(0.02, 0.03, 0.06))
    effects = [EFFECTS["gravity"](), EFFECTS["bend"](), EFFECTS["damping"](), pads]
    values = {"finger_pads": {"squeeze": squeeze, "mu": MU}, "damping": {"rate": 1.0}}
    rope = Rope(x, mass=MASS, bend=1e-3, radius=0.005, **fields)
    return make([rope], effects, values, bodies=[hand], dt=1e-3, substeps=2, integrator=integrator)


def fallen(scene, params, state, count=150, lift=0.0):
    """How far the rope slid down through the pads, which rise at a speed [m/s]; and the last state."""
    start = state.rods.pos[..., 0, 2]
    with torch.no_grad():
        for _ in range(count):
            led = stationary_control(scene, state)
            up = tree.replace(led.bodies, pos=led.bodies.pos + vec(0, 0, lift * scene.dt))
            state = step(scene, params, state, tree.replace(led, bodies=up))
    return start + lift * count * scene.dt - state.rods.pos[..., 0, 2], state


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_a_rope_slips_when_its_weight_is_more_than_friction(integrator):
    # The bar is 5 % of 2 mu N. Just beyond it the rope slides as 0.05 g t^2 / 2, 5 mm in 0.15 s.
    held, _ = fallen(*hanging(1.05 * LIMIT, integrator))
    slid, _ = fallen(*hanging(0.95 * LIMIT, integrator))
    assert abs(float(held)) < 5e-4
    assert float(slid) > 3e-3


def test_a_sliding_rope_is_braked_by_friction_and_nothing_else():
    # m a = m g - 2 mu N; the first vertices leave the pads later than this.
    slid, _ = fallen(*hanging(0.5 * LIMIT), count=60)
    # Decay of velocities takes a third of its rate times the time; the start is half a substep short.
    assert float(slid) == pytest.approx(0.5 * 0.5 * G * 0.06**2, rel=0.05)


def test_pads_carry_the_rope_along_and_open_hands_do_not():
    moved, state = fallen(*hanging(2 * LIMIT), lift=0.2)
    # The pads start at once; friction of twice the weight brings the rope to their speed with an acceleration g.
    assert float(moved) == pytest.approx(0.2**2 / (2 * G), rel=0.05)
    assert float(state.rods.vel[:, 2].mean()) == pytest.approx(0.2, rel=0.01)
    gone, _ = fallen(*hanging(0.0), count=60)
    assert float(gone) == pytest.approx(0.5 * G * 0.06**2, rel=0.05)


def test_gradients_by_force_and_friction_are_those_of_differences():
    scene, params, state = hanging(0.5 * LIMIT)
    led = stationary_control(scene, state)

    def height(squeeze, mu):
        numbers = params.effects | {"finger_pads": {"squeeze": squeeze, "mu": mu}}
        now = state
        for _ in range(10):
            now = step(scene, tree.replace(params, effects=numbers), now, led)
        return now.rods.pos[:, 2].sum()

    point = [torch.tensor([[x]], dtype=F64, requires_grad=True) for x in (0.5 * LIMIT, MU)]
    found = torch.autograd.grad(height(*point), point)
    with torch.no_grad():
        for k, gradient in enumerate(found):
            up, down = ([x + s * 1e-4 * (j == k) for j, x in enumerate(point)] for s in (1, -1))
            assert float(gradient) == pytest.approx(float(height(*up) - height(*down)) / 2e-4, rel=1e-5)


def test_the_hand_takes_the_opposite_force():
    scene, params, state = hanging(2 * LIMIT)
    from torchdlo.coupling.bodies import dynamics as rigid
    from torchdlo.physics.effects.base import PredictedMotion
    from torchdlo.physics.rod import kinematics as rod

    pads, view = scene.effects[-1], rod.view(scene.topology, params.rods, state.rods, 1e-3)
    gone = 1e-4 * torch.randn(11, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    answer = (1e-6 / params.rods.material.mass).expand(11, 3)
    motion = rigid.predict_free_motion(
        scene.bodies,
        params.bodies,
        state.bodies,
        stationary_control(scene, state).bodies,
        0.0,
        first=torch.zeros(1, 1),
        dt=1e-3,
    )
    push = pads.solve_contact(view, PredictedMotion(gone, answer, answer, motion), params.effects["finger_pads"])
    assert torch.allclose(push.force.sum(-2), -push.body_force[0], atol=1e-12)
    lever = state.rods.pos - state.bodies.pos
    assert torch.allclose(torch.linalg.cross(lever, push.force).sum(-2), -push.body_torque[0], atol=1e-12)
