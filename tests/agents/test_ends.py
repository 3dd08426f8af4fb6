"""What ends a search, or does not: missing packages, Ctrl-C in a surrogate task, worlds that get harder."""

from __future__ import annotations

import json
import math
import sys

import pytest
import torch

from tests.agents.problems import Push, SurrogateRound
from torchdlo.agents.trajopt.gradient_descent import descent
from torchdlo.agents.trajopt.proposals import SearchPlan, Told
from torchdlo.agents.trajopt.search import SearchSettings, optimize
from torchdlo.agents.trajopt.search_result import result_json
from torchdlo.errors import InputError

pytestmark = pytest.mark.quick


@pytest.mark.parametrize("method", ["cmaes", "hybrid"])
def test_a_package_that_is_missing_is_named_before_anything_is_played(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    monkeypatch.setattr(Push, "evaluate", lambda *_: pytest.fail("it was played"))
    with pytest.raises(InputError, match=r"need the package cma; pip install 'torchdlo\[cmaes\]'"):
        optimize(Push(), SearchSettings(method, episodes=4000, population=20))


def test_what_a_rehearsal_promised_is_not_said_of_the_problem_itself() -> None:
    settings = SearchSettings("hybrid", episodes=160, population=16, hold=5, surrogate_share=0.8)

    def stop(_: str, done: int, *__: object) -> None:
        if done >= 48:
            raise KeyboardInterrupt

    found = optimize(SurrogateRound(), settings, callback=stop)
    assert found.interrupted and found.curve[-1]["surrogate"]
    assert found.max_return == found.search_return == -math.inf and math.isfinite(float(found.outcome.returns[0]))
    written = json.loads(result_json(found, SurrogateRound(), settings))
    assert written["max_return"] is None and written["search_return"] is None and written["return"] is not None


@pytest.mark.parametrize(("kept", "iterations"), [({"drifts": 0.5}, 20), ({"surrogates": 9}, 18), ({}, 9)])
def test_descent_does_not_measure_by_milder_worlds(kept: dict, iterations: int) -> None:
    plan = SearchPlan(horizon=4, width=3, group=3, limit=0.01, population=1, iterations=40, hold=2, **kept)
    search = descent(plan, torch.Generator().manual_seed(0))
    ask, no = next(search), torch.zeros(1, dtype=torch.bool)
    stage_waypoints = []
    for k in range(35):
        loss, gradient = torch.full((1,), float(k), dtype=torch.float64), torch.ones_like(ask.points)
        before, ask = ask.points, search.send(Told(-loss, loss, 0 * loss, no, no, gradient))
        stage_waypoints.append(float((ask.points - before).abs().max()))
    # Returns fall from one iteration to the next; starts that are given up jump.
    jump = next(k for k, way in enumerate(stage_waypoints) if way > 1.5 * plan.rate)
    assert jump >= iterations
