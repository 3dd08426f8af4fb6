"""Searches that share their batches find what they find alone, and end together when something breaks."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.agents.problems import Drag, Push, SurrogateRound, signature
from torchdlo.agents.trajopt.batched_evaluation import evaluate_batched
from torchdlo.agents.trajopt.problem import Evaluation, Problem
from torchdlo.agents.trajopt.search import METHODS, Robust, SearchSettings, optimize
from torchdlo.errors import InputError

pytestmark = pytest.mark.quick

SETTINGS = SearchSettings(episodes=48, population=8, hold=5, chunk=5)
ALL = [replace(SETTINGS, method=method, seed=seed) for method in METHODS for seed in (0, 1)]


class Counting(Push):
    """A problem that notes the sizes of its batches, and breaks after some."""

    def __init__(self, after: int = 1000) -> None:
        super().__init__()
        object.__setattr__(self, "sizes", [])
        object.__setattr__(self, "after", after)

    def evaluate(self, actions: Tensor) -> Evaluation:
        """Play."""
        if len(self.sizes) == self.after:
            raise MemoryError
        self.sizes.append(len(actions))
        return super().evaluate(actions)


def searching(settings: SearchSettings, **choices: Any) -> Any:
    return lambda shared: optimize(shared, settings, **choices)


def test_searches_find_what_they_find_alone() -> None:
    problem = Counting()
    found = evaluate_batched(problem, [searching(settings) for settings in ALL], room=30)
    own = Counting()
    for each, settings in zip(found, ALL, strict=True):
        alone = optimize(own, settings)
        # A batch of another size rounds in another order; what was found alone is played alone.
        assert each.outcome.returns == pytest.approx(alone.outcome.returns, rel=1e-6)
        assert each.episodes == alone.episodes == 48
    # Those with gradients and those without are played in batches of their own; the best of each is played alone.
    assert sorted(set(problem.sizes)) == [1, 30] and problem.sizes.count(30) < len(own.sizes) / 2


def test_rehearsals_are_shared_as_well() -> None:
    settings = [
        SearchSettings("hybrid", episodes=48, population=8, hold=5, seed=seed, surrogate_share=0.5) for seed in (0, 1)
    ]
    problem = SurrogateRound()
    found = evaluate_batched(problem, [searching(each) for each in settings], room=16)
    assert [played for played, _ in itertools.groupby(problem.played)] == ["surrogate", "earnest"]
    for each, alone in zip(found, settings, strict=True):
        assert signature(each.actions) == signature(optimize(SurrogateRound(), alone).actions)


@pytest.mark.parametrize("kind", [Push, Drag])
def test_slopes_are_those_of_the_problem(kind: Any) -> None:
    inner = kind()
    actions = [0.01 * torch.randn(n, inner.horizon, 3, dtype=torch.float64) for n in (3, 1, 4)]

    def gradient(x: Tensor, problem: Problem) -> Tensor:
        x = x.clone().requires_grad_()
        return torch.autograd.grad((problem.evaluate(x).loss * torch.arange(len(x)).exp()).sum(), x)[0]

    found = evaluate_batched(inner, [partial(gradient, x) for x in actions], room=5)
    for x, each in zip(actions, found, strict=True):
        # Rounding of a batch of another size grows through contact: the eighth digit differs between machines.
        torch.testing.assert_close(each, gradient(x, inner), rtol=1e-6, atol=1e-6)


def test_one_that_wants_no_slope_gets_none() -> None:
    actions = torch.zeros(2, 30, 3, dtype=torch.float64)
    searches = [lambda p: p.evaluate(actions), lambda p: p.evaluate(actions.clone().requires_grad_())]
    problem = Counting()
    plain, with_gradient = evaluate_batched(problem, searches, room=5, with_gradient=3)
    assert not plain.loss.requires_grad and with_gradient.loss.requires_grad
    assert problem.sizes == [5, 3]


def test_searches_that_were_stopped_go_on(tmp_path: Path) -> None:
    def run(problem: Problem, resume: bool, **choices: Any) -> Any:
        searches = [searching(settings, journal=tmp_path / str(k), resume=resume) for k, settings in enumerate(ALL)]
        return evaluate_batched(problem, searches, room=30, **choices)

    every = Counting()
    whole = evaluate_batched(every, [searching(settings) for settings in ALL], room=30)
    with pytest.raises(MemoryError):
        run(Counting(after=5), resume=False)
    with pytest.raises(KeyboardInterrupt):
        beats = []

        def pulse() -> None:
            beats.append(1)
            if len(beats) == 3:
                raise KeyboardInterrupt

        run(Push(), resume=True, pulse=pulse)
    problem = Counting()
    found = run(problem, resume=True)
    assert 0 < problem.sizes.count(30) <= every.sizes.count(30) - 8, "what was played is read"
    assert [signature(each.actions) for each in found] == [signature(each.actions) for each in whole]


def test_a_search_that_fails_is_told_and_the_others_end() -> None:
    def wrong(shared: Problem) -> None:
        shared.evaluate(torch.zeros(1, 30, 3, dtype=torch.float64))
        raise ValueError("lost")

    ended = []

    def right(shared: Problem) -> None:
        ended.append(optimize(shared, SETTINGS))

    with pytest.raises(ValueError, match="lost"):
        evaluate_batched(Push(), [wrong, right], room=8)
    assert len(ended) == 1 and ended[0].episodes == 48


def test_robust_searches_are_refused() -> None:
    robust = replace(SETTINGS, robust=Robust(copies=2, finalists=1, trials=2))
    with pytest.raises(InputError, match="push: robust searches do not share batches"):
        evaluate_batched(Push(), [searching(robust)], room=8)


def test_nothing_to_search_is_nothing() -> None:
    assert evaluate_batched(Push(), [], room=8) == []
