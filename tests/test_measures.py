"""Curvature, twist, tension and energies of a state are those of mechanics."""

from __future__ import annotations

import io
import math

import pytest
import torch

from torchdlo import measures, scene
from torchdlo.coupling.rod_body.rod_body_effect import RodBody
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch, Twist
from torchdlo.physics.effects.external import Damping, Gravity, TiltedGravity
from torchdlo.physics.effects.material import AxialStiffness, NonuniformStiffness, PointMass

pytestmark = pytest.mark.quick

N, R, BEND = 41, 0.2, 2e-3


def arc(**choices):
    """A quarter of a circle, straight at rest."""
    angle = torch.linspace(0, math.pi / 2, N, dtype=torch.float64)
    x = R * torch.stack([angle.sin(), 0 * angle, 1 - angle.cos()], -1)
    rope = scene.Rope(x, radius=0.004, mass=0.05, bend=BEND, twist=1e-3)
    effects = [Gravity(), Bend(), Twist(), Damping()]
    return scene.make([rope], effects, integrator="implicit", dt=1e-3, substeps=1, **choices)


def test_a_circle_has_its_curvature_and_its_bending_energy() -> None:
    world, params, state = arc()
    kappa = measures.curvature(world, params, state)
    # The discrete curvature 2 tan(phi / 2) / l of chords of a circle is 1 / R up to the square of the step.
    torch.testing.assert_close(
        kappa[1:-1].norm(dim=-1), torch.full((N - 2,), 1 / R, dtype=torch.float64), rtol=1e-3, atol=0
    )
    assert kappa[[0, -1]].eq(0).all() and torch.allclose(kappa[1:-1, 1], -kappa[1:-1].norm(dim=-1))
    inner = R * math.pi / 2 * (N - 2) / (N - 1)
    assert float(measures.bending_energy(world, params, state)) == pytest.approx(0.5 * BEND / R**2 * inner, rel=2e-3)


def test_weight_and_motion_have_their_energies() -> None:
    world, params, state = arc()
    mass, height = params.rods.material.mass, state.rods.pos[..., 2:]
    assert float(measures.gravitational_energy(world, params, state)) == pytest.approx(
        float(9.81 * (mass * height).sum())
    )
    moving = tree.replace(state, rods=tree.replace(state.rods, vel=torch.full_like(state.rods.vel, 2.0)))
    assert float(measures.kinetic_energy(world, params, moving)) == pytest.approx(0.5 * 0.05 * 12)


def test_a_straight_rope_that_is_turned_has_even_twist() -> None:
    x = torch.zeros(N, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(0, 0.4, N, dtype=torch.float64)
    rope = scene.Rope(x, radius=0.004, mass=0.05, bend=BEND, twist=1e-3)
    world, params, state = scene.make(
        [rope], [Bend(), Twist()], integrator="implicit", dt=1e-3, substeps=1, twist="quasistatic"
    )
    angle = torch.linspace(0, 1.0, N, dtype=torch.float64)[:, None]
    turned = tree.replace(state, rods=tree.replace(state.rods, twist=angle))
    per_metre = 1.0 / (N - 1) / (0.4 / (N - 1))
    torch.testing.assert_close(
        measures.twist(world, params, turned)[1:-1], torch.full((N - 2, 1), per_metre, dtype=torch.float64)
    )
    energy = 0.5 * 1e-3 * per_metre**2 * 0.4 * (N - 2) / (N - 1)
    assert float(measures.twisting_energy(world, params, turned)) == pytest.approx(energy)


def test_a_hanging_rope_is_pulled_by_what_hangs_below() -> None:
    x = torch.zeros(11, 3, dtype=torch.float64)
    x[:, 2] = -torch.linspace(0, 0.4, 11)
    rope = scene.Rope(x, radius=0.004, mass=0.05, bend=BEND)
    world, params, state = scene.make(
        [rope],
        [Gravity(), Bend(), Damping()],
        {"damping": {"rate": 20.0}},
        integrator="implicit",
        dt=2e-3,
        substeps=1,
        prescribed_vertices=(0,),
    )
    for _ in range(100):
        state = scene.step(world, params, state, scene.stationary_control(world, state))
    below = params.rods.material.mass.flip(-2).cumsum(-2).flip(-2)[1:] * 9.81
    torch.testing.assert_close(measures.tension(world, params, state)[:-1], below, rtol=1e-4, atol=1e-6)


def test_an_elastic_rope_pulls_by_its_stretch() -> None:
    x = torch.zeros(5, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(0, 0.4, 5)
    rope = scene.Rope(x, radius=0.004, mass=0.05, bend=BEND, stretch=100.0)
    world, params, state = scene.make([rope], [Bend(), Stretch()], dt=1e-4, constrained=False)
    longer = tree.replace(state, rods=tree.replace(state.rods, pos=1.01 * state.rods.pos))
    torch.testing.assert_close(
        measures.tension(world, params, longer)[:-1], torch.full((4, 1), 1.0, dtype=torch.float64)
    )


def test_energies_tension_and_moments_are_of_what_steps_use() -> None:
    x = torch.zeros(N, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(0, 0.4, N, dtype=torch.float64)
    rope = scene.Rope(x, radius=0.004, mass=0.01, bend=BEND)
    values = {"point_mass": {"mass": 1.0, "position": 0.4}, "tilted_gravity": {"angles": (0.1, 0.0)}}
    world, params, state = scene.make([rope], [Gravity(), TiltedGravity(), PointMass()], values, check=False)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=torch.ones_like(x) * x.new_tensor([0, 1.0, 0])))
    assert float(measures.kinetic_energy(world, params, state)) == pytest.approx(0.505)
    up = tree.replace(state, rods=tree.replace(state.rods, pos=state.rods.pos + x.new_tensor([0.0, 0.0, 2.0])))
    rise = float(measures.gravitational_energy(world, params, up) - measures.gravitational_energy(world, params, state))
    assert rise == pytest.approx(1.01 * 9.81 * 2 * math.cos(0.1))
    soft = scene.Rope(x, radius=0.004, mass=0.01, bend=BEND, stretch=100.0)
    effects = [Stretch(), AxialStiffness()]
    given = scene.make([soft], effects, {"stretch": {"EA": 100.0}}, dt=1e-4, constrained=False)
    longer = tree.replace(given[2], rods=tree.replace(given[2].rods, pos=1.01 * given[2].rods.pos))
    assert measures.tension(*given[:2], longer)[:-1, 0].tolist() == pytest.approx([0.5] * (N - 1))
    world, params, state = arc()
    plain, moment = measures.bending_energy(world, params, state), measures.bending_moment(world, params, state)
    stiffer = scene.make(
        [scene.Rope(state.rods.pos, radius=0.004, mass=0.05, bend=BEND)],
        [Bend(), NonuniformStiffness()],
        {"nonuniform_stiffness": {"factor": math.log(2), "width": 1e3}},
        check=False,
    )
    torch.testing.assert_close(measures.bending_energy(*stiffer), 2 * plain, rtol=1e-6, atol=0)
    torch.testing.assert_close(measures.bending_moment(*stiffer), 2 * moment, rtol=1e-6, atol=0)


def test_the_moment_of_a_circle_is_its_stiffness_times_its_curvature() -> None:
    world, params, state = arc()
    moment = measures.bending_moment(world, params, state)
    torch.testing.assert_close(moment, BEND * measures.curvature(world, params, state))
    # In the material frame it is the same, whichever way the directors point.
    for director in ((0.0, 1.0, 0.0), (0.0, 1.0, 2.0)):
        rope = scene.Rope(state.rods.pos, mass=0.05, bend=BEND, director=torch.tensor(director).double())
        framed = scene.make([rope], [BendFrame()], check=False)
        torch.testing.assert_close(measures.bending_moment(*framed), moment)
        torch.testing.assert_close(measures.bending_energy(*framed), measures.bending_energy(world, params, state))


def test_natural_curvature_and_two_stiffnesses_count() -> None:
    x = arc()[2].rods.pos
    across, inside = torch.tensor([0.0, 1.0, 0.0]).double(), torch.tensor([0.0, 0.0, 1.0]).double()
    length = R * math.pi / 2 * (N - 2) / (N - 1)
    # It bends towards the second director if the first one is across the plane of the arc.
    for director, stiffness in ((inside, BEND), (across, 3 * BEND)):
        rope = scene.Rope(x, mass=0.05, bend=BEND, bend2=3 * BEND, director=director)
        made = scene.make([rope], [BendFrame()], check=False)
        energy = 0.5 * stiffness / R**2 * length
        assert float(measures.bending_energy(*made)) == pytest.approx(energy, rel=2e-3)
        size = measures.bending_moment(*made)[1:-1].norm(dim=-1)
        torch.testing.assert_close(size, torch.full_like(size, stiffness / R), rtol=1e-3, atol=0)
        natural = scene.make([scene.Rope(x, mass=0.05, bend=BEND, rest="as_placed")], [BendFrame()], check=False)
        assert float(measures.bending_energy(*natural)) < 1e-15 and bool(
            (measures.bending_moment(*natural).abs() < 1e-12).all()
        )
    half = torch.tensor([[0.0, 0.5 / R]]).double().expand(N, 2)
    made = scene.make(
        [scene.Rope(x, mass=0.05, bend=BEND, rest_curvature=half, director=across)], [BendFrame()], check=False
    )
    size = measures.bending_moment(*made)[1:-1].norm(dim=-1)
    either = (torch.full_like(size, 0.5 * BEND / R), torch.full_like(size, 1.5 * BEND / R))
    assert min(float((size - e).abs().max()) for e in either) < 1e-3 * BEND / R


def drift(dt: float) -> float:
    """How far the energy of a rope with a welded plug, falling and swinging from one end, strays from its start [J]."""
    x = torch.zeros(9, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(0, 0.4, 9, dtype=torch.float64)
    rope = scene.Rope(x, radius=0.004, mass=0.01, bend=1e-3)
    plug = scene.RigidBody("box", (0.02, 0.015, 0.01), pos=(0.42, 0.0, 0.0), mass=0.05)
    weld = scene.RopeJoint(body=0)
    world, params, state = scene.make(
        [rope], [Gravity(), Bend()], bodies=[plug], joints=[weld], dt=dt, substeps=1, prescribed_vertices=(0,)
    )
    control, found = scene.stationary_control(world, state), []
    moving = (measures.kinetic_energy, measures.body_kinetic_energy)
    resting = (measures.gravitational_energy, measures.body_gravitational_energy, measures.bending_energy)
    with torch.no_grad():
        for _ in range(round(0.12 / dt)):
            after = scene.step(world, params, state, control)
            # Velocities lie half a step before positions.
            kinetic = sum(0.5 * float(e(world, params, s)) for e in moving for s in (state, after))
            found.append(kinetic + sum(float(e(world, params, state)) for e in resting))
            state = after
    return max(abs(e - found[1]) for e in found[1:])


def test_the_energy_of_a_rope_and_the_body_at_its_end_stays() -> None:
    # Of the second order of the step, while the plug falls by centimetres.
    coarse, fine = drift(2e-3), drift(1e-3)
    assert fine < 0.35 * coarse and coarse < 1e-5, (coarse, fine)


def test_states_are_saved_loaded_and_moved_as_the_page_says() -> None:
    *_, state = arc()
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    again = torch.load(file, weights_only=False)
    assert all(torch.equal(a, b) for a, b in zip(tree.leaves(state), tree.leaves(again), strict=True))
    single = tree.map(lambda t: t.to("cpu", torch.float32), state)
    assert all(leaf.dtype == torch.float32 for leaf in tree.leaves(single))


@pytest.mark.parametrize("how", [{}, {"integrator": "implicit"}], ids=["explicit", "implicit"])
def test_contact_carries_a_rope_that_lies_on_a_slope(how: dict[str, str]) -> None:
    # Friction holds it while tan a < mu, so that contact is minus the weight, vertex by vertex.
    a, mass = math.atan(0.3), 0.02
    down = torch.tensor([math.cos(a), 0.0, -math.sin(a)], dtype=torch.float64)
    up = torch.tensor([math.sin(a), 0.0, math.cos(a)], dtype=torch.float64)
    across = torch.linspace(-0.05, 0.05, 6, dtype=torch.float64)[:, None] * down.new_tensor([0, 1.0, 0])
    rope = scene.Rope(across + 0.005 * up, radius=0.005, mass=mass, bend=1e-4)
    plane = scene.RigidBody(
        "plane", quat=(math.cos(a / 2), 0.0, math.sin(a / 2), 0.0), motion="fixed", mu_s=0.5, mu_k=0.5
    )
    made, params, state = scene.make([rope], [Gravity(), Bend(), RodBody()], bodies=[plane], dt=1e-3, substeps=2, **how)
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(60):
            state = scene.step(made, params, state, control)
        felt = measures.contact_forces(made, params, state, control)
    weight = params.rods.material.mass * torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64)
    torch.testing.assert_close(felt.force, -weight, rtol=0, atol=0.02 * 9.81 * mass / 6)
    # Implicit steps do not add up what a fixed body bears.
    borne = felt.force.sum(0) if not how else 0 * felt.force[0]
    torch.testing.assert_close(felt.body_force[0], -borne, rtol=1e-9, atol=1e-12)


def test_contact_changes_the_momentum_of_a_free_body() -> None:
    x = torch.zeros(5, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(-0.05, 0.05, 5, dtype=torch.float64)
    ball = scene.RigidBody("sphere", 0.02, pos=(0.004, 0.0, 0.0255), vel=(0.0, 0.0, -1.0), mass=0.02)
    rope = scene.Rope(x, radius=0.005, mass=0.01, bend=1e-4)
    made, params, before = scene.make([rope], [Bend(), RodBody()], bodies=[ball], dt=1e-3, substeps=2)
    control = scene.stationary_control(made, before)
    felt = measures.contact_forces(made, params, before, control)
    after = scene.step(made, params, before, control)
    change = 0.02 * (after.bodies.vel - before.bodies.vel)
    assert felt.force.shape == (5, 3) and felt.body_torque.shape == (1, 3) and float(change[0, 2]) > 1e-3
    torch.testing.assert_close(1e-3 * felt.body_force, change, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(felt.force.sum(0), -felt.body_force[0], rtol=1e-9, atol=1e-12)


def test_a_scene_without_contact_has_no_contact_forces() -> None:
    made, params, state = arc()
    felt = measures.contact_forces(made, params, state, scene.stationary_control(made, state))
    assert felt.force.eq(0).all() and felt.force.shape == (N, 3) and felt.body_force.shape == (0, 3)
