"""Rigid bodies and matter: exact momentum, energy, support, buoyancy, friction, gradients."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from material_points import DOUBLE, OPEN, ball, momenta
from meetings import SHAPES, meeting

from torchdlo import scene
from torchdlo.coupling import BodyMpmCoupling
from torchdlo.coupling.bodies.dynamics import RigidBody, conjugate
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.constitutive_models import Elastic, Liquid, Plastic
from torchdlo.coupling.mpm.particles import Grid, ParticleBlock, assemble, fill_box
from torchdlo.coupling.mpm.rod_coupling_effect import RodMpmCoupling
from torchdlo.physics import tree
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.execution import compiled
from torchdlo.physics.linalg.rotation import rotate

SPACING, G = 0.01, 9.81


def world(material_points, bodies, effects=(), gravity=True, dt=1e-3, substeps=5, batch=()):
    """A scene of bodies and matter, with a short held rope far away."""
    x = torch.zeros(*batch, 3, 3, dtype=DOUBLE)
    x[..., 0], x[..., 2] = torch.linspace(0, 0.02, 3), 3.0
    rope = scene.Rope(x, radius=1e-3, density=1000.0, bend=1e-6)
    acting = [*([Gravity()] if gravity else []), *(effects or [BodyMpmCoupling()])]
    made = scene.make(
        [rope],
        acting,
        bodies=bodies,
        material_points=material_points,
        dt=dt,
        substeps=substeps,
        prescribed_vertices=(0, 1, 2),
    )
    return (*made, scene.stationary_control(made[0], made[2]))


def go(made, steps, keep=None):
    """Advance; also return what `keep` says after each step."""
    cable, params, state, control = made
    seen = []
    for _ in range(steps):
        state = scene.step(cable, params, state, control)
        if keep:
            seen.append(keep(state))
    return (state, torch.stack(seen)) if keep else state


def block(low, high, law=None, walls=OPEN, box=((0.0,) * 3, (0.2,) * 3), spacing=0.005, window=None, **numbers):
    x = fill_box(low, high, spacing, torch.zeros((), dtype=DOUBLE))
    volume = math.prod(b - a for a, b in zip(low, high, strict=True)) / len(x)
    blob = ParticleBlock(x, law or Elastic(), volume, numbers=numbers)
    return assemble([blob], Grid(*box, SPACING, walls, window), friction=0.0)


def thrown(vel, mu=0.0, effect=None, batch=(), density=1500.0):
    """A spinning ball above a block that floats in space, at a speed towards it."""
    solid = RigidBody(
        "sphere", 0.02, pos=(0.1, 0.1, 0.105), vel=vel, omega=(0.0, 3.0, 0.0), density=density, mu_s=mu, mu_k=mu
    )
    material_points = block((0.075, 0.075, 0.04), (0.125, 0.125, 0.08), window=(12, 12, 10), youngs=5e4)
    return world(material_points, [solid], [effect or BodyMpmCoupling()], gravity=False, batch=batch)


def whole(params, cable, state):
    """Momentum, angular momentum, and the momentum of the bodies."""
    line, turn = momenta(cable.material_points, params.material_points, state.material_points)
    b, moved = state.bodies, params.bodies.mass * state.bodies.vel
    own = rotate(b.quat, params.bodies.inertia * rotate(conjugate(b.quat), b.omega))
    return line + moved.sum(-2), turn + (torch.linalg.cross(b.pos, moved) + own).sum(-2), moved.sum(-2)


@pytest.mark.parametrize(("vel", "mu"), [((0.0, 0.0, -1.0), 0.0), ((0.5, 0.2, -1.0), 0.0), ((0.5, 0.2, -1.0), 0.5)])
def test_a_ball_and_the_block_that_it_hits_keep_their_momentum(vel, mu):
    cable, params, state, control = thrown(vel, mu)
    before = whole(params, cable, state)
    with torch.no_grad():
        end = go((cable, params, state, control), 14)
    after = whole(params, cable, end)
    scale = float(before[0].norm())
    assert float((after[2] - before[2]).norm()) > 0.5 * scale  # it was hit
    turned = float((end.bodies.omega - state.bodies.omega).norm())
    assert turned > 1.0 if mu else turned < 1e-9  # a smooth ball does not begin to spin
    assert float((after[0] - before[0]).norm()) / scale < 1e-12
    assert float((after[1] - before[1]).norm()) / (0.1 * scale) < 1e-12


def sums(grid, nodes, motion, impulse, torque):
    """Momentum, angular momentum and energy of nodes and bodies that got impulses."""
    p, b = nodes.mass[..., None] * nodes.vel, motion.state
    q = motion.params.mass * motion.change / motion.dt + impulse
    own = rotate(b.quat, motion.params.inertia * rotate(conjugate(b.quat), motion.turn / motion.dt)) + torque
    turn = torch.linalg.cross(mpm.places(grid, nodes), p).sum(1)
    turn = turn + (torch.linalg.cross(b.pos.expand_as(q), q) + own).sum(1)
    spin = rotate(conjugate(b.quat).expand(*own.shape[:-1], 4), own)
    kinetic = (p * nodes.vel).sum((1, 2)) + (q * q / motion.params.mass + spin**2 / motion.params.inertia).sum((1, 2))
    return p.sum(1) + q.sum(1), turn, 0.5 * kinetic


@pytest.mark.parametrize("sweeps", [1, 4, 30])
@pytest.mark.parametrize("names", [*([n] for n in SHAPES if n != "plane"), ["box", "sphere"]], ids="-".join)
def test_bodies_of_all_shapes_keep_momentum_and_never_add_energy(names, sweeps):
    grid, nodes, after, motion, (impulse, torque, lost) = meeting(names, BodyMpmCoupling(sweeps=sweeps, recovery=0.0))
    assert float(impulse.norm()) > 1e-4 and float(lost.max()) == 0
    before = sums(grid, nodes, motion, torch.zeros_like(impulse), torch.zeros_like(torque))
    later = sums(grid, after, motion, impulse, torque)
    # Sums over 10^4 nodes: relative to the sum of sizes.
    size = float((nodes.mass[..., None] * nodes.vel.abs()).sum())
    assert float((later[0] - before[0]).abs().max()) / size < 1e-14
    assert float((later[1] - before[1]).abs().max()) / (0.2 * size) < 1e-14
    assert bool((later[2] < before[2]).all())


def test_sweeps_converge():
    found = [meeting(["box"], BodyMpmCoupling(sweeps=n))[4][0] for n in (4, 16, 64, 256)]
    errors = [float((f - found[-1]).norm() / found[-1].norm()) for f in found[:-1]]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_nodes_far_from_bodies_need_no_room():
    everything, some = (meeting(["box", "sphere"], BodyMpmCoupling(room=n)) for n in (0, 1000))
    assert float(some[4][2].max()) == 0
    assert torch.allclose(everything[4][0], some[4][0], atol=1e-16, rtol=0)
    assert torch.allclose(everything[2].vel, some[2].vel, atol=1e-13, rtol=0)
    assert float(meeting(["box", "sphere"], BodyMpmCoupling(room=50))[4][2].min()) > 0


def test_nodes_without_room_are_reported():
    end = go(thrown((0.0, 0.0, -1.0), effect=BodyMpmCoupling(room=10)), 14)
    assert not bool(scene.ok(end))


def test_a_box_comes_to_rest_on_a_block_at_the_depth_of_its_weight():
    # A column between smooth walls under a plate. Without Poisson's effect Cauchy's stress is E (s - 1), s the stretch:
    # the column is shorter by (W / A L + rho g L^2 / 2) / E. The grid knows where the plate is to half a node spacing.
    side, height, youngs, density, mass = 0.04, 0.06, 4e3, 500.0, 0.16
    walls = ("slip",) * 4 + ("separate", "open")
    made = world(
        block(
            (0.0,) * 3,
            (side, side, height),
            Elastic(),
            walls,
            ((0.0,) * 3, (side, side, 0.12)),
            youngs=youngs,
            poisson=0.0,
            density=density,
        ),
        [RigidBody("box", (0.05, 0.05, 0.01), pos=(0.02, 0.02, 0.071), mass=mass, damping=60.0)],
        substeps=1,
    )
    with torch.no_grad():
        end, height_then = go(made, 500, keep=lambda s: s.bodies.pos[0, 2])
    load = mass * G / side**2
    depth = (load * height + 0.5 * density * G * height**2) / youngs
    assert float(height_then[-50:].max() - height_then[-50:].min()) < 1e-4  # it rests
    assert abs(float(height_then[-1]) - 0.01 - (height - depth)) < 0.5 * SPACING
    # The virial of what is at rest: volume times stress is force times height, of plate and gravity. The plate's force
    # acts at nodes that are up to one spacing off it.
    stretch = (1 + end.material_points.strain[:, 2]).sqrt()
    stress = youngs * (stretch.square() - stretch)  # Kirchhoff's
    volume, z = made[1].material_points.volume[:, 0], end.material_points.pos[:, 2]
    pressed = -(volume * (stress + density * G * z)).sum() / (mass * G)
    assert abs(float(pressed) - (float(height_then[-1]) - 0.01)) < SPACING


def test_a_floating_cylinder_displaces_its_weight():
    # From wall to wall. The grid knows its surface to half a node spacing.
    radius, width, density = 0.02, 0.12, 600.0
    across = 2 * SPACING
    x = fill_box((0.0,) * 3, (width, across, 0.08), SPACING / 2, torch.zeros((), dtype=DOUBLE))
    at = 0.075
    x = x[(x[:, [0, 2]] - x.new_tensor([width / 2, at])).norm(dim=-1) > radius]
    grid = Grid((0.0,) * 3, (width, across, 0.14), SPACING, ("slip",) * 4 + ("separate",) * 2)
    water = assemble([ParticleBlock(x, Liquid(), (SPACING / 2) ** 3, numbers={"bulk": 5e4, "viscosity": 10.0})], grid)
    cylinder = RigidBody(
        "cylinder",
        (radius, 0.1),
        (width / 2, across / 2, at),
        (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
        mass=density * math.pi * radius**2 * across,
        inertia=(1e-5,) * 3,
        damping=5.0,
        mu_s=0.0,
        mu_k=0.0,
    )
    made = world(water, [cylinder], [BodyMpmCoupling(room=400)], dt=5e-4, substeps=1)
    with torch.no_grad():
        _, height = go(made, 800, keep=lambda s: s.bodies.pos[0, 2])
    height = float(height[-200:].mean())

    def wet(depth, r):
        return r * r * math.acos((r - depth) / r) - (r - depth) * math.sqrt(depth * (2 * r - depth))

    for off, sign in ((-0.5 * SPACING, 1), (0.5 * SPACING, -1)):
        # The cylinder that displaces as much as this one of a radius that is half a spacing off, and water around it.
        r, low, high = radius + off, 0.0, 2 * (radius + off)
        for _ in range(60):
            depth = 0.5 * (low + high)
            low, high = (depth, high) if wet(depth, r) < density / 1000 * math.pi * radius**2 else (low, depth)
        surface = (len(x) * (SPACING / 2) ** 3 / across + wet(depth, r)) / width
        assert sign * (height - (surface + r - depth)) > 0


def test_liquid_stays_in_a_box_of_bodies():
    thick, half, tall = 0.02, 0.03, 0.03
    middle = (0.07, 0.07)
    walls = [RigidBody("box", (half + 2 * thick, half + 2 * thick, thick), (*middle, 0.04), motion="fixed")]
    for axis in (0, 1):
        for side in (-1, 1):
            place_, size = [*middle, 0.06 + tall], [half + 2 * thick] * 2 + [tall]
            place_[axis] += side * (half + thick)
            size[axis] = thick
            walls.append(RigidBody("box", tuple(size), tuple(place_), motion="fixed", mu_s=0.0, mu_k=0.0))
    water = block((0.045, 0.045, 0.06), (0.095, 0.095, 0.1), Liquid(), window=(12, 12, 10), bulk=2e4)
    made = world(water, walls, [BodyMpmCoupling(sweeps=3, room=800)], substeps=1)
    with torch.no_grad():
        end = go(made, 250)
    scene.check_state(end)
    x = end.material_points.pos
    assert float((x[:, :2] - x.new_tensor(middle)).abs().max()) < half + 0.5 * SPACING
    assert float(x[:, 2].min()) > 0.06 - 0.5 * SPACING
    # It has spread from wall to wall: 4 cm deep by 5^2 cm^2 are 2.8 cm by 6^2 cm^2.
    assert float(x[:, 2].mean()) == pytest.approx(0.06 + 0.5 * 0.04 * (0.05 / 0.06) ** 2, abs=0.5 * SPACING)


def sliding(slope, mu, velocity, steps):
    """Mean velocity over time of a block on a fixed plane that slopes down towards +x."""
    c, s = math.cos(slope), math.sin(slope)
    x = fill_box((-0.03, -0.02, 0.0), (0.03, 0.02, 0.03), 0.005, torch.zeros((), dtype=DOUBLE)) + 0.0
    down, up = x.new_tensor([c, 0.0, -s]), x.new_tensor([s, 0.0, c])
    x = x[:, :1] * down + x[:, 1:2] * x.new_tensor([0.0, 1.0, 0.0]) + (x[:, 2:] + 0.003) * up
    grid = Grid((-0.1, -0.05, -0.1), (0.2, 0.05, 0.1), SPACING, OPEN, window=(13, 9, 11))
    stuff = assemble([ParticleBlock(x, Elastic(), 0.005**3, velocity * down, {"youngs": 5e4})], grid)
    plane = RigidBody(
        "plane", quat=(math.cos(slope / 2), 0.0, math.sin(slope / 2), 0.0), motion="fixed", mu_s=mu, mu_k=mu
    )
    with torch.no_grad():
        return go(world(stuff, [plane]), steps, keep=lambda s: s.material_points.vel.mean(0) @ down)[1]


def test_a_block_slides_with_coulomb_friction_and_sticks_below_its_angle():
    # v' = g (sin a - mu cos a) while it slides. Over 0.05 s, 3 times the block's slowest period, 4 height / c.
    slope, mu = 0.3, 0.2
    speed = sliding(slope, mu, 0.5, 80)
    rate = float(speed[-1] - speed[29]) / 0.05
    # Where it still bounces at 1 cm/s, the mean normal force is off by 1 cm/s over g cos a 0.05 s, 2 % of it.
    friction = mu * math.cos(slope) * G
    assert abs(rate - (G * math.sin(slope) - friction)) < 0.02 * friction
    assert abs(float(sliding(slope, 0.5, 0.0, 40)[-1])) < 1e-3


def test_matter_does_not_stay_inside():
    stuff = block((0.055,) * 3, (0.145,) * 3, Liquid(), spacing=SPACING, window=(14,) * 3, bulk=2e4)
    made = world(stuff, [RigidBody("sphere", 0.04, (0.1,) * 3, motion="fixed")], gravity=False, substeps=1)

    def depth(state):
        return (0.04 - (state.material_points.pos - 0.1).norm(dim=-1)).clamp(min=0.0).sum()

    with torch.no_grad():
        _, left = go(made, 150, keep=depth)
    assert float(left[-1]) < 0.5 * float(left[0])


def test_a_scene_is_the_same_alone_and_in_a_batch():
    with torch.no_grad():
        alone, many = (go(thrown((0.5, 0.0, -1.0), 0.4, batch=b), 14) for b in ((), (3,)))
    assert many.bodies.pos.shape == (3, 1, 3)
    assert float((alone.bodies.vel - alone.bodies.vel.new_tensor([0.5, 0.0, -1.0])).norm()) > 0.1
    for now in range(3):
        assert torch.allclose(many.bodies.pos[now], alone.bodies.pos, atol=1e-13, rtol=0)
        assert torch.allclose(many.material_points.pos[now], alone.material_points.pos, atol=1e-13, rtol=0)


def test_gradients_of_200_substeps_are_central_differences():
    weight = torch.randn(800, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)

    def values(speed, youngs):
        """One scene per speed of the ball and modulus of the block."""
        cable, params, state, control = thrown((0.5, 0.0, -1.0), 0.3, BodyMpmCoupling(sweeps=2), batch=speed.shape)
        ((group, law),) = params.material_points.laws.items()
        laws = {group: {**law, "youngs": youngs.reshape(-1, 1, 1)}}
        numbers = tree.replace(params, material_points=tree.replace(params.material_points, laws=laws))
        vel = torch.cat([state.bodies.vel[..., :2], speed.reshape(-1, 1, 1)], -1)
        start = tree.replace(state, bodies=tree.replace(state.bodies, vel=vel))
        controls = tree.map(lambda c: c.expand(40, *c.shape), control)
        end, _ = scene.rollout(partial(scene.step, cable), numbers, start, controls, segment=5, keep=lambda s: s.time)
        return (end.bodies.pos * weight[0]).sum((-1, -2)) + (end.material_points.pos * weight).sum((-1, -2)) / 800

    at = [torch.tensor([x], dtype=DOUBLE, requires_grad=True) for x in (-1.0, 5e4)]
    found = torch.autograd.grad(values(*at).sum(), at)
    h = (1e-6, 0.05)
    with torch.no_grad():
        moves = torch.tensor([[h[0], 0.0], [-h[0], 0.0], [0.0, h[1]], [0.0, -h[1]]], dtype=DOUBLE)
        ends = values(*(x + move for x, move in zip(at, moves.T, strict=True)))
    for k in (0, 1):
        expected = (ends[2 * k] - ends[2 * k + 1]) / (2 * h[k])
        assert float((found[k] - expected).abs() / expected.abs()) < 1e-4


@pytest.mark.compile
@pytest.mark.slow
def test_compiled_steps_are_the_same(monkeypatch):
    monkeypatch.setattr(compiled, "compile_graph", lambda graph, examples, options: graph.forward)
    cable, params, state, control = thrown((0.5, 0.0, -1.0), 0.3, batch=(2,))
    found = {}
    for execution in ("eager", "compiled"):
        vel = state.bodies.vel.clone().requires_grad_()
        end, step = (
            tree.replace(state, bodies=tree.replace(state.bodies, vel=vel)),
            scene.stepper(cable, execution=execution),
        )
        for _ in range(3):
            end = step(params, end, control)
        found[execution] = torch.autograd.grad(end.material_points.pos.square().sum(), vel)[0]
    assert float(found["eager"].abs().max()) > 0
    # The same operations in the same order.
    assert torch.allclose(found["compiled"], found["eager"], rtol=1e-12, atol=1e-15)


def test_a_body_and_a_rope_touch_the_same_matter():
    solid = RigidBody("sphere", 0.02, pos=(0.1, 0.1, 0.105), vel=(0.0, 0.0, -1.0), density=1500.0)
    material_points = block((0.07, 0.07, 0.05), (0.13, 0.13, 0.08), box=((0.0,) * 3, (0.2, 0.2, 0.16)), youngs=5e4)
    x = torch.zeros(9, 3, dtype=DOUBLE)
    x[:, 0], x[:, 1], x[:, 2] = torch.linspace(0.02, 0.18, 9), 0.1, 0.032
    rope = scene.Rope(x, radius=0.005, density=1000.0, bend=1e-4)
    made = scene.make([rope], [RodMpmCoupling(), BodyMpmCoupling()], bodies=[solid], material_points=material_points)
    cable, params, state = made
    mass = params.rods.material.mass
    before = whole(params, cable, state)[0]
    with torch.no_grad():
        end = go((*made, scene.stationary_control(cable, state)), 30)
    felt = mass * end.rods.vel
    after = whole(params, cable, end)
    assert float(felt[:, 2].sum()) < -0.02 * float(before.norm())  # the ball pushes the block onto the rope
    assert float((after[0] + felt.sum(-2) - before).norm() / before.norm()) < 1e-12


def test_planes_may_be_left_to_walls():
    floor = RigidBody("plane", pos=(0.0, 0.0, 0.04), motion="fixed")
    ball = RigidBody("sphere", 0.02, pos=(0.1, 0.1, 0.105), vel=(0.0, 0.0, -1.0), density=1500.0)
    material_points = block((0.075, 0.075, 0.04), (0.125, 0.125, 0.08), youngs=5e4)

    def met(solids, **choices):
        return go(world(material_points, solids, [BodyMpmCoupling(**choices)], gravity=False), 10)

    alone, both, left = met([ball]), met([floor, ball]), met([floor, ball], planes=False)
    assert torch.equal(left.material_points.pos, alone.material_points.pos)
    assert torch.equal(left.bodies.vel[1], alone.bodies.vel[0]) and not left.bodies.vel[0].any()
    assert float((both.material_points.pos - alone.material_points.pos).abs().max()) > 1e-4
    assert torch.equal(met([floor], planes=False).material_points.pos, material_points[2].pos)


def test_the_effect_needs_bodies_and_matter():
    solid, material_points = RigidBody("sphere", 0.02, density=100.0), block((0.07,) * 3, (0.1,) * 3)
    with pytest.raises(ValueError, match="BodyMpmCoupling is among the effects, but there is no matter"):
        world((), [solid])
    with pytest.raises(ValueError, match="BodyMpmCoupling or FingerPads needs bodies, but there are none"):
        world(material_points, [])


@pytest.mark.parametrize("wrong", [{"sweeps": 0}, {"room": -1}, {"reach": -0.1}, {"recovery": -1.0}])
def test_choices_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=f"BodyMpmCoupling: {next(iter(wrong))} is"):
        BodyMpmCoupling(**wrong)


@pytest.mark.parametrize("what", ["youngs", "rope", "body"])
def test_numbers_of_more_scenes_than_the_matter_make_as_many(what):
    """One ball, three numbers of its law, of its friction with the rope, or of that with the ground."""

    def moved(number):
        given = {"youngs": 3e4, "rope": 0.3, "body": 0.3} | {what: number}
        matter = ball(Plastic(), shake=0.3, youngs=given["youngs"])
        line = torch.tensor([[0.05 + 0.025 * k, 0.1, 0.125] for k in range(5)], dtype=DOUBLE)
        rope = scene.Rope(line, radius=3e-3, density=1e3)
        ground = RigidBody("plane", motion="fixed", pos=(0.0, 0.0, 0.07), mu_s=given["body"], mu_k=given["body"])
        made, params, state = scene.make(
            [rope],
            [RodMpmCoupling(), BodyMpmCoupling()],
            {"rod_mpm_coupling": {"mu": given["rope"]}},
            bodies=[ground],
            material_points=matter,
        )
        last = go((made, params, state, scene.stationary_control(made, state)), 4)
        return torch.cat([last.material_points.pos, last.rods.pos], -2)

    numbers = torch.tensor([1e4, 5e4, 2e5] if what == "youngs" else [0.0, 0.9, 0.3], dtype=DOUBLE)
    per_scene = {"youngs": (3,), "rope": (3, 1, 1), "body": (3, 1)}[what]
    together, alone = moved(numbers.reshape(per_scene)), [moved(float(x)) for x in numbers]
    torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-14)
    assert all(float((x - alone[0]).abs().max()) > 1e-7 for x in alone[1:])
