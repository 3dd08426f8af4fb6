"""Inextensible ropes keep their length, or somebody says that they do not."""

from __future__ import annotations

import pytest
import torch
from helpers import F64, effects, run, straight

from torchdlo import scene
from torchdlo.physics import tree
from torchdlo.scene import Rope, make


def loaded(load: float, check: bool = True, **choices):
    """A rope of 10 g and 1 m that carries a weight [kg] at its lower end."""
    mass = torch.full((101,), 0.01 / 100, dtype=F64)
    mass[[0, -1]] *= 0.5
    made, params, state = make(
        [Rope(straight(101, 1.0, (0, 0, -1)), mass=0.01, bend=1e-5)],
        effects("bend", "gravity"),
        prescribed_vertices=(0,),
        check=False,
        **choices,
    )
    mass[-1] += load
    material = tree.replace(params.rods.material, mass=mass.unsqueeze(-1))
    params = tree.replace(params, rods=tree.replace(params.rods, material=material))
    if check:
        scene.check_step(made, params)
    return made, params, state


def length(state) -> float:
    return float((state.rods.pos[1:] - state.rods.pos[:-1]).norm(dim=-1).sum())


def test_explicit_steps_refuse_a_weight_that_they_cannot_hold_and_hold_it_at_the_bound_that_they_name():
    with pytest.raises(ValueError, match="hanging weight allows less than"):
        loaded(5.0)
    made, params, _ = loaded(5.0, check=False)
    # T < l m / 4 dt^2 with the lightest vertex, which is the held end with half a mass.
    bound = scene.limits(made, params)["hanging weight"]
    assert bound == pytest.approx((0.25 * 0.01 * 0.00005 / (9.81 * 5.01)) ** 0.5, rel=1e-6)
    substeps = int(1e-3 / bound) + 1
    made, params, state = loaded(5.0, substeps=substeps)
    state, lengths = run(made, params, state, 100, seen=length)
    assert max(abs(x - 1) for x in lengths) < 1e-9
    scene.check_state(state)


def test_what_stretches_all_the_same_is_reported():
    made, params, state = loaded(5.0, check=False)
    state, _ = run(made, params, state, 200)
    assert length(state) > 1.05
    with pytest.raises(RuntimeError, match="longer than it has to be"):
        scene.check_state(state)


def test_what_gives_way_is_reported_before_it_is_long():
    # It was silent up to 5 % of an edge's length: the hold carried 13 N for 49, and all was well.
    made, params, state = loaded(5.0, check=False)
    state, _ = run(made, params, state, 10)
    assert length(state) < 1.01
    with pytest.raises(RuntimeError, match="longer than it has to be"):
        scene.check_state(state)


@pytest.mark.parametrize("load", [5.0, 50.0])
def test_implicit_steps_hold_any_weight(load):
    made, params, state = loaded(load, integrator="implicit", dt=2e-3, substeps=1)
    state, lengths = run(made, params, state, 100, seen=length)
    assert max(abs(x - 1) for x in lengths) < 1e-6
    scene.check_state(state)


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_a_hold_that_moves_too_far_in_a_step_is_reported(integrator):
    made, params, state = make(
        [Rope(straight(11), mass=0.1, bend=1e-4)], effects("bend"), prescribed_vertices=(0,), integrator=integrator
    )
    control = scene.stationary_control(made, state)
    moved = scene.step(made, params, state, tree.replace(control, pos=control.pos + 10.0))
    with pytest.raises(RuntimeError):
        scene.check_state(moved)
