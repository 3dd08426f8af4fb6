"""Clamps with play, clamps that creep, and ropes in a liquid against closed forms."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import F64, rand, straight, vec, view, wild

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.elastic import bending_moments, curvature, elastic_curvature, hinge_stiffness
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.physics.effects.loose_clamps import GripperDamping, GripperPlay
from torchdlo.physics.integrators.rod_step import _twist_matrix
from torchdlo.physics.rod.topology import preceding
from torchdlo.scene import Control, Rope, make, stationary_control, step

H, G = 0.1, 9.81
PLAY = {"angle": 0.1, "stiffness": 0.03}
CURVED = {"mass": 0.1, "bend": 1e-3, "twist": 2e-3, "rest": "as_placed"}


def corner(angle: float) -> torch.Tensor:
    return torch.stack([vec(-H, 0, 0), vec(0, 0, 0), vec(H * math.cos(angle), H * math.sin(angle), 0)])


def bent(laws: list, values: dict, shift: float, **given):
    """A rope that is curved, twisted and away from its curved rest shape."""
    rope = Rope(wild(7, 3), **(CURVED | given))
    built, params, state = make([rope], laws, values, constrained=False, check=False)
    r = state.rods
    twist = rand(*r.twist.shape, seed=4, low=-0.5, high=0.5)
    v = view(built, params, state, r.pos + shift * rand(*r.pos.shape, seed=5, low=-1), twist)
    return built, params, tree.replace(state, rods=v.state)


def played_energy(v, angle: float) -> torch.Tensor:
    """Energy of the hinges with the play taken off the bend of hinge 1."""
    strain = elastic_curvature(v, curvature(v))
    beyond = (1 - 2 * math.tan(angle / 2) / strain[1].norm()).clamp(min=0.0)
    strain = torch.cat([strain[:1], beyond * strain[1:2], strain[2:]])
    return 0.5 * (bending_moments(hinge_stiffness(v), strain) * strain).sum()


@pytest.mark.parametrize("given", [{}, {"bend2": 3e-3}, "three"], ids=["one", "two", "three"])
@pytest.mark.parametrize("angle", [0.05, 1.2], ids=["beyond", "within"])
def test_play_is_taken_off_the_energy_of_the_hinge(angle, given):
    # Loads are minus the gradient, answers to twist the second derivative of E(b (1 - p / |b|)): rounding.
    more = [EFFECTS["anisotropic_bending"]()] if given == "three" else []
    values = {"gripper_play": PLAY | {"angle": angle}}
    values |= {"anisotropic_bending": {"ratio": 2.5, "direction": 0.4}} if more else {}
    laws = [EFFECTS["bend_frame"](), *more, GripperPlay(hinges=(1,))]
    built, params, state = bent(laws, values, 0.05, **(given if given != "three" else {}))
    bend = elastic_curvature(view(built, params, state), curvature(view(built, params, state)))[1].norm()
    assert bool(bend > 2 * math.tan(angle / 2)) == (angle < 1)
    pos, twist = state.rods.pos.clone().requires_grad_(), state.rods.twist.clone().requires_grad_()
    by_pos, by_twist = torch.autograd.grad(played_energy(view(built, params, state, pos, twist), angle), (pos, twist))
    here = view(built, params, state)
    loads = effect.total_loads(built.effects, here, params.effects)
    mask = here.params.rest.edge_mask
    pull = loads["gradient"] * mask
    assert float((pull - preceding(built.topology, pull) + by_pos).abs().max()) <= 1e-12 * float(by_pos.abs().max())
    assert float((loads["torque"] * mask + by_twist).abs().max()) <= 1e-12 * float(by_twist.abs().max())

    def energy(turn):
        s = tree.replace(state, rods=tree.replace(state.rods, twist=turn[:, None]))
        return played_energy(view(built, params, s), angle)

    second = torch.autograd.functional.hessian(energy, state.rods.twist[:, 0])[:6, :6]
    same, after = _twist_matrix(here, loads)
    same = same + loads["twist_geometry"][..., 1:] + here.next(loads["twist_geometry"][..., :1])
    found = torch.diag(same[:6, 0]) + torch.diag(after[:5, 0], 1) + torch.diag(after[:5, 0], -1)
    assert float((found - second).abs().max()) <= 1e-12 * float(second.abs().max())


def hanging(laws: list, values: dict, seconds: float, dt: float = 1e-2):
    """Sine of the turn of a stiff bar of 0.4 m and 0.1 kg that a clamp holds level, after some seconds."""
    choices = {"integrator": "implicit", "twist": "quasistatic", "dt": dt, "substeps": 1, "implicit_weight": 0.3}
    rope = Rope(straight(6, 0.5), mass=0.125, bend=1e3, twist=1e3)
    built, params, state = make(
        [rope],
        [EFFECTS[n]() for n in ("gravity", "bend_frame", "twist", "damping")] + laws,
        {"damping": {"rate": 30.0}} | values,
        prescribed_vertices=(0, 1),
        prescribed_edges=(0,),
        **choices,
    )
    control = stationary_control(built, state)
    for _ in range(round(seconds / dt)):
        state = step(built, params, state, control)
    x = state.rods.pos
    return float((x[1, 2] - x[-1, 2]) / 0.4)


def bar_turn(play: float, spring: float) -> float:
    """Turn of the bar at rest: spring (turn - play) = m g cos(turn) L / 2, with a chain's masses."""
    # Of masses m / 5 at 0.1 to 0.3 m, m / 10 at 0.4 m, for m = 0.125 kg: the bar beyond the clamp.
    moment = G * 0.125 * (0.2 * (0.1 + 0.2 + 0.3) + 0.1 * 0.4)
    turn = 0.0
    for _ in range(200):
        turn = 0.5 * turn + 0.5 * (play + moment * math.cos(turn) / spring)
    return turn


def test_a_bar_in_a_clamp_with_play_hangs_by_the_play_and_the_spring():
    # The hinge's bend is 2 tan(turn / 2), its moment k (2 tan(turn / 2) - 2 tan(play / 2)) / cos^2(turn / 2):
    # turn^2 / 3 beside the law, 2e-3 of 0.08 rad; the bar itself bends by 1e-3 of it.
    for play in (0.0, 0.04):
        values = {"gripper_play": {"angle": play, "stiffness": 5.0}}
        turn = math.asin(hanging([GripperPlay(hinges=(1,))], values, 1.0))
        assert turn == pytest.approx(bar_turn(play, 5.0), rel=5e-3)


def test_play_without_an_angle_is_an_elastic_clamp():
    both = []
    for law, more in ((GripperCompliance, {}), (GripperPlay, {"angle": 0.0})):
        both.append(hanging([law(hinges=(1,))], {law.name: {"stiffness": 5.0} | more}, 0.2))
    assert both[0] == pytest.approx(both[1], abs=1e-12)


def test_damping_without_a_loss_time_is_an_elastic_clamp_and_with_one_comes_to_the_same_rest():
    elastic = hanging([GripperCompliance(hinges=(1,))], {"gripper_compliance": {"stiffness": 5.0}}, 0.2)
    spring = hanging([GripperDamping(hinges=(1,))], {"gripper_damping": {"stiffness": 5.0, "loss_time": 0.0}}, 0.2)
    assert spring == pytest.approx(elastic, abs=1e-12)
    late = hanging([GripperDamping(hinges=(1,))], {"gripper_damping": {"stiffness": 5.0, "loss_time": 0.1}}, 1.2)
    assert math.asin(late) == pytest.approx(bar_turn(0.0, 5.0), rel=5e-3)
    early = hanging([GripperDamping(hinges=(1,))], {"gripper_damping": {"stiffness": 5.0, "loss_time": 0.1}}, 0.05)
    assert early < 0.7 * late


@pytest.mark.parametrize("given", [{}, {"bend2": 3e-3}], ids=["one", "two"])
def test_a_bend_that_is_held_creeps_in_a_damped_clamp(given):
    # (loss_time / (1 + S / k)) t' = t_rest - t, t_rest = b S / (S + k); Euler's implicit rule after n steps has
    # 1 - (1 + dt / time)^-n of it. The moment is S (b - t). Exact in every direction of its own.
    spring, loss, dt, count, angle = 0.02, 0.05, 2e-3, 30, 0.3
    built, params, state = make(
        [Rope(corner(0.0), mass=0.1, bend=1e-3, director=vec(0, math.cos(0.5), math.sin(0.5)), **given)],
        [EFFECTS["bend_frame"](), GripperDamping(hinges=(1,))],
        {"gripper_damping": {"stiffness": spring, "loss_time": loss}},
        dt=dt,
        substeps=1,
        prescribed_vertices=(0, 1, 2),
    )
    control = Control(corner(0.0), torch.zeros(0, 3, dtype=F64))
    state = step(built, params, state, control)
    for _ in range(count + 1):  # what is remembered is that of the state before
        state = step(built, params, state, Control(corner(angle), control.director))
    here = view(built, params, state)
    bend = elastic_curvature(here, curvature(here))[1]
    assert float(bend.norm()) == pytest.approx(2 * math.tan(angle / 2), rel=1e-12)
    turn, stiffness = state.rods.memory["gripper_damping"][1, :2], vec(1e-3, 3e-3 if given else 1e-3) / H
    time = loss / (1 + stiffness / spring)
    assert torch.allclose(
        turn, bend * stiffness / (stiffness + spring) * (1 - (1 + dt / time) ** -count), rtol=1e-10, atol=0.0
    )
    # The turn of the next substep goes with the loads.
    after = bend * stiffness / (stiffness + spring) * (1 - (1 + dt / time) ** -(count + 1))
    loads = effect.total_loads(built.effects, here, params.effects)
    moment = stiffness * (bend - after)
    wanted = curvature(here).pull_back(here, torch.stack([0 * moment, moment, 0 * moment]))
    assert torch.allclose(loads["gradient"], wanted["gradient"], rtol=1e-10, atol=1e-15)


def test_damping_answers_to_twist_as_it_says():
    laws = [EFFECTS["anisotropic_bending"](), GripperDamping(hinges=(1,))]
    values = {"gripper_damping": {"stiffness": 0.02, "loss_time": 0.01}}
    values |= {"anisotropic_bending": {"ratio": 2.5, "direction": 0.4}}
    built, params, state = bent(laws, values, 0.05)
    one, own = built.effects[1], params.effects["gripper_damping"]
    r, before = state.rods, view(built, params, state)
    memory = one.update_memory(before, own)
    moved = view(built, params, state, r.pos + 0.02 * rand(*r.pos.shape, seed=9, low=-1)).state
    state = tree.replace(state, rods=tree.replace(moved, memory={one.name: memory}))

    def torque(turn):
        s = tree.replace(state, rods=tree.replace(state.rods, twist=turn[:, None]))
        return -one.loads(view(built, params, s), own)["torque"][:, 0]

    wanted = torch.autograd.functional.jacobian(torque, state.rods.twist[:, 0])[:6, :6]
    here = view(built, params, state)
    loads = one.loads(here, own)
    same, after = _twist_matrix(here, loads)
    same = same + loads["twist_geometry"][..., 1:] + here.next(loads["twist_geometry"][..., :1])
    found = torch.diag(same[:6, 0]) + torch.diag(after[:5, 0], 1) + torch.diag(after[:5, 0], -1)
    assert float((found - wanted).abs().max()) <= 1e-11 * float(wanted.abs().max())
    assert float(loads["hinge_stiffness"][1]) > 0 and float(loads["hinge_stiffness"][[0, 2, 3, 4, 5]].abs().max()) == 0


@pytest.mark.parametrize("law", [GripperPlay, GripperDamping])
def test_loose_clamps_that_are_not_at_hinges_are_refused(law):
    with pytest.raises(ValueError, match=f"{law.name}: hinges"):
        make([Rope(straight(6), mass=0.1)], [EFFECTS["bend_frame"](), law(hinges=(0,))])


RADIUS, LENGTH, MASS, WATER = 0.01, 1.0, 0.5, 1000.0
DISPLACED = WATER * math.pi * RADIUS**2 * LENGTH


def sinking(direction, numbers: dict, seconds: float, integrator: str, dt: float = 1e-3):
    """Velocity of a straight rope that was let go in water [m/s]."""
    built, params, state = make(
        [Rope(straight(9, LENGTH, along=direction), mass=MASS, bend=0.1, radius=RADIUS)],
        [EFFECTS[n]() for n in ("gravity", "bend", "buoyancy", "fluid_forces")],
        {"fluid_forces": numbers, "gravity": {"acceleration": (0, 0, -G)}, "buoyancy": {"acceleration": (0, 0, -G)}},
        integrator=integrator,
        dt=dt,
        substeps=1,
    )
    control = stationary_control(built, state)
    with torch.no_grad():
        for _ in range(round(seconds / dt)):
            state = step(built, params, state, control)
    return (params.rods.material.mass * state.rods.vel).sum(0) / MASS


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_a_rope_sinks_as_fast_as_drag_lets_it(integrator):
    # Across: (m - displaced) g = density r c L v^2; along: the same with pi times the friction of the surface.
    weight = (MASS - DISPLACED) * G
    across = sinking((1, 0, 0), {"across": 1.2}, 0.6, integrator, 5e-3)
    assert float(across[2]) == pytest.approx(-math.sqrt(weight / (WATER * RADIUS * 1.2 * LENGTH)), rel=1e-4)
    along = sinking((0, 0, 1), {"along": 0.05}, 1.6, integrator, 1e-2)
    assert float(along[2]) == pytest.approx(-math.sqrt(weight / (math.pi * WATER * RADIUS * 0.05 * LENGTH)), rel=1e-4)


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_added_mass_slows_the_fall_across_and_not_along(integrator):
    # Oblique by a: accelerations g' sin a along and g' cos a m / (m + added) across, g' = (1 - displaced / m) g.
    # Along it lags by added / (m + added) steps or less: of first order.
    coefficient, a, errors = 3.0, 0.6, []
    added = coefficient * DISPLACED
    along, across = vec(math.cos(a), 0, -math.sin(a)), vec(math.sin(a), 0, math.cos(a))
    fall = (1 - DISPLACED / MASS) * G
    for dt in (1e-3, 5e-4):
        v = sinking((math.cos(a), 0, -math.sin(a)), {"added_mass": coefficient}, 0.02, integrator, dt)
        time = 0.02 - dt / 2  # velocities live half a step earlier
        assert float(v @ across) == pytest.approx(-fall * math.cos(a) * MASS / (MASS + added) * time, rel=1e-9)
        errors.append(abs(float(v @ along) - fall * math.sin(a) * time))
    assert errors[0] < 2e-3 * fall * math.sin(a) * added / MASS
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.05)


def test_air_drag_is_a_fluid_without_friction_along_and_added_mass():
    x, v = wild(7, 1), rand(7, 3, seed=2, low=-1)
    found = []
    for name, values in (("air_drag", {"c_d": 1.1}), ("fluid_forces", {"across": 1.1, "density": 1.2})):
        rope = Rope(x, velocities=v, mass=0.1, bend=1e-3, radius=0.01)
        built, params, state = make([rope], [EFFECTS["bend"](), EFFECTS[name]()], {name: values})
        found.append(effect.total_loads(built.effects[1:], view(built, params, state), params.effects))
    for key in ("force", "drag"):
        assert torch.allclose(found[0][key], found[1][key], rtol=1e-12, atol=0.0), key
