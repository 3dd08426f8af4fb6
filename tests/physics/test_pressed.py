"""Straight ropes whose hands move towards each other: they buckle if they can, and say so if they cannot."""

from __future__ import annotations

import pytest
import torch
from helpers import F64, straight

from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.scene import Rope, check_state, make, ok, stationary_control, step

LENGTH, SPEED = 0.5, 0.5


def pressed(count: int, bow: float, frames: int, gravity: bool = False, **choices):
    """State of a rope, bowed by a sine, after frames of 2 ms in which its ends approach."""
    x = straight(count, LENGTH)
    x[:, 1] = bow * torch.sin(torch.pi * x[:, 0] / LENGTH)
    acting = [Bend(), Damping(), *([Gravity()] if gravity else [])]
    rope = Rope(x, radius=0.005, density=1000.0, bend=1e-6, rest="straight")
    scene, params, state = make([rope], acting, prescribed_vertices=(0, count - 1), dt=2e-3, substeps=4, **choices)
    first = stationary_control(scene, state)
    with torch.no_grad():
        for k in range(frames):
            way = 0.5 * SPEED * scene.dt * (k + 1)
            move = torch.tensor([[way, 0, 0], [-way, 0, 0]], dtype=F64)
            state = step(scene, params, state, tree.replace(first, pos=first.pos + move))
    return params, state


@pytest.mark.parametrize(
    ("integrator", "count", "bow", "gravity"),
    [("explicit", 11, 1e-9, False), ("explicit", 11, 1e-9, True), ("implicit", 41, 0.0, True)],
)
def test_ropes_that_are_nearly_straight_buckle(integrator, count, bow, gravity):
    # A bow of a nanometre, or what gravity makes of none, has to become one of a centimetre at once, by far more than
    # three Newton steps find. What they leave has to be put right by later ones: after 0.12 s lengths are those that
    # Newton's method reaches, and the ropes are where inextensible ones can be.
    params, state = pressed(count, bow, 60, gravity, integrator=integrator)
    length = (state.rods.pos[1:] - state.rods.pos[:-1]).norm(dim=-1)
    rest = params.rods.rest.length[:-1, 0]
    assert float((length / rest - 1).abs().max()) < 1e-6
    ends = 0.5 * SPEED * 0.12
    # Nothing is further from the middle of an end than the length of the rope in between.
    assert float((state.rods.pos - state.rods.pos.new_tensor([ends, 0, 0])).norm(dim=-1).max()) <= LENGTH * (1 + 1e-6)


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_ropes_that_are_exactly_straight_say_that_they_were_pressed_short(integrator):
    # Nothing pushes them sideways: after 50 frames their ends are 10 % nearer, so that some edge is at least as short.
    _, state = pressed(11, 0.0, 1, integrator=integrator)
    check_state(state)  # 0.2 % on average
    _, state = pressed(11, 0.0, 50, integrator=integrator)
    assert float(state.diagnostics[..., 2]) >= 0.1 - 1e-9 and not bool(ok(state))
    with pytest.raises(RuntimeError, match="shorter than it has to be: a straight rope was pressed"):
        check_state(state)


def test_ropes_that_may_shorten_say_nothing():
    # With EA = 4 N, a strain of 10 % takes 0.4 N: that is their law, not a fault.
    x = straight(11, LENGTH)
    rope = Rope(x, radius=0.005, density=1000.0, bend=1e-4, stretch=4.0)
    scene, params, state = make([rope], [Bend(), Damping()], prescribed_vertices=(0, 10), dt=2e-3, substeps=4)
    first = stationary_control(scene, state)
    with torch.no_grad():
        for k in range(50):
            move = torch.tensor([[0.0, 0, 0], [-0.001 * (k + 1), 0, 0]], dtype=F64)
            state = step(scene, params, state, tree.replace(first, pos=first.pos + move))
    assert float(state.rods.tension[:-1].min()) < -0.3
    check_state(state)
