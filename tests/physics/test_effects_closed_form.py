"""Effects against closed forms: wind, tilt, axial stiffness, laws of the hinge, and clamps that give."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import F64, effects, rand, run, straight, vec, view, wild

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.physics.integrators.rod_step import _twist_matrix
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.topology import preceding
from torchdlo.scene import Control, Rope, make, stationary_control, step, stepper

H, G = 0.1, 9.81


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_wind_across_a_rod_drives_it_by_the_quadratic_law(integrator):
    # m v' = c (U - v)^2, c = rho c_d r L: v = U - U / (1 + U c t / m). Drag is taken at the start of a step, dt/2 late:
    # U c dt / 2m = 6e-4 of U here, so 1e-3 of U.
    r, mass, u, dt = 0.02, 0.05, 3.0, 1e-3
    built, params, state = make(
        [Rope(straight(9), mass=mass, bend=1e-3, radius=r)],
        effects("bend", "wind"),
        {"wind": {"velocity": (1.3, 0.0, u), "c_d": 0.9}},  # the part along the rod does nothing
        integrator=integrator,
        dt=dt,
        substeps=1,
    )
    state, _ = run(built, params, state, 300)
    mean = (params.rods.material.mass * state.rods.vel).sum(0) / mass
    t = 0.3 - dt / 2  # velocities live half a step earlier
    assert float(mean[2]) == pytest.approx(u - u / (1 + u * 1.2 * 0.9 * r * t / mass), abs=1e-3 * u)
    assert float(mean[:2].abs().max()) < 1e-3 * u


def test_wind_is_air_drag_seen_from_the_moving_air():
    x, v, u = wild(7, 1), rand(7, 3, seed=2, low=-1), vec(1.0, -2.0, 0.5)
    given = {"mass": 0.1, "bend": 1e-3, "radius": 0.01}
    found = []
    for name, velocity, values in (
        ("wind", v, {"wind": {"velocity": u, "c_d": 1.1}}),
        ("air_drag", v - u, {"air_drag": {"c_d": 1.1}}),
    ):
        built, params, state = make([Rope(x, velocities=velocity, **given)], effects("bend", name), values)
        found.append(effect.total_loads(built.effects[1:], view(built, params, state), params.effects))
    for key in ("force", "drag"):
        assert torch.allclose(found[0][key], found[1][key], rtol=1e-12, atol=0.0), key


@pytest.mark.parametrize(("angles", "wanted"), [((0.15, 0), (0, 1)), ((0, 0.15), (-1, 0))], ids=["x", "y"])
def test_tilted_gravity_is_gravity_turned_about_a_horizontal_axis(angles, wanted):
    # R_x (0, 0, -g) = g (0, sin a, -cos a); R_y (0, 0, -g) = g (-sin a, 0, -cos a).
    values = {"tilted_gravity": {"angles": vec(*angles)[None], "acceleration": vec(0, 0, -G)[None]}}
    built, params, state = make([Rope(straight(4), mass=0.1)], effects("gravity", "tilted_gravity"), values)
    found = effect.total_loads(built.effects, view(built, params, state), params.effects)["acceleration"][0]
    turned = G * vec(math.sin(0.15) * wanted[0], math.sin(0.15) * wanted[1], -math.cos(0.15))
    assert torch.allclose(found, turned, rtol=1e-14, atol=1e-14)
    both = EFFECTS["tilted_gravity"]().loads(
        view(built, params, state), {"angles": vec(0.1, -0.12)[None], "acceleration": vec(0.3, 0.2, -G)[None]}
    )
    total = both["acceleration"][0] + vec(0.3, 0.2, -G)
    assert float(total.norm()) == pytest.approx(float(vec(0.3, 0.2, -G).norm()), rel=1e-14)


@pytest.mark.parametrize("stretch", [float("inf"), 40.0])
def test_a_hanging_rope_lengthens_by_its_weight_over_the_axial_stiffness(stretch):
    # Edge k of a chain carries the vertices below it: its strain is that weight (1 / EA + 1 / own).
    n, mass, ea = 6, 0.3, 50.0
    built, params, state = make(
        [Rope(straight(n, 1.0, along=(0, 0, -1)), mass=mass, bend=1e-4, stretch=stretch)],
        effects("bend", "gravity", "damping", "stretch"),
        {"damping": {"rate": 8.0}, "stretch": {"EA": ea}},
        integrator="implicit",
        dt=5e-3,
        substeps=1,
        prescribed_vertices=(0,),
    )
    state, _ = run(built, params, state, 1600)  # motion decays at 4/s: e^-32 of it is left
    below = G * params.rods.material.mass[:, 0].flip(0).cumsum(0).flip(0)[1:]
    wanted = (1 + below * (1 / ea + 1 / stretch)) / (n - 1)
    found = (state.rods.pos[1:] - state.rods.pos[:-1]).norm(dim=-1)
    assert float((found / wanted - 1).abs().max()) < 1e-9


def corner(angle: float) -> torch.Tensor:
    return torch.stack([vec(-H, 0, 0), vec(0, 0, 0), vec(H * math.cos(angle), H * math.sin(angle), 0)])


def rubbing(kappa_c: float = 0.7, moment: float = 2e-3, n: torch.Tensor | None = None, **choices):
    """A hinge that is led by hand."""
    choices = {"dt": 0.01, "substeps": 1, "prescribed_vertices": (0, 1, 2)} | choices
    rope = Rope(corner(0.0) if n is None else n, mass=0.1, bend=1e-3, director=choices.pop("director", None))
    return make(
        [rope],
        effects("bend_frame", "internal_friction"),
        {"internal_friction": {"moment": moment, "kappa_c": kappa_c}},
        **choices,
    )


def led(built, params, state, curvatures):
    """Lead the hinge through curvatures [1/m] and return the state; the last is held a moment, to be remembered."""
    for k in [*curvatures, curvatures[-1]]:
        angle = 2 * math.atan(0.5 * k * H)  # kappa l = 2 tan(angle / 2)
        state = step(built, params, state, Control(corner(angle), torch.zeros(0, 3, dtype=F64)))
    return state


def remembered(state) -> torch.Tensor:
    return state.rods.memory["internal_friction"][1, :2]


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("substeps", [1, 7])
@pytest.mark.parametrize("count", [4, 50])
def test_friction_in_bending_follows_dahl_whatever_the_step_and_the_rate(integrator, substeps, count):
    # Up: z = 1 - exp(-k / kc). From K back: z = -1 + (1 + z_K) exp(-(K - k) / kc). Exact for every substep: rounding.
    top, kc = 3.0, 0.7
    built, params, state = rubbing(kc, integrator=integrator, substeps=substeps)
    up = [top * (k + 1) / count for k in range(count)]
    state = led(built, params, state, up)
    first = 1 - math.exp(-top / kc)
    assert float(remembered(state).norm()) == pytest.approx(first, rel=1e-12)
    direction = remembered(state) / remembered(state).norm()
    state = led(built, params, state, [top - 2.2 * (k + 1) / count for k in range(count)])
    wanted = -1 + (1 + first) * math.exp(-2.2 / kc)
    assert float(remembered(state) @ direction) == pytest.approx(wanted, rel=1e-11)
    assert float(state.rods.memory["internal_friction"][[0, 2], :2].abs().max()) == 0


def test_a_cycle_of_bending_loses_the_area_of_the_dahl_loop():
    # Steady loop of amplitude A: energy 4 M (A - kc tanh(A / kc)) per length. Trapezoids of width d: relative
    # (d / kc)^2 / 12 = 2e-5 at the steepest place, with d = A pi / 600 at most. The elastic part cancels to the same.
    amplitude, kc, moment = 2.0, 0.7, 2e-3
    built, params, state = rubbing(kc, moment)
    count, lost = 1200, 0.0

    def resists(state):
        v = view(built, params, state)
        loads = effect.total_loads(built.effects[1:], v, params.effects)
        pull = loads["gradient"] * v.params.rest.edge_mask
        return (pull - preceding(built.topology, pull))[2]

    for k in range(2 * count):
        angle = 2 * math.atan(0.5 * H * amplitude * math.sin(2 * math.pi * (k + 1) / count))
        before, start = resists(state), state.rods.pos[2]
        state = step(built, params, state, Control(corner(angle), torch.zeros(0, 3, dtype=F64)))
        work = -float((0.5 * (before + resists(state)) * (state.rods.pos[2] - start)).sum())
        lost += work if k >= count else 0.0
    assert lost == pytest.approx(4 * moment * (amplitude - kc * math.tanh(amplitude / kc)) * H, rel=1e-4)


def test_friction_in_bending_turns_with_the_material_directors():
    # The same motion with the first director turned by a about the rope: the vector z turns by -a in its components.
    turn, seen = 0.7, []
    for a in (0.0, turn):
        built, params, state = rubbing(n=corner(0.0), director=vec(0, math.cos(a), math.sin(a)))
        for k in range(12):
            x = corner(0.0).clone()
            tip = vec(1.0, 0.03 * k, 0.3 * math.sin(0.5 * k))
            x[2] = H * tip / tip.norm()
            state = step(built, params, state, Control(x, torch.zeros(0, 3, dtype=F64)))
        seen.append(remembered(state))
    c, s = math.cos(turn), math.sin(turn)
    assert torch.allclose(seen[1], vec(c * seen[0][0] + s * seen[0][1], c * seen[0][1] - s * seen[0][0]), atol=1e-12)
    assert float(seen[0].abs().min()) > 0.05


CURVED = {"mass": 0.1, "bend": 1e-3, "twist": 2e-3, "rest": "as_placed"}


def bent(names: list[str], values: dict, **given):
    """A rope that is curved, twisted and away from its curved rest shape."""
    rope = Rope(wild(7, 3), **(CURVED | given))
    built, params, state = make([rope], effects(*names), values, constrained=False, check=False)
    r = state.rods
    twist = rand(*r.twist.shape, seed=4, low=-0.5, high=0.5)
    pos = r.pos + 0.02 * rand(*r.pos.shape, seed=5, low=-1)
    v = view(built, params, state, pos, twist)
    return built, params, tree.replace(state, rods=v.state)


LAWS = {
    "three numbers": (["bend_frame", "anisotropic_bending"], {}, 0),
    "three numbers from two": (["bend_frame", "anisotropic_bending"], {"bend2": 3e-3}, 0),
    "stiffening": (["stiffening_bending"], {}, 0),
    "stiffening of two": (["stiffening_bending"], {"bend2": 3e-3}, 0),
    "stiffening of three": (["stiffening_bending", "anisotropic_bending"], {"bend2": 3e-3}, 0),
}
NUMBERS = {"stiffening_bending": {"c": 0.03}, "anisotropic_bending": {"ratio": 2.5, "direction": 0.4}}


@pytest.mark.parametrize("case", LAWS)
def test_loads_are_the_gradient_of_the_energy_and_their_answers_its_second_derivative(case):
    names, given, law = LAWS[case]
    values = {name: NUMBERS[name] for name in names if name in NUMBERS}
    built, params, state = bent(names, values, **given)
    one = built.effects[law]
    pos, twist = state.rods.pos.clone().requires_grad_(), state.rods.twist.clone().requires_grad_()
    v = view(built, params, state, pos, twist)
    by_pos, by_twist = torch.autograd.grad(one.energy(v, params.effects[one.name]).sum(), (pos, twist))
    loads = one.loads(view(built, params, state), params.effects[one.name])
    mask = v.params.rest.edge_mask
    pull = loads["gradient"] * mask
    force = pull - preceding(built.topology, pull)
    assert float((force + by_pos).abs().max()) <= 1e-12 * float(by_pos.abs().max())
    assert float((loads["torque"] * mask + by_twist).abs().max()) <= 1e-12 * float(by_twist.abs().max())

    def energy(angle):
        s = tree.replace(state, rods=tree.replace(state.rods, twist=angle[:, None]))
        return one.energy(view(built, params, s), params.effects[one.name]).sum()

    second = torch.autograd.functional.hessian(energy, state.rods.twist[:, 0])[:6, :6]
    here = view(built, params, state)
    same, after = _twist_matrix(here, loads)
    same = same + loads["twist_geometry"][..., 1:] + here.next(loads["twist_geometry"][..., :1])
    found = torch.diag(same[:6, 0]) + torch.diag(after[:5, 0], 1) + torch.diag(after[:5, 0], -1)
    assert float((found - second).abs().max()) <= 1e-12 * float(second.abs().max())


def test_friction_in_bending_answers_to_twist_as_it_says():
    # Derivatives of the torques by the twists, the part that has no energy included.
    built, params, state = bent(["internal_friction"], {"internal_friction": {"moment": 2e-3, "kappa_c": 2.0}})
    one, values = built.effects[0], params.effects["internal_friction"]
    for k in range(3):  # a path that turns
        memory = one.update_memory(view(built, params, state), values)
        r = state.rods
        pos = r.pos + 0.01 * rand(*r.pos.shape, seed=20 + k, low=-1)
        state = tree.replace(state, rods=view(built, params, state, pos).state)
        state = tree.replace(state, rods=tree.replace(state.rods, memory={one.name: memory}))

    def torque(angle):
        s = tree.replace(state, rods=tree.replace(state.rods, twist=angle[:, None]))
        return -one.loads(view(built, params, s), values)["torque"][:, 0]

    wanted = torch.autograd.functional.jacobian(torque, state.rods.twist[:, 0])[:6, :6]
    here = view(built, params, state)
    loads = one.loads(here, values)
    same, after = _twist_matrix(here, loads)
    same = same + loads["twist_geometry"][..., 1:] + here.next(loads["twist_geometry"][..., :1])
    skew = here.next(loads["twist_skew"])
    found = torch.diag(same[:6, 0]) + torch.diag((after + skew)[:5, 0], 1) + torch.diag((after - skew)[:5, 0], -1)
    assert float((found - wanted).abs().max()) <= 1e-12 * float(wanted.abs().max())
    assert float((wanted - wanted.T).abs().max()) > 1e-6 * float(wanted.abs().max())


def test_stiffening_adds_a_cubic_moment():
    # A hinge bent to k has M = B (k + c k^3): its tip, at distance H across, is pushed with M / (H) cos^2(angle / 2)
    # = dE/dangle / H, with kappa l = 2 tan(angle / 2).
    angle, bend, c = 0.8, 1e-3, 0.05
    built, params, state = make(
        [Rope(corner(angle), mass=0.1, bend=bend)],
        effects("bend_frame", "stiffening_bending"),
        {"stiffening_bending": {"c": c}},
    )
    v = view(built, params, state)
    loads = effect.total_loads(built.effects, v, params.effects)
    pull = loads["gradient"] * v.params.rest.edge_mask
    force = (pull - preceding(built.topology, pull))[2]
    k = 2 * math.tan(angle / 2) / H
    moment = bend * (k + c * k**3)
    across = vec(-math.sin(angle), math.cos(angle), 0)
    assert float(force @ across) == pytest.approx(-moment / math.cos(angle / 2) ** 2 / H, rel=1e-12)


@pytest.mark.parametrize("given", [{}, {"bend2": 4e-3}], ids=["one", "two"])
def test_anisotropy_keeps_the_mean_and_points_where_it_says(given):
    # Alone: eigenvalues B sqrt(r), B / sqrt(r), the first towards (cos a, sin a). On any B the determinant stays.
    r, a = 2.5, 0.4
    built, params, state = bent(
        ["bend_frame", "anisotropic_bending"], {"anisotropic_bending": {"ratio": r, "direction": a}}, **given
    )
    made = view(built, params, state).params.material.bend[0]
    matrix = torch.stack([made[[0, 2]], made[[2, 1]]])
    assert float(torch.linalg.det(matrix)) == pytest.approx(1e-3 * given.get("bend2", 1e-3), rel=1e-13)
    if not given:
        n = vec(math.cos(a), math.sin(a))
        assert torch.allclose(matrix @ n, 1e-3 * math.sqrt(r) * n, rtol=1e-13)


def test_a_rope_bends_least_towards_the_stiffer_direction():
    # A hinge bent towards n = cos a m1 + sin a m2 stores B sqrt(r) |kappa|^2 / 2 l, across it B / sqrt(r).
    r, a, angle = 3.0, 0.6, 0.3
    for towards, factor in ((a, math.sqrt(r)), (a + math.pi / 2, 1 / math.sqrt(r))):
        # m1 is y and m2 is z on the first edge; the turn without twist keeps their plane of bending.
        n = vec(0, math.cos(towards), math.sin(towards))
        x = torch.stack([vec(-H, 0, 0), vec(0, 0, 0), H * (math.cos(angle) * vec(1, 0, 0) + math.sin(angle) * n)])
        built, params, state = make(
            [Rope(x, mass=0.1, bend=1e-3, director=vec(0, 1, 0))],
            effects("bend_frame", "anisotropic_bending"),
            {"anisotropic_bending": {"ratio": r, "direction": a}},
        )
        energy = built.effects[0].energy(view(built, params, state), {}).sum()
        squared = (2 * math.tan(angle / 2)) ** 2
        assert float(energy) == pytest.approx(0.5 * 1e-3 * factor * squared / H, rel=1e-12)


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("names", [[], ["anisotropic_bending"]], ids=["one", "three"])
def test_a_clamp_that_turns_is_a_spring_in_series(names, share):
    # (l B^-1 + 1/k)^-1 = B' / l at the clamp's hinge, in bending and in twist; nothing elsewhere. The hinge may stand
    # for less rope than lies between the middles of its edges; the spring is not softer for that.
    spring, n, span = 0.03, 6, share * H
    built, params, _ = make(
        [Rope(straight(n, 0.5), mass=0.1, bend=1e-3, twist=2e-3)],
        [GripperCompliance(hinges=(1,)), *effects("bend_frame", "twist", *names)],
        {"gripper_compliance": {"stiffness": spring}} | {name: NUMBERS[name] for name in names},
        check=True,
    )
    rest = params.rods.rest
    rods = tree.replace(params.rods, rest=tree.replace(rest, share=share * rest.share))
    free = effect.altered_params(built.effects[1:], built.topology, rods, params.effects).material
    held = effect.altered_params(built.effects, built.topology, rods, params.effects).material

    def matrix(bend):
        return torch.stack([bend[[0, 2]], bend[[2, 1]]]) if bend.shape[-1] == 3 else bend[:, None]

    before, after = matrix(free.bend[1]) / span, matrix(held.bend[1]) / span
    wanted = torch.linalg.inv(torch.linalg.inv(before) + torch.eye(len(before), dtype=F64) / spring)
    assert torch.allclose(after, wanted, rtol=1e-13, atol=0.0)
    assert float(held.twist[1]) / span == pytest.approx(1 / (span / 2e-3 + 1 / spring), rel=1e-13)
    others = [0, 2, 3, 4, 5]
    assert torch.equal(held.bend[others], free.bend[others].expand_as(held.bend[others]))


@pytest.mark.parametrize("hinges", [(), (0,), (5,), (9,)])
def test_clamps_that_are_not_at_hinges_are_refused(hinges):
    with pytest.raises(ValueError, match="gripper_compliance: hinges"):
        make([Rope(straight(6), mass=0.1)], [*effects("bend"), GripperCompliance(hinges=hinges)])


@pytest.mark.compile
@pytest.mark.slow
def test_compiled_steps_with_every_law_equal_eager_ones():
    # The same operations in another order: 1e-10 of the rope's size after 20 steps.
    laws = ["internal_friction", "stiffening_bending", "anisotropic_bending", "stretch", "wind", "tilted_gravity"]
    values = {"wind": {"velocity": (1.0, 2.0, 0.0)}, "stretch": {"EA": 60.0}, "tilted_gravity": {"angles": (0.1, 0.0)}}
    values |= NUMBERS | {"internal_friction": {"moment": 1e-3}, "gripper_compliance": {"stiffness": 0.02}}
    x = straight(8, 0.7).expand(3, 8, 3).clone()
    built, params, state = make(
        [Rope(x, mass=0.1, bend=1e-3, twist=2e-3, radius=0.01, velocities=rand(3, 8, 3, low=-0.3, high=0.3))],
        [*effects("bend_frame", "twist", "gravity", "damping", *laws), GripperCompliance(hinges=(1,))],
        values,
        integrator="implicit",
        # In balance, every Newton step is a copy of the laws: it compiles for minutes and shows nothing else.
        twist="dynamic",
        dt=2e-3,
        substeps=1,
        prescribed_vertices=(0, 1),
        prescribed_edges=(0,),
    )
    control = stationary_control(built, state)
    compiled, eager = state, state
    fast = stepper(built)
    with torch.no_grad():
        for _ in range(20):
            compiled, eager = fast(params, compiled, control), step(built, params, eager, control)
    assert float((compiled.rods.pos - eager.rods.pos).abs().max()) < 1e-10
    memory = (compiled.rods.memory["internal_friction"], eager.rods.memory["internal_friction"])
    assert float((memory[0] - memory[1]).abs().max()) < 1e-9
    assert float(memory[1][..., :2].abs().max()) > 1e-2
    assert rod.view(built.topology, params.rods, eager.rods, 1.0).length.isfinite().all()
