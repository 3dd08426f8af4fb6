"""The wires of Letter Art keep bends."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.envs import TASKS
from torchdlo.envs.core.task import RADIUS, make
from torchdlo.envs.tasks import letter_art as letters
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import BendFrame
from torchdlo.physics.effects.material import BendingPlasticity
from torchdlo.physics.execution.tracing import record
from torchdlo.scene import Rope

HALF = 5
"""Edges on either side of the post."""


def end(angle: float) -> torch.Tensor:
    """Where a wire ends that lies on a post at the origin up to an angle on one side, and is straight from there."""
    left = 0.02 * HALF - letters.ROUND * angle - 5e-4
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([letters.ROUND * c - left * s, letters.ROUND * s + left * c, RADIUS])


def bent(x: torch.Tensor) -> float:
    """Angle between the outer two edges of either side [degrees]."""
    a, b = x[2] - x[0], x[-1] - x[-3]
    return math.degrees(math.acos(float(a @ b) / float(a.norm() * b.norm())))


@pytest.mark.slow
def test_a_bend_of_60_degrees_over_a_post_keeps_40():
    # On a slippery table: friction would keep any shape.
    y = 0.02 * torch.arange(-HALF, HALF + 1.0)
    line = torch.stack([letters.ROUND + 1e-3 + 0 * y, y, RADIUS + 0 * y], -1)[None]
    wire = Rope(line, RADIUS, mass=1e-3 * 2 * HALF, youngs=letters.STIFFNESS[1], stretch=1e5 * math.pi * RADIUS**2)
    post = RigidBody("cylinder", (letters.POST, letters.TOP / 2), (0.0, 0.0, letters.TOP / 2), motion="fixed")
    values = {"bending_plasticity": letters.PLASTIC, "table_friction": {"mu": 0.0}}
    made = make(
        TASKS["letter_art"](), [wire], [BendFrame(), BendingPlasticity()], values, solids=[post], held=(0, 2 * HALF)
    )
    scene, params, state = made
    control = scenes.stationary_control(scene, state)
    attachment_weight = torch.ones_like(control.pos[..., :1])
    control = tree.replace(control, attachment_weight={"vertices": attachment_weight})
    step = record(lambda s, c: scenes.step(scene, params, s, c), state, control)
    # Bent in 0.1 s, held for 0.2 s, let go for 0.1 s.
    for k in range(400):
        place = end(math.radians(30.0) * min(1.0, (k + 1) / 100))
        goal = torch.stack([place * place.new_tensor([1.0, -1.0, 1.0]), place])[None]
        control = tree.replace(control, pos=goal, attachment_weight={"vertices": attachment_weight * float(k < 300)})
        state = step(state, control)
        if k == 299:
            held = bent(state.rods.pos[0])
    assert 55 < held < 70
    assert bent(state.rods.pos[0]) >= 40
