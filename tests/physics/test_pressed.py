"""Ropes that are pressed at both ends buckle and keep their lengths, whatever the step."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.field import Damping, Gravity

F64 = torch.float64


def pressed(integrator: str, dt: float, bend: float, gravity: bool):
    """A straight rope of 0.3 m whose ends come 6 cm nearer in 30 steps and then rest; lengths of its edges [m]."""
    x = torch.zeros(1, 12, 3, dtype=F64)
    x[..., 0] = torch.linspace(0, 0.3, 12, dtype=F64)
    rope = scene.Rope(x, radius=0.005, density=1000.0, bend=bend)
    effects = [Bend(), Damping(), *([Gravity()] if gravity else [])]
    substeps = {"explicit": 2, "implicit": 1}[integrator]
    made, params, state = scene.make(
        [rope], effects, held_vertices=(0, 11), dt=dt, substeps=substeps, integrator=integrator
    )
    control = scene.hold(made, state)
    step = torch.tensor([[[1e-3, 0, 0], [-1e-3, 0, 0]]], dtype=F64)
    for k in range(60):
        control = tree.replace(control, pos=control.pos + step) if k < 30 else control
        state = scene.step(made, params, state, control)
    scene.check_state(state)
    return (state.rods.pos[:, 1:] - state.rods.pos[:, :-1]).norm(dim=-1)


@pytest.mark.parametrize("bend", [1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize(("integrator", "dt"), [("explicit", 1e-3), ("implicit", 2e-3), ("implicit", 5e-3)])
def test_a_pressed_rope_buckles_and_keeps_its_length(integrator: str, dt: float, bend: float) -> None:
    if integrator == "explicit" and bend > 1e-3:
        pytest.skip("such a stiff rope needs smaller explicit steps")
    # Edges keep their lengths to single steps of Newton's method where they do not give way: 1e-3 is far from giving
    # way, which takes 20 % of the length here.
    length = pressed(integrator, dt, bend, gravity=True)
    assert float((length / (0.3 / 11) - 1).abs().max()) < 1e-3


@pytest.mark.parametrize(("integrator", "dt"), [("explicit", 1e-3), ("implicit", 2e-3), ("implicit", 5e-3)])
def test_a_rope_that_nothing_bends_gives_way_and_stays_where_it_is(integrator: str, dt: float) -> None:
    # Nothing says to which side: the rope stays straight, 24 cm for 30. No edge may then be longer than it was.
    length = pressed(integrator, dt, 1e-3, gravity=False)
    assert float(length.sum()) == pytest.approx(0.24, rel=1e-9)
    assert float(length.max()) < 0.3 / 11
