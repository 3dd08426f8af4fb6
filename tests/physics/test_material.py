"""Plasticity, inner friction, and effects that change the rods."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from helpers import F64, altered, effects, energy, loads, run, speed, straight, vec

from torchdlo.physics import tree
from torchdlo.scene import Control, Rope, make, stationary_control, step

YIELD, RATE, H = 2.0, 6.0, 0.1


def corner(angle: float) -> torch.Tensor:
    return torch.stack([vec(-H, 0, 0), vec(0, 0, 0), vec(H * math.cos(angle), H * math.sin(angle), 0)])


def plastic(angle: float, held=(0, 1, 2), numbers=None, **choices):
    choices = {"dt": 0.01, "substeps": 1} | choices
    numbers = {"yield_curvature": YIELD, "rate": RATE} | (numbers or {})
    return make(
        [Rope(corner(angle), mass=0.1, bend=1e-3)],
        effects("bend_frame", "bending_plasticity", "damping"),
        {"bending_plasticity": numbers, "damping": {"rate": 20.0}},
        prescribed_vertices=held,
        **choices,
    )


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("substeps", [1, 7])
def test_held_curvature_flows_by_the_closed_form_whatever_the_step(integrator, substeps):
    # P1: kbar = (|k| - yield l)(1 - exp(-rate t)), k = 2 tan(phi / 2); the same for every substep, to rounding.
    angle = 0.9
    scene, params, state = plastic(angle, integrator=integrator, substeps=substeps)
    state, _ = run(scene, params, state, 20)
    k = 2 * math.tan(angle / 2)
    wanted = (k - YIELD * H) * (1 - math.exp(-RATE * 0.2))
    assert float(state.rods.plastic[1].norm()) == pytest.approx(wanted, rel=1e-12)
    assert float(state.rods.plastic[[0, 2]].abs().max()) == 0


@pytest.mark.parametrize("hardening", [0.0, 0.4, 3.0])
def test_flow_with_hardening_is_the_return_mapping(hardening):
    # P2. At rate -> infinity every step returns to the yield surface, g = (|d| - yield) / (1 + H) with d = k_el - H k_p
    # (Simo and Hughes 1998, chapter 1); here exp(-rate dt) = exp(-100). From no plastic
    # curvature d is the elastic curvature. Bent to and fro along one axis, so that the other way yields sooner.
    scene, params, state = plastic(0.0, numbers={"rate": 1e4, "hardening": hardening})
    limit, kept, first = YIELD * H, 0.0, None
    none = torch.zeros(0, 3, dtype=F64)
    for angle in (0.1, 0.9, 0.7, 0.0, -0.5, -0.2, 1.2):
        # The flow of a step goes by the shape at its start.
        for _ in range(2):
            state = step(scene, params, state, Control(corner(angle), none))
        d = 2 * math.tan(angle / 2) - (1 + hardening) * kept
        kept += math.copysign(max(abs(d) - limit, 0.0) / (1 + hardening), d)
        first = kept if first is None and kept else first
        assert float(state.rods.plastic[1].norm()) == pytest.approx(abs(kept), rel=1e-12, abs=1e-14), angle
    assert first == pytest.approx((2 * math.tan(0.45) - limit) / (1 + hardening), rel=1e-12)


@pytest.mark.parametrize("substeps", [1, 7])
def test_flow_with_hardening_does_not_depend_on_the_step(substeps):
    # The excess |d| - yield decays as exp(-rate t) with hardening as without.
    scene, params, state = plastic(0.9, numbers={"hardening": 0.6}, substeps=substeps)
    state, _ = run(scene, params, state, 20)
    wanted = (2 * math.tan(0.45) - YIELD * H) / 1.6 * (1 - math.exp(-RATE * 0.2))
    assert float(state.rods.plastic[1].norm()) == pytest.approx(wanted, rel=1e-12)


def test_a_bent_cantilever_keeps_its_shape_only_if_plastic():
    # P4. Bent by five times B / m' L^3 across it for 2 s and let go: an elastic rod comes back to 5 % of its greatest
    # deflection, one that yields at 1 / m, well below the 2 / m at the clamp, keeps more than three times that.
    left = {}
    for limit in (1e6, 1.0):
        names = effects("bend_frame", "bending_plasticity", "damping", "gravity")
        plastic = {"yield_curvature": limit, "rate": 50.0, "hardening": 0.5}
        scene, params, state = make(
            [Rope(straight(9), mass=0.1, bend=0.2)],
            names,
            {"bending_plasticity": plastic, "damping": {"rate": 8.0}, "gravity": {"acceleration": (0, 10.0, 0)}},
            integrator="implicit",
            dt=1e-2,
            substeps=1,
            prescribed_vertices=(0, 1),
        )
        state, _ = run(scene, params, state, 200)
        peak = float(state.rods.pos[-1, 1])
        params.effects["gravity"]["acceleration"] = vec(0, 0, 0)[None]
        state, _ = run(scene, params, state, 400)
        assert speed(state) < 1e-6
        left[limit] = float(state.rods.pos[-1, 1]) / peak
    assert abs(left[1e6]) < 0.05 and left[1.0] > 3 * 0.05, left


def test_curvature_below_yield_never_flows():
    scene, params, state = plastic(0.19)
    state, _ = run(scene, params, state, 50)
    assert float(state.rods.plastic.abs().max()) == 0


def test_released_hinge_springs_back_by_the_yield_curvature():
    # P3. Held at |k| until flowed out, the elastic part is the yield curvature; released, that much springs back.
    angle = 0.9
    scene, params, state = plastic(angle, integrator="implicit")
    state, _ = run(scene, params, state, 500)
    k = 2 * math.tan(angle / 2)
    assert float(state.rods.plastic[1].norm()) == pytest.approx(k - YIELD * H, rel=1e-10)
    free, params, _fresh = plastic(angle, held=(0, 1), integrator="implicit")
    state = tree.replace(state, rods=tree.replace(state.rods, vel=torch.zeros_like(state.rods.vel)))
    state, _ = run(free, params, state, 900, stationary_control(free, state))
    assert speed(state) < 1e-9
    edge = state.rods.pos[2] - state.rods.pos[1]
    left = 2 * math.tan(0.5 * math.atan2(float(edge[1]), float(edge[0])))
    assert left == pytest.approx(k - YIELD * H, rel=1e-6)


def test_bending_to_and_fro_loses_energy_only_if_plastic():
    # P3. Work of the held vertex round a closed path: zero for an elastic hinge to 1e-6 of the energy, positive
    # beyond yield.
    work = {}
    for limit in (1e6, YIELD):
        scene, params, state = plastic(0.0, dt=4e-3)
        params.effects["bending_plasticity"]["yield_curvature"] = vec(limit)[None]
        done, most = 0.0, 0.0
        for turn in range(2):
            for k in range(200):
                angle = 0.8 * math.sin(2 * math.pi * (k + 1) / 200)
                force = loads(scene, params, state)[0][2]
                before = state.rods.pos[2]
                state = step(scene, params, state, Control(corner(angle), torch.zeros(0, 3, dtype=F64)))
                after = loads(scene, params, state)[0][2]
                if turn == 1:
                    done -= float((0.5 * (force + after) * (state.rods.pos[2] - before)).sum())
                most = max(most, float(energy(scene, params, state)))
        work[limit] = done / most
    assert abs(work[1e6]) < 1e-6
    assert work[YIELD] > 0.1, work


def test_natural_curvature_rolls_a_free_rod_into_an_arc():
    # Equilibrium without loads: every hinge has k = 2 tan(phi / 2) = curvature * l, the turning angles add up.
    n, k = 9, 2.0
    x = straight(n)
    scene, params, state = make(
        [Rope(x, mass=0.1, bend=0.05, twist=0.05, director=vec(0, 1, 0))],
        effects("bend_frame", "rest_curvature", "damping"),
        {"rest_curvature": {"curvature": (0.0, k)}, "damping": {"rate": 5.0}},
        integrator="implicit",
        dt=2e-2,
        substeps=1,
        prescribed_vertices=(0, 1),
    )
    state, _ = run(scene, params, state, 500)
    assert speed(state) < 1e-8
    h = 1 / (n - 1)
    edge = state.rods.pos[1:] - state.rods.pos[:-1]
    t = edge / edge.norm(dim=-1, keepdim=True)
    turn = torch.acos((t[1:] * t[:-1]).sum(-1).clamp(-1, 1))
    assert float((2 * torch.tan(turn / 2) - k * h).abs().max()) < 1e-7
    # About the second director, which is z for a first director along y: the rod stays in the plane of x and z or x
    # and y.
    assert float(t[-1, 0]) == pytest.approx(math.cos(float(turn.sum())), abs=1e-6)


def test_point_mass_adds_weight_where_it_is_said():
    # Mass m and its moment m s about the first vertex are exact, inside edges, at vertices and at both ends.
    n, length = 8, 0.7
    for where in (0.0, 0.13, 0.2, 0.4, length):
        scene, params, _ = make(
            [Rope(straight(n, length), mass=0.2)],
            effects("point_mass"),
            {"point_mass": {"position": where, "mass": 0.05}},
        )
        added = (altered(scene, params).material.mass - params.rods.material.mass)[:, 0]
        s = torch.linspace(0, length, n, dtype=F64)
        assert float(added.sum()) == pytest.approx(0.05, rel=1e-12)
        assert float((added * s).sum()) == pytest.approx(0.05 * where, abs=1e-12)


def test_stiffness_varies_along_the_rope_as_declared():
    # B(s) = B0 exp(factor exp(-((s/L - position)/width)^2 / 2)) (1 + gradient (s/L - 1/2)).
    numbers = {"position": 0.3, "width": 0.15, "factor": 0.8, "slope": 0.5}
    scene, params, _ = make(
        [Rope(straight(11), mass=0.2, bend=0.01)],
        effects("bend", "nonuniform_stiffness"),
        {"nonuniform_stiffness": numbers},
    )
    s = torch.linspace(0, 1, 11, dtype=F64)
    wanted = 0.01 * torch.exp(0.8 * torch.exp(-0.5 * ((s - 0.3) / 0.15) ** 2)) * (1 + 0.5 * (s - 0.5))
    assert torch.allclose(altered(scene, params).material.bend[:, 0], wanted, rtol=1e-12)


def test_bending_friction_decays_a_mode_at_the_kelvin_voigt_rate():
    # Kelvin-Voigt: M = B k + c k', so a mode of frequency w decays at w^2 c / 2 B; small amplitude free-free three-
    # vertex rod:
    # one hinge, w^2 = B k^T k / (m l): checked by the logarithmic decrement, 1 %.
    bend, c = 1e-3, 2e-6
    found = {}
    for integrator in ("explicit", "implicit"):
        x = corner(1e-3)
        scene, params, state = make(
            [Rope(x, mass=0.1, bend=bend, rest=straight(3, 2 * H))],
            effects("bend_frame", "bending_damping"),
            {"bending_damping": {"coefficient": c}},
            integrator=integrator,
            numerical_damping=0.0,
            dt=4e-3,
            substeps=1,
        )

        def kink(st):
            e = st.rods.pos[1:] - st.rods.pos[:-1]
            return float(torch.atan2(e[1, 1], e[1, 0]) - torch.atan2(e[0, 1], e[0, 0]))

        _, seen = run(scene, params, state, 300, seen=kink)
        # modal mass: masses m/4, m/2, m/4 moving by (a, -a, a): angle = 4 a / h, T = m a'^2 / 2.
        w2 = bend / H * 16 / H**2 / 0.1
        peaks = [k for k in range(1, len(seen) - 1) if seen[k - 1] < seen[k] > seen[k + 1]]
        rate = math.log(seen[peaks[0]] / seen[peaks[-1]]) / (4e-3 * (peaks[-1] - peaks[0]))
        found[integrator] = rate / (w2 * c / (2 * bend))
    assert all(ratio == pytest.approx(1, abs=0.02) for ratio in found.values()), found


def test_friction_of_a_strongly_bent_rope_converges_with_the_step():
    # The hinges turn by 0.13 rad each at first, out of a plane, so that the moment twists as well as bends.
    angle = torch.linspace(0, 1.3 * math.pi, 21, dtype=F64)
    spiral = torch.stack([0.05 * angle.sin(), 0.03 * angle, 0.05 * (1 - angle.cos())], -1)

    def ended(substeps):
        scene, params, state = make(
            [Rope(spiral, radius=0.003, mass=0.01, bend=1e-4, twist=1e-4, rest="straight")],
            effects("gravity", "bend", "twist", "bending_damping"),
            {"bending_damping": {"coefficient": 1e-4}},
            dt=4e-3,
            substeps=substeps,
            integrator="implicit",
            twist="quasistatic",
            prescribed_vertices=(0, 1),
            prescribed_edges=(0,),
        )
        return run(scene, params, state, 50)[0].rods.pos

    ends = [ended(n) for n in (2, 4, 8, 16)]
    changes = [float((a - b).norm(dim=-1).max()) for a, b in itertools.pairwise(ends)]
    # First order: halved each time.
    assert changes[0] < 0.01 and changes[1] < 0.6 * changes[0] and changes[2] < 0.6 * changes[1], changes


def test_drag_slows_a_rod_by_the_quadratic_law():
    # Straight rod moving sideways: m v' = -rho c_d r L v^2 -> v = v0 / (1 + v0 t rho c_d r L / m); along itself: no
    # drag.
    n, r, mass, v0 = 9, 0.02, 0.05, 3.0
    for axis, drags in ((vec(0, 1, 0), True), (vec(1, 0, 0), False)):
        rope = Rope(straight(n), mass=mass, bend=1e-3, radius=r, velocities=(v0 * axis).expand(n, 3))
        for integrator in ("explicit", "implicit"):
            scene, params, state = make(
                [rope],
                effects("bend", "air_drag"),
                {"air_drag": {"c_d": 1.5}},
                integrator=integrator,
                dt=2e-3,
                substeps=1,
            )
            state, _ = run(scene, params, state, 200)
            m = params.rods.material.mass
            v = float((m * state.rods.vel).sum(-2) @ axis / mass)
            wanted = v0 / (1 + v0 * (0.4 - 1e-3) * 1.2 * 1.5 * r / mass) if drags else v0
            assert v == pytest.approx(wanted, rel=5e-3), (integrator, drags)
