"""What every effect promises; a new one is tested by being in `EFFECTS`."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from contract import ACTIVE, F64, INSTANCES, default_values, respond, ropes, scene, track

from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import KINDS, LOADS, Effect, altered_params, observed_markers
from torchdlo.physics.linalg import rotation
from torchdlo.physics.rod import kinematics as rod
from torchdlo.scene import Rope, make, stationary_control, step

NAMES = [name for name, law in EFFECTS.items() if not law.is_contact]
"""What touches stands above the physics, and is tested in tests/coupling."""

each = pytest.mark.parametrize("name", NAMES)
LAWS = {"stretch_force", "bend", "bend_frame", "twist"}


@each
def test_effect_declares_its_numbers_completely(name):
    cls = EFFECTS[name]
    assert issubclass(cls, Effect) and dataclasses.is_dataclass(cls) and cls.__dataclass_params__.frozen
    assert cls.name == name or (cls.name, name) == ("bend", "bend_frame")
    assert cls.__doc__ and cls.kind in KINDS
    for number, p in cls.params.items():
        default = p.default if isinstance(p.default, tuple) else (p.default,)
        assert all(p.low <= d <= p.high for d in default), (
            f"{name}.{number}: default {p.default} outside {p.low} to {p.high}"
        )
        assert p.unit and p.doc.endswith(".") and len(p.doc) > 8, f"{name}.{number}"
        assert (
            p.scale in ("log", "linear", "reciprocal")
            and math.isfinite(p.low)
            and math.isfinite(p.high)
            and p.low < p.high
        )
        assert p.scale == "linear" or p.low > 0, f"{name}.{number}: {p.scale} from {p.low}"
        assert p.scale != "reciprocal" or p.off == p.high, f"{name}.{number}: a stiffness in series is off at its most"
        assert p.off is None or p.low <= p.off <= p.high or (name, p.off) == ("damping", 0.0)
        assert p.size == len(default)
        x = torch.tensor([0.9 * p.low + 0.1 * p.high, p.high], dtype=F64)
        assert torch.allclose(p.value(p.coordinate(x)), x, rtol=1e-14, atol=0.0), f"{name}.{number}"
    values = default_values(cls, torch.zeros(3, 3, dtype=F64))
    assert {k: v.shape for k, v in values.items()} == {k: (1, p.size) for k, p in cls.params.items()}


@each
def test_loads_have_declared_names_and_shapes(name):
    made, params, state = scene(name, (3,))
    found = respond(made, params, state)
    assert found, "nothing happens: give the contract numbers at which the effect acts"
    v = state.rods.pos.shape[-2]
    columns = {"twist_hessian": 3, "twist_geometry": 2, "flow": 2}
    columns |= dict.fromkeys(("force", "acceleration", "gradient", "stiffness", "drag"), 3)
    for key, load in found.items():
        if key.startswith("altered"):
            continue
        if key in ("remembered", "observed"):
            wanted = (3, v, EFFECTS[name].memory) if key == "remembered" else (3, 7, v - 1, 3)
            assert load.shape == wanted, (key, load.shape)
            continue
        assert key in LOADS or key == "flow", key
        rows = (1,) if key in ("acceleration", "rate", "twist_decay") else (1, v)
        assert load.shape[-1] == columns.get(key, 1) and load.shape[-2] in rows, (key, load.shape)
        assert torch.broadcast_shapes(load.shape, (3, v, load.shape[-1])) == (3, v, load.shape[-1])


@each
def test_effect_does_nothing_when_it_is_off(name):
    off = {number: p for number, p in EFFECTS[name].params.items() if p.off is not None}
    if not off:
        assert name in LAWS | {"table"}, f"{name} cannot be switched off"
        return
    made, params, state = scene(name)
    values = dict(params.effects[EFFECTS[name].name])
    for number, p in off.items():
        values[number] = torch.full_like(values[number], p.off)
    for key, load in respond(made, params, state, values).items():
        if key != "remembered":
            assert float(load.abs().max()) == 0.0, f"{name}: {key} is not zero"


def degenerate() -> dict[str, list[Rope]]:
    """Ropes in which plain square roots and angles have no derivative."""

    def line(*x):
        return torch.stack([torch.tensor(p, dtype=F64) for p in x])

    given = {"mass": 0.1, "bend": 1e-3, "twist": 2e-3, "stretch": 50.0, "radius": 0.01}
    straight = line((0, 0, 0.01), (0.1, 0, 0.01), (0.2, 0, 0.01), (0.3, 0, 0.01), (0.4, 0, 0.01))
    folded = line((0, 0, 0.01), (0.1, 0, 0.01), (0, 0, 0.01), (0.1, 0, 0.01), (0.2, 0, 0.01))
    return {
        "straight, at rest, touching exactly": [Rope(straight, **given)],
        "folded flat": [Rope(folded, rest=straight, **given)],
        "moving along itself": [Rope(straight, velocities=torch.tensor([1.0, 0, 0], dtype=F64).expand(5, 3), **given)],
    }


@each
@pytest.mark.parametrize("case", [*degenerate(), "neighbours coincide"])
def test_loads_and_gradients_are_finite_in_degenerate_states(name, case):
    rope = degenerate().get(case, degenerate()["straight, at rest, touching exactly"])
    made, params, state = scene(name, given=rope)
    r = state.rods
    state = tree.replace(
        state, rods=tree.replace(r, twist=torch.zeros_like(r.twist), twist_rate=torch.zeros_like(r.twist_rate))
    )
    if case == "neighbours coincide":
        pos = state.rods.pos.clone()
        pos[2] = pos[1]
        state = tree.replace(state, rods=tree.replace(state.rods, pos=pos))
    values = params.effects[EFFECTS[name].name]
    if name.startswith("table"):  # the surface at which vertices exactly touch
        values = values | {"height": torch.zeros(1, 1, dtype=F64)}
    leaves, rebuild = tree.flatten((params.rods, state.rods, values))
    inputs = [x.detach().clone().requires_grad_() for x in leaves]
    rods, now, numbers = rebuild(inputs)
    found = respond(made, tree.replace(params, rods=rods), tree.replace(state, rods=now), numbers)
    assert all(bool(torch.isfinite(load).all()) for load in found.values()), {
        k: bool(torch.isfinite(x).all()) for k, x in found.items()
    }
    total = sum(load.sum() for load in found.values() if load.requires_grad)
    if not isinstance(total, torch.Tensor):
        return
    for leaf, g in zip(inputs, torch.autograd.grad(total, inputs, allow_unused=True), strict=True):
        assert g is None or bool(torch.isfinite(g).all()), leaf.shape


@each
@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["float32", "float64"])
def test_precision_is_kept_and_single_is_close_to_double(name, dtype):
    made, params, state = scene(name, dtype=dtype)
    found = respond(made, params, state)
    assert all(load.dtype == dtype for load in found.values()), {k: x.dtype for k, x in found.items()}
    if dtype == torch.float32:
        exact = respond(*scene(name))
        for key, load in found.items():
            assert float((load - exact[key]).abs().max()) <= 1e-4 * float(exact[key].abs().max()) + 1e-9, key


@each
def test_batch_equals_singles(name):
    made, params, state = scene(name, (3,))
    many = respond(made, params, state)
    for k in range(3):
        one = tree.replace(state, rods=tree.map(lambda x, k=k: x[k], state.rods), time=state.time[k])
        rods = tree.map(lambda x, k=k: x[k] if x.dim() == 3 else x, params.rods)
        for key, load in respond(made, tree.replace(params, rods=rods), one).items():
            wanted = many[key][k] if many[key].dim() >= 3 else many[key]
            assert float((load - wanted).abs().max()) <= 1e-12 * max(float(wanted.abs().max()), 1e-12), key


@each
def test_a_number_for_each_scene_equals_one_scene_at_a_time(name):
    # Numbers (batch, 1, C) on one state without batch axes.
    made, params, state = scene(name)
    given = params.effects[EFFECTS[name].name]
    factors = torch.tensor([0.7, 1.0, 1.2], dtype=F64)[:, None, None]
    many = respond(made, params, state, {number: factors * x for number, x in given.items()})
    for k in range(3):
        for key, load in respond(made, params, state, {number: factors[k] * x for number, x in given.items()}).items():
            found = many[key][k] if many[key].dim() > load.dim() else many[key]
            assert float((found - load).abs().max()) <= 1e-12 * max(float(load.abs().max()), 1e-12), key


VECTORS = {"force", "acceleration", "gradient", "observed"}
# Numbers that are directions in the world: they turn along.
WORLD = {
    "gravity": ["acceleration"],
    "wind": ["velocity"],
    "tilted_gravity": ["acceleration", "angles"],
    "buoyancy": ["acceleration"],
}


@each
@pytest.mark.parametrize("angle", [0.0, math.pi / 2, 2.1])
def test_loads_turn_about_the_vertical_and_move_with_the_rope(name, angle):
    # Nothing distinguishes a horizontal direction or place: forces turn, scalars stay.
    q = torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], dtype=F64)

    def turn(x):
        return rotation.rotate(q.expand(*x.shape[:-1], 4), x)

    made, params, state = scene(name)
    shift = torch.tensor([0.7, -1.3, 0.0 if name.startswith("table") else 0.9], dtype=F64)
    r = state.rods
    moved = tree.replace(
        state, rods=tree.replace(r, pos=turn(r.pos) + shift, vel=turn(r.vel), director=turn(r.director))
    )
    values = dict(params.effects[made.effects[0].name])
    for number in WORLD.get(name, []):
        x = values[number]
        flat = torch.cat([x, torch.zeros_like(x[..., :1])], -1) if x.shape[-1] == 2 else x
        values[number] = turn(flat)[..., : x.shape[-1]]
    before, after = respond(made, params, state), respond(made, params, moved, values)
    for key, load in before.items():
        if key == "remembered" and made.effects[0].kind == "force":
            continue  # vectors and scalars together
        if key in ("stiffness", "drag"):
            # Diagonals of resistance along the axes: only their trace is turned along.
            load, other = load.sum(-1), after[key].sum(-1)
        else:
            load, other = turn(load) if key in VECTORS else load, after[key]
        assert float((load - other).abs().max()) <= 1e-9 * max(float(load.abs().max()), 1e-9), key


@each
def test_resistances_are_not_negative(name):
    made, params, state = scene(name)
    for key, load in respond(made, params, state).items():
        if key in ("stiffness", "drag", "hinge_stiffness", "hinge_drag", "rate", "twist_decay", "edge_stiffness"):
            assert float(load.min()) >= 0, key


def test_internal_effects_exert_no_total_force():
    inner = [n for n, cls in EFFECTS.items() if cls.kind == "material"]
    assert {"stretch_force", "bend", "internal_friction", "stiffening_bending"} <= set(inner)
    for name in inner:
        made, params, state = scene(name)
        assert "force" not in respond(made, params, state), (
            "inner forces belong in `gradient`, whose total is zero by construction"
        )
    assert ropes()


@each
def test_numbers_of_effects_that_are_off_have_gradients_to_search_along(name):
    # One over the number, for stiffnesses in series: at its off value the law itself must still answer.
    off = {number: p for number, p in EFFECTS[name].params.items() if p.off is not None}
    made, params, state = scene(name)
    values = dict(params.effects[EFFECTS[name].name])
    raw = {}
    for number, p in off.items():
        at = p.low if p.scale == "log" and p.off == 0 else p.off
        raw[number] = p.coordinate(torch.full_like(values[number], at)).requires_grad_()
        values[number] = p.value(raw[number])
    if not raw:
        return
    found = [load for key, load in respond(made, params, state, values).items() if key != "remembered"]
    weights = torch.Generator().manual_seed(3)
    total = sum((load * torch.rand(load.shape, generator=weights, dtype=F64)).sum() for load in found)
    for number, g in zip(raw, torch.autograd.grad(total, list(raw.values()), allow_unused=True), strict=True):
        if (name, number) == ("bending_plasticity", "yield_curvature"):
            continue  # flows only beyond yield, so that it cannot be felt from above
        assert g is not None and bool(torch.isfinite(g).all()) and float(g.abs().max()) > 0, number


@pytest.mark.parametrize(
    ("name", "number"), [(n, k) for n, cls in EFFECTS.items() for k, p in cls.params.items() if p.periodic]
)
def test_least_and_greatest_value_of_a_period_mean_the_same(name, number):
    p = EFFECTS[name].params[number]
    made, params, state = scene(name)
    values = dict(params.effects[EFFECTS[name].name])
    low, high = (
        respond(made, params, state, values | {number: torch.full_like(values[number], x)}) for x in (p.low, p.high)
    )
    for key, load in low.items():
        assert float((load - high[key]).abs().max()) <= 1e-12 * float(load.abs().max()), key


BASE = ["bend_frame", "twist", "gravity", "damping"]


def ten_steps(names: list[str], values: dict, integrator: str) -> torch.Tensor:
    """Positions of a clamped, curved rope after ten steps of 2 ms."""
    x = torch.linspace(0, 0.6, 7, dtype=F64)[:, None] * torch.tensor([0.8, 0.1, 0.5], dtype=F64)
    x = x + 0.02 * torch.sin(9 * x).flip(-1)
    rope = Rope(x, mass=0.1, bend=1e-3, twist=2e-3, radius=0.01, rest="as_placed", velocities=x.flip(-1))
    made = [INSTANCES.get(n) or EFFECTS[n]() for n in names]
    choices = {"dt": 2e-3, "substeps": 1, "integrator": integrator, "twist": "quasistatic"}
    built, params, state = make([rope], made, values, prescribed_vertices=(0, 1), prescribed_edges=(0,), **choices)
    control = stationary_control(built, state)
    for _ in range(10):
        state = step(built, params, state, control)
    return state.rods.pos


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("name", [n for n in NAMES if n not in LAWS | {"table", "gravity", "damping"}])
def test_motion_with_an_effect_that_is_off_is_that_without_it(name, integrator):
    # Same operations but for additions of zero and factors of one: 1e-12 of the rope's size.
    off = {number: p.off for number, p in EFFECTS[name].params.items() if p.off is not None}
    off = {number: (x,) * EFFECTS[name].params[number].size for number, x in off.items()}
    values = {name: ACTIVE.get(name, {}) | off}
    without, with_it = ten_steps(BASE, {}, integrator), ten_steps([*BASE, name], values, integrator)
    assert float((with_it - without).abs().max()) <= 1e-12
    # A yield point that these small motions reach, and damping that explicit steps of this length can follow.
    weaker = {"bending_plasticity": {"yield_curvature": 0.01}, "bending_damping": {"coefficient": 1e-4}}
    active = weaker.get(name, ACTIVE.get(name, {}))
    acting = ten_steps([*BASE, name], {name: active}, integrator)
    inert = EFFECTS[name].kind == "measurement" or name == "table_friction"  # nothing touches the table here
    assert inert or float((acting - without).abs().max()) > 1e-9


def test_effects_that_alter_the_same_number_compose_in_any_order():
    # Scaling and turning of the stiffness commute; clamps soften what the others have made, wherever they are listed.
    names = ["nonuniform_stiffness", "anisotropic_bending", "gripper_compliance", "point_mass", "stretch"]
    made, params, _ = scene("bend_frame")
    effects = [INSTANCES.get(n) or EFFECTS[n]() for n in names]
    values = {n: scene(n)[1].effects[n] for n in names}
    one = altered_params(effects, made.topology, params.rods, values)
    other = altered_params(effects[::-1], made.topology, params.rods, values)
    for a, b, before in zip(tree.leaves(one), tree.leaves(other), tree.leaves(params.rods), strict=True):
        assert torch.allclose(a, b, rtol=1e-13, atol=0.0)
        assert a.shape == before.shape or a.shape[-1] == 3
    assert not torch.equal(one.material.mass, params.rods.material.mass)
    assert float((one.material.stretch - 1 / (1 / 50 + 1 / 80)).abs().max()) < 1e-12


def test_delay_applies_to_offset_markers_in_any_order():
    made, params, state = scene("marker_offset")
    seen = track(rod.view(made.topology, params.rods, state.rods, made.dt))
    effects = [EFFECTS[n]() for n in ("time_delay", "marker_offset")]
    values = {n: scene(n)[1].effects[n] for n in ("time_delay", "marker_offset")}
    one, other = observed_markers(effects, seen, values), observed_markers(effects[::-1], seen, values)
    assert torch.equal(one, other)
    beside = tree.replace(seen, pos=effects[1].observe(seen, values["marker_offset"]))
    assert torch.equal(one, effects[0].observe(beside, values["time_delay"]))
