"""Optimisers find known optima, depend on nothing but their seed, and the hybrid finds more than its parts."""

from __future__ import annotations

import itertools
import math
import random
import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.agents.problems import Drag, Peaks, Plain, Push, Reach, SurrogateRound, signature
from torchdlo.agents.trajopt.cmaes import draw_population, make_strategy
from torchdlo.agents.trajopt.problem import Encoding, Evaluation
from torchdlo.agents.trajopt.proposals import rank_proposals
from torchdlo.agents.trajopt.search import METHODS, Robust, SearchResult, SearchSettings, optimize
from torchdlo.errors import InputError

SMALL = SearchSettings(episodes=64, population=8, hold=5)


def returned(found: SearchResult) -> float:
    return float(found.outcome.returns[0])


@pytest.mark.parametrize(("method", "episodes"), [("cmaes", 2400), ("gd", 800), ("hybrid", 400)])
def test_the_known_optimum_is_found(method: str, episodes: int) -> None:
    problem = Reach()
    found = optimize(problem, SearchSettings(method, episodes=episodes, population=16, hold=5))
    # 0 is the best there is. Success asks that the tip ends within one action's way, 1 cm, of the goal; a path that is
    # nowhere further off than that loses at most 100 * 20 * 0.01^2.
    assert bool(found.outcome.success[0])
    assert -100 * 20 * 0.01**2 <= returned(found) <= 0


def test_descent_in_the_hybrid_converges_on_a_quadratic() -> None:
    # The residual of L-BFGS on a convex quadratic falls at least linearly; Adam's last steps leave an error of about a
    # thousandth of its first ones, 1e-3 m * 1e-3, per number: 100 * 60 * (1e-6)^2 * 20 / 2 of the return.
    found = optimize(Reach(), SearchSettings("hybrid", episodes=1600, population=16, hold=5))
    assert returned(found) > -100 * 60 * 1e-12 * 10


@pytest.mark.parametrize("method", METHODS)
def test_the_seed_decides_everything(method: str) -> None:
    same, again, other = (optimize(Reach(), replace(SMALL, method=method, seed=seed)) for seed in (3, 3, 4))
    assert signature(same.actions) == signature(again.actions) and same.curve == again.curve
    assert same.curve != other.curve


@pytest.mark.parametrize("method", METHODS)
def test_generators_of_others_are_left_alone(method: str) -> None:
    def states() -> tuple:
        # The package cma would use the generator of numpy's old interface, which all of a process share.
        return random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # noqa: NPY002

    before = states()
    optimize(Push(), replace(SMALL, method=method))
    assert states() == before


@pytest.mark.parametrize("method", METHODS)
def test_the_budget_is_kept_and_the_best_is_the_best(method: str) -> None:
    seen: list[Tensor] = []
    sizes: list[int] = []

    class Watched(Push):
        def evaluate(self, actions: Tensor) -> Evaluation:
            outcome = super().evaluate(actions)
            sizes.append(len(actions))
            # The hybrid plays once more what it wants gradients of.
            if method != "hybrid" or not actions.requires_grad:
                seen.append(outcome.returns.detach())
            return outcome

    found = optimize(Watched(), replace(SMALL, method=method, episodes=70, chunk=3))
    played = torch.cat(seen)
    assert found.episodes == 64 == len(played) - 1, "the best is played once more, alone"
    assert found.search_return == float(played[:-1].max()) == found.curve[-1]["best"]
    assert max(sizes) <= 3
    best = [point["best"] for point in found.curve]
    assert best == sorted(best)


def test_chunks_change_nothing_but_the_size_of_batches() -> None:
    # Sums over 30 steps in an order that does not depend on the batch: the results are equal to rounding, and nothing
    # is chosen by a comparison so close.
    one, many = (optimize(Reach(), replace(SMALL, method="cmaes", chunk=chunk)) for chunk in (8, 3))
    torch.testing.assert_close(one.actions, many.actions)


def test_slopes_are_zero_before_contact() -> None:
    actions = torch.zeros(1, 30, 3, dtype=torch.float64, requires_grad=True)
    outcome = Push().evaluate(actions)
    assert (torch.autograd.grad(outcome.loss.sum(), actions)[0] == 0).all()


def test_the_hybrid_beats_both_where_slopes_begin_at_contact() -> None:
    results = {
        method: [returned(optimize(Push(), SearchSettings(method, 320, 16, seed, hold=5))) for seed in range(6)]
        for method in METHODS
    }
    mean = {method: sum(values) / 6 for method, values in results.items()}
    assert mean["hybrid"] >= max(mean["cmaes"], mean["gd"]), results
    assert min(results["hybrid"]) >= max(min(results["cmaes"]), min(results["gd"])), results


@pytest.mark.slow
def test_the_hybrid_beats_both_on_a_rope_dragged_over_a_table() -> None:
    results = {m: returned(optimize(Drag(), SearchSettings(m, 48, 8, 1, hold=2))) for m in METHODS}
    assert results["hybrid"] >= max(results["cmaes"], results["gd"]), results


@dataclass(frozen=True)
class Broken(Reach):
    """Breaks down where the first action goes up, and has no gradient where it goes left."""

    always: bool = False

    def evaluate(self, actions: Tensor) -> Evaluation:
        outcome = super().evaluate(actions)
        up = (actions[:, 0, 2] > 0) | self.always
        left = torch.where(actions[:, 0, 0] < 0, torch.nan, 1.0)
        nan = torch.where(up, torch.nan, outcome.returns)
        return Evaluation(
            nan,
            outcome.loss * torch.where(left.isnan(), (actions.sum((1, 2)) * 0).sqrt() + 1, 1.0),
            outcome.terminal_cost,
            outcome.success & ~up,
            up,
        )


@dataclass(frozen=True)
class Picky(Reach):
    """Counts as done only near the start, where little is earned; and not when it is played alone, at the left."""

    def evaluate(self, actions: Tensor) -> Evaluation:
        outcome = super().evaluate(actions)
        end = actions.sum(1)
        return replace(outcome, success=(end.norm(dim=-1) < 0.05) & ((end[:, 0] > 0) | (len(actions) > 1)))


def test_a_trajectory_that_succeeds_also_alone_is_chosen_before_one_that_earns_more() -> None:
    found = optimize(Picky(), replace(SMALL, episodes=160, method="cmaes"))
    assert bool(found.outcome.success[0]) and float(found.actions.sum(0)[0]) > 0
    assert found.max_return > found.search_return == pytest.approx(returned(found))
    # Those that did not succeed alone are not chosen, and had earned more.
    assert found.max_return == max(point["best"] for point in found.curve)


@dataclass(frozen=True)
class Latch(Reach):
    """Earns the same for all but a way once round a circle; the loss says how far a way is from that."""

    def evaluate(self, actions: Tensor) -> Evaluation:
        turn = torch.linspace(0, 2 * torch.pi, self.horizon + 1, dtype=actions.dtype)[1:]
        circle = 0.025 * torch.stack([1 - turn.cos(), turn.sin(), 0 * turn], -1)
        far = (actions.cumsum(1) - circle).square().sum(-1).mean(-1)
        done = far < 0.003**2
        outcome = super().evaluate(actions)
        return replace(outcome, returns=1.0 + done.to(far), loss=far - 1.0 - done.to(far), success=done)


def test_where_all_earn_the_same_the_hybrid_follows_the_loss() -> None:
    found = optimize(Latch(), SearchSettings("hybrid", episodes=256, population=16, hold=5))
    assert bool(found.outcome.success[0]) and returned(found) == 2
    assert found.curve[0]["best"] == 1, "it is not met by chance"


@dataclass(frozen=True)
class Lure(Reach):
    """Earns most at the goal, and a little less at one corner of it, which alone counts as done."""

    shown: bool = True

    def evaluate(self, actions: Tensor) -> Evaluation:
        end, goal = actions.sum(1), actions.new_tensor(self.goal)
        returns = 10.0 - (end - goal).norm(dim=-1)
        far = (end - goal - actions.new_tensor([-0.02, 0.02, 0.0])).norm(dim=-1)
        terminal_cost = self.shown * 5 * (far - 0.004).clamp(min=0)
        return Evaluation(returns, terminal_cost - returns, terminal_cost, far < 0.005, returns.isnan())


def test_the_hybrid_goes_where_it_succeeds_and_not_where_it_earns_most() -> None:
    settings = SearchSettings("hybrid", episodes=384, population=16, hold=5)
    done, blind = (optimize(Lure(shown=shown), settings) for shown in (True, False))
    assert bool(done.outcome.success[0]) and not bool(blind.outcome.success[0])
    assert returned(blind) > returned(done) > 9.96


@pytest.mark.parametrize("method", METHODS)
def test_a_search_begins_with_a_rehearsal(method: str) -> None:
    settings = SearchSettings(method, episodes=240, population=24, hold=5, surrogate_share=0.8)
    problem = SurrogateRound()
    found = optimize(problem, settings)
    # Eight iterations of ten.
    assert [played for played, _ in itertools.groupby(problem.played)] == ["surrogate", "earnest"]
    assert [point["surrogate"] for point in found.curve] == [True] * 8 + [False] * 2
    assert found.curve[7]["best"] == -math.inf and found.curve[7]["success"] == 0 and found.curve[7]["median"] is None
    assert returned(found) == pytest.approx(max(point["best"] for point in found.curve))
    blind = optimize(SurrogateRound(), replace(settings, episodes=48, surrogate_share=0.0))
    if method == "hybrid":
        assert returned(found) > returned(blind) + 0.1, "two iterations alone do less"
    else:
        assert found.curve[8]["best"] > blind.curve[0]["best"], "what did well before is played first"


def test_trajectories_are_ranked_by_return_and_then_by_loss() -> None:
    returns = torch.tensor([1.0, 2.0, 2.00001, -torch.inf, 2.1, 2.0], dtype=torch.float64)
    loss = torch.tensor([-9.0, 0.3, 0.4, torch.inf, 7.0, 0.1], dtype=torch.float64)
    assert rank_proposals(returns, loss).tolist() == [4, 5, 1, 2, 0, 3]
    assert rank_proposals(torch.zeros(3), torch.tensor([2.0, torch.inf, 1.0])).tolist() == [2, 0, 1]
    assert rank_proposals(torch.full((2,), -torch.inf), torch.full((2,), torch.inf)).tolist() == [0, 1]


@dataclass(frozen=True)
class Narrow(Reach):
    """Trajectories that come near the goal break down alone; in a batch they do not."""

    def evaluate(self, actions: Tensor) -> Evaluation:
        outcome = super().evaluate(actions)
        broken = (len(actions) == 1) & (outcome.returns > -0.5)
        return replace(outcome, returns=torch.where(broken, -100.0, outcome.returns), success=outcome.success & ~broken)


def test_of_what_breaks_down_alone_the_next_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchdlo.agents.trajopt.search._FINALISTS", 64)
    found = optimize(Narrow(), replace(SMALL, episodes=160, method="cmaes"))
    assert found.max_return > -0.5 > returned(found) > -2
    assert found.search_return == pytest.approx(returned(found))


@pytest.mark.parametrize("method", METHODS)
def test_what_has_no_number_is_never_chosen_and_hides_nothing(method: str) -> None:
    found = optimize(Broken(), replace(SMALL, method=method, episodes=160))
    assert not bool(found.outcome.failed[0]) and np.isfinite(returned(found))
    assert sum(point["failed"] for point in found.curve) > 0
    if method != "cmaes":
        assert sum(point["without_gradient"] for point in found.curve) > 0
    with pytest.raises(InputError, match=r"reach: none of 160 episodes had a finite return"):
        optimize(Broken(always=True), replace(SMALL, method=method, episodes=160))


def test_robust_trajectories_hold_in_worlds_that_no_search_has_seen() -> None:
    best = torch.tensor(Peaks().narrow, dtype=torch.float64).expand(4, 3) / 4
    assert float(Peaks().evaluate(best[None]).returns) == pytest.approx(1)
    robust = optimize(Peaks(), SearchSettings("cmaes", 400 * 8 + 64, 20, hold=4, robust=Robust()))
    worlds = Peaks().varied(64, 1.0, 10**9)
    # Starts are even in a cube of 2 cm each way, so that the mean of d^2 is 0.02^2 and that of exp(-d^2 / 0.06^2) at
    # least exp(-1/9), by convexity: 0.72 at the broad peak. Of the narrow one's 8 mm ball at half its height, volume
    # 2.6e-3 of the cube's, little is left; half of the starts at the foot of the broad one would earn 0.3.
    held = [float(worlds.evaluate(actions[None]).returns[0]) for actions in (best, robust.actions)]
    assert held[1] > 0.5 > held[0], held


def test_a_robust_search_counts_every_copy_and_grows_its_worlds() -> None:
    how = Robust(copies=2, warm=0.5, finalists=2, trials=4)
    found = optimize(Push(), replace(SMALL, method="cmaes", episodes=200, robust=how))
    assert found.episodes == 12 * 8 * 2 + 8
    scales = [point["scale"] for point in found.curve]
    assert scales == sorted(scales) and scales[0] == pytest.approx(1 / 6) and scales[-1] == 1
    with pytest.raises(InputError, match="expected at least 24: 16 for an iteration and 8 for the last judgement"):
        optimize(Push(), replace(SMALL, method="cmaes", episodes=23, robust=how))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"method": "luck"}, "method is 'luck'; expected one of cmaes, gd, hybrid."),
        ({"episodes": 7}, "episodes is 7; expected at least 8: 8 for an iteration."),
        ({"population": 3}, "population is 3; expected at least 4 for cmaes."),
        ({"population": 0, "method": "gd"}, "population is 0; expected at least 1 for gd."),
        ({"hold": 31}, "hold is 31; expected 1 to 30 actions."),
        ({"sigma": float("nan")}, "sigma is nan; expected a positive number."),
        ({"rate": 0.0}, "rate is 0.0; expected a positive number."),
        ({"chunk": 0}, "chunk is 0; expected at least 1."),
        ({"surrogate_share": 0.5, "robust": Robust(2)}, "surrogate_share is 0.5; expected 0 with robust."),
        (
            {"surrogate_share": 1.0},
            "surrogate_share is 1.0; expected a share of the iterations from 0 up, less than 1.",
        ),
        (
            {"surrogate_share": 0.5, "method": "hybrid", "episodes": 32},
            "push: it has no surrogate task; set surrogate_share to 0.",
        ),
        ({"seed": -1}, "seed is -1; expected a whole number from 0 to 2^32 - 1."),
        ({"seed": 2**32}, "seed is 4294967296; expected a whole number from 0 to 2^32 - 1."),
    ],
)
def test_settings_that_make_no_search_are_refused(wrong: dict, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        optimize(Push(), replace(SMALL, **wrong))
    assert str(error.value) == sentence


def test_problems_of_any_width_are_searched() -> None:
    @dataclass(frozen=True)
    class Line(Plain):
        name: str = "line"
        horizon: int = 1
        width: int = 1
        group: int = 1
        limit: float = 1.0

        def evaluate(self, actions: Tensor) -> Evaluation:
            returns = -(actions[:, 0, 0] - 0.3).square()
            return Evaluation(returns, -returns, 0 * returns, returns > -1e-6, returns.isnan())

    for method in METHODS:
        found = optimize(Line(), SearchSettings(method, episodes=400, population=4))
        assert float(found.actions) == pytest.approx(0.3, abs=1e-3), method


def test_strategies_of_many_numbers_do_not_warn_of_what_they_were_not_told() -> None:
    # From 300 numbers on cma proposes points of its own; limits move them, so that it does not find them again.
    encoding = Encoding(60, 6, 3, 0.02, 1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = make_strategy(
            torch.zeros(encoding.size, dtype=torch.float64), 0.01, 16, torch.Generator().manual_seed(0)
        )
        for _ in range(5):
            x = draw_population(found, encoding)
            found.tell(list(x.numpy()), (x - 0.01).square().sum(-1).tolist())
    assert not said, said[0].message
