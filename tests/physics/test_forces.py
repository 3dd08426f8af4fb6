"""Forces and torques of elastic rods against derivatives of their energies, and what symmetry demands of them."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import ELASTIC, F64, circle, effects, energy, loads, rand, straight, vec, view, wild

from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch, Twist, curvature
from torchdlo.physics.linalg import rotation
from torchdlo.scene import Rope, make, stationary_control, step

pytestmark = pytest.mark.quick


def ropes(kind: str) -> list[Rope]:
    """Heterogeneous, anisotropic ropes in random shapes with random rest shapes."""

    def one(n: int, seed: int, closed: bool) -> Rope:
        second = rand(n, seed=seed + 5)
        return Rope(
            wild(n, seed, closed),
            closed=closed,
            mass=0.3,
            stretch=rand(n, seed=seed + 1),
            bend=rand(n, seed=seed + 2),
            bend2=second,
            twist=rand(n, seed=seed + 3),
            rest=wild(n, seed + 4, closed),
        )

    if kind == "open":
        return [one(8, 1, False)]
    if kind == "closed":
        return [one(7, 2, True)]
    if kind == "loop of three":
        return [one(3, 2, True)]
    return [one(6, 3, False), one(5, 4, True), one(3, 5, False)]


def disturbed(state, seed: int = 9):
    """Random twists and plastic curvature."""
    r = state.rods
    twist = rand(*r.twist.shape, seed=seed, low=-3, high=3)
    plastic = rand(*r.plastic.shape, seed=seed + 1, low=-0.3, high=0.3)
    return tree.replace(state, rods=tree.replace(r, twist=twist, plastic=plastic))


KINDS = ["open", "closed", "loop of three", "mixed"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", ELASTIC)
def test_loads_are_the_negative_gradient_of_the_energy(kind, law):
    # F = -dU/dx with frames carried along by parallel transport, torque = -dU/dtheta. float64: 1e-9 relative.
    scene, params, state = make(ropes(kind), [law()], constrained=law is not Stretch, dt=1e-6, check=False)
    if law is Bend:  # isotropic law
        params = tree.replace(
            params,
            rods=tree.replace(
                params.rods, material=tree.replace(params.rods.material, bend=params.rods.material.bend[..., :1])
            ),
        )
    state = disturbed(state)
    pos = state.rods.pos.clone().requires_grad_()
    twist = state.rods.twist.clone().requires_grad_()
    u = energy(scene, params, state, pos, twist)
    by_pos, by_twist = torch.autograd.grad(u, (pos, twist), allow_unused=True)
    force, torque = loads(scene, params, state)
    assert float((force + by_pos).norm() / by_pos.norm()) < 1e-9
    real = params.rods.rest.edge_mask
    by_twist = torch.zeros_like(torque) if by_twist is None else by_twist * real
    assert float((torque + by_twist).norm()) <= 1e-9 * max(float(by_twist.norm()), 1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", ELASTIC)
def test_internal_forces_and_torques_sum_to_zero(kind, law):
    # T9. sum F = 0; sum x cross F + sum t tau = 0, as a rigid turn changes no energy.
    scene, params, state = make(ropes(kind), [law()], constrained=law is not Stretch, dt=1e-6, check=False)
    if law is Bend:
        params = tree.replace(
            params,
            rods=tree.replace(
                params.rods, material=tree.replace(params.rods.material, bend=params.rods.material.bend[..., :1])
            ),
        )
    state = disturbed(state)
    force, torque = loads(scene, params, state)
    size = force.norm(dim=-1).sum()
    assert float(force.sum(-2).norm() / size) < 1e-13
    v = view(scene, params, state)
    turn = (torch.linalg.cross(state.rods.pos, force) + torque * v.tangent).sum(-2)
    assert float(turn.norm() / (size + torque.abs().sum())) < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_energy_does_not_change_under_rigid_motion(kind):
    # T9. All of the state turns with the rods: directors too. 1e-12 relative.
    scene, params, state = make(
        ropes(kind), effects("stretch_force", "bend_frame", "twist"), constrained=False, dt=1e-6, check=False
    )
    state = disturbed(state)
    q = vec(0.3, -0.5, 0.7, 0.2)
    q = q / q.norm()

    def turn(x):
        return rotation.rotate(q.expand(x.shape[0], 4), x)

    moved = tree.replace(state.rods, pos=turn(state.rods.pos) + vec(1, -2, 3), director=turn(state.rods.director))
    a, b = energy(scene, params, state), energy(scene, params, tree.replace(state, rods=moved))
    assert float((a - b).abs() / a) < 1e-12
    # Turning in time (frames carried by transport plus the turn of the frame about the tangents) keeps it as well:
    # the
    # forces turn with the rods.
    fa, ta = loads(scene, params, state)
    fb, tb = loads(scene, params, tree.replace(state, rods=moved))
    assert float((turn(fa) - fb).norm() / fa.norm()) < 1e-12
    assert float((ta - tb).norm() / ta.norm()) < 1e-12


def test_stiffness_maps_from_material_and_radius():
    # T1. EA given; EI = E pi r^4/4, GJ = G pi r^4/2 per hinge length; masses rho pi r^2 h, half at the ends.
    n, r, e, g, rho, length = 11, 0.003, 2e7, 8e6, 1200.0, 0.7
    _, params, _ = make(
        [Rope(straight(n, length), radius=r, youngs=e, shear=g, density=rho, stretch=55.0)], [], check=False
    )
    m = params.rods.material
    assert torch.allclose(m.bend, torch.full_like(m.bend, e * math.pi * r**4 / 4), rtol=1e-12, atol=0)
    assert torch.allclose(m.twist, torch.full_like(m.twist, g * math.pi * r**4 / 2), rtol=1e-12, atol=0)
    assert torch.allclose(m.stretch, torch.full_like(m.stretch, 55.0), rtol=1e-12, atol=0)
    line = rho * math.pi * r**2
    h = length / (n - 1)
    assert float(m.mass.sum()) == pytest.approx(line * length, rel=1e-12)
    assert float(m.mass[0]) == pytest.approx(line * h / 2, rel=1e-12)
    assert float(m.mass[4]) == pytest.approx(line * h, rel=1e-12)
    assert float(m.inertia[3]) == pytest.approx(0.5 * line * h * r**2, rel=1e-12)


def test_energy_per_hinge_is_stiffness_over_hinge_length():
    # T1. U = B (2 tan(phi/2))^2 / (2 h), C tau^2 / (2 h), EA eps^2 h / 2 for one hinge with edges h.
    h, phi, tau, eps, b, c, ea = 0.2, 0.4, 0.3, 0.05, 1.7, 0.9, 30.0
    bent = torch.stack([vec(0, 0, 0), vec(h, 0, 0), vec(h + h * math.cos(phi), h * math.sin(phi), 0)])
    rope = Rope(bent, mass=1.0, bend=b, twist=c, stretch=ea, rest=straight(3, 2 * h))
    scene, params, state = make([rope], [Bend()], dt=1e-6, check=False)
    wanted = b * (2 * math.tan(phi / 2)) ** 2 / (2 * h)
    assert float(energy(scene, params, state)) == pytest.approx(wanted, rel=1e-12)
    scene, params, state = make([rope], [BendFrame()], dt=1e-6, check=False)
    assert float(energy(scene, params, state)) == pytest.approx(wanted, rel=1e-12)
    scene, params, state = make([rope], [Twist()], dt=1e-6, check=False)
    twist = torch.tensor([[0.0], [tau], [0.0]], dtype=F64)
    assert float(energy(scene, params, state, twist=twist)) == pytest.approx(c * tau**2 / (2 * h), rel=1e-12)
    scene, params, state = make([rope], [Stretch()], constrained=False, dt=1e-6, check=False)
    stretched = state.rods.pos * (1 + eps)
    assert float(energy(scene, params, state, stretched)) == pytest.approx(ea * eps**2 * h, rel=1e-12)


def test_uniform_twist_exerts_the_closed_form_torque_and_no_force():
    # T2. theta_j linear over the n - 1 hinges between the first and last edge: torque C Theta / (L - h), F = 0.
    n, length, c, total = 9, 1.0, 0.8, 5.0
    scene, params, state = make(
        [Rope(straight(n, length), mass=1.0, bend=1.0, twist=c)], [BendFrame(), Twist()], dt=1e-6, check=False
    )
    h = length / (n - 1)
    theta = torch.linspace(0, total, n - 1, dtype=F64)
    theta = torch.cat([theta, theta.new_zeros(1)])[:, None]
    force, torque = loads(scene, params, tree.replace(state, rods=tree.replace(state.rods, twist=theta)))
    assert float(force.abs().max()) < 1e-12
    assert float(torque[1:-2].abs().max()) < 1e-12
    assert float(torque[0]) == pytest.approx(c * total / (length - h), rel=1e-12)


def test_end_moment_rolls_a_rod_up_with_equal_hinge_angles():
    # S4 and T3. Equal turning angles phi at every hinge carry the moment M = B 2 tan(phi/2)/h: it is what the closed-
    # form
    # forces exert on each inner edge, and they vanish on inner vertices. At phi = 2 pi / n the rod is a circle.
    n_edges, b = 20, 1.3
    phi = 2 * math.pi / n_edges
    h = 0.1
    heading = phi * torch.arange(n_edges, dtype=F64)
    edges = h * torch.stack([torch.cos(heading), torch.sin(heading), torch.zeros_like(heading)], -1)
    pos = torch.cat([torch.zeros(1, 3, dtype=F64), torch.cumsum(edges, 0)])
    assert float(pos[-1].norm()) < 1e-14
    for law in (Bend(), BendFrame()):
        scene, params, state = make([Rope(pos, mass=1.0, bend=b)], [law], dt=1e-6, check=False)
        force, _ = loads(scene, params, state)
        moment = b * 2 * math.tan(phi / 2) / h
        # Inner vertices are free of force, and the couple h F on the first edge is the moment. The hinge energy
        # 2 B tan^2(phi/2) * 2/(2h): dU/dphi = moment (1 + tan^2(phi/2)), the discrete measure of the same moment.
        assert float(force[2:-2].norm(dim=-1).max()) < 1e-12
        couple = h * float(force[0].norm())
        assert couple == pytest.approx(moment * (1 + math.tan(phi / 2) ** 2), rel=1e-10)
        assert couple == pytest.approx(2 * math.pi * b / (n_edges * h), rel=phi**2)


@pytest.mark.parametrize("law", ["bend", "bend_frame", "twist", "bending_damping"])
def test_loads_of_nearly_opposite_edges_are_bounded(law):
    # A hinge folded flat: forces and what implicit steps use stay finite, with finite gradients.
    for gap in (1e-3, 1e-7, 0.0):
        pos = torch.stack([vec(0, 0, 0), vec(0.1, 0, 0), vec(0, gap, 0), vec(0.1, gap, 0.05)]).requires_grad_()
        rope = Rope(pos, mass=1.0, bend=0.01, twist=0.01, rest=straight(4, 0.3))
        scene, params, state = make([rope], effects(law), dt=1e-6, check=False)
        force, torque = loads(scene, params, state)
        assert bool(torch.isfinite(force).all() and torch.isfinite(torque).all())
        (gradient,) = torch.autograd.grad(force.sum() + torque.sum(), pos, allow_unused=True)
        assert gradient is None or bool(torch.isfinite(gradient).all())


def test_a_fold_opens_without_blowing_up():
    # 170 degrees and exactly folded hinges, implicit steps of 5 ms: finite, inextensible, energy not above the
    # start's.
    for angle in (170.0, 179.999):
        a = math.radians(angle)
        pos = torch.stack(
            [
                vec(-0.2, 0, 0),
                vec(-0.1, 0, 0),
                vec(0, 0, 0),
                vec(math.cos(a), math.sin(a), 0) * 0.1,
                vec(math.cos(a), math.sin(a), 0) * 0.2,
            ]
        )
        scene, params, state = make(
            [Rope(pos, mass=0.01, bend=1e-4)], [Bend()], integrator="implicit", dt=5e-3, substeps=1
        )
        control = stationary_control(scene, state)
        start = float(energy(scene, params, state))
        for _ in range(40):
            state = step(scene, params, state, control)
            assert bool(torch.isfinite(state.rods.pos).all())
        assert float(energy(scene, params, state)) < start


TREFOIL_TURN = -2.225662


def trefoil(n: int) -> torch.Tensor:
    t = 2 * math.pi * torch.arange(n, dtype=F64) / n
    return torch.stack(
        [torch.sin(t) + 2 * torch.sin(2 * t), torch.cos(t) - 2 * torch.cos(2 * t), -torch.sin(3 * t)], -1
    )


def test_parallel_transport_round_a_trefoil_turns_by_its_writhe():
    # T8. -2.225662 rad at n = 100, 0 for a planar circle (2 pi Wr mod 2 pi).
    for pos, turn in ((trefoil(100), TREFOIL_TURN), (circle(30), 0.0)):
        edges = torch.roll(pos, -1, 0) - pos
        t = edges / edges.norm(dim=-1, keepdim=True)
        d = start = rotation.any_normal(t[0])
        for k in range(len(t)):
            d = rotation.transport(d, t[k], t[(k + 1) % len(t)])
        found = float(rotation.signed_angle(start, d, t[0]))
        assert found == pytest.approx(turn, abs=5e-7)
        # What the simulator spreads over the edges: the reference twists sum to minus the holonomy.
        _, _, state = make([Rope(pos, mass=1.0, closed=True)], [Twist()], dt=1e-6, check=False)
        assert float(state.rods.ref_twist.sum()) == pytest.approx(-turn, abs=5e-7)


@pytest.mark.parametrize("pos", [circle(24), trefoil(60)], ids=["ring", "trefoil"])
def test_loops_at_rest_as_placed_have_no_energy_and_stay(pos):
    # T8. Zero energy to 1e-12 of B/L; stepping a loop that is curved out of plane leaves it where it is.
    rope = Rope(0.05 * pos, mass=0.05, bend=1e-3, twist=1e-3, closed=True, rest="as_placed")
    scene, params, state = make(
        [rope], effects("bend_frame", "twist"), twist="dynamic", integrator="implicit", dt=2e-3, substeps=1
    )
    assert float(energy(scene, params, state).abs()) < 1e-15
    force, torque = loads(scene, params, state)
    assert float(force.abs().max()) < 1e-12 and float(torque.abs().max()) < 1e-14
    start = state.rods.pos
    for _ in range(20):
        state = step(scene, params, state, stationary_control(scene, state))
    assert float((state.rods.pos - start).abs().max()) < 1e-11
    # Turned as a whole, it still feels nothing.
    q = vec(0.8, 0.1, -0.5, 0.3)
    q = (q / q.norm()).expand(len(pos), 4)
    moved = tree.replace(state.rods, pos=rotation.rotate(q, start), director=rotation.rotate(q, state.rods.director))
    force, _ = loads(scene, params, tree.replace(state, rods=moved))
    assert float(force.abs().max()) < 1e-9


def test_curvature_rate_is_the_time_derivative_of_curvature():
    # Central difference of kappa along the motion: x +- dt v, theta +- dt omega; error O(dt^2).
    scene, params, state = make(ropes("mixed"), [BendFrame(), Twist()], dt=1e-6, check=False)
    state = disturbed(state)
    v, w = rand(*state.rods.pos.shape, seed=21, low=-1), rand(*state.rods.twist.shape, seed=22, low=-1)
    moving = tree.replace(state, rods=tree.replace(state.rods, vel=v, twist_rate=w))
    rate = curvature(view(scene, params, moving)).rate(view(scene, params, moving))
    eps = 1e-6
    k = [
        curvature(view(scene, params, state, state.rods.pos + s * eps * v, state.rods.twist + s * eps * w)).kappa
        for s in (1, -1)
    ]
    found = (k[0] - k[1]) / (2 * eps)
    mask = params.rods.rest.hinge_mask
    assert float(((rate - found) * mask).norm() / (found * mask).norm()) < 1e-8
