"""Islands of the hybrid, its line from doing nothing, and which gradients it believes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.agents.problems import Push, Reach
from torchdlo.agents.trajopt import hybrid
from torchdlo.agents.trajopt.lbfgs import Descent
from torchdlo.agents.trajopt.problem import Encoding, Evaluation
from torchdlo.agents.trajopt.proposals import SearchPlan, Told
from torchdlo.agents.trajopt.search import METHODS, SearchSettings, optimize

pytestmark = pytest.mark.quick


def test_islands_know_nothing_of_each_other() -> None:
    def asked(shift: float) -> list[Tensor]:
        problem = Reach()
        plan = SearchSettings("hybrid", episodes=600, population=40, hold=5).plan(problem)
        search, told, points = METHODS["hybrid"](plan, torch.Generator().manual_seed(0)), None, []
        for _ in range(12):
            ask = search.send(told)
            points.append(ask.points)
            x = ask.points.clone().requires_grad_()
            went = problem.evaluate(ask.encoding.decode(x))
            (gradient,) = torch.autograd.grad(went.loss.sum(), x)
            # The second island is told of another problem.
            each = torch.arange(len(x))
            off = torch.where((each >= 16) & (each < 36), shift * each, 0.0)
            told = Told(went.returns.detach() - off, went.loss.detach() + off, 0 * off, *[off < 0] * 2, gradient)
        return points

    same, other = asked(0.0), asked(1.0)
    for a, b in zip(same, other, strict=True):
        assert len(a) == 40 and torch.equal(a[:16], b[:16]) and torch.equal(a[36:], b[36:])
    assert torch.equal(same[0], other[0]) and not torch.equal(same[-1][16:36], other[-1][16:36])


def test_one_line_of_the_hybrid_descends_from_doing_nothing() -> None:
    plan, problem = SearchSettings("hybrid", episodes=240, population=24, hold=5).plan(Reach()), Reach()

    def ends(plan: SearchPlan, count: int) -> list[float]:
        search, told, found = METHODS["hybrid"](plan, torch.Generator().manual_seed(0)), None, []
        for k in range(count):
            ask = search.send(told)
            if k == 0:
                assert bool((ask.points[-4] == 0).all()), "it begins there"
            x = ask.points.clone().requires_grad_()
            went = problem.evaluate(ask.encoding.decode(x))
            (gradient,) = torch.autograd.grad(went.loss.sum(), x)
            none = torch.zeros(len(x), dtype=torch.bool)
            told = Told(went.returns.detach(), went.loss.detach(), 0 * went.loss.detach(), none, none, gradient)
            found.append(float(told.value[-4:].max()))
        return found

    found = ends(plan, 8)
    assert found == sorted(found) and found[-1] > 1e-3 * found[0]
    # What was had in a surrogate task is measured again before the line goes on from there.
    again = ends(replace(plan, surrogates=4), 8)
    assert again[:4] == found[:4] and again[4] == pytest.approx(found[3]) and again == sorted(again)
    # Small populations have none left for it, and milder worlds say nothing of harder ones.
    for other in (replace(plan, population=8), replace(plan, drifts=0.5)):
        with pytest.raises(AssertionError, match="it begins there"):
            ends(other, 1)


def test_the_hybrid_has_slopes_of_the_best_quarter() -> None:
    played, with_gradient = [], []

    class Watched(Push):
        def evaluate(self, actions: Tensor) -> Evaluation:
            outcome = super().evaluate(actions)
            (with_gradient if actions.requires_grad else played).append(outcome.returns.detach())
            return outcome

    optimize(Watched(), SearchSettings("hybrid", episodes=80, population=40, hold=5))
    # Islands of 16 and 20, and 4 of which the first does nothing. Nothing is told of the second iteration, which is the
    # last. The best is played alone.
    first, gradients = played[0].split([16, 20, 4]), torch.cat(with_gradient).split([4, 5, 1])
    assert len(torch.cat(played)) == 81
    for island, chosen in zip(first[:2], gradients[:2], strict=True):
        # No shortfall in this problem: value and return are the same.
        assert sorted(chosen.tolist()) == pytest.approx(sorted(island.tolist())[-len(chosen) :])
    assert gradients[2].tolist() == pytest.approx(first[2][:1].tolist())


def test_islands_that_are_behind_go_on_from_the_best_trajectory_of_all() -> None:
    plan = SearchSettings("hybrid", episodes=1200, population=60, hold=5).plan(Push())
    search, told, away = METHODS["hybrid"](plan, torch.Generator().manual_seed(0)), None, []
    none = torch.zeros(60, dtype=torch.bool)
    for k in range(plan.iterations):
        ask = search.send(told)
        # The second island of three is ahead from the start, the first one follows, then the line from nothing, and
        # the third island is last.
        sizes = [16, 20, 20, 4]
        value = torch.tensor([1.0, 2.0, 0.0, 0.5], dtype=torch.float64).repeat_interleave(torch.tensor(sizes))
        if k == 0:
            value[25] += 1
            leading = ask.points[25]
        away.append([float((part - leading).norm(dim=-1).median()) for part in ask.points.split(sizes)])
        told = Told(value, -value, 0 * value, none, none, 0 * ask.points)
    first, _, last, _ = zip(*away, strict=True)
    assert max(last[8], first[14]) < 0.3 * min(*first[:8], *last[:8])
    assert first[8] > 0.9 * min(first[:8]), "the first island goes on until later"


def test_slopes_that_grew_beyond_measure_are_cut() -> None:
    # Back in time, from the last of thirty actions, gradients double with each.
    growth = 2.0 ** torch.arange(29, -1, -1, dtype=torch.float64)
    gradient = torch.stack([growth, torch.ones_like(growth), torch.zeros_like(growth)])[..., None] * torch.ones(2)
    none, plan = torch.zeros(3, dtype=torch.bool), SearchPlan(30, 2, 2, 0.01, 4, 10)

    def tamed(largest: float) -> Tensor:
        loss = torch.tensor([-largest, 0.0, math.inf], dtype=torch.float64)
        told = Told(-loss, loss, 0 * loss, none, none, gradient.flatten(1))
        return hybrid._Tame(plan)(told).gradient.unflatten(1, (30, 2))

    found = tamed(1e9)
    size = torch.linalg.vector_norm(found, dim=-1)
    most = 10 * math.sqrt(2) * 2**9
    assert float(size.max()) <= most and float(size[0, 0]) < 1e-3 * most
    kept = growth <= most / math.sqrt(2)
    assert torch.equal(found[:, kept], gradient[:, kept]) and torch.equal(found[1:], gradient[1:])
    # A first step of 1 mm that promises to change the loss by ten times all of it says nothing.
    few = tamed(0.01)
    held = growth * math.sqrt(2) * 1e-3 <= 0.1
    assert 0 < int(held.sum()) < 10
    assert torch.equal(few[:, held], gradient[:, held]) and not few[:, ~held][0].any()
    assert torch.equal(few[1:], gradient[1:])


def test_descent_follows_the_limits_of_ways() -> None:
    # A path with a bend, twice as fast as can be: what is missing ahead must not hide what can be had aside.
    plan, encoding = SearchPlan(20, 3, 3, 0.01, 4, 10), Encoding(20, 3, 3, 0.01, 1)
    share = torch.linspace(0, 1, 21, dtype=torch.float64)[1:]
    wanted = torch.stack([0.4 * share, 0.03 * torch.sin(6 * share), 0 * share], -1)

    def told(x: Tensor) -> Told:
        x = x.clone().requires_grad_()
        loss = 100 * (x.unflatten(1, (20, 3)).cumsum(1) - wanted).square().sum((1, 2))
        (gradient,) = torch.autograd.grad(loss.sum(), x)
        loss, none = loss.detach(), torch.zeros(len(x), dtype=torch.bool)
        return Told(-loss, loss, 0 * loss, none, none, gradient)

    line = Descent(plan, torch.Generator().manual_seed(0))
    start = torch.zeros(1, 60, dtype=torch.float64)
    line.offer(start, told(start))
    for _ in range(8):
        x = line.ask()
        line.tell(x, told(x))
    # The projected gradient method, with steps below the inverse of the largest curvature, 200 * 20^2.
    slow = start
    for _ in range(8000):
        slow = encoding.project(slow - 1e-5 * told(slow).gradient)
    low, high = float(told(slow).loss), float(told(start).loss)
    assert float(line.loss) - low < 1e-5 * (high - low)


def test_lines_begin_where_they_get_on() -> None:
    plan = SearchPlan(4, 1, 1, 0.01, 8, 10)
    value = torch.tensor([5.0, 4.0, 3.0, 2.0, 1.0], dtype=torch.float64)
    # The best breaks down, the second has a gradient by its last action only, and the third and the last have good
    # ones.
    gradient = torch.ones(5, 4, dtype=torch.float64)
    gradient[1, :3], gradient[3] = 0, 0
    failed = torch.tensor([True, False, False, False, False])
    told = Told(value, -value, 0 * value, failed, failed, gradient)
    x = 0.001 * torch.arange(5, dtype=torch.float64)[:, None].expand(5, 4)
    line = Descent(plan, torch.Generator().manual_seed(0))
    line.offer(x, told)
    assert line.value.tolist() == [3.0, 1.0] and line.best[0] == 5.0
    # They are given up for better ones of which the same holds, and go on before all others.
    better = replace(told, returns=value + 0.5, loss=-value - 0.5)
    line.offer(x, better)
    assert line.value.tolist() == [3.5, 3.0]
    # Where there are none, those that have a gradient come first.
    line.clear()
    line.offer(x, replace(told, failed=torch.tensor([True, False, True, False, True])))
    assert line.value.tolist() == [4.0, 5.0]
