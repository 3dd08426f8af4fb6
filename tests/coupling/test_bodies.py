"""Rigid bodies without contact: free fall, spin, poses, and clear refusals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from touching import F64, line

from torchdlo.coupling import RodBody
from torchdlo.coupling.bodies import dynamics as bodies
from torchdlo.coupling.bodies.dynamics import RigidBody, conjugate
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, Effect
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.linalg.rotation import multiply, rotate
from torchdlo.scene import Control, Rope, make, rollout, stationary_control, step

pytestmark = pytest.mark.quick

NONE = torch.zeros(1, 3, dtype=F64)


def fly(solids: list[RigidBody], time: float, dt: float, gravity: float = 0.0):
    """States of bodies under gravity alone, one per substep."""
    kinds, params, state = bodies.place_bodies(solids, NONE)
    targets, seen = bodies.stationary_control(kinds, state), [state]
    for k in range(round(time / dt)):
        first = torch.tensor([[float(k == 0)]], dtype=F64)
        motion = bodies.predict_free_motion(
            kinds, params, state, targets, NONE.new_tensor([[0, 0, -gravity]]), first, dt
        )
        state = bodies.advance_bodies(motion, targets, ContactForces(NONE, NONE, NONE))
        seen.append(state)
    return params, seen


def spin_of(params, state):
    """Angular momentum in the world and energy of the turning, shape (..., K, 3) and (..., K)."""
    local = rotate(conjugate(state.quat), state.omega)
    return rotate(state.quat, params.inertia * local), 0.5 * (params.inertia * local.square()).sum(-1)


TUMBLING = RigidBody("box", (0.1, 0.2, 0.3), density=1000.0, omega=(0.1, 6.0, 0.05))
"""Turns about its middle axis, which is not stable."""


def test_angular_momentum_is_constant_and_energy_stays_in_bounds():
    # 6 s, several flips. The energy of a symmetric scheme of second order stays within (w dt)^2 / 12 of its start.
    params, seen = fly([TUMBLING], 6.0, 5e-3)
    start, energy = spin_of(params, seen[0])
    pairs = [spin_of(params, state) for state in seen]
    assert max(float((l - start).norm()) for l, _ in pairs) < 1e-12 * float(start.norm())
    drift = [abs(float(e / energy) - 1) for _, e in pairs]
    bound = (6.0 * 5e-3) ** 2 / 12
    assert max(drift) < bound and max(drift[-200:]) < bound
    middle = [float(rotate(conjugate(s.quat), s.omega)[0, 1]) for s in seen]
    assert min(middle) < -5.0, "it has not flipped"
    assert max(abs(float(s.quat.norm()) - 1) for s in seen) < 1e-14


def test_spin_is_second_order():
    ends = [fly([TUMBLING], 1.0, dt)[1][-1].quat for dt in (0.02, 0.01, 0.005, 0.00125)]
    errors = [float((q - ends[-1]).norm()) for q in ends[:-1]]
    # The reference's own error is 1/16 of the finest's.
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
    assert math.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.15)


def test_a_symmetric_top_turns_as_in_closed_form():
    # Its axis turns about the angular momentum L at the rate L / I_1 (Landau and Lifshitz, Mechanics, section 33).
    params, seen = fly([RigidBody("cylinder", (0.1, 0.02), mass=1.0, omega=(1.0, 0.0, 3.0))], 1.0, 1e-3)
    momentum, _ = spin_of(params, seen[0])
    rate = momentum / params.inertia[..., :1]
    axis = rotate(bodies.turn_by(rate * 1.0), torch.tensor([[0.0, 0.0, 1.0]], dtype=F64))
    found = rotate(seen[-1].quat, torch.tensor([[0.0, 0.0, 1.0]], dtype=F64))
    assert float((found - axis).norm()) < 1e-5  # (w dt)^2


def test_free_fall_is_exact_and_damping_is_exponential():
    # Stoermer-Verlet is exact under a constant force.
    _, seen = fly([RigidBody("sphere", 0.1, mass=2.0, vel=(1.0, 0, 2.0))], 0.5, 5e-3, 9.81)
    assert float(seen[-1].pos[0, 2]) == pytest.approx(2.0 * 0.5 - 0.5 * 9.81 * 0.25, abs=1e-12)
    _, seen = fly([RigidBody("sphere", 0.1, mass=2.0, vel=(1.0, 0, 0), omega=(0, 2.0, 0), damping=3.0)], 0.5, 5e-3)
    assert float(seen[-1].vel[0, 0]) == pytest.approx(math.exp(-1.5), rel=1e-9)
    assert float(seen[-1].omega[0, 1]) == pytest.approx(2 * math.exp(-1.5), rel=1e-9)


def test_rotation_vectors_lead_from_one_pose_to_another():
    g = torch.Generator().manual_seed(1)
    v = torch.randn(50, 3, generator=g, dtype=F64)
    v = torch.cat([v / v.norm(dim=-1, keepdim=True) * torch.linspace(0, 3.1, 50, dtype=F64)[:, None], 1e-9 * v, 0 * v])
    start = bodies.turn_by(torch.randn(150, 3, generator=g, dtype=F64))
    end = multiply(bodies.turn_by(v), start)
    assert float((bodies.turn_between(start, end) - v).abs().max()) < 1e-12
    assert float((bodies.turn_between(start, -end) - v).abs().max()) < 1e-12
    assert torch.autograd.gradcheck(
        lambda v: bodies.turn_between(start, multiply(bodies.turn_by(v), start)), (v.requires_grad_(),)
    )


def scene_of(*solids: RigidBody, effects: Sequence[Effect] = (), **choices: Any):
    rope = Rope(line(4, 0.1), radius=0.005, density=1000.0)
    return make([rope], [Gravity(), *effects], bodies=solids, dt=1e-3, substeps=4, **choices)


def test_kinematic_bodies_follow_control_evenly_and_fixed_ones_stay():
    scene, params, state = scene_of(
        RigidBody("sphere", 0.02, motion="kinematic", pos=(0, 0, 1.0)),
        RigidBody("plane", pos=(0, 0, -1.0), motion="fixed"),
    )
    control = stationary_control(scene, state)
    turn = torch.tensor([[0.0, 0.0, 0.01]], dtype=F64)
    targets = tree.replace(
        control.bodies, pos=control.bodies.pos + 0.002, quat=multiply(bodies.turn_by(turn), control.bodies.quat)
    )
    after = step(scene, params, state, tree.replace(control, bodies=targets))
    assert torch.allclose(after.bodies.pos[0], state.bodies.pos[0] + 0.002, atol=1e-15, rtol=0)
    assert torch.allclose(after.bodies.vel[0], torch.full((3,), 2.0, dtype=F64))
    assert torch.allclose(after.bodies.omega[0], 1000 * turn[0])
    assert torch.equal(after.bodies.pos[1], state.bodies.pos[1]) and torch.equal(
        after.bodies.quat[1], state.bodies.quat[1]
    )


def test_bodies_run_in_batches_and_rollouts():
    pos = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]], dtype=F64)
    scene, params, state = scene_of(RigidBody("box", (0.1, 0.2, 0.3), pos=pos, mass=1.0, omega=(1.0, 2.0, 3.0)))
    assert state.rods.pos.shape == (2, 4, 3) and state.bodies.quat.shape == (2, 1, 4)
    controls = tree.map(lambda c: c.expand(3, *c.shape), stationary_control(scene, state))
    last, path = rollout(lambda *a: step(scene, *a), params, state, controls, keep=lambda s: s.bodies.pos)
    assert path.shape == (3, 2, 1, 3) and bool((last.bodies.quat[0] == last.bodies.quat[1]).all())


def test_a_scene_without_bodies_has_none_in_its_trees():
    scene, params, state = make([Rope(line(4, 0.1), radius=0.005, density=1000.0)], [Gravity()], dt=1e-3)
    assert params.bodies == state.bodies == stationary_control(scene, state).bodies == ()


@pytest.mark.parametrize(
    ("solid", "words"),
    [
        (RigidBody("egg", 1.0), "expected one of"),
        (RigidBody("sphere", (1.0, 2.0), mass=1.0), "expected (..., 1)"),
        (RigidBody("sphere", 0.0, mass=1.0), "more than 0"),
        (RigidBody("sphere", 0.1), "either mass or density"),
        (RigidBody("sphere", 0.1, mass=1.0, density=1.0), "either mass or density"),
        (RigidBody("sphere", 0.1, mass=-1.0), "more than 0"),
        (RigidBody("plane"), "no mass"),
        (RigidBody("sphere", 0.1, motion="fixed", vel=(1.0, 0, 0)), "only free bodies"),
        (RigidBody("sphere", 0.1, motion="floating"), "expected one of"),
        (RigidBody("torus", (0.1, 0.2), mass=1.0), "thicker"),
        (RigidBody("ring", (0.2, 0.1, 7.0), mass=1.0), "whole turn"),
        (RigidBody("sphere", 0.1, mass=1.0, quat=(0.0, 0.0, 0.0, 0.0)), "zero"),
        (RigidBody("sphere", 0.1, mass=1.0, pos=(0.0, math.nan, 0.0)), "finite"),
        (RigidBody("sphere", 0.1, mass=1.0, mu_k=-0.1), "0 or more"),
        (RigidBody("mesh", (0.1, 0.1, 0.1), mass=1.0), "needs a grid"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_bad_bodies_are_refused_with_what_is_expected(solid, words):
    with pytest.raises(ValueError) as error:
        scene_of(solid)
    assert words in str(error.value), str(error.value)


def test_bad_scenes_and_controls_are_refused():
    with pytest.raises(ValueError, match="there are none"):
        scene_of(effects=(RodBody(),))
    with pytest.raises(ValueError, match="rename one"):
        scene_of(RigidBody("plane", motion="fixed", name="a"), RigidBody("sphere", 0.1, motion="fixed", name="a"))
    scene, params, state = scene_of(RigidBody("plane", motion="kinematic"))
    control = stationary_control(scene, state)
    with pytest.raises(ValueError, match="poses of 1 kinematic"):
        step(scene, params, state, Control(control.pos, control.director))
