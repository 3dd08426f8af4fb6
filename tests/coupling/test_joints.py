"""Joints of ropes with free bodies and with each other."""

from __future__ import annotations

import math
import re

import pytest
import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling import RodBody, RodContact
from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.physics import tree
from torchdlo.physics.effects import Bend, BendFrame, Gravity, Twist
from torchdlo.physics.integrators import contact_kernel
from torchdlo.physics.integrators.carried_mass import carried_mass
from torchdlo.physics.linalg.free_rotation import spin_freely, spin_gradient
from torchdlo.physics.linalg.rotation import multiply, rotate
from torchdlo.scene import RigidBody, Rope, RopeJoint

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
    effects = [Gravity(), Bend()]
    return scenes.make([rope], effects, bodies=[plug], joints=[RopeJoint(body="plug", kind=kind)], **choices)


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


@pytest.mark.parametrize("kind", ["weld", "ball"])
@pytest.mark.parametrize("integrator", STEPS)
def test_a_hanging_plug_pulls_with_its_weight(integrator: str, kind: str) -> None:
    made = hung(integrator, kind)
    state = ran(made, 5)
    force, torque = scenes.joint_forces(made[0], state)
    weight = torch.tensor([[0.0, 0.0, -0.05 * G]], dtype=torch.float64)
    torch.testing.assert_close(force, weight, atol=1e-9, rtol=0)
    torch.testing.assert_close(torque, torch.zeros_like(torque), atol=1e-12, rtol=0)
    scenes.check_state(state)


def chained(*, held=(0,), between=5.0, ropes=2, **steps):
    """Ropes of 10 g and 11 vertices one below the other, with a ball of some mass at the end of each."""
    made = [Rope(line(11, 1.0, (0.0, 0.0, -1.04 * k)), radius=0.003, mass=0.01) for k in range(ropes)]
    mass = (between, 0.1)[:ropes]
    balls = [RigidBody("sphere", 0.02, pos=(0, 0, -1.02 - 1.04 * k), mass=m) for k, m in enumerate(mass)]
    joints = [RopeJoint(rope=k, body=k, kind="ball") for k in range(ropes)]
    joints += [RopeJoint(rope=k + 1, vertex=0, body=k, kind="ball") for k in range(ropes - 1)]
    return scenes.make(made, [Gravity()], bodies=balls, joints=joints, prescribed_vertices=held, **steps)


def bound(load: float) -> float:
    """Longest explicit substep [s] in which the lightest vertex of these ropes, of 0.5 g, holds a mass [kg]."""
    return math.sqrt(0.25 * 0.1 * 0.0005 / (G * load))


def test_explicit_steps_refuse_bodies_that_ropes_cannot_carry_by_their_joints() -> None:
    # The bound was that of the rope alone, 28 ms: it carried 21 N of 49, and nothing was said.
    with pytest.raises(ValueError, match=r"hanging weight allows less than 0\.000504 s"):
        chained(ropes=1, dt=2e-3, substeps=1)
    made, params, _ = chained(ropes=1)
    assert scenes.limits(made, params)["hanging weight"] == pytest.approx(bound(5.01))
    # Of two, the upper one carries all. Held in the middle of the lower one, its upper end carries what is above, and
    # edges between carry all on vertices of twice that mass. What nothing holds carries nothing.
    made, params, _ = chained(dt=1e-3)
    assert scenes.limits(made, params)["hanging weight"] == pytest.approx(bound(5.12))
    made, params, _ = chained(held=(11 + 5,), between=0.3)
    assert scenes.limits(made, params)["hanging weight"] == pytest.approx(bound(0.3105))
    made, params, _ = chained(held=())
    assert not scenes.limits(made, params)


def test_a_thin_rope_below_carries_what_is_below_it_only() -> None:
    made, params, _ = chained(between=2.0)
    loads = made.joints.load(params.bodies)
    carried = carried_mass(made.topology, made.prescribed_vertices, params.rods.material.mass, loads)[:, 0]
    assert carried[:10].tolist() == pytest.approx([2.12] * 9 + [0.0005 + 2.11])
    assert carried[11:21].tolist() == pytest.approx([0.11] * 9 + [0.1005])


def test_a_plug_on_a_stiff_cable_swings_as_a_compound_pendulum() -> None:
    # T = 2 pi sqrt(I / (M g d)) with the inertia I about the pivot and the distance d of the centre of mass from it.
    made = hung("implicit", n=9, bend=10.0, tilt=0.05, dt=5e-3)
    inertia = 0.01 * 0.4**2 / 3 + 0.05 * 0.42**2 + 0.05 / 3 * (0.01**2 + 0.02**2)
    period = 2 * math.pi * math.sqrt(inertia / (G * (0.01 * 0.2 + 0.05 * 0.42))) * (1 + 0.05**2 / 16)
    scene, params, state = made
    control, step = scenes.stationary_control(scene, state), scenes.stepper(scene, execution="recorded")
    crossings, last = [], float(state.bodies.pos[0, 0])
    with torch.no_grad():
        for k in range(200):
            state = step(params, state, control)
            now = float(state.bodies.pos[0, 0])
            if now * last < 0:
                crossings.append(scene.dt * (k + last / (last - now)))
            last = now
    assert len(crossings) == 2
    assert 2 * (crossings[1] - crossings[0]) == pytest.approx(period, rel=0.005)
    scenes.check_state(state)


def momentum(params: scenes.Params, state: scenes.State) -> tuple[Tensor, Tensor]:
    """Linear and angular momentum of ropes and bodies."""
    light, heavy = params.rods.material.mass * state.rods.vel, params.bodies.mass * state.bodies.vel
    whole = (light.sum(-2), heavy.sum(-2))
    quat = state.bodies.quat
    spin = rotate(quat, params.bodies.inertia * rotate(conjugate(quat), state.bodies.omega))
    turning = torch.linalg.cross(state.rods.pos, light).sum(-2) + torch.linalg.cross(state.bodies.pos, heavy).sum(-2)
    return whole[0] + whole[1], turning + spin.sum(-2)


def flying(joint: RopeJoint | None, integrator: str, **other):
    rope = Rope(line(9, 0.4), radius=0.004, mass=0.01, bend=1e-4, twist=1e-4)
    plug = RigidBody("box", (0.01, 0.015, 0.02), (0, 0, -0.42), mass=0.05, omega=(3.0, 2.0, 8.0), vel=(0.1, 0, 0))
    frames = other.get("twist", "none") != "none"
    effects = [BendFrame(), Twist()] if frames else [Bend()]
    scene, params, state = scenes.make(
        [rope],
        effects,
        bodies=[plug],
        joints=[joint] if joint else [],
        integrator=integrator,
        **STEPS[integrator] | other,
    )
    vel = torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return scene, params, tree.replace(state, rods=tree.replace(state.rods, vel=0.1 * vel))


PLACES = {
    "ball": (RopeJoint(body=0, kind="ball"), "none"),
    "weld": (RopeJoint(body=0), "none"),
    "weld with twist": (RopeJoint(body=0), "quasistatic"),
    "ball within an edge": (RopeJoint(body=0, kind="ball", at=0.93, anchor=(0.0, 0.0, 0.048)), "none"),
    "weld within an edge": (RopeJoint(body=0, at=0.93, anchor=(0.0, 0.0, 0.048)), "none"),
    "weld in the middle": (RopeJoint(body=0, vertex=-3, anchor=(0.0, 0.0, 0.12)), "quasistatic"),
}


def gap(made, state: scenes.State) -> Tensor:
    """By how far joined points miss their places in the body [m]."""
    joints, quat = made[0].joints, state.bodies.quat[..., :1, :]
    local = rotate(quat.expand(*made[1].joints.local.shape[:-1], 4), made[1].joints.local)
    return (
        joints.weights(state.rods.pos.shape[-2], state.rods.pos) @ state.rods.pos - state.bodies.pos[..., :1, :] - local
    )


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("integrator", STEPS)
def test_a_rope_and_a_plug_in_free_flight_keep_their_momentum(integrator: str, place: str) -> None:
    joint, twist = PLACES[place]
    made = flying(joint, integrator, twist=twist)
    one = ran(made, 1)
    state = ran((*made[:2], one), 10)
    (p, turning), (p_later, later) = momentum(made[1], one), momentum(made[1], state)
    torch.testing.assert_close(p_later, p, atol=1e-14, rtol=0)
    # Implicit steps keep angular momentum to third order, as those of a rope alone do.
    torch.testing.assert_close(later, turning, atol=1e-14 if integrator == "explicit" else 2e-7, rtol=0)
    assert float(gap(made, state).abs().max()) < 1e-13
    scenes.check_state(state)


def knotted():
    """Two ropes that are joined, crossed by a third one, with a plug at an end and a ball near it."""
    points = line(9, 0.2, way=(0.8, 0.0, -0.6))
    other = line(5, 0.1, start=(0.04, -0.05, -0.0198), way=(0.0, 1.0, 0.0))
    ropes = [Rope(x, radius=0.004, mass=0.01, bend=1e-6) for x in (points[:5], points[4:], other)]
    plug = RigidBody("sphere", (0.01,), pos=(0.168, 0.0, -0.126), mass=0.05, omega=(3.0, 2.0, 8.0))
    ball = RigidBody("sphere", (0.02,), pos=(0.0973, 0.0, -0.1036), mass=0.02)
    joints = [RopeJoint(other_rope=1, kind="ball"), RopeJoint(rope=1, body=0)]
    effects = [Gravity(), Bend(), RodContact(), RodBody()]
    return scenes.make(
        ropes, effects, bodies=[plug, ball], joints=joints, prescribed_vertices=[0], **STEPS["implicit"],
        integrator="implicit",
    )  # fmt: skip


@pytest.mark.parametrize("case", ["weld with twist", "ball within an edge", "ropes, contact"])
def test_the_kernel_gives_what_tensor_operations_give(case: str, monkeypatch) -> None:
    if not contact_kernel.available(torch.zeros(1, dtype=torch.float64)):
        pytest.skip("needs a C++ compiler")
    made = knotted() if case not in PLACES else flying(PLACES[case][0], "implicit", twist=PLACES[case][1])
    fast = ran(made, 3)
    monkeypatch.setattr(contact_kernel, "available", lambda _: False)
    slow = ran(made, 3)
    pairs = [(fast.rods, slow.rods, 1e-10), (fast.bodies, slow.bodies, 1e-8), (fast.joints, slow.joints, 1e-5)]
    for one, other, least in pairs:
        for a, b in zip(tree.leaves(one), tree.leaves(other), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-7, atol=least)
    torch.testing.assert_close(fast.diagnostics, slow.diagnostics)


@pytest.mark.slow
@pytest.mark.parametrize(("cable", "plug"), [(0.01, 0.05), (0.2, 0.005)])
@pytest.mark.parametrize("dt", [1e-3, 2e-3, 5e-3])
def test_light_and_heavy_plugs_gain_no_energy(dt: float, cable: float, plug: float) -> None:
    rope = Rope(line(7, 0.3, way=(0.8, 0.0, -0.6)), radius=0.004, mass=cable, bend=1e-4)
    body = RigidBody("sphere", (0.01,), (0.248, 0.0, -0.186), mass=plug)
    made = scenes.make(
        [rope], [Gravity(), Bend()], bodies=[body], joints=[RopeJoint(body=0)], dt=dt, substeps=1,
        integrator="implicit", prescribed_vertices=[0],
    )  # fmt: skip
    scene, params, state = made
    control, step = scenes.stationary_control(scene, state), scenes.stepper(scene, execution="recorded")

    def energy(one: scenes.State, two: scenes.State) -> float:
        """At the time of `one`: velocities stand half a step before positions."""
        found = 0.0
        for m, now, later in (
            (params.rods.material.mass, one.rods, two.rods),
            (params.bodies.mass, one.bodies, two.bodies),
        ):
            speed = 0.25 * (now.vel + later.vel).square().sum(-1, keepdim=True)
            found += float((m * (0.5 * speed + G * now.pos[..., 2:])).sum())
        return found

    first, most = None, -math.inf
    with torch.no_grad():
        for _ in range(round(0.1 / dt)):
            later = step(params, state, control)
            now = energy(state, later)
            first = now if first is None else first
            most, state = max(most, now), later
    fallen = G * (cable + plug) * 0.02
    assert most < first + 0.01 * fallen
    assert float(gap(made, state).abs().max()) < 1e-12
    scenes.check_state(state)


def loss(made, leaves: list[Tensor], steps: int = 3, segment: int | None = None) -> Tensor:
    scene, params, state = made
    mass, inertia, local, bend, vel, spin = leaves
    bodies = tree.replace(params.bodies, mass=mass, inertia=inertia)
    rods = tree.replace(params.rods, material=tree.replace(params.rods.material, bend=bend))
    params = tree.replace(params, bodies=bodies, rods=rods, joints=tree.replace(params.joints, local=local))
    start = tree.replace(state.bodies, omega=spin)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=vel), bodies=start)
    control = scenes.stationary_control(scene, state)
    controls = tree.map(lambda x: x.expand(steps, *x.shape), control)
    step = lambda p, s, c: scenes.step(scene, p, s, c)  # noqa: E731
    last, _ = scenes.rollout(step, params, state, controls, segment=segment, keep=lambda s: s.time)
    force, torque = scenes.joint_forces(scene, last)
    found = [last.rods.pos, last.bodies.pos, last.bodies.quat, force, torque, 0.1 * last.rods.vel]
    return sum((x * torch.linspace(0.3, 1.7, x.numel(), dtype=x.dtype).reshape(x.shape)).sum() for x in found)


def inputs(made) -> list[Tensor]:
    _, params, state = made
    bodies, rods = params.bodies, params.rods.material
    found = bodies.mass, bodies.inertia, params.joints.local, rods.bend, state.rods.vel, state.bodies.omega
    return [x.detach().clone().requires_grad_() for x in found]


@pytest.mark.parametrize("place", ["ball within an edge", "weld with twist"])
@pytest.mark.parametrize("integrator", STEPS)
def test_gradients_are_those_of_differences(integrator: str, place: str) -> None:
    joint, twist = PLACES[place]
    # The velocities that ropes start with do not fit their lengths: the first step has far to go.
    steps = {"substeps": 1, "dt": 1e-3} if integrator == "implicit" else {"substeps": 1, "dt": 2e-4}
    steps |= {"constraint_iterations": 7} if integrator == "explicit" else {}
    made = flying(joint, integrator, twist=twist, **steps)
    leaves = inputs(made)
    found = torch.autograd.grad(loss(made, leaves), leaves)
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):
        ways = [torch.randn(x.shape, generator=generator, dtype=x.dtype) * x.detach().abs().amax() for x in leaves]
        ways[2] = 1e-3 * ways[2]  # joints that do not fit at first pull with some kN

        def along(h: float, ways: list[Tensor] = ways) -> float:
            with torch.no_grad():
                return float(loss(made, [x + h * way for x, way in zip(leaves, ways, strict=True)]))

        # Fourth order, with steps that are large: forces of constraints have the rounding of positions over dt^2.
        h = 3e-4
        expected = (8 * (along(h) - along(-h)) - along(2 * h) + along(-2 * h)) / (12 * h)
        parts = [float((g * way).sum()) for g, way in zip(found, ways, strict=True)]
        # In one of the directions they cancel; rounding does not.
        assert sum(parts) == pytest.approx(expected, rel=1e-5, abs=1e-6 * sum(map(abs, parts)))


def test_replayed_gradients_are_the_same() -> None:
    made = flying(*PLACES["weld with twist"][:1], "implicit", twist="quasistatic")
    leaves = inputs(made)
    one, two = (torch.autograd.grad(loss(made, leaves, segment=s), leaves) for s in (None, 2))
    for a, b in zip(one, two, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("integrator", STEPS)
def test_two_ropes_end_to_end_swing_as_one(integrator: str) -> None:
    way = (0.8, 0.0, -0.6)
    points = line(9, 0.4, way=way)
    choices = STEPS[integrator] | {"integrator": integrator, "prescribed_vertices": [0]}

    def rope(points: Tensor, mass: float) -> Rope:
        return Rope(points, radius=0.004, mass=mass, bend=1e-9)

    whole = scenes.make([rope(points, 0.02)], [Gravity(), Bend()], **choices)
    joint = RopeJoint(other_rope=1, kind="ball")
    halves = [rope(points[:5], 0.01), rope(points[4:], 0.01)]
    parts = scenes.make(halves, [Gravity(), Bend()], joints=[joint], **choices)
    one, two = (ran(made, 40).rods.pos for made in (whole, parts))
    torch.testing.assert_close(two[:5], one[:5], atol=1e-7, rtol=0)
    torch.testing.assert_close(two[5:], one[4:], atol=1e-7, rtol=0)


def test_two_stiff_ropes_that_are_welded_bend_as_one() -> None:
    # Within a rope of n edges, one hinge that does not give makes the tip sag less by about 3 / n of it times a
    # quarter: the moment in the middle of a cantilever.
    points = line(17, 0.4, way=(1.0, 0.0, 0.0))
    choices = {"integrator": "implicit", "dt": 5e-3, "substeps": 1, "prescribed_vertices": [0, 1]}

    def rope(points: Tensor, mass: float) -> Rope:
        return Rope(points, radius=0.004, mass=mass, bend=0.02)

    whole = scenes.make([rope(points, 0.02)], [Gravity(), Bend()], **choices)
    halves = [rope(points[:9], 0.01), rope(points[8:], 0.01)]
    parts = scenes.make(halves, [Gravity(), Bend()], joints=[RopeJoint(other_rope=1)], **choices)
    one, two = (ran(made, 20) for made in (whole, parts))
    assert float(two.rods.pos[-1, 2]) == pytest.approx(float(one.rods.pos[-1, 2]), rel=0.08)
    edges = two.rods.pos[1:] - two.rods.pos[:-1]
    torch.testing.assert_close(edges[7], edges[9], atol=1e-12, rtol=0)
    scenes.check_state(two)


def test_a_welded_plug_turns_on_the_twist_of_its_rope() -> None:
    # w = sqrt(GJ / (L I)): L is the length between the middles of the two edges whose frames are held.
    rope = Rope(line(9, 0.4), radius=0.004, mass=0.01, bend=1e-4, twist=1e-3)
    plug = RigidBody("box", (0.01, 0.015, 0.02), (0.0, 0.0, -0.42), mass=0.05, omega=(0.0, 0.0, 2.0))
    scene, params, state = scenes.make(
        [rope], [Gravity(), BendFrame(), Twist()], bodies=[plug], joints=[RopeJoint(body=0)], integrator="implicit",
        dt=1e-3, substeps=1, prescribed_vertices=[0, 1], prescribed_edges=[0], twist="quasistatic",
    )  # fmt: skip
    control, step = scenes.stationary_control(scene, state), scenes.stepper(scene, execution="recorded")
    period = 2 * math.pi * math.sqrt(0.35 * 0.05 / 3 * (0.01**2 + 0.015**2) / 1e-3)
    last, crossing = 2.0, None
    with torch.no_grad():
        for k in range(round(0.35 * period / 1e-3)):
            state = step(params, state, control)
            now = float(state.bodies.omega[0, 2])
            if crossing is None and now < 0:
                # Velocities stand half a step before.
                crossing = (k + 0.5 + last / (last - now) - 0.0) * 1e-3 - 0.5e-3
            last = now
    assert crossing == pytest.approx(period / 4, rel=0.01)
    torque = scenes.joint_forces(scene, state)[1]
    assert float(torque[0, 2].abs()) > 1e-5


def test_scenes_of_a_batch_are_as_alone_and_recorded_steps_as_others() -> None:
    rope = Rope(line(7, 0.3, way=(0.8, 0.0, -0.6)), radius=0.004, mass=0.01, bend=1e-4)
    masses = torch.tensor([0.05, 0.01], dtype=torch.float64)

    def made(mass, dtype=torch.float64, integrator="implicit"):
        body = RigidBody("sphere", (0.01,), (0.248, 0.0, -0.186), mass=mass)
        given = Rope(rope.positions.to(dtype), radius=0.004, mass=0.01, bend=1e-4)
        choices = {"dt": 1e-3, "substeps": 1, "prescribed_vertices": [0], "integrator": integrator}
        return scenes.make([given], [Gravity(), Bend()], bodies=[body], joints=[RopeJoint(body=0)], **choices)

    for integrator in STEPS:
        both = made(masses, integrator=integrator)
        many, alone = ran(both, 3), ran(made(0.01, integrator=integrator), 3)
        torch.testing.assert_close(many.rods.pos[1], alone.rods.pos, atol=1e-10, rtol=0)
        single = ran(made(0.01, torch.float32, integrator), 3)
        torch.testing.assert_close(single.bodies.pos.double(), alone.bodies.pos, atol=2e-5, rtol=0)
        scenes.check_state(single)
    recorded = scenes.stepper(both[0], execution="recorded")
    quick = ran(both, 3, lambda scene, *given: recorded(*given))
    torch.testing.assert_close(quick.rods.pos, many.rods.pos, atol=1e-10, rtol=0)


@pytest.mark.parametrize("integrator", STEPS)
def test_a_rope_does_not_push_the_plug_that_it_is_joined_to(integrator: str) -> None:
    made = hung(integrator)
    scene, params, state = scenes.make(
        [Rope(line(9, 0.4), radius=0.004, mass=0.01, bend=1e-4)], [Gravity(), Bend(), RodBody()],
        bodies=[RigidBody("box", (0.01, 0.015, 0.02), (0.0, 0.0, -0.42), mass=0.05)], joints=[RopeJoint(body=0)],
        integrator=integrator, prescribed_vertices=[0], **STEPS[integrator],
    )  # fmt: skip
    assert scene.effects[-1].left_out == ((7, 0),)
    with_contact, without = ran((scene, params, state), 4), ran(made, 4)
    torch.testing.assert_close(with_contact.rods.pos, without.rods.pos, atol=1e-9, rtol=0)
    torch.testing.assert_close(with_contact.bodies.pos, without.bodies.pos, atol=1e-9, rtol=0)


@pytest.mark.parametrize("integrator", STEPS)
def test_ropes_do_not_push_each_other_at_their_joint(integrator: str) -> None:
    points = line(9, 0.2, way=(0.8, 0.0, -0.6))
    choices = {"dt": 1e-3, "substeps": 1} | {"integrator": integrator, "prescribed_vertices": [0]}
    halves = [Rope(x, radius=0.004, mass=0.01, bend=1e-6) for x in (points[:5], points[4:])]
    joint = RopeJoint(other_rope=1, kind="ball")
    one, two = (
        scenes.make(halves, [Gravity(), Bend(), *contact], joints=[joint], **choices)
        for contact in ((), (RodContact(),))
    )
    torch.testing.assert_close(ran(two, 5).rods.pos, ran(one, 5).rods.pos, atol=1e-9, rtol=0)


def test_an_elastic_rope_stretches_under_its_plug() -> None:
    rope = Rope(line(5, 0.4), radius=0.004, mass=1e-4, bend=1e-4, stretch=20.0)
    body = RigidBody("sphere", (0.01,), (0.0, 0.0, -0.41), mass=0.05, damping=20.0)
    made = scenes.make(
        [rope], [Gravity(), Bend()], bodies=[body], joints=[RopeJoint(body=0, kind="ball")], integrator="implicit",
        dt=5e-3, substeps=1, prescribed_vertices=[0],
    )  # fmt: skip
    state = ran(made, 150)
    # Strain = m g / EA, by the weight below.
    assert float(-state.rods.pos[-1, 2]) == pytest.approx(0.4 * (1 + 0.05005 * G / 20.0), abs=2e-5)


WRONG = {
    "expected a body, 0 to 1": RopeJoint(body="plugg"),
    "is fixed, and joints are for free bodies": RopeJoint(body="wall"),
    "expected a vertex, -9 to 8": RopeJoint(body=0, vertex=9),
    "mm off the surface of body 'plug'": RopeJoint(body=0, vertex=3),
    "starts 40 mm from it": RopeJoint(body=0, anchor=(0.0, 0.0, 0.06)),
    "either a body or other_rope": RopeJoint(),
    "which is prescribed": RopeJoint(body=0, vertex=0, anchor=(0.0, 0.0, 0.42)),
    "expected another rope": RopeJoint(other_rope=0),
    "a share of the rope's length": RopeJoint(body=0, at=1.5),
}


@pytest.mark.parametrize("sentence", WRONG)
def test_what_cannot_be_joined_is_refused(sentence: str) -> None:
    rope = Rope(line(9, 0.4), radius=0.004, mass=0.01, bend=1e-4)
    plug = RigidBody("box", (0.01, 0.015, 0.02), (0.0, 0.0, -0.42), mass=0.05, name="plug")
    wall = RigidBody("box", (0.1, 0.1, 0.1), (0.0, 1.0, 0.0), motion="fixed", name="wall")
    with pytest.raises(ValueError, match=re.escape(sentence)):
        scenes.make([rope], [Gravity()], bodies=[plug, wall], joints=[WRONG[sentence]], prescribed_vertices=[0])


def star(pairs, bodies=(), joined=()):
    """Three ropes of 1 m that start at one point, joined there pairwise, and to bodies."""
    ways = ((1.0, 0.0, 0.0), (-0.6, 0.8, 0.0), (-0.6, -0.8, 0.0))
    ropes = [Rope(line(5, 1.0, way=way), radius=0.003, mass=0.01) for way in ways]
    joints = [RopeJoint(rope=a, vertex=0, other_rope=b, other_vertex=0, kind="ball") for a, b in pairs]
    return scenes.make(ropes, [Gravity()], bodies=bodies, joints=[*joints, *joined], dt=1e-3)


def test_joints_that_repeat_others_are_refused() -> None:
    # Explicit steps ended in a singular matrix, implicit ones in numbers that are none.
    ball = RigidBody("sphere", 0.02, pos=(0.0, 0.0, -0.02), mass=0.1)
    onto = [RopeJoint(rope=k, vertex=0, body=0, kind="ball") for k in (0, 1)]
    with pytest.raises(
        ValueError, match=r"joints\[2\]: repeats what joints\[0\] and joints\[1\] hold together already"
    ):
        star([(0, 1), (0, 2), (1, 2)])
    with pytest.raises(ValueError, match=r"joints\[1\]: repeats what joints\[0\] holds together already"):
        star([], [ball], [onto[0], onto[0]])
    with pytest.raises(ValueError, match=r"joints\[2\]: repeats what joints\[0\] and joints\[1\] hold together"):
        star([(0, 1)], [ball], onto)
    for made in (star([(0, 1), (0, 2)]), star([(0, 1)], [ball], onto[:1]), star([], [ball], onto)):
        scenes.check_state(ran(made, 3))


def test_two_bodies_on_two_points_of_a_rope_are_refused_and_three_in_a_ring_are_not() -> None:
    def ring(corners) -> None:
        # A rope round a triangle, and balls between its corners.
        at = [torch.tensor(x, dtype=torch.float64) for x in ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.1, 0.3, 0.0))]
        points = torch.stack([a + share * (at[(k + 1) % 3] - a) for k, a in enumerate(at) for share in (0.0, 0.3, 0.6)])
        balls, joints = [], []
        for k, (a, b) in enumerate(corners):
            centre = ((at[a] + at[b]) / 2).tolist()
            balls.append(RigidBody("sphere", 0.02, pos=(*centre[:2], -0.05 * (k + 1)), mass=0.1))
            ends = [tuple(float(at[c][j]) - balls[k].pos[j] for j in range(3)) for c in (a, b)]
            joints += [
                RopeJoint(vertex=3 * c, body=k, kind="ball", anchor=end) for c, end in zip((a, b), ends, strict=True)
            ]
        rope = Rope(points, radius=0.003, mass=0.01, closed=True)
        scenes.check_state(ran(scenes.make([rope], [Gravity()], bodies=balls, joints=joints, dt=1e-3), 3))

    ring([(0, 1), (1, 2), (2, 0)])
    with pytest.raises(ValueError, match=r"joints\[3\]: repeats what joints\[0\] and joints\[1\] and joints\[2\] hold"):
        ring([(0, 1), (0, 1)])


def test_two_welds_on_one_vertex_are_refused() -> None:
    rope = Rope(line(9, 0.4), radius=0.004, mass=0.01, bend=1e-4)
    plugs = [RigidBody("sphere", (0.02,), (x, 0.0, -0.4), mass=0.05) for x in (0.02, -0.02)]
    with pytest.raises(ValueError, match=r"joints\[1\]: vertex 7 belongs to a weld already"):
        scenes.make([rope], [Gravity()], bodies=plugs, joints=[RopeJoint(body=0), RopeJoint(body=1)])
