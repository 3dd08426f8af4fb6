"""Ropes and matter: exact momentum, energy, support, buoyancy, gradients."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from material_points import DOUBLE, ONE, OPEN, ball, derivative, momenta

from torchdlo import scene
from torchdlo.coupling import RodMpmCoupling
from torchdlo.coupling.mpm import rod_coupling_op
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.constitutive_models import Elastic, Liquid
from torchdlo.coupling.mpm.particles import Grid, ParticleBlock, assemble, fill_ball, fill_box
from torchdlo.coupling.mpm.rod_coupling_solver import Lines, RodParticleTouch, block_size, exchange, near_size
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity

RADIUS, SPACING = 0.005, 0.01


def lines_through_a_ball(vertices=14):
    """Two scenes, in each a shaken ball that a crooked rope of masses of 1 g runs into."""
    medium, material_points, state = ball(Elastic(), batch=(2,), shake=0.3)
    g = torch.Generator().manual_seed(0)
    pos = torch.zeros(2, vertices, 3, dtype=DOUBLE)
    pos[..., 0], pos[..., 1], pos[..., 2] = torch.linspace(0.0, 0.2, vertices), 0.1, 0.075
    pos = pos + 0.003 * torch.randn(pos.shape, generator=g, dtype=DOUBLE)
    vel = 0.2 * torch.randn(pos.shape, generator=g, dtype=DOUBLE)
    real = torch.ones(vertices, 1, dtype=DOUBLE)
    real[-1] = 0.0
    after = torch.tensor([*range(1, vertices), 0])
    inverse = torch.full((2, vertices, 1), 1e3, dtype=DOUBLE)
    nodes, _ = mpm.to_grid(medium, material_points, state, 0 * ONE, 2e-4, ONE)
    return medium.grid, nodes, Lines(pos, vel, inverse, torch.full((1, 1, 1), RADIUS, dtype=DOUBLE), real, after)


def touch(room=14, sweeps=3):
    return RodParticleTouch(block_size(0.025, RADIUS, SPACING), room, sweeps)


@pytest.fixture
def by_tensors(monkeypatch):
    """No kernel: tensor operations, as on a GPU."""
    monkeypatch.setattr(rod_coupling_op, "ready", lambda *_: False)


def sums(grid, nodes, lines, vel):
    """Linear and angular momentum and energy of nodes and vertices."""
    at = torch.cartesian_prod(*[torch.arange(n, dtype=DOUBLE) for n in grid.size]) * grid.spacing
    at = at + torch.tensor(grid.first, dtype=DOUBLE)
    p, q = nodes.mass[..., None] * nodes.vel, vel / lines.inverse
    turn = torch.linalg.cross(at.expand_as(p), p).sum(1) + torch.linalg.cross(lines.pos, q).sum(1)
    return p.sum(1) + q.sum(1), turn, 0.5 * ((p * nodes.vel).sum((1, 2)) + (q * vel).sum((1, 2)))


@pytest.mark.parametrize("mu", [0.0, 0.3, 5.0])
@pytest.mark.parametrize("sweeps", [1, 3, 30])
@pytest.mark.parametrize("kernel", [True, False], ids=["kernel", "tensors"])
def test_exchange_keeps_momentum_and_never_adds_energy(mu, sweeps, kernel, monkeypatch):
    if not kernel:
        monkeypatch.setattr(rod_coupling_op, "ready", lambda *_: False)
    grid, nodes, lines = lines_through_a_ball()
    friction = torch.full((1, 1, 1), mu, dtype=DOUBLE)
    impulse, after, lost = exchange(grid, nodes, lines, touch(sweeps=sweeps), friction)
    assert float(impulse.norm()) > 1e-4 and float(lost.max()) == 0
    before, later = sums(grid, nodes, lines, lines.vel), sums(grid, after, lines, lines.vel + lines.inverse * impulse)
    # Sums over 10^4 nodes: relative to the sum of sizes.
    size = (nodes.mass[..., None] * nodes.vel.abs()).sum() + (lines.vel.abs() / lines.inverse).sum()
    assert float((later[0] - before[0]).abs().max() / size) < 1e-14
    assert float((later[1] - before[1]).abs().max() / (0.2 * size)) < 1e-14
    assert bool((later[2] < before[2]).all())


def exchanged(friction, sweeps):
    """Impulses and velocities after them, and the derivative of a sum of both by all numbers."""
    grid, nodes, lines = lines_through_a_ball()
    lead = ["vel", "mass", "share"], ["pos", "vel", "inverse"]
    leaves = [
        getattr(x, n).clone().requires_grad_() for x, names in zip((nodes, lines), lead, strict=True) for n in names
    ]
    leaves.append(torch.full((1, 1, 1), friction, dtype=DOUBLE, requires_grad=True))
    nodes = tree.replace(nodes, **dict(zip(lead[0], leaves[:3], strict=True)))
    lines = tree.replace(lines, **dict(zip(lead[1], leaves[3:6], strict=True)))
    impulse, after, _ = exchange(grid, nodes, lines, touch(sweeps=sweeps), leaves[6])
    both = torch.cat([1e3 * impulse.flatten(), after.vel.flatten()])
    weight = torch.sin(torch.arange(len(both), dtype=DOUBLE))
    return both.detach(), torch.autograd.grad((weight * both).sum(), leaves)


@pytest.mark.skipif(not rod_coupling_op.ready("cpu", DOUBLE), reason="there is no C++ compiler")
@pytest.mark.parametrize("mu", [0.0, 0.05, 5.0])
@pytest.mark.parametrize("sweeps", [1, 4])
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(mu, sweeps, monkeypatch):
    found, gradient = exchanged(mu, sweeps)
    monkeypatch.setattr(rod_coupling_op, "ready", lambda *_: False)
    wanted, expected = exchanged(mu, sweeps)
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-14)
    assert all(float(g.abs().max()) > 0 for g in expected)
    for mine, theirs in zip(gradient, expected, strict=True):
        assert float((mine - theirs).abs().max() / theirs.abs().max()) < 1e-11


def test_places_that_are_no_numbers_touch_nothing():
    grid, nodes, lines = lines_through_a_ball()
    lines.pos[0, 4:6] = torch.nan
    impulse, after, _ = exchange(grid, nodes, lines, touch(), torch.full((1, 1, 1), 0.3, dtype=DOUBLE))
    assert bool(after.vel.isfinite().all())
    assert float(impulse[1].norm()) > 0


def test_sweeps_converge():
    grid, nodes, lines = lines_through_a_ball()
    friction = torch.full((1, 1, 1), 0.3, dtype=DOUBLE)
    sizes = [exchange(grid, nodes, lines, touch(sweeps=n), friction)[0] for n in (4, 16, 64, 256)]
    errors = [float((s - sizes[-1]).norm() / sizes[-1].norm()) for s in sizes[:-1]]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_room_for_the_nodes_of_a_capsule_is_enough_and_less_is_said(by_tensors):
    grid, nodes, lines = lines_through_a_ball()
    friction = torch.full((1, 1, 1), 0.3, dtype=DOUBLE)
    sizes = (0.025, RADIUS, SPACING)
    every = RodParticleTouch(block_size(*sizes), 14)
    capsule = dataclasses.replace(every, near=near_size(*sizes))
    assert capsule.near < 0.6 * every.block**3
    wanted, other = (exchange(grid, nodes, lines, t, friction) for t in (every, capsule))
    assert float(other[2].max()) == 0
    torch.testing.assert_close(other[0], wanted[0], rtol=1e-12, atol=1e-18)
    torch.testing.assert_close(other[1].vel, wanted[1].vel, rtol=1e-12, atol=1e-15)
    few = exchange(grid, nodes, lines, dataclasses.replace(every, near=3), friction)
    assert float(few[2].min()) > 0


def test_edges_far_from_matter_need_no_room(by_tensors):
    grid, nodes, lines = lines_through_a_ball(30)
    friction = torch.full((1, 1, 1), 0.3, dtype=DOUBLE)
    everything, _, _ = exchange(grid, nodes, lines, touch(room=30), friction)
    some, _, lost = exchange(grid, nodes, lines, touch(room=20), friction)
    assert float(lost.max()) == 0
    assert torch.allclose(everything, some, atol=1e-18, rtol=0)
    assert float(exchange(grid, nodes, lines, touch(room=4), friction)[2].min()) > 0


def ball_on_rope(law=None, dtype=DOUBLE, gap=0.003, held=(0, 11), batch=(1,), effects=(), speed=0.0, **numbers):
    """A rope along x, and a ball above its middle."""
    x = torch.zeros(*batch, 12, 3, dtype=dtype)
    x[..., 0], x[..., 1], x[..., 2] = torch.linspace(0.02, 0.18, 12), 0.1, 0.1
    rope = scene.Rope(x, radius=RADIUS, density=1000.0, youngs=1e5)
    points = fill_ball((0.1, 0.1, 0.1 + 0.02 + RADIUS + SPACING + gap), 0.02, 0.0064, x)
    velocity = torch.tensor([0.0, 0.0, -speed], dtype=dtype)
    blob = ParticleBlock(points.expand(*batch, *points.shape), law or Elastic(), 0.0064**3, velocity, numbers)
    material_points = assemble([blob], Grid((0.0, 0.05, 0.05), (0.2, 0.15, 0.25), SPACING, OPEN, window=(11, 11, 11)))
    return scene.make(
        [rope], [*effects, Bend(), RodMpmCoupling()], material_points=material_points, prescribed_vertices=held
    )


def go(cable, params, state, steps):
    control = scene.stationary_control(cable, state)
    for _ in range(steps):
        state = scene.step(cable, params, state, control)
    return state


def test_a_ball_and_a_free_rope_keep_their_momentum():
    cable, params, state = ball_on_rope(held=(), speed=1.0)
    mass = params.rods.material.mass

    def whole(state):
        line, turn = momenta(cable.material_points, params.material_points, state.material_points)
        moved = mass * state.rods.vel
        return line + moved.sum(-2), turn + torch.linalg.cross(state.rods.pos, moved).sum(-2), moved.sum(-2)

    before, end = whole(state), go(cable, params, state, 20)
    after = whole(end)
    scale = float(before[0].norm())
    assert float(after[2][..., 2].abs()) > 0.02 * scale  # the rope was hit
    assert float((after[0] - before[0]).norm()) / scale < 1e-12
    # Forces of bending and lengths act between where vertices were and are: their torque is exact, too.
    assert float((after[1] - before[1]).norm()) / (0.1 * scale) < 1e-12
    length = (end.rods.pos[..., 1:, :] - end.rods.pos[..., :-1, :]).norm(dim=-1)
    assert float((length / params.rods.rest.length[..., :-1, 0] - 1).abs().max()) < 1e-8


def test_a_ball_stays_on_a_rope():
    cable, params, state = ball_on_rope(effects=[Gravity()], gap=0.0)
    with torch.no_grad():
        end = go(cable, params, state, 120)
    scene.check_state(end)
    low = float(end.material_points.pos[..., 2].min())
    assert low > float(end.rods.pos[..., 5:7, 2].mean()) + RADIUS
    # Without the rope it would have fallen by g t^2 / 2 = 7 cm.
    assert float(end.material_points.pos[..., 2].mean()) > 0.1


def test_a_scene_is_the_same_alone_and_in_a_batch():
    alone, many = (go(*ball_on_rope(batch=b, effects=[Gravity()], speed=0.5), 10) for b in ((1,), (3, 2)))
    assert many.material_points.pos.shape[:2] == (3, 2)
    assert torch.allclose(many.material_points.pos[2, 1], alone.material_points.pos[0], atol=1e-13, rtol=0)
    assert torch.allclose(many.rods.pos[2, 1], alone.rods.pos[0], atol=1e-13, rtol=0)


def test_single_precision_follows_double():
    single, double = (go(*ball_on_rope(dtype=d, effects=[Gravity()], speed=0.5), 10) for d in (torch.float32, DOUBLE))
    assert single.material_points.pos.dtype == torch.float32
    # 50 substeps that round places of 0.2 m by 1e-8 m, which a grid of 0.01 m turns into speeds of 0.5 m/s times 1e-6.
    assert float((single.material_points.pos - double.material_points.pos).abs().max()) < 1e-5


def test_a_rope_in_a_liquid_feels_the_weight_of_what_it_displaces():
    # A fixed horizontal rope from wall to wall. Liquid is held off by up to a node spacing, so the rope displaces a
    # cylinder of its own radius at least and of one node spacing more at most: rho g pi r^2 per length.
    radius, width, dt = 0.02, 0.12, 5e-4
    across = 2 * SPACING
    x = fill_box((0.0,) * 3, (width, across, width), SPACING / 2, torch.zeros((), dtype=DOUBLE))
    off = (x[:, [0, 2]] - width / 2).norm(dim=-1)
    grid = Grid((0.0,) * 3, (width, across, 0.16), SPACING, ("slip",) * 4 + ("separate",) * 2)
    blob = ParticleBlock(x[off > radius], Liquid(), (SPACING / 2) ** 3, numbers={"bulk": 5e4, "viscosity": 10.0})
    medium, material_points, state = assemble([blob], grid)
    pos = torch.full((1, 5, 3), width / 2, dtype=DOUBLE)
    pos[..., 1] = torch.linspace(-0.5 * across, 1.5 * across, 5)
    real = torch.tensor([1.0, 1, 1, 1, 0], dtype=DOUBLE)[:, None]
    fixed, thick = torch.zeros(1, 5, 1, dtype=DOUBLE), torch.full((1, 1, 1), radius, dtype=DOUBLE)
    lines = Lines(pos, 0 * pos, fixed, thick, real, torch.tensor([1, 2, 3, 4, 0]))
    near = RodParticleTouch(block_size(0.011, radius, SPACING), 5)
    force = []
    with torch.no_grad():
        for _ in range(800):
            nodes, strained = mpm.to_grid(medium, material_points, state, ONE * pos.new_tensor([0, 0, -9.81]), dt, ONE)
            impulse, nodes, _ = exchange(grid, nodes, lines, near, 0 * thick)
            state = mpm.from_grid(medium, material_points, strained, nodes, dt)
            force.append(float(impulse[..., 2].sum()) / dt)
    lift = sum(force[400:]) / 400 / across
    assert 1000 * 9.81 * math.pi * radius**2 < lift < 1000 * 9.81 * math.pi * (radius + SPACING) ** 2


def _value(name):
    """What is asked for the derivative of, as a function of one number."""
    # A straight rope held at both ends could not be moved at all: its lengths would not fit.
    cable, params, state = ball_on_rope(effects=[Gravity()], gap=-0.002, speed=0.5, held=(0,))
    control = scene.stationary_control(cable, state)
    weight = torch.randn(2, 400, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)

    def value(x):
        numbers, start = params, state
        if name == "mu":
            numbers = tree.replace(params, effects={**params.effects, "rod_mpm_coupling": {"mu": x.reshape(1, 1)}})
        elif name == "youngs":
            ((group, law),) = params.material_points.laws.items()
            laws = {group: {**law, "youngs": x.reshape(1, 1)}}
            numbers = tree.replace(params, material_points=tree.replace(params.material_points, laws=laws))
        elif name == "rope":
            start = tree.replace(state, rods=tree.replace(state.rods, pos=state.rods.pos + x * weight[1, :12]))
        else:
            moved = state.material_points.pos + x * weight[1, : state.material_points.pos.shape[-2]]
            start = tree.replace(state, material_points=tree.replace(state.material_points, pos=moved))
        for _ in range(10):
            start = scene.step(cable, numbers, start, control)
        rope, some = start.rods.pos, start.material_points.pos
        return (rope * weight[0, :12]).sum() + (some * weight[0, : some.shape[-2]]).sum()

    return value


@pytest.mark.parametrize(
    ("name", "number", "step"),
    [("mu", 0.1, 1e-5), ("youngs", 1e5, 10.0), ("rope", 0.0, 1e-8), ("material_points", 0.0, 1e-8)],
)
def test_gradients_through_the_exchange_are_central_differences(name, number, step):
    value = _value(name)
    x = torch.tensor(number, dtype=DOUBLE, requires_grad=True)
    (found,) = torch.autograd.grad(value(x), x)
    expected = derivative(value, x.detach(), step)
    assert float(expected.abs()) > 0
    assert float((found - expected).abs() / expected.abs()) < 1e-4


def test_the_effect_needs_matter():
    x = torch.zeros(5, 3)
    x[:, 0] = torch.linspace(0, 1, 5)
    with pytest.raises(ValueError, match="there is no matter"):
        scene.make([scene.Rope(x, radius=0.01, density=1000.0)], [RodMpmCoupling()])


def test_matter_that_is_too_stiff_for_the_step_is_refused():
    with pytest.raises(ValueError, match="sound in elastic_0"):
        ball_on_rope(youngs=1e7)
