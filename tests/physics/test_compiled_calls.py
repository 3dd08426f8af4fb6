"""Compiled code is called without torch once it is known, and does what torch does with it."""

from __future__ import annotations

import pytest
import torch

from torchdlo.physics import tree
from torchdlo.physics.execution import compiled
from torchdlo.physics.execution.compiled import Compiled, Kinds


@pytest.fixture(autouse=True)
def without_code_generator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let graphs run as they are."""
    monkeypatch.setattr(compiled, "compile_graph", lambda graph, examples, options: graph.forward)


@pytest.fixture
def looked_up(monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """Return a list with an entry per call that torch looked code up for."""
    calls: list[None] = []
    plain = Compiled._plain
    monkeypatch.setattr(Compiled, "_plain", lambda *given: (calls.append(None), plain(*given))[1])
    return calls


def same(inputs):
    return inputs


def test_known_code_is_called_with_other_numbers_and_what_passes_through_is_the_same_tensor(looked_up):
    def function(scale, given):
        return {"scaled": scale * given["x"], "kept": given["y"], "again": (given["y"], given["x"] + 1)}

    run, kinds = Compiled(function, 3.0), Kinds(same)
    for k in range(3):
        given = {"unused": torch.zeros(1), "x": torch.full((2,), float(k)), "y": torch.ones(3)}
        with kinds(given) as (inputs, kind):
            found = run(kind, inputs)
        assert torch.equal(found["scaled"], 3.0 * given["x"]) and torch.equal(found["again"][1], given["x"] + 1)
        assert found["kept"] is given["y"] and found["again"][0] is given["y"]
    assert len(looked_up) == 1


def test_a_tensor_that_stands_twice_is_told_from_two_that_are_alike(looked_up):
    run, kinds = Compiled(lambda x, y: x - y), Kinds(same)
    one, other = torch.ones(2), torch.full((2,), 5.0)
    for given, expected in (((one, one), 0.0), ((other, one), 4.0), ((one, one), 0.0), ((one, other), -4.0)):
        with kinds(given) as (inputs, kind):
            assert torch.equal(run(kind, *inputs), torch.full((2,), expected))
    assert len(looked_up) == 2


def test_repeated_calls_have_their_own_code_where_their_inputs_differ(looked_up):
    def function(params, state, shift, share):
        # Not stored as it came, the first time.
        return {"x": (params * state["x"] + share * shift).mT.contiguous().mT, "name": state["name"]}

    run, kinds, shares = Compiled(function), Kinds(same), torch.tensor([0.25, 0.5, 1.0]).split(1)
    for k in range(3):
        params, shift = torch.tensor(2.0 + k), torch.tensor(1.0)
        state = {"x": torch.arange(6.0).reshape(2, 3), "name": torch.zeros(1)}
        expected = state["x"]
        for share in shares:
            expected = params * expected + share * shift
        with kinds((params, state, shift)) as (_, kind):
            found = run.repeat(kind, params, state, (shift,), shares)
        assert torch.equal(found["x"], expected) and found["name"] is state["name"]
    assert len(looked_up) == 3


def test_what_reads_tensors_from_elsewhere_is_left_to_torch(looked_up):
    elsewhere = torch.tensor(2.0)
    run, kinds = Compiled(lambda x: elsewhere * x), Kinds(same)
    for k in (1.0, 2.0, 3.0):
        with kinds((torch.full((2,), k),)) as (inputs, kind):
            assert torch.equal(run(kind, *inputs), torch.full((2,), 2 * k))
    assert len(looked_up) == 3


def test_gradients_pass_through_code_that_is_called_directly(looked_up):
    run, kinds = Compiled(lambda x, y: (x * x * y, y + 1)), Kinds(same)
    for k in (1.0, 2.0, 3.0):
        x, y = torch.full((2,), k, requires_grad=True), torch.full((2,), 3.0)
        with kinds((x, y), torch.is_grad_enabled()) as (inputs, kind):
            found, other = run(kind, *inputs)
        assert not other.requires_grad
        (gradient,) = torch.autograd.grad(found.sum(), x)
        assert torch.equal(gradient, torch.full((2,), 6 * k))
    assert len(looked_up) == 1


def test_a_step_that_fails_is_not_known(looked_up):
    kinds, given = Kinds(same), (torch.ones(2),)
    with pytest.raises(ArithmeticError), kinds(given):
        raise ArithmeticError
    with kinds(given) as (_, kind):
        assert not kind.known
    with kinds(given) as (_, kind):
        assert kind.known


def test_a_builder_makes_trees_of_leaves():
    given = {"a": (torch.zeros(1), [torch.ones(2), None]), "b": torch.zeros(3), "c": ()}
    build = tree.builder(given)
    leaves = [torch.full((k,), 7.0) for k in (1, 2, 3)]
    made = build(leaves)
    assert made["a"][0] is leaves[0] and made["a"][1][0] is leaves[1] and made["a"][1][1] is None
    assert made["b"] is leaves[2] and made["c"] == ()


def test_dictionaries_in_another_order_are_of_another_kind(looked_up):
    run, kinds = Compiled(lambda x, numbers: x * numbers["a"] + numbers["b"]), Kinds(same)
    a, b, x = (torch.full((1,), k) for k in (2.0, 100.0, 3.0))
    for numbers in ({"a": a, "b": b}, {"b": b, "a": a}, {"a": a, "b": b}):
        with kinds((x, numbers)) as (inputs, kind):
            assert run(kind, *inputs) == 106
    assert len(looked_up) == 2
