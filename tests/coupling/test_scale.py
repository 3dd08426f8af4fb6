"""Scenes at another scale: lengths times s, times and speeds times its root."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import RodContact
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import Rope, make

F64 = torch.float64


def loop_on_rope(scale: float, steps: int, implicit: bool = False):
    """A rope of radius 5 mm and edges of 2 cm that falls on one held at its ends, times a scale."""
    s = torch.linspace(-0.2, 0.2, 21, dtype=F64)
    one = torch.stack([s, 0 * s, 0 * s], -1)
    other = torch.stack([0 * s + 0.003, s, 0 * s + 0.0102], -1)
    speed = torch.tensor([0.1, 0.0, -0.5], dtype=F64).expand(21, 3)
    # Weights go with s^3, bending moments with weight times length.
    numbers = {"radius": 0.005 * scale, "mass": 0.01 * scale**3, "bend": 1e-3 * scale**5}
    ropes = [Rope(one * scale, **numbers), Rope(other * scale, velocities=speed * scale**0.5, **numbers)]
    effects = [EFFECTS["bend"](), EFFECTS["gravity"](), RodContact(room=200)]
    dt = 1e-3 * scale**0.5
    choices = {"integrator": "implicit", "substeps": 1} if implicit else {"substeps": 10}
    made, params, state = make(ropes, effects, dt=dt, prescribed_vertices=(0, 20), **choices)
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(steps):
            state = scene.step(made, params, state, control)
    scene.check_state(state)
    return state.rods.pos / scale


@pytest.mark.parametrize("implicit", [False, True], ids=["explicit", "implicit"])
def test_the_same_scene_at_a_thousandth_of_the_scale_moves_the_same(implicit):
    big, small = (loop_on_rope(scale, 15, implicit) for scale in (1.0, 1e-3))
    assert float((big - small).abs().max()) < 1e-8
    assert float(big[31, 2]) < 0.0102  # it fell on the other


def test_a_suture_has_room_for_its_pairs_of_edges():
    # Radius 0.15 mm and edges of 1 mm: a step looked for pairs within 2 mm, found 2563, and had no room for them.
    s = torch.linspace(0, 1, 101, dtype=F64)
    turn = 10 * torch.pi * s
    x = torch.stack([0.003 * turn.cos(), 0.003 * turn.sin(), 0.006 * s], -1)
    rope = Rope(x, radius=0.15e-3, density=1100.0, bend=1e-9, rest="as_placed")
    effects = [EFFECTS["bend_frame"](), EFFECTS["gravity"](), RodContact()]
    made, params, state = make([rope], effects, dt=1e-3, substeps=20, prescribed_vertices=(0,))
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(10):
            state = scene.step(made, params, state, control)
    scene.check_state(state)
