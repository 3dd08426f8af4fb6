"""Gradients inside an evolution strategy, and descent beside it: for losses that are flat until something is touched.

Where a population has room for it, one line descends from doing nothing on a small island, as plain gradient descent
does. What else there is of the population lives on others, which know nothing of each other: whichever way round an
obstacle a search goes, it seldom comes back, and another one may go the other way. On each of them, two parts share the
budget, iteration by iteration, and both have the gradients of the best quarter of what they play:

1. Straight sweeps over what can be reached find out what there is to touch; rounds about bodies, and drags over them by
   tools that draw nearer, find out what comes of it. CMA-ES searches way-points from the best of them. A part of each
   population are the best points so far, moved down their gradient in the metric of the strategy; they are handed over
   as in Hansen 2011 (arXiv:1110.4181).
2. The best points descend in all actions, see `lbfgs`.

CMA-ES begins; then the part goes on that gained more lately, but each in its turn. Where both begin in a surrogate
task, the best of its iterations are the first to be played in the problem itself.

Islands that have fallen behind seldom catch up: they are given up in favour of the best one, half of them first. In
their place, CMA-ES searches about the best trajectory of all, in small steps.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.cmaes import draw_population, make_strategy
from torchdlo.agents.trajopt.lbfgs import TRIES, Descent
from torchdlo.agents.trajopt.problem import Encoding
from torchdlo.agents.trajopt.proposals import (
    Ask,
    Search,
    SearchPlan,
    SurrogateRound,
    Told,
    best_indices,
    circular_proposals,
    drag_proposals,
    random_proposals,
    rank_proposals,
    straight_proposals,
)

__all__ = ["hybrid"]

_ISLAND = 20
"""Trajectories of which another island is made."""
_FRESH = 0.1
"""Share of the iterations that only try sweeps and rounds."""
_COARSE = 0.3
"""Share of the iterations in which CMA-ES is alone."""
_TURN = 5
"""Iterations of which each part has at least one."""
_SURGE, _CUT = 3, 10.0
"""Gradients of all actions are believed up to so many times the largest one of the last third of them."""
_WILD = 10.0
"""Gradients of an action are dropped that promise to change the loss by so many times the largest loss in a first
step."""
_SHORT = 0.1
"""Share of the first step from which shorter ones are given up."""
_GIVEN_UP = {0.4: 0.5, 0.7: 1.0}
"""Which shares of the islands are given up if they are behind, after which shares of the iterations."""
_CLOSE = 0.2
"""First spread about the best trajectory of all, over that of other beginnings."""
_BEHIND = 1e-4
"""Share of the largest value by which an island has to be behind."""
_APART = 0.2
"""How far tools go their own ways where they go 1 together: they hold on to the same things."""


def hybrid(plan: SearchPlan, rng: torch.Generator) -> Search:
    """Search on islands, see above."""
    count = max(1, plan.population // _ISLAND)  # of islands
    sizes = [(plan.population + k) // count for k in range(count)]
    # A line has no use for losses that do not compare, as worlds get harder from one iteration to the next.
    plain = plan.drifts == 0 and sizes[0] >= 3 * TRIES
    if plain:
        sizes = [sizes[0] - TRIES, *sizes[1:], TRIES]
        count += 1
    plans = [replace(plan, population=size) for size in sizes]
    rngs = [torch.Generator().manual_seed(seed) for seed in torch.randint(2**31, (count,), generator=rng).tolist()]
    kinds = [_island] * (count - plain) + [_line] * plain
    islands = [kind(own, seeded) for kind, own, seeded in zip(kinds, plans, rngs, strict=True)]
    if plan.first is not None:
        # What is given may be wrong: every other island begins as without it.
        for j in range(0, count, 2):
            islands[j] = kinds[j](plans[j], rngs[j], 0, plan.first[j // 2 % len(plan.first)])
    parts: list[Told | None] = [None] * count
    given_up = {math.ceil(when * plan.iterations): share for when, share in _GIVEN_UP.items()}
    # What was measured in a surrogate task or in milder worlds does not compare with what comes after.
    anew = {*range(math.ceil(plan.drifts * plan.iterations) + 1), plan.surrogates}
    top: list[tuple[float, Tensor]] = []
    for k in itertools.count():
        if k in anew:
            top = [(-math.inf, torch.empty(0))] * count
        order = sorted(range(count), key=lambda j: -top[j][0])
        value, leading = top[order[0]]
        for j in order[count - round(given_up.get(k, 0.0) * (count - 1)) :]:
            if top[j][0] < value - _BEHIND * abs(value):
                islands[j], parts[j] = kinds[j](plans[j], rngs[j], k, leading), None
        asks = [
            next(island) if told is None else island.send(told) for island, told in zip(islands, parts, strict=True)
        ]
        counts = [len(ask.points) for ask in asks]

        def pick(told: Told, _: int, asks: list[Ask] = asks, counts: list[int] = counts) -> Tensor:
            first = itertools.accumulate(counts, initial=0)
            own = zip(asks, told.split(counts), first, strict=False)
            return torch.cat([ask.pick(part, ask.with_gradient) + start for ask, part, start in own])

        told = yield Ask(
            asks[0].encoding, torch.cat([ask.points for ask in asks]), sum(a.with_gradient for a in asks), pick
        )
        answers = told.split(counts)
        parts = [*answers]
        for j, (ask, part) in enumerate(zip(asks, answers, strict=True)):
            at = int(part.value.argmax())
            top[j] = max(top[j], (float(part.value[at]), ask.points[at]), key=lambda found: found[0])


def _line(plan: SearchPlan, rng: torch.Generator, first: int = 0, about: Tensor | None = None) -> Search:
    """Descend on one line, from doing nothing or from actions that are given; arguments as of `_island`."""
    encoding, line, tame = plan.encoding(1), Descent(plan, rng), _Tame(plan)
    start = line.best[1] if about is None else about
    for k in itertools.count(first):
        if k in (first, plan.surrogates):
            # Nothing but the gradient there is wanted; what is played beside it are ways about it.
            away = plan.encoding(plan.hold).decode(random_proposals(plan, rng)).flatten(1)
            x = encoding.project(torch.cat([start[None], start + away[1:]]))
            told = yield Ask(encoding, x, 1, lambda told, _: torch.zeros(1, dtype=torch.long))
            line.clear()
            line.offer(x[:1], tame(told).split([1, len(x) - 1])[0])
        else:
            x = line.ask()
            told = yield Ask(encoding, x, line.count, line.pick)
            line.tell(x, tame(told))
        start = line.best[1]


def _island(plan: SearchPlan, rng: torch.Generator, first: int = 0, about: Tensor | None = None) -> Search:
    """Search with sweeps, rounds, CMA-ES and descent.

    Args:
        plan: of this island.
        rng: where random numbers come from.
        first: iterations that are over.
        about: actions to begin with in place of sweeps and rounds [m], shape (T A,).
    """
    given = about is not None and first == 0
    encoding, coarse, fine = plan.encoding(1), _Evolution(plan, rng, about, given=given), Descent(plan, rng)
    with_gradient, tame = fine.count, _Tame(plan)
    both: tuple[_Evolution | Descent, ...] = (coarse, fine)
    drifts = math.ceil(plan.drifts * plan.iterations)
    alone = max(drifts, first + 1 if first else math.ceil(_COARSE * plan.iterations))
    gain: dict[_Evolution | Descent, float] = {coarse: 0.0, fine: math.inf}
    last: dict[_Evolution | Descent, int] = {coarse: first, fine: first}
    top = -math.inf
    surrogate_share = SurrogateRound(plan)
    for k in itertools.count(first):
        if k == plan.surrogates > 0:
            x = surrogate_share.actions
            told = yield Ask(encoding, x, min(with_gradient, len(x)))
            told = tame(told)
            coarse.lines = None
            fine.clear()
            fine.offer(x, told)
            top = float(told.value.max())
            continue

        turns = {part: (k - last[part] >= _TURN, gain[part], -last[part]) for part in both}
        part = coarse if k < alone else max(both, key=turns.__getitem__)
        x = part.ask()
        told = yield Ask(encoding, x, with_gradient, best_indices if part is coarse else fine.pick)
        told = tame(told)
        # What was measured in milder worlds does not compare.
        if k < drifts:
            coarse.lines = None
            fine.clear()
            top = -math.inf
        if k < plan.surrogates:
            surrogate_share.note(x, told)
        part.tell(x, told)
        if part is coarse:
            fine.offer(x, told)
        max_return = float(told.value.max())
        gained = max(0.0, max_return - top) if math.isfinite(top) else 0.0
        gain[part] = gained if math.isinf(gain[part]) else 0.5 * (gain[part] + gained)
        last[part], top = k, max(top, max_return)


class _Tame:
    """Drops or cuts gradients that grew beyond measure.

    Ropes may move chaotically: derivatives then grow from action to action, back in time, and hold for ways so short
    that they are of no use. Left alone, the largest would be all that steps go by.
    """

    def __init__(self, plan: SearchPlan) -> None:
        self.plan, self.largest = plan, 0.0

    def __call__(self, told: Told) -> Told:
        """Return what was told, with gradients by actions, shape (P, T A), as far as they are believed.

        What is left of them is scaled down by the square of how far it is beyond the later ones.
        """
        each = told.gradient.unflatten(-1, (self.plan.horizon, -1))
        size = torch.linalg.vector_norm(each, dim=-1, keepdim=True)
        self.largest = max([self.largest, *told.loss[torch.isfinite(told.loss)].abs().tolist()])
        held = self.plan.rate * size <= _WILD * self.largest
        each, size = torch.where(held, each, 0.0), torch.where(held, size, 0.0)
        most = _CUT * size[:, -math.ceil(self.plan.horizon / _SURGE) :].amax(1, keepdim=True)
        factor = torch.where((most > 0) & (size > most), most / size, 1.0)
        return replace(told, gradient=(each * factor.square()).flatten(1))


class _Evolution:
    """CMA-ES over way-points, with lines; asked and told by turns.

    It begins with the best of sweeps and rounds, or adds its way-points to actions (T A,) that are given.
    """

    def __init__(
        self, plan: SearchPlan, rng: torch.Generator, about: Tensor | None = None, *, given: bool = False
    ) -> None:
        self.plan, self.rng, self.encoding, self.about = plan, rng, plan.encoding(plan.hold, _APART), about
        self.unplayed = given  # nobody has played these actions yet
        self.fresh = max(1, round(_FRESH * plan.iterations))
        self.tried: list[tuple[Tensor, Told]] = []
        self.x = torch.zeros(0, self.encoding.size, dtype=torch.float64)
        self.found: Any = None
        if about is not None:
            self.found = make_strategy(about.new_zeros(self.encoding.size), _CLOSE * plan.sigma, plan.population, rng)
        self.lines: _Lines | None = None
        """None lets them start anew from what is told next."""

    def ask(self) -> Tensor:
        """Return what to play: beginnings at first, then points that were moved, and what the strategy draws."""
        if self.found is None:
            self.x = _beginnings(self.plan, self.encoding, self.rng)
        else:
            moved = self.x[:0] if self.lines is None else self.encoding.project(self.lines.moved(self.found))
            if self.unplayed:
                moved, self.unplayed = torch.zeros(1, self.encoding.size, dtype=torch.float64), False
            self.x = draw_population(self.found, self.encoding, moved)
        actions = self.encoding.decode(self.x).flatten(1)
        return actions if self.about is None else self.plan.encoding(1).project(self.about + actions)

    def tell(self, _: Tensor, told: Told) -> None:
        """Learn from how that went."""
        told = replace(told, gradient=self.encoding.pull(self.x, told.gradient))
        count = max(1, self.plan.population // TRIES)
        if self.found is None:
            self.tried.append((self.x, told))
            if len(self.tried) == self.fresh:
                x, parts = zip(*self.tried, strict=True)
                self.lines = _Lines(torch.cat(x), Told.cat(parts), count)
                self.found = make_strategy(self.lines.x[0], self.plan.sigma, self.plan.population, self.rng)
            return
        # The strategy looks at nothing but the order.
        place = rank_proposals(told.value, told.loss).argsort()
        self.found.tell(list(self.x.numpy()), place.double().tolist())
        if self.lines is None:
            self.lines = _Lines(self.x, told, count)
        else:
            self.lines.learn(self.x, told)


def _beginnings(plan: SearchPlan, encoding: Encoding, rng: torch.Generator) -> Tensor:
    """Return points of sweeps and of random walks.

    Half are rounds where there is something to touch; several tools drag what they hold over it in most others.
    """
    x = straight_proposals(plan, encoding, rng)
    x[1::2] = encoding.project(random_proposals(plan, rng))[1::2]
    if plan.touch:
        turn = torch.arange(len(x)) % 6
        if len(plan.tools) > 1:
            dragged = (turn == 1) | (turn == 2)
            x[dragged] = drag_proposals(plan, encoding, rng, int(dragged.sum()))
        x[turn > 2] = circular_proposals(plan, encoding, rng, int((turn > 2).sum()))
    return x


class _Lines:
    """Points that go down their gradients within an evolution strategy, the best first at the start."""

    def __init__(self, x: Tensor, told: Told, count: int) -> None:
        rows = best_indices(told, count)
        self.x, self.value, self.loss, self.gradient = x[rows], told.value[rows], told.loss[rows], told.gradient[rows]
        # A drawn point lies about the root of the dimension away from the mean; half of it is a step.
        self.first = 0.5 * math.sqrt(x.shape[1])
        self.length = torch.full_like(self.loss, self.first)

    def moved(self, found: Any) -> Tensor:
        """Return the points after a step down; those without gradient, or whose steps came to nothing, stay out."""
        down = -self.gradient @ torch.as_tensor(found.sm.covariance_matrix)
        size = -(down * self.gradient).sum(-1)
        self.active = ((size > 0) & (self.length > _SHORT * self.first)).nonzero()[:, 0]
        scale = found.sigma * self.length[self.active] / size[self.active].sqrt()
        return self.x[self.active] + scale[:, None] * down[self.active]

    def learn(self, x: Tensor, told: Told) -> None:
        """Take steps that went down, shorten those that did not, and let new points in for the worst lines."""
        active, n = self.active, len(self.active)
        down = told.loss[:n] < self.loss[active]
        self.length[active] *= torch.where(down, 2.0, 0.5)
        self._put(active[down], x, told, torch.arange(n)[down])
        fresh = rank_proposals(told.value[n:], told.loss[n:])[: max(1, len(self.x) // 2)] + n
        live = (self.length > _SHORT * self.first) & (self.gradient != 0).any(-1)
        value = torch.where(live, self.value, -math.inf)
        worst = value.argsort(stable=True)[: len(fresh)]
        better = told.value[fresh] > value[worst]
        self.length[worst[better]] = self.first
        self._put(worst[better], x, told, fresh[better])

    def _put(self, rows: Tensor, x: Tensor, told: Told, of: Tensor) -> None:
        self.x[rows], self.gradient[rows] = x[of], told.gradient[of]
        self.value[rows], self.loss[rows] = told.value[of], told.loss[of]
