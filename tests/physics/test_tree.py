"""Trees of tensors, and parts of the vertex axis."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
import torch.utils._pytree as pytree
from helpers import circle, effects, straight, vec, wild

from torchdlo.physics import tree
from torchdlo.physics.rod import kinematics as rod
from torchdlo.scene import Rope, make

pytestmark = pytest.mark.quick


class Pair(NamedTuple):
    """A kind of tree that only torch knows."""

    first: torch.Tensor
    second: torch.Tensor


@tree.struct
class Part:
    """A small struct."""

    here: torch.Tensor
    there: dict[str, torch.Tensor]
    nowhere: torch.Tensor | None = None


def grown():
    """A tree with all that trees are made of, its leaves 0 to 7."""
    x = [torch.tensor(float(k)) for k in range(8)]
    return Part(x[0], {"b": x[1], "a": x[2]}), (x[3], [x[4], ()]), {}, Pair(x[5], x[6]), x[7]


def test_every_leaf_is_found_and_mapped_where_torch_finds_it():
    made, kinds = grown(), (Part, tuple, dict, Pair, torch.Tensor)
    assert sorted(float(x) for x in tree.leaves(made)) == list(range(8))
    assert {id(x) for x in tree.leaves(made)} == {id(x) for x in pytree.tree_leaves(made)}
    doubled = tree.map(lambda x, y: x + y, made, grown())
    assert tuple(type(part) for part in doubled) == kinds
    assert [float(x) for x in tree.leaves(doubled)] == [2 * float(x) for x in tree.leaves(made)]
    assert float(doubled[0].there["a"]) == 4 and doubled[0].nowhere is None and float(doubled[3].second) == 12


def test_dictionaries_match_by_key_and_not_by_order():
    difference = tree.map(lambda x, y: x - y, {"a": vec(1.0), "b": vec(5.0)}, {"b": vec(5.0), "a": vec(1.0)})
    assert all(float(x) == 0 for x in difference.values())


@pytest.mark.parametrize(
    "other", [(vec(1.0),), (vec(1.0), vec(2.0), vec(3.0)), {"a": vec(1.0), "b": vec(2.0)}, vec(1.0, 2.0)]
)
def test_trees_of_other_structure_are_refused(other):
    for one, another in (((vec(1.0), vec(2.0)), other), (other, (vec(1.0), vec(2.0)))):
        with pytest.raises((ValueError, TypeError)):
            tree.map(lambda x, y: x + y, one, another)


def test_detached_numbers_have_no_history_and_the_others_are_kept():
    free, tied = vec(1.0), vec(2.0).requires_grad_() * 2
    kept, cut = tree.detach((free, tied))
    assert kept is free and not cut.requires_grad and tied.requires_grad


@pytest.mark.parametrize("slots", [(), (0,), (2, 3, 4), (4, 3), (0, 2, 5), (1, 1)])
def test_some_vertices_are_copies_of_them(slots):
    x = tree.batch_innermost(torch.arange(36.0).reshape(2, 6, 3))
    taken = tree.take_vertices(x, slots)
    assert torch.equal(taken, torch.stack([x[:, k] for k in slots], 1) if slots else x[:, :0])
    before = x.clone()
    taken += 1
    assert torch.equal(x, before)


@pytest.mark.parametrize("edges", [(), (0, 1), (3, 8), (9, 4)])
def test_directors_of_some_edges_are_those_of_all(edges):
    ropes = [Rope(wild(6, seed=3), mass=0.1, bend=1e-3, twist=1e-3, radius=0.01)]
    ropes += [Rope(x, mass=0.1, bend=1e-3, twist=1e-3, radius=0.01) for x in (circle(6), straight(4))]
    scene, params, state = make(ropes, effects("bend_frame", "twist"))
    turned = torch.linspace(-2, 3, scene.topology.size, dtype=state.rods.twist.dtype)[:, None]
    rods = tree.replace(state.rods, twist=state.rods.twist + turned)
    every, _ = rod.view(scene.topology, params.rods, rods, 1e-3).frames()
    torch.testing.assert_close(rod.directors(scene.topology, rods, edges), every[..., list(edges), :])
