"""Ropes that meet: momentum, rebound, friction, and nothing passes through."""

from __future__ import annotations

import math

import pytest
import torch
from touching import F64, distances, line, momenta, nearest, run, two, with_velocity

from torchdlo.coupling import RodContact
from torchdlo.coupling.common.step_diagnostics import broad_phase
from torchdlo.coupling.rod_contact import rod_contact_op as rod_pairs
from torchdlo.physics import tree
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.base import PredictedMotion
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.physics.rod import kinematics as rod
from torchdlo.scene import Rope, check_state, finite, make, ok, stationary_control, step

ANGLES = pytest.mark.parametrize("angle", [0.0, math.pi / 6, math.pi / 2], ids=["parallel", "inclined", "crossed"])
RUBBING = {"mu_s": 0.5, "mu_k": 0.4, "restitution": 0.3}


def solved(scene, params, state, dt: float):
    """Contacts, their forces, and the forces on vertices, for free motion from a state."""
    control = stationary_control(scene, state)
    values = broad_phase(scene, params, state, control, control).effects["rod_contact"]
    rods = effect.altered_params(scene.effects, scene.topology, params.rods, params.effects)
    view = rod.view(scene.topology, rods, state.rods, dt)
    mobility = (dt * dt / rods.material.mass).expand_as(state.rods.pos)
    motion = PredictedMotion(dt * state.rods.vel, mobility, mobility)
    contact = next(e for e in scene.effects if e.name == "rod_contact")
    return (*contact.solve(view, motion, values)[:2], contact.solve_contact(view, motion, values), values)


@ANGLES
@pytest.mark.parametrize("values", [{}, RUBBING], ids=["smooth", "rubbing"])
def test_forces_of_a_pair_have_no_sum_and_no_moment(angle, values):
    # Exact up to rounding: 1e-13 of the sum of all forces, and of forces times the size of the ropes.
    scene, params, state = two(angle, 2.0, (0.7, 0.4, 0.0), values, gap=1e-4)
    _, _, force, _ = solved(scene, params, state, 2e-4)
    size = float(force.abs().sum())
    assert size > 1.0
    assert float(force.sum(-2).abs().max()) < 1e-13 * size
    moment = torch.linalg.cross(state.rods.pos, force, dim=-1).sum(-2)
    assert float(moment.abs().max()) < 1e-13 * size * 0.5


@ANGLES
@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("values", [{}, RUBBING], ids=["smooth", "rubbing"])
def test_collisions_keep_linear_and_angular_momentum(angle, integrator, values):
    # D5. Velocities are differences of positions: rounding adds 1e-16 * 0.25 m / dt per vertex and substep, 3e-13 of
    # a speed of 2 m/s at 2e-4 s, and adds up as its root over 42 vertices and 100 substeps to below 1e-12 of the sum.
    # In implicit steps the tension leans with its edge within a substep, which keeps linear momentum only.
    choices = {"integrator": integrator, "dt": 2e-4, "substeps": 1}
    scene, params, state = two(angle, 2.0, (0.3, 0.2, 0.0), values, **choices)
    before = momenta(params, state)
    after_state = run(scene, params, state, 100)
    check_state(after_state)
    after = momenta(params, after_state)
    turned = float(after_state.rods.vel[:21, 2].mean() - state.rods.vel[:21, 2].mean())
    assert turned > 0.5, "they did not collide"
    scale = float((params.rods.material.mass * state.rods.vel.norm(dim=-1, keepdim=True)).sum())
    assert float((after[0] - before[0]).norm()) < 1e-12 * scale
    assert integrator == "implicit" or float((after[1] - before[1]).norm()) < 1e-12 * scale * 0.5


@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_crossed_rods_rebound_with_the_coefficient_of_restitution(e):
    # C8: two stiff rods of three vertices that meet at their middle vertices: the middles part with e times their
    # approach, in the substep in which they would touch.
    r, v, dt = 0.01, 0.3, 2e-4
    ropes = []
    for side, angle in ((1, 0.0), (-1, math.pi / 2)):
        x = line(3, 0.2, angle, side * (r + 1e-4))
        ropes.append(
            Rope(x, radius=r, density=1000.0, velocities=torch.zeros_like(x) - side * v * x.new_tensor([0, 0, 1]))
        )
    scene, params, state = make(
        ropes, [RodContact(sweeps=20)], {"rod_contact": {"restitution": e, "mu_s": 0, "mu_k": 0}}, dt=dt, substeps=1
    )
    before = None
    for _ in range(5):
        apart = state.rods.vel[1, 2] - state.rods.vel[4, 2]
        if float(apart) > -2 * v * 0.999:
            break
        before = apart
        state = run(scene, params, state, 1)
    if e == 0:  # they stop where they touch, one substep later
        state = run(scene, params, state, 1)
        apart = state.rods.vel[1, 2] - state.rods.vel[4, 2]
    assert float(before) == pytest.approx(-2 * v)
    # The four pairs at the two middles are alike; sweeps leave less than a hundredth of the speed.
    assert float(apart) == pytest.approx(2 * e * v, abs=0.01 * 2 * v)


def test_parallel_rods_rebound_as_a_whole():
    # All along each other they stay straight, but for the ends; energy is kept for e = 1 and quartered for e = 1/2.
    for e in (0.5, 1.0):
        scene, params, state = two(0.0, 0.3, values={"restitution": e}, contact=RodContact(sweeps=10), gap=1e-3)
        m = params.rods.material.mass
        after = run(scene, params, state, 6)
        found = float((m * after.rods.vel)[:21, 2].sum() / m[:21].sum())
        assert found == pytest.approx(0.3 * e, rel=0.02), e


@pytest.mark.parametrize("angle", [0.3, math.pi / 2], ids=["inclined", "crossed"])
def test_ropes_of_1_cm_that_cross_at_2_metres_per_second_stay_uncrossed(angle):
    scene, params, state = two(angle, 1.0, gap=5e-3, n=41)
    least = math.inf
    for _ in range(40):
        state = run(scene, params, state, 1)
        least = min(least, nearest(state.rods.pos, (41, 41)))
    check_state(state)
    assert least > 0.99 * 0.02


@pytest.mark.parametrize("share", [0.5, 1.0], ids=["half a radius", "a radius"])
@pytest.mark.parametrize("angle", [0.3, math.pi / 2], ids=["inclined", "crossed"])
def test_nothing_passes_at_a_radius_per_substep(angle, share):
    # C7. Distances are watched along the way, not only at its ends: they would go through zero.
    dt, r = 1e-3, 0.01
    scene, params, state = two(
        angle, share * r / dt / 2, gap=0.05, dt=dt, substeps=1, contact=RodContact(room=441, rounds=4)
    )
    least = math.inf
    for _ in range(int(0.05 / (share * r)) + 10):
        after = run(scene, params, state, 1)
        for f in torch.linspace(0, 1, 9, dtype=F64):
            least = min(least, nearest((1 - f) * state.rods.pos + f * after.rods.pos, (21, 21)))
        state = after
    assert bool(ok(state)) and least > 0.9 * 2 * r, least


def test_friction_is_the_coulomb_law_of_every_pair():
    # One pair of crossed edges, pressed with approach v and sliding with u: sliding friction is mu_k N against the
    # slip, sticking friction below mu_s N is what stops the slip.
    for slide, sticks in ((2.0, False), (0.02, True)):
        ropes = []
        for side, angle in ((1, 0.0), (-1, math.pi / 2)):
            x = line(4, 0.3, angle, side * 0.01005)
            v = torch.tensor([slide * (side > 0), 0.0, -side * 0.5], dtype=F64).expand(4, 3)
            ropes.append(Rope(x, radius=0.01, density=1000.0, velocities=v))
        values = {"rod_contact": {"mu_s": 0.5, "mu_k": 0.3}}
        scene, params, state = make(ropes, [RodContact(sweeps=40)], values, dt=1e-3, substeps=1)
        contacts, forces, force, _ = solved(scene, params, state, 1e-3)
        pressing = forces.normal[:, 0] > 1e-6
        assert int(pressing.sum()) == 1 and float(contacts.normal[pressing][0, 2]) == pytest.approx(1.0)
        ratio = float(forces.friction[pressing].norm() / forces.normal[pressing])
        assert float(forces.friction[pressing][0, 0]) < 0 and float(forces.friction[pressing][0, 1:].norm()) < 1e-9
        if sticks:
            assert 0 < ratio < 0.5
        else:
            assert ratio == pytest.approx(0.3, rel=1e-12)
        # What the first rope feels is this force, up to the hundredth by which parallel edges would be balanced.
        assert float(force[:4, 0].sum()) == pytest.approx(float(forces.friction[pressing][0, 0]), rel=0.01)


G = 9.81


def on_bars(mu_s: float, mu_k: float):
    """A stiff rope that has come to rest on two held ropes."""
    r = 0.01
    ropes = [Rope(line(13, 0.6), radius=r, density=1000.0, bend=1.0)]
    for place in (-0.147, 0.153):
        ropes.append(Rope(line(3, 0.3, math.pi / 2, -2 * r) + torch.tensor([place, 0, 0]), radius=r, density=1000.0))
    values = {"gravity": {"acceleration": (0.0, 0.0, -G)}, "rod_contact": {"mu_s": mu_s, "mu_k": mu_k}}
    choices = {
        "integrator": "implicit",
        "dt": 1e-3,
        "substeps": 1,
        "numerical_damping": 0.5,
        "prescribed_vertices": tuple(range(13, 19)),
    }
    scene, params, state = make(ropes, [Bend(), Gravity(), RodContact()], values, **choices)
    return scene, params, run(scene, params, state, 150)


def tilted(params, tangent: float):
    """Return parameters in which gravity is tilted along the rope, and the angle."""
    a = math.atan(tangent)
    acceleration = torch.tensor([[G * math.sin(a), 0.0, -G * math.cos(a)]], dtype=F64)
    effects = params.effects | {"gravity": params.effects["gravity"] | {"acceleration": acceleration}}
    return tree.replace(params, effects=effects), a


@pytest.mark.slow
@pytest.mark.parametrize("mu_k", [0.5, 0.3])
def test_a_rope_on_ropes_sticks_below_and_slides_above_the_friction_angle(mu_k):
    # C3 among ropes: sticks while tan a < mu_s, slides with g (sin a - mu_k cos a) above. The rope bends, and a load of
    # 2 % either way is on the way between it and its supports; where sliding is easier than sticking, a sudden tilt to
    # nine tenths of mu_s may therefore start it.
    scene, params, state = on_bars(0.5, mu_k)
    assert 0 < nearest(state.rods.pos, (13, 3, 3)) - 0.02 < 0.02 * 0.01  # at rest by two hundredths of the radius
    for tangent in (0.3, 0.45) if mu_k == 0.5 else (0.3,):
        given, _ = tilted(params, tangent)
        way = float((run(scene, given, state, 200).rods.pos - state.rods.pos)[:13, 0].mean())
        assert abs(way) < 0.01 * 0.5 * G * 0.2**2 * tangent
    for tangent in (0.6, 0.9):
        given, a = tilted(params, tangent)
        early = run(scene, given, state, 50)
        late = run(scene, given, early, 100)
        found = float((late.rods.vel - early.rods.vel)[:13, 0].mean()) / 0.1
        friction = (G * math.sin(a) - found) / (G * math.cos(a))
        assert friction == pytest.approx(mu_k, rel=0.02)


def test_sweeps_without_friction_equal_coefficients_of_zero():
    smooth = run(*two(0.4, 1.0, (0.2, 0.1, 0), contact=RodContact(friction=False)), 5)
    zero = run(*two(0.4, 1.0, (0.2, 0.1, 0)), 5)
    assert float((smooth.rods.pos - zero.rods.pos).abs().max()) < 1e-15


def test_friction_takes_energy_and_never_gives_it():
    energies = []
    scene, params, state = two(0.4, 0.5, (0.4, 0.3, 0), {"mu_s": 0.5, "mu_k": 0.4})
    for _ in range(20):
        state = run(scene, params, state, 1)
        energies.append(float((0.5 * params.rods.material.mass * state.rods.vel.square()).sum()))
    smooth = run(*two(0.4, 0.5, (0.4, 0.3, 0)), 20)
    assert energies[-1] < float((0.5 * params.rods.material.mass * smooth.rods.vel.square()).sum())


def test_batch_equals_loop_and_runs_repeat_bit_for_bit():
    scene, params, state = two(0.5, 0.8, (0.3, 0.1, 0), RUBBING)
    g = torch.Generator().manual_seed(0)
    vel = state.rods.vel + 0.1 * torch.randn(3, *state.rods.vel.shape, generator=g, dtype=F64)
    many = tree.map(lambda x: tree.batch_innermost(x.expand(3, *x.shape).clone()), state)
    many = with_velocity(many, tree.batch_innermost(vel))
    batch = run(scene, params, many, 8)
    again = run(scene, params, many, 8)
    assert torch.equal(batch.rods.pos, again.rods.pos) and torch.equal(batch.rods.vel, again.rods.vel)
    for k in range(3):
        one = run(scene, params, with_velocity(state, vel[k]), 8)
        assert float((batch.rods.pos[k] - one.rods.pos).abs().max()) < 1e-12


def test_forward_motion_is_the_same_with_and_without_gradients():
    scene, params, state = two(0.5, 0.8, (0.3, 0.1, 0), RUBBING)
    plain = run(scene, params, state, 6)
    control, with_gradient = (
        stationary_control(scene, state),
        with_velocity(state, state.rods.vel.clone().requires_grad_()),
    )
    for _ in range(6):
        with_gradient = step(scene, params, with_gradient, control)
    assert torch.equal(plain.rods.pos, with_gradient.rods.pos.detach())


def test_single_precision_is_close_to_double():
    scene, params, state = two(0.5, 0.8, (0.3, 0.1, 0), RUBBING)
    double = run(scene, params, state, 6)
    small = run(scene, tree.to(params, torch.float32), tree.to(state, torch.float32), 6)
    assert small.rods.pos.dtype == torch.float32 and bool(ok(small))
    # Velocities round by 6e-8 * 0.25 m / 2e-4 s = 7e-5 m/s per substep, over 6 ms: below 1e-6 m, hits included.
    assert float((small.rods.pos.double() - double.rods.pos).abs().max()) < 5e-6


def test_a_held_rope_is_not_moved_and_pairs_of_held_edges_do_nothing():
    scene, params, state = two(0.5, 0.8, (0.3, 0.1, 0), RUBBING, prescribed_vertices=tuple(range(21, 42)))
    after = run(scene, params, state, 10)
    assert torch.equal(after.rods.pos[21:], state.rods.pos[21:]) and bool(ok(after))
    assert nearest(after.rods.pos, (21, 21)) > 0.99 * 0.02
    scene, params, state = two(0.5, 0.0, gap=-1e-3, prescribed_vertices=tuple(range(42)))
    assert torch.equal(run(scene, params, state, 3).rods.pos, state.rods.pos)


def degenerate() -> dict[str, torch.Tensor]:
    a = line(6, 0.25)
    crossing = line(6, 0.25, math.pi / 2)
    return {
        "on top of each other": torch.cat([a, a.clone()]),
        "crossing in a point": torch.cat([a, crossing]),
        "end to end": torch.cat([a, a + torch.tensor([0.25, 0, 0], dtype=F64)]),
        "touching exactly, parallel": torch.cat([a, a + torch.tensor([0, 0, 0.02], dtype=F64)]),
        "far away": torch.cat([a, a + 5.0]),
    }


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["float32", "float64"])
@pytest.mark.parametrize("case", degenerate())
def test_forces_and_gradients_are_finite_in_degenerate_states(case, dtype):
    x = degenerate()[case].to(dtype)
    apart = x[6:] + torch.tensor([0.0, 0.0, 1.0], dtype=dtype)  # what starts in another rope is refused
    ropes = [Rope(x[:6], radius=0.01, density=1000.0), Rope(apart, radius=0.01, density=1000.0)]
    scene, params, state = make(ropes, [Bend(), RodContact(room=100)], {"rod_contact": RUBBING}, dt=2e-4, substeps=1)
    state = tree.replace(state, rods=tree.replace(state.rods, pos=x))
    leaves, rebuild = tree.flatten((params, state.rods))
    inputs = [p.detach().clone().requires_grad_() for p in leaves]
    given, rods = rebuild(inputs)
    after = step(scene, given, tree.replace(state, rods=rods), stationary_control(scene, state))
    assert bool(finite(after))
    found = torch.autograd.grad(after.rods.pos.square().sum() + after.rods.vel.sum(), inputs, allow_unused=True)
    assert all(g is None or bool(torch.isfinite(g).all()) for g in found)


def stadium(n: int, straight: float, radius: float) -> torch.Tensor:
    """Vertices (n, 3) of a closed rope: two straight sides and two half circles, evenly spaced along it."""
    half = straight + math.pi * radius
    s = torch.arange(n, dtype=F64) / n * 2 * half
    u, side = s % half, 1.0 - 2.0 * (s >= half).to(F64)
    a = (u - straight).clamp(min=0.0) / radius
    x = u.clamp(max=straight) - straight / 2 + radius * torch.sin(a)
    return torch.stack([side * x, side * -radius * torch.cos(a), 0 * x], -1)


def test_the_sides_of_a_closed_rope_stay_apart():
    # Squeezed until its sides overlap by a twentieth of the diameter; they part and its ends bulge.
    scene, params, state = make(
        [Rope(stadium(48, 0.15, 0.0095), radius=0.01, density=1000.0, bend=1e-5, closed=True)], [Bend(), RodContact()]
    )
    i, j = torch.triu_indices(47, 47, 8)
    far = j - i <= 48 - 8
    assert float(distances(state.rods.pos, i[far], j[far]).min()) < 0.96 * 0.02
    after = run(scene, params, state, 60)
    assert float(distances(after.rods.pos, i[far], j[far]).min()) > 0.99 * 0.02 and bool(ok(after))


@pytest.mark.parametrize("eager", [False, True], ids=["kernel", "tensors"])
@pytest.mark.parametrize("off", [0.0, 1e-4, 1e-3, 3e-3])
def test_held_vertices_that_overlap_do_not_throw_the_free_ends_of_their_edges(off, eager, monkeypatch):
    # Two ropes of two edges cross close to their middles, which are held: free ends can hardly part them.
    monkeypatch.setattr(rod_pairs, "ready", lambda *_: not eager)
    overlap, dt = 3e-3, 2e-4
    ropes = [line(3, 0.04), line(3, 0.04, math.pi / 2, 0.02 - overlap) + torch.tensor([off, off, 0.0], dtype=F64)]
    ropes = [Rope(x, radius=0.01, mass=0.003) for x in ropes]
    rubbing = {"rod_contact": {"mu_s": 0.3, "mu_k": 0.3}}
    made = make(ropes, [RodContact(), Damping()], rubbing, dt=dt, substeps=1, prescribed_vertices=(1, 4))
    scene, params, state = made
    fastest = []
    for _ in range(100):
        state = step(scene, params, state, stationary_control(scene, state))
        fastest.append(float(state.rods.vel.norm(dim=-1).max()))
    assert max(fastest) < 2 * overlap / dt and fastest[-1] < 0.5
