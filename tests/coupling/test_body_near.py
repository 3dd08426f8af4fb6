"""The kernel that finds nodes near bodies against tensor operations."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from material_points import DOUBLE
from meetings import SHAPES, meeting

from torchdlo.coupling import BodyMpmCoupling
from torchdlo.coupling.mpm import body_broad_phase_op, body_coupling_effect
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.physics import tree

pytestmark = pytest.mark.skipif(not body_broad_phase_op.ready("cpu", DOUBLE), reason="there is no C++ compiler")


# Where there is too little room, two nodes as far from a torus as each other would be chosen between by rounding.
SCARCE = [[n] for n in SHAPES if n != "torus"]
CASES = [(names, room) for room, kinds in ((600, [[n] for n in SHAPES]), (60, SCARCE)) for names in kinds]


@pytest.mark.parametrize(("names", "room"), [*CASES, (["box", "sphere"], 600), (["box", "sphere"], 60)])
def test_the_kernel_chooses_as_tensors_do(names, room, monkeypatch):
    found = meeting(names, BodyMpmCoupling(room=room, reach=0.7))
    monkeypatch.setattr(body_broad_phase_op, "ready", lambda *_: False)
    again = meeting(names, BodyMpmCoupling(room=room, reach=0.7))
    for mine, theirs in zip((found[2].vel, *found[4]), (again[2].vel, *again[4]), strict=True):
        assert mine.shape == theirs.shape
        # Sums in another order; a node more or less would show in the third digit.
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-13)
    assert bool((found[4][2] > 0).any()) == (room == 60)


def test_of_nodes_that_are_as_far_either_is_right():
    grid, nodes, _, motion, _ = meeting(["torus"], BodyMpmCoupling())
    solids, points = body_coupling_effect._solids(motion, (2,)), mpm.places(grid, nodes)
    off = body_coupling_effect._probe(motion, solids, points.unsqueeze(1))[0][:, 0, :, 0]
    mine, lost = body_broad_phase_op.choose(motion, grid, nodes, (2,), 0.007, 60)
    theirs, missed = body_coupling_effect._chosen(motion, solids, nodes, points, 0.007, 60)
    assert torch.equal(lost.long(), missed.long()) and (lost > 0).any()
    far = [off.gather(1, chosen).sort(-1)[0] for chosen in (mine, theirs)]
    torch.testing.assert_close(*far, rtol=0, atol=1e-12)


def test_the_kernel_chooses_every_node_once_and_none_without_mass():
    grid, nodes, _, motion, _ = meeting(["box", "sphere"], BodyMpmCoupling())
    reach = 0.01
    near, lost = body_broad_phase_op.choose(motion, grid, nodes, (2,), reach, 700)
    assert all(len(row.unique()) == 700 for row in near) and not lost.any()
    off = body_coupling_effect._probe(
        motion, body_coupling_effect._solids(motion, (2,)), mpm.places(grid, nodes).unsqueeze(1)
    )[0]
    wanted = (off.amin(1)[..., 0] < reach) & (nodes.mass > 0)
    for row, there in zip(near, wanted, strict=True):
        count = int(there.sum())
        assert row[:count].tolist() == there.nonzero()[:, 0].tolist() and 60 < count < 700
    state, params, nodes = (tree.map(lambda x: x.float(), y) for y in (motion.state, motion.params, nodes))
    single = dataclasses.replace(motion, state=state, params=params)
    again, _ = body_broad_phase_op.choose(single, grid, nodes, (2,), reach, 700)
    assert all(set(a.tolist()) == set(b.tolist()) for a, b in zip(again, near, strict=True))
