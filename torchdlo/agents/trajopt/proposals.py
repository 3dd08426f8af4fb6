"""What the optimisers agree on: what they ask for, what they are told, and how much of it there is."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.problem import Encoding, Problem

__all__ = [
    "Ask",
    "Search",
    "SearchPlan",
    "SurrogateRound",
    "Told",
    "best_indices",
    "drag_proposals",
    "search_surrogate",
]
__all__ += ["circular_proposals", "random_proposals", "rank_proposals", "straight_proposals"]

_ALIKE = 1e-4
"""Share of the largest return by which returns differ that are not to be told apart."""
_ROUND = (2, 20)
"""Smallest and greatest radius of rounds, and how far they are above things at most: what a tool goes in one action is
1."""


@dataclass(frozen=True, eq=False)
class Told:
    """How they went."""

    returns: Tensor
    """Returns; -inf where there is no number [-], shape (P,)."""
    loss: Tensor
    """Losses; inf where there is no number [-], shape (P,)."""
    terminal_cost: Tensor
    """How far the ends are from success, in the units of the return [-], shape (P,)."""
    success: Tensor
    """Whether the task was done, bool [-], shape (P,)."""
    failed: Tensor
    """Whether the episode broke down, bool [-], shape (P,)."""
    gradient: Tensor
    """Gradient of the loss [1/m], zero where there is no number and where it was not asked for, shape (P, size); (P, 0)
    if it was asked for nowhere."""

    @property
    def value(self) -> Tensor:
        """Returns without what is missing to success; -inf where there is no number [-], shape (P,)."""
        return self.returns - self.terminal_cost

    def split(self, sizes: Sequence[int]) -> list[Told]:
        """Return the parts for so many trajectories each."""
        columns = (getattr(self, f.name).split(list(sizes)) for f in dataclasses.fields(self))
        return [Told(*part) for part in zip(*columns, strict=True)]

    @classmethod
    def cat(cls, parts: Sequence[Told]) -> Told:
        """Return how the trajectories of all parts went."""
        return cls(*(torch.cat([getattr(part, f.name) for part in parts]) for f in dataclasses.fields(cls)))


def best_indices(told: Told, count: int) -> Tensor:
    """Return the indices of the best, failed ones last, shape (count,) or, if there are fewer, (P,)."""
    return rank_proposals(told.value, told.loss, ~told.failed)[:count]


@dataclass(frozen=True, eq=False)
class Ask:
    """Trajectories to play."""

    encoding: Encoding
    points: Tensor
    """Numbers of the way-points [m], shape (P, size)."""
    with_gradient: int = 0
    """How many gradients of the loss are wanted."""
    pick: Callable[[Told, int], Tensor] = best_indices
    """Returns which ones, `with_gradient` indices, from how all went. A gradient costs several times what playing does:
    those of a part are had by playing that part once more."""


Search = Generator[Ask, Told, None]
"""An optimiser: yields what it wants played, and is sent how that went. It never runs anything itself."""


@dataclass(frozen=True)
class SearchPlan:
    """Size of a problem and of the search; lengths in metres."""

    horizon: int
    width: int
    group: int
    limit: float
    population: int
    """Trajectories per iteration."""
    iterations: int
    """Iterations that the budget allows."""
    hold: int = 10
    """Actions per way-point of CMA-ES."""
    sigma: float = 0.05
    """First standard deviation of a way-point's displacement [m]."""
    rate: float = 1e-3
    """First step of Adam [m]."""
    last: float = 1e-6
    """Its last step [m]."""
    steps: int = 100
    """Steps of Adam from one start at most."""
    patience: int = 10
    """Steps without gain after which a start is given up."""
    drifts: float = 0.0
    """Share of the iterations in which worlds get harder from one to the next: results of different ones do not compare
    until then."""
    surrogates: int = 0
    """Iterations that are played in a problem much like this one; their results do not compare with later ones."""
    touch: tuple[tuple[float, float, float], ...] = ()
    """Where there are things to touch, see `Problem.touch`."""
    tools: tuple[tuple[float, float, float], ...] = ()
    """Where tools are at the start, see `Problem.tools`."""
    first: Tensor | None = None
    """Trajectories to begin with, if there are any [m], shape (K, T A)."""

    @classmethod
    def of(cls, problem: Problem, population: int, iterations: int, **choices: Any) -> SearchPlan:
        """Return the plan for a problem; lengths that are not given follow from its limit."""
        hold = choices.setdefault("hold", min(10, problem.horizon))
        # 0.05 m, 1 mm and 1 um where tools go 1 cm per action and way-points have ten.
        lengths = {"sigma": 0.5 * hold * problem.limit, "rate": 0.1 * problem.limit, "last": 1e-4 * problem.limit}
        sizes = (problem.horizon, problem.width, problem.group, problem.limit)
        places = {"touch": problem.touch, "tools": problem.tools}
        return cls(*sizes, population, iterations, **(places | lengths | choices))

    def encoding(self, hold: int, apart: float | None = None) -> Encoding:
        """Return the encoding with `hold` actions per way-point, see `Encoding`."""
        return Encoding(self.horizon, self.width, self.group, self.limit, hold, apart)


class SurrogateRound:
    """The best of every iteration of a surrogate task: the first to be played in the problem itself."""

    def __init__(self, plan: SearchPlan) -> None:
        self.plan = plan
        self.parts: list[Tensor] = []

    def note(self, actions: Tensor, told: Told) -> None:
        """Keep the best of an iteration; actions (P, T A) [m]."""
        each = math.ceil(self.plan.population / self.plan.surrogates)
        self.parts.append(actions[best_indices(told, each)])

    @property
    def actions(self) -> Tensor:
        """Those of the latest iterations, as many as a population has, shape (P, T A) [m]."""
        return torch.cat(self.parts[::-1])[: self.plan.population]


def search_surrogate(search: Search, plan: SearchPlan) -> Search:
    """Search as `search` does; what did well in a surrogate task is played in the problem itself before that goes
    on."""
    kept = SurrogateRound(plan)
    told: Told | None = None
    for k in itertools.count():
        ask = next(search) if told is None else search.send(told)
        if k == plan.surrogates > 0:
            yield Ask(plan.encoding(1), kept.actions)
        told = yield ask
        if k < plan.surrogates:
            kept.note(ask.encoding.decode(ask.points).flatten(1), told)


def random_proposals(plan: SearchPlan, rng: torch.Generator, count: int | None = None) -> Tensor:
    """Return random way-points [m], shape (count, size), as CMA-ES would draw them at first; a population if not given.

    They may reach further than tools do.
    """
    size = plan.encoding(plan.hold).size
    return plan.sigma * torch.randn(count or plan.population, size, generator=rng, dtype=torch.float64)


def straight_proposals(plan: SearchPlan, encoding: Encoding, rng: torch.Generator) -> Tensor:
    """Return points of straight sweeps in one to three legs, shape (population, size).

    Independent displacements walk as far as the root of their number; sweeps go as far as possible, and so meet things
    that lie away from the start. Tools go their own ways in some, which may tear what they hold, and together in the
    others. The first is the trajectory that does nothing.
    """
    knots, groups, count = encoding.knots, plan.width // plan.group, plan.population
    draw = torch.randn(count, 3, groups, plan.group, generator=rng, dtype=torch.float64)
    heading = draw / torch.linalg.vector_norm(draw, dim=-1, keepdim=True)
    length = encoding.reach * torch.rand(count, 3, groups, 1, generator=rng, dtype=torch.float64)
    stage_waypoints = heading * length
    each = torch.arange(count)
    stage_waypoints = torch.where((each % 4 < 2)[:, None, None, None], stage_waypoints, stage_waypoints[:, :, :1])
    moves = stage_waypoints[each[:, None], _legs(knots, count)]
    return encoding.project(encoding.encode(torch.cat([torch.zeros_like(moves[:1]), moves[1:]])))


def drag_proposals(plan: SearchPlan, encoding: Encoding, rng: torch.Generator, count: int) -> Tensor:
    """Return points of ways straight over a thing that can be touched, by tools that draw nearer, (count, size).

    What tools hold between them comes to lie about the things on its way, and is drawn together there. Ways have one to
    three legs, which differ in how far tools go and in how much nearer they draw.
    """
    things, leg = _targets(plan), _legs(encoding.knots, count)
    aim = things[torch.randint(len(things), (count,), generator=rng)]
    ahead = aim / torch.linalg.vector_norm(aim, dim=-1, keepdim=True).clamp(min=1e-9)
    speed = encoding.reach * torch.rand(count, 3, generator=rng, dtype=torch.float64).gather(1, leg)
    nearer = torch.rand(count, 3, generator=rng, dtype=torch.float64).gather(1, leg)
    # All of it together is a share of the way to where tools would meet.
    nearer = nearer / nearer.sum(1, keepdim=True) * torch.rand(count, 1, generator=rng, dtype=torch.float64)
    together = speed[..., None, None] * ahead[:, None, None]
    apart = torch.tensor(plan.tools, dtype=torch.float64)
    return encoding.project(encoding.encode(together - nearer[..., None, None] * apart))


def _legs(knots: int, count: int) -> Tensor:
    """Return to which leg each way-point belongs, of one, two and three by turns, shape (count, knots)."""
    return torch.arange(knots)[None] * (1 + torch.arange(count) % 3)[:, None] // knots


def _targets(plan: SearchPlan) -> Tensor:
    """Return where things are, and the middle of several [m], shape (N, 3)."""
    if not plan.touch:
        raise ValueError("there is nothing to touch; expected a plan with touch")
    things = torch.tensor(plan.touch, dtype=torch.float64)
    return torch.cat([things, things.mean(0, keepdim=True)]) if len(things) > 1 else things


def circular_proposals(plan: SearchPlan, encoding: Encoding, rng: torch.Generator, count: int) -> Tensor:
    """Return points of ways straight to a circle about a thing that can be touched, and on along it, (count, size).

    Ropes are put round and over things, and drawn round them. Every fourth circle is upright, in line with the way to
    the thing; the others are level, somewhat higher than its middle. The middle of all things is one, too. Tools go
    together.
    """

    def rand() -> Tensor:
        return torch.rand(count, 1, generator=rng, dtype=torch.float64)

    things = _targets(plan)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    middle = things[torch.randint(len(things), (count,), generator=rng)] + _ROUND[1] * plan.limit * rand() * up
    radius = plan.limit * _ROUND[0] * (_ROUND[1] / _ROUND[0]) ** rand()
    ahead = middle * (1 - up)
    ahead = ahead / torch.linalg.vector_norm(ahead, dim=-1, keepdim=True).clamp(min=1e-9)
    upright = (torch.arange(count) % 4 == 3).unsqueeze(-1)
    side = torch.where(upright, up, torch.linalg.cross(up.expand_as(ahead), ahead))
    first, way = 2 * math.pi * rand(), torch.where(rand() < 0.5, -1.0, 1.0)
    speed = torch.where(rand() < 0.5, 1.0, 0.5 + 0.5 * rand()) * plan.limit
    entry = middle + radius * (first.cos() * ahead + first.sin() * side)
    far = torch.linalg.vector_norm(entry, dim=-1, keepdim=True).clamp(min=1e-9)
    # How far tools have come at each way-point: up to the circle, then along it.
    done = speed * encoding.hold * torch.arange(encoding.knots + 1, dtype=torch.float64)
    angle = first + way * (done - far).clamp(min=0) / radius
    straight_on = entry.unsqueeze(1) * (done / far).clamp(max=1).unsqueeze(-1)
    turn = (angle.cos() - first.cos()).unsqueeze(-1) * ahead.unsqueeze(1)
    turn = turn + (angle.sin() - first.sin()).unsqueeze(-1) * side.unsqueeze(1)
    moves = (straight_on + radius.unsqueeze(-1) * turn).diff(dim=1)
    tools = plan.width // plan.group
    return encoding.project(encoding.encode(moves.unsqueeze(2).expand(-1, -1, tools, -1)))


def rank_proposals(returns: Tensor, loss: Tensor, tier: Tensor | None = None) -> Tensor:
    """Return indices, the best first: of the larger return; where returns are alike, of the smaller loss; shape (P,).

    Returns may be flat until something is touched, while the loss leads there.

    Args:
        returns: shape (P,).
        loss: shape (P,).
        tier: if given, all of a larger one come before all of a smaller one, shape (P,).
    """
    good = returns[torch.isfinite(returns)].abs()
    grain = _ALIKE * float(good.max()) if len(good) else 0.0
    coarse = (returns / grain).round() if grain else returns
    first = loss.argsort(stable=True)
    order = first[coarse[first].argsort(descending=True, stable=True)]
    return order if tier is None else order[tier[order].int().argsort(descending=True, stable=True)]
