"""A rod whose ends are turned against each other and brought together winds up around itself, and comes to rest."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import measures, scene
from torchdlo.coupling import RodContact
from torchdlo.physics import tree
from torchdlo.physics.effects import BendFrame, Damping, Twist
from torchdlo.physics.linalg import rotation

VERTICES, LENGTH, RADIUS = 41, 0.5, 0.003


def wound_up(dt: float, turns: float = 10.0, slack: float = 0.2, within: float = 3.0, seconds: float = 7.0):
    """Scene, parameters and last state of implicit steps of `dt` [s]."""
    x = torch.linspace(0, LENGTH, VERTICES, dtype=torch.float64)
    line = torch.stack([x, 1e-4 * torch.sin(math.pi * x / LENGTH), 2e-4 * torch.sin(2 * math.pi * x / LENGTH)], -1)
    made, params, state = scene.make(
        [scene.Rope(line, radius=RADIUS, mass=0.02, bend=1e-4, twist=1e-4)],
        [BendFrame(), Twist(), Damping(), RodContact(burst=1.0, room=2000)],
        {"damping": {"rate": 2.0}},
        dt=dt,
        substeps=1,
        integrator="implicit",
        twist="quasistatic",
        prescribed_vertices=(0, 1, VERTICES - 2, VERTICES - 1),
        prescribed_edges=(0, VERTICES - 2),
    )
    step, held = scene.stepper(made, execution="recorded"), scene.stationary_control(made, state)
    axis = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        for k in range(round(seconds / dt)):
            share = min(1.0, (k + 1) * dt / within)
            turn = torch.tensor([[2 * math.pi * turns * share]], dtype=torch.float64)
            director, pos = held.director.clone(), held.pos.clone()
            director[1] = rotation.about(axis, turn, held.director[1:2])[0]
            pos[2:, 0] -= slack * share
            state = step(params, state, tree.replace(held, pos=pos, director=director))
    return made, params, state


@pytest.mark.slow  # 4 s
def test_plectoneme_comes_to_rest_at_5_ms():
    made, params, state = wound_up(5e-3)
    scene.check_state(state)
    x = state.rods.pos
    edges = x[1:] - x[:-1]
    torch.testing.assert_close(
        edges.norm(dim=-1), torch.full((VERTICES - 1,), LENGTH / (VERTICES - 1)).to(x), rtol=1e-4, atol=0
    )
    assert float(state.rods.vel.norm(dim=-1).max()) < 5e-3  # 2 mm/s were seen, 500 would be the jitter of a contact
    middles = (x[1:] + x[:-1]) / 2
    i, j = torch.triu_indices(VERTICES - 1, VERTICES - 1, 3)
    assert int(((middles[i] - middles[j]).norm(dim=-1) < 2.5 * RADIUS).sum()) > 5  # it is wound around itself
    # The couple at the ends is what the twist in the straight part at an end exerts, GJ times its rate.
    couple = float(state.reaction.couple[1, 0])
    twist = measures.twist(made, params, state)[1:8]
    assert math.isclose(abs(couple), 1e-4 * float(twist.abs().mean()), rel_tol=1e-3)
    assert math.isclose(abs(couple), 7.0e-3, rel_tol=0.02)  # as steps of 1 and 2 ms and explicit ones have it
