"""What every effect promises; a new one is tested by being in `EFFECTS`."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from contract import F64, default_values, respond, ropes, scene

from torchdlo.physics import rotation, tree
from torchdlo.physics.effect import LOADS, Effect
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import Rope

each = pytest.mark.parametrize("name", EFFECTS)
LAWS = {"stretch_force", "bend", "bend_frame", "twist"}


@each
def test_effect_declares_its_numbers_completely(name):
    cls = EFFECTS[name]
    assert issubclass(cls, Effect) and dataclasses.is_dataclass(cls) and cls.__dataclass_params__.frozen
    assert cls.name == name or (cls.name, name) == ("bend", "bend_frame")
    assert cls.__doc__
    for number, p in cls.params.items():
        default = p.default if isinstance(p.default, tuple) else (p.default,)
        assert all(p.low <= d <= p.high for d in default), (
            f"{name}.{number}: default {p.default} outside {p.low} to {p.high}"
        )
        assert p.unit and p.doc.endswith(".") and len(p.doc) > 8, f"{name}.{number}"
        assert p.scale in ("log", "linear") and math.isfinite(p.low) and math.isfinite(p.high) and p.low < p.high
        assert p.scale == "linear" or p.low > 0, f"{name}.{number}: logarithmic from {p.low}"
        assert p.size == len(default)
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
            wanted = many[key][k] if many[key].dim() == 3 else many[key]
            assert float((load - wanted).abs().max()) <= 1e-12 * max(float(wanted.abs().max()), 1e-12), key


VECTORS = {"force", "acceleration", "gradient"}


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
    before, after = respond(made, params, state), respond(made, params, moved)
    for key, load in before.items():
        if key in ("stiffness", "drag"):
            # Diagonals of resistance along the axes: only their trace is turned along.
            load, other = load.sum(-1), after[key].sum(-1)
        else:
            load, other = turn(load) if key in VECTORS else load, after[key]
        if name == "gravity":
            load = before[key]
        assert float((load - other).abs().max()) <= 1e-9 * max(float(load.abs().max()), 1e-9), key


@each
def test_resistances_are_not_negative(name):
    made, params, state = scene(name)
    for key, load in respond(made, params, state).items():
        if key in ("stiffness", "drag", "hinge_stiffness", "hinge_drag", "rate", "twist_decay", "edge_stiffness"):
            assert float(load.min()) >= 0, key


def test_internal_effects_exert_no_total_force():
    for name in ("stretch_force", "bend", "bend_frame", "twist", "bending_damping"):
        made, params, state = scene(name)
        assert "force" not in respond(made, params, state), (
            "inner forces belong in `gradient`, whose total is zero by construction"
        )
    assert ropes()
