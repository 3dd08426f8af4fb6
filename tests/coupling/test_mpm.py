"""The material point method: transfers, conservation, stability, batches, precision, gradients."""

from __future__ import annotations

import math

import pytest
import torch
from material_points import DOUBLE, ONE, OPEN, ball, derivative, momenta, run, with_number

from torchdlo import scene
from torchdlo.coupling.mpm import p2g_g2p, transfer_op
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.constitutive_models import Elastic, Liquid, Plastic, Sand
from torchdlo.coupling.mpm.particles import Grid, ParticleBlock, assemble, fill_box
from torchdlo.physics import tree

LAWS = [Elastic(), Plastic(), Sand(), Liquid()]


def _transfer_case():
    g = torch.Generator().manual_seed(0)
    size = (7, 6, 8)
    room = torch.tensor([4.0, 3.0, 5.0], dtype=DOUBLE)[:, None]
    at = 1 + torch.rand(2, 3, 20, generator=g, dtype=DOUBLE) * room
    shapes = (2, 4, 20), (2, 9, 20), (2, 7 * 6 * 8, 4)
    return size, at, *(torch.randn(s, generator=g, dtype=DOUBLE) for s in shapes)


def test_transfers_have_the_derivatives_that_they_say():
    size, *tensors = _transfer_case()
    at, value, gradient, grid = (t.requires_grad_() for t in tensors)
    assert torch.autograd.gradcheck(lambda a, v, s: p2g_g2p.particles_to_grid(a, v, s, size), (at, value, gradient))
    assert torch.autograd.gradcheck(lambda a, g: p2g_g2p.grid_to_particles(a, g, size), (at, grid))


@pytest.mark.skipif(not transfer_op.ready("cpu", DOUBLE), reason="there is no C++ compiler")
@pytest.mark.parametrize("lost", [False, True])
def test_the_kernel_does_what_tensor_operations_do(lost, monkeypatch):
    size, at, value, gradient, _ = _transfer_case()
    value[:, 3] = value[:, 3].abs() + 0.1
    value[0, 3, 5] = 0.0
    if lost:
        at[0, :, 0], at[1, 1, 1], at[1, 0, 2] = -5.0, 15.0, torch.nan
    tensors = [t.requires_grad_() for t in (at, value, gradient)]
    weight = torch.sin(torch.arange(2 * 7 * 6 * 8 * 4, dtype=DOUBLE)).reshape(2, -1, 4)

    def everything():
        vel, mass = transfer_op.give_to_nodes(*tensors, size)
        # Where little mass is, velocities are large.
        said = (weight[..., :3] * mass.detach().nan_to_num().unsqueeze(-1) * vel).sum() + (weight[..., 3] * mass).sum()
        return vel.detach(), mass.detach(), *torch.autograd.grad(said, tensors)

    fast = everything()
    monkeypatch.setattr(transfer_op, "ready", lambda *_: False)
    for a, b in zip(fast, everything(), strict=True):
        assert a.shape == b.shape
        known = a.isfinite() & b.isfinite() if lost else torch.ones_like(a, dtype=torch.bool)
        assert float(known.double().mean()) > 0.4
        assert float((a - b)[known].abs().max()) < 1e-10 * float(b[known].abs().max())


def test_affine_fields_survive_the_way_to_the_grid_and_back():
    # APIC: v and C of a rigid turn and stretch are the same after both transfers (Jiang et al. 2015).
    medium, material_points, state = ball(Elastic())
    c = torch.tensor([[0.3, -1.0, 0.2], [1.0, 0.1, 0.5], [-0.4, 0.2, -0.7]], dtype=DOUBLE)
    state = tree.replace(state, vel=state.pos @ c.T, affine=c.reshape(9).expand(*state.pos.shape[:-1], 9))
    nodes, strained = mpm.to_grid(medium, material_points, tree.replace(state), 0 * ONE, 1e-30, ONE)
    after = mpm.from_grid(medium, material_points, strained, nodes, 1e-30)
    assert torch.allclose(after.vel, state.vel, atol=1e-12)
    assert torch.allclose(after.affine, state.affine, atol=1e-10)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_block_falls_freely_on_a_parabola(law):
    medium, material_points, state = ball(law)
    start = tree.replace(state, vel=torch.tensor([0.2, -0.1, 0.3], dtype=DOUBLE).expand_as(state.vel))
    end, t = run(medium, material_points, start, 100, 2e-4, (0.0, 0.0, -9.81)), 100 * 2e-4
    fallen = start.pos + start.vel * t + 0.5 * torch.tensor([0, 0, -9.81], dtype=DOUBLE) * t**2
    assert torch.allclose(end.pos, fallen, atol=1e-12)  # Stoermer-Verlet is exact for parabolas


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_momentum_is_exact(law):
    medium, material_points, state = ball(law, shake=0.3)
    before = momenta(medium, material_points, state)
    after = momenta(medium, material_points, run(medium, material_points, state, 100, 2e-4))
    size = (mpm.density(medium, material_points) * material_points.volume).sum() * 0.3
    assert float((after[0] - before[0]).norm() / size) < 1e-12
    assert float((after[1] - before[1]).norm() / (size * 0.1)) < 1e-12


def _energy(medium, material_points, state):
    """Kinetic, with that of the affine fields, and elastic energy of small strains [J]."""
    mass = mpm.density(medium, material_points) * material_points.volume
    inner = medium.grid.spacing**2 / 4 * state.affine.square().sum(-1, keepdim=True)
    kinetic = 0.5 * (mass * (state.vel.square().sum(-1, keepdim=True) + inner)).sum()
    stress, deformed = mpm.deform(medium, material_points, state, 1e-30)
    weight = state.pos.new_tensor([1, 1, 1, 2, 2, 2])
    return kinetic + 0.25 * (material_points.volume * stress * deformed.strain * weight).sum()


def _bar(spacing, grid_spacing, length=0.2):
    x = fill_box((0.05, 0.09, 0.09), (0.05 + length, 0.11, 0.11), spacing, torch.zeros((), dtype=DOUBLE))
    grid = Grid((0.0,) * 3, (0.3, 0.2, 0.2), grid_spacing, OPEN)
    medium, material_points, state = assemble(
        [ParticleBlock(x, Elastic(), spacing**3, numbers={"youngs": 1e5, "poisson": 0.0})], grid
    )
    mode = torch.cos(math.pi * (state.pos[..., :1] - 0.05) / length)
    along = torch.tensor([1.0, 0.0, 0.0], dtype=DOUBLE)
    return medium, material_points, tree.replace(state, vel=0.01 * mode * along), mode


@pytest.mark.parametrize("spacing", [0.01, 0.005])
def test_a_free_bar_rings_at_half_a_wavelength(spacing):
    # f = c / (2 L), c = sqrt(E / rho). The mass at each end is seen as up to half a node spacing further out or in, so
    # L is known to one node spacing.
    medium, material_points, state, mode = _bar(spacing / 2, spacing)
    c, length, dt = 10.0, 0.2, 0.25 * spacing / 10.0
    steps = round(2.2 * 2 * length / c / dt)
    _, seen = run(medium, material_points, state, steps, dt, keep=lambda s: (s.vel[..., :1] * mode).mean())
    signs = torch.sign(seen)
    at = (signs[1:] != signs[:-1]).nonzero()[:, 0]
    crossings = at + seen[at] / (seen[at] - seen[at + 1])
    period = 2 * dt * float((crossings[-1] - crossings[0]) / (len(crossings) - 1))
    assert abs(period * c / (2 * length) - 1) < spacing / length
    assert len(crossings) >= 4


def test_energy_does_not_grow():
    medium, material_points, state, _ = _bar(0.005, 0.01)
    dt, period = 5e-4, 2 * 0.2 / 10.0
    _, seen = run(
        medium, material_points, state, 5 * round(period / dt), dt, keep=lambda s: _energy(medium, material_points, s)
    )
    # Velocities live half a substep earlier, so the sum swings by w dt / 2 twice per period; its means over periods do
    # so in second order only.
    means = seen.reshape(5, -1).mean(1)
    swing = math.pi / period * dt
    assert bool((means.diff() < swing**2 * means[:-1]).all())
    # What transfers smooth away: the longest mode keeps most of its energy for five periods.
    assert float(means[-1] / means[0]) > 0.5


def test_a_window_changes_nothing():
    whole = ball(Elastic(), shake=0.3)
    some = ball(Elastic(), shake=0.3, grid=Grid((0.0,) * 3, (0.2,) * 3, 0.01, OPEN, window=(12, 12, 13)))
    a, b = (run(*scene, 50, 2e-4, (0.0, 0.0, -9.81)) for scene in (whole, some))
    assert torch.allclose(a.pos, b.pos, atol=1e-13)
    assert float(mpm.outside(some[0].grid, b.pos)) == 0


def test_matter_that_leaves_the_window_is_counted():
    medium, _, state = ball(Elastic(), grid=Grid((0.0,) * 3, (0.2,) * 3, 0.01, OPEN, window=(5, 12, 12)))
    assert float(mpm.outside(medium.grid, state.pos)) > 100


def test_a_batch_is_its_scenes():
    scenes = ball(Plastic(), batch=(2, 3), shake=0.5)
    end = run(*scenes, 20, 2e-4)
    assert end.pos.shape[:2] == (2, 3)
    medium, material_points, state = scenes
    alone = tree.map(lambda x: x[1, 2], state)
    one = run(medium, tree.map(lambda x: x[1, 2] if x.shape[:2] == (2, 3) else x, material_points), alone, 20, 2e-4)
    assert torch.allclose(end.pos[1, 2], one.pos, atol=1e-14)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_single_precision_follows_double(law):
    scene = ball(law, radius=0.02, shake=0.3)
    single = run(scene[0], *(tree.to(x, torch.float32) for x in scene[1:]), 100, 2e-4)
    assert single.pos.dtype == torch.float32
    # Places of 0.1 m are rounded by 4e-9 m in each of 100 substeps, 4e-7 of a node spacing; they move 6e-3 m meanwhile.
    assert float((single.pos - run(*scene, 100, 2e-4).pos).abs().max()) < 1e-5


def test_unstable_substeps_are_refused_with_the_term_that_limits_them():
    medium, material_points, _ = ball(Elastic(), youngs=1e6)
    with pytest.raises(ValueError, match="sound in elastic_0"):
        mpm.check_step(medium, material_points, 2e-4)
    medium, material_points, _ = ball(Liquid(), viscosity=100.0)
    with pytest.raises(ValueError, match="viscosity of liquid_0"):
        mpm.check_step(medium, material_points, 2e-4)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_substeps_at_the_limit_are_stable(law):
    medium, material_points, state = ball(law, radius=0.025, shake=0.01)
    dt = min(mpm.limits(medium, material_points).values())
    mpm.check_step(medium, material_points, 0.999 * dt)
    assert float(run(medium, material_points, state, 300, dt).vel.norm(dim=-1).max()) < 0.05


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (dict(numbers={"bulk": 1e5}), "has no number 'bulk'"),
        (dict(numbers={"youngs": -1.0}), "youngs is"),
        (dict(numbers={"poisson": 0.5}), "poisson is"),
        (dict(volume=0.0), "volume has to be positive"),
        (dict(positions=torch.full((4, 3), 0.3)), "inside the box"),
        (dict(positions=torch.zeros(4, 2)), "expected a float tensor"),
    ],
)
def test_bad_matter_is_refused_with_a_sentence(given, sentence):
    fields = dict(positions=torch.full((4, 3), 0.1), law=Elastic(), volume=1e-6) | given
    with pytest.raises(ValueError, match=sentence):
        assemble([ParticleBlock(**fields)], Grid((0.0,) * 3, (0.2,) * 3, 0.01))


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (dict(high=(0.2, 0.2, 0.205)), "expected a whole number"),
        (dict(spacing=0.0), "expected a positive length"),
        (dict(walls=("sticky",) * 6), "expected six of"),
        (dict(window=(4, 8, 8)), "at least 5"),
    ],
)
def test_bad_grids_are_refused_with_a_sentence(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        Grid(**(dict(low=(0.0,) * 3, high=(0.2,) * 3, spacing=0.01) | given))


CASES = [
    (Elastic(), "youngs", 1e5),
    (Elastic(), "density", 1000.0),
    (Plastic(), "yield_stress", 200.0),
    (Plastic(), "poisson", 0.3),
    (Sand(), "friction_angle", 0.5),
    (Liquid(), "bulk", 1e5),
    (Liquid(), "viscosity", 1.0),
]


@pytest.mark.parametrize(("law", "name", "number"), CASES, ids=lambda v: getattr(v, "name", v))
def test_gradients_of_numbers_are_central_differences(law, name, number):
    # A ball falls on the floor of the box; 50 substeps.
    grid = Grid((0.0, 0.0, 0.07), (0.2, 0.2, 0.17), 0.01)
    medium, material_points, state = ball(law, radius=0.02, shake=0.1, grid=grid, **{name: number})
    state = tree.replace(state, vel=state.vel + state.pos.new_tensor([0.2, 0.0, -1.0]))
    weight = torch.randn(state.pos.shape, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)

    def value(x):
        end = run(medium, with_number(material_points, name, x), state, 50, 2e-4, (0.0, 0.0, -9.81))
        return (weight * end.pos).sum() + 1e-3 * (weight * end.vel).sum()

    x = torch.tensor([[number]], dtype=DOUBLE, requires_grad=True)
    (found,) = torch.autograd.grad(value(x), x)
    expected = derivative(value, x.detach(), 1e-4 * number)
    assert float(expected.abs()) > 0
    assert float((found - expected).abs() / expected.abs()) < 1e-4


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_gradients_of_the_start_are_central_differences(law):
    grid = Grid((0.0, 0.0, 0.07), (0.2, 0.2, 0.17), 0.01)
    medium, material_points, state = ball(law, radius=0.02, shake=0.1, grid=grid)
    state = tree.replace(state, vel=state.vel + state.pos.new_tensor([0.2, 0.0, -1.0]))
    g = torch.Generator().manual_seed(1)
    weight, moved, sped = (torch.randn(state.pos.shape, generator=g, dtype=DOUBLE) for _ in range(3))

    def value(x):
        start = tree.replace(state, pos=state.pos + x * moved, vel=state.vel + 100 * x * sped)
        return (weight * run(medium, material_points, start, 100, 2e-4, (0.0, 0.0, -9.81)).pos).sum()

    x = torch.zeros((), dtype=DOUBLE, requires_grad=True)
    (found,) = torch.autograd.grad(value(x), x)
    expected = derivative(value, x.detach(), 1e-7)
    assert float((found - expected).abs() / expected.abs()) < 1e-4


def test_matter_of_another_precision_than_the_rope_is_read_as_numbers_of_its_own():
    found = []
    for kind in (torch.float32, torch.float64):
        places = fill_box((0.075, 0.075, 0.0), (0.125, 0.125, 0.04), 0.01, torch.zeros((), dtype=kind))
        block = ParticleBlock(places, Plastic(), 1e-6, velocity=torch.tensor([0, 0, -1.0], dtype=kind))
        matter = assemble([block], Grid((0.0,) * 3, (0.2,) * 3, 0.01), friction=0.3)
        x = torch.tensor([[0.0, 0, 3], [0.01, 0, 3], [0.02, 0, 3]], dtype=torch.float64)
        rope = scene.Rope(x, radius=1e-3, density=1000.0)
        made, params, state = scene.make([rope], [], material_points=matter, dt=1e-3, prescribed_vertices=(0, 1, 2))
        state = scene.step(made, params, state, scene.stationary_control(made, state))
        found.append(state.material_points)
    assert found[0].vel.norm() > 1
    torch.testing.assert_close(found[0].vel, found[1].vel, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found[0].strain, found[1].strain, rtol=1e-4, atol=1e-6)
