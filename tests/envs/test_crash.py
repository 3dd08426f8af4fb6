"""Which points are inside bodies that do not give way, and which ropes broke down."""

from __future__ import annotations

import math

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.coupling.bodies.dynamics import RigidBody
from torchdlo.coupling.rod_body.rod_body_effect import RodBody
from torchdlo.envs.core.divergence import broken_lengths, inside_bodies
from torchdlo.physics import tree
from torchdlo.physics.effects.material import AxialStiffness

pytestmark = pytest.mark.quick

F64 = torch.float64
POINTS = {
    "in the post": (0.0, 0.0, 0.05),
    "beside the post": (0.03, 0.0, 0.05),
    "above the post": (0.0, 0.0, 0.11),
    "in the free ball": (1.0, 0.0, 0.1),
    "in the moving box, which is turned": (2.0, 0.09, 0.1),
    "where it would be if it were not turned": (2.09, 0.0, 0.1),
    "below the floor": (3.0, 0.0, -0.01),
}


def test_points_are_inside_what_does_not_give_way():
    quarter = (math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))
    solids = [
        RigidBody("plane", motion="fixed"),
        RigidBody("cylinder", (0.02, 0.05), (0.0, 0.0, 0.05), motion="fixed"),
        RigidBody("sphere", (0.05,), (1.0, 0.0, 0.1), mass=1.0),
        RigidBody("box", (0.1, 0.02, 0.02), (2.0, 0.0, 0.1), quarter, motion="kinematic"),
    ]
    line = torch.tensor([[0.0, 1.0, 0.5], [0.1, 1.0, 0.5], [0.2, 1.0, 0.5]], dtype=F64).expand(2, 3, 3)
    rope = scenes.Rope(line, 0.01, mass=0.01, bend=1e-4)
    scene, params, state = scenes.make([rope], [RodBody()], {}, dt=1e-3, substeps=1, bodies=solids)
    found = inside_bodies(scene, params, state, torch.tensor(list(POINTS.values()), dtype=F64).expand(2, -1, -1))
    said = {name for name, hit in zip(POINTS, found[0].tolist(), strict=True) if hit}
    assert said == {"in the post", "in the moving box, which is turned", "below the floor"}
    assert found.shape == (2, len(POINTS)) and bool((found[0] == found[1]).all())


def test_nothing_is_inside_where_there_are_no_bodies():
    line = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], dtype=F64).expand(1, 3, 3)
    scene, params, state = scenes.make([scenes.Rope(line, 0.01, mass=0.01, bend=1e-4)], [], {}, dt=1e-3, substeps=1)
    assert inside_bodies(scene, params, state, torch.zeros(1, 4, 3, dtype=F64)).tolist() == [[False] * 4]


def test_inextensible_ropes_that_lost_their_lengths_are_broken():
    line = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], dtype=F64)
    # As it is, bent, too short by a fifth, torn apart.
    ends = line.new_tensor([[0.2, 0.0, 0.0], [0.1, 0.1, 0.0], [0.18, 0.0, 0.0], [1e7, 0.0, 0.0]])
    for stretch, expected in ((math.inf, [False, False, True, True]), (1e3, [False] * 4)):
        rope = scenes.Rope(line.expand(4, 3, 3), 0.01, mass=0.01, bend=1e-4, stretch=stretch)
        scene, params, state = scenes.make([rope], [], {}, dt=1e-3, substeps=10)
        pos = torch.cat([line[:2].expand(4, 2, 3), ends[:, None]], 1)
        moved = tree.replace(state, rods=tree.replace(state.rods, pos=pos))
        assert broken_lengths(scene, params, moved).tolist() == expected


@pytest.mark.parametrize(("stiffness", "expected"), [(1e3, False), (1e18, True)])
def test_ropes_that_an_effect_makes_elastic_may_stretch(stiffness: float, expected: bool):
    line = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]], dtype=F64)
    rope = scenes.Rope(line[None], 0.01, mass=0.01, bend=1e-4)
    values = {"stretch": {"EA": stiffness}}
    scene, params, state = scenes.make([rope], [AxialStiffness()], values, dt=1e-3, substeps=10)
    longer = tree.replace(state, rods=tree.replace(state.rods, pos=1.2 * state.rods.pos))
    # 1e18 N stands for inextensible.
    assert broken_lengths(scene, params, longer).tolist() == [expected]
