"""Gradients of ropes that hands pull taut, against differences of the same simulation."""

from __future__ import annotations

import pytest
import torch
from helpers import F64

from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.scene import Rope, make, stationary_control, step

LENGTH, FRAMES = 0.25, 50


def slack(**choices):
    """A rope of five vertices that hangs between two hands 20 % nearer than its length."""
    angle = torch.linspace(-1.08, 1.08, 4, dtype=F64)
    edges = LENGTH / 4 * torch.stack([torch.cos(angle), 0 * angle, torch.sin(angle)], -1)
    x = torch.cat([torch.zeros(1, 3, dtype=F64), edges.cumsum(0)])
    rope = Rope(x, radius=0.005, density=1000.0, bend=1e-5, stretch=choices.pop("stretch", float("inf")))
    acting, damping = [Bend(), Damping(), Gravity()], {"damping": {"rate": 2.0}}
    return make([rope], acting, damping, prescribed_vertices=(0, 4), dt=2e-3, substeps=4, **choices)


def middle(made, far: torch.Tensor) -> torch.Tensor:
    """Height of the middle after the hands have moved `far` rope lengths apart."""
    scene, params, state = made
    first, x = stationary_control(scene, state), state.rods.pos
    gap = x[4, 0] - x[0, 0]
    for k in range(FRAMES):
        share = min(1.0, (k + 1) / (0.6 * FRAMES))
        end = torch.stack([gap + share * (LENGTH * far - gap), x[4, 1], x[4, 2]])
        state = step(scene, params, state, tree.replace(first, pos=torch.stack([x[0], end])))
    return state.rods.pos[2, 2]


@pytest.mark.parametrize(
    ("integrator", "stretch", "newton"),
    [("explicit", float("inf"), 8), ("explicit", 1e3, 3), ("implicit", 1e3, 3)],
)
def test_gradients_of_ropes_pulled_taut_are_those_of_differences(integrator, stretch, newton):
    # The adjoint is exact where Newton's method converges; three steps are too few where an inextensible rope snaps
    # taut. Differences: what that method leaves, some 1e-10 of a length of 1e-2 m, over a step that has to be far below
    # the 1e-4 lengths over which the motion after the snap changes: 1e-12 / 1e-7 = 1e-5, times what the snap amplifies.
    made, h = slack(integrator=integrator, stretch=stretch, constraint_iterations=newton), 1e-7
    far = torch.tensor(0.999, dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad(middle(made, far), far)
    with torch.no_grad():
        wanted = (middle(made, far + h) - middle(made, far - h)) / (2 * h)
    assert abs(float(wanted)) > 1e-3
    assert float(found) == pytest.approx(float(wanted), rel=1e-3)
