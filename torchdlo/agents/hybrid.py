"""Gradients inside an evolution strategy, then descent: for losses that are flat until something is touched.

Three parts share the budget, and every episode of all of them is played with gradient:

1. Straight sweeps over what can be reached find out what there is to touch.
2. CMA-ES searches from the best of them. A part of each population are the best points so far, moved down their slope
   in the metric of the strategy; they are handed over as in Hansen 2011 (arXiv:1110.4181).
3. The best points descend in all actions by L-BFGS (Nocedal and Wright 2006, algorithm 7.4), several step lengths of
   each side by side, as a batch costs little more than one.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.cmaes import drawn, strategy
from torchdlo.agents.plan import Ask, Plan, Search, Told, costs, sweeps, walks

__all__ = ["hybrid"]

_COARSE = 0.5
"""Share of the iterations that search way-points."""
_LINES = 0.25
"""Share of a population that are points moved down their slopes."""
_PAIRS = 8
"""Steps that L-BFGS remembers."""
_TRIES = 4
"""Step lengths that are tried side by side, from four times the last one to a sixteenth of it."""


def hybrid(plan: Plan, rng: torch.Generator) -> Search:
    """Search with sweeps, CMA-ES and descent, see above."""
    encoding = plan.encoding(plan.hold)
    x = sweeps(plan, rng)
    x[1::2] = encoding.project(walks(plan, rng))[1::2]
    told = yield Ask(encoding, x, graded=True)
    lines = _Lines(x, told, max(1, round(_LINES * plan.population)))
    found = strategy(lines.x[0], plan.sigma, plan.population, rng)
    for _ in range(1, math.ceil(_COARSE * plan.iterations)):
        down, active = lines.moved(found)
        x = drawn(found, encoding, encoding.project(down))
        told = yield Ask(encoding, x, graded=True)
        found.tell(list(x.numpy()), costs(told).tolist())
        if plan.drifts:
            # What was measured in milder worlds does not compare: lines start anew.
            lines = _Lines(x, told, len(lines.x))
        else:
            lines.learn(x, told, active)
    yield from _descend(plan, encoding.decode(lines.x).flatten(1), rng)


class _Lines:
    """Points that go down their slopes within an evolution strategy, the best first at the start."""

    def __init__(self, x: Tensor, told: Told, count: int) -> None:
        best = told.returns.argsort(descending=True, stable=True)[:count]
        self.x, self.returns, self.loss, self.slope = x[best], told.returns[best], told.loss[best], told.slope[best]
        # A drawn point lies about the root of the dimension away from the mean; half of it is a step.
        self.first = 0.5 * math.sqrt(x.shape[1])
        self.length = torch.full_like(self.loss, self.first)

    def moved(self, found: Any) -> tuple[Tensor, Tensor]:
        """Return the points after a step down, and which lines they are of; those without slope stay out."""
        metric = torch.as_tensor(found.sm.covariance_matrix)
        down = -self.slope @ metric
        size = -(down * self.slope).sum(-1)
        active = (size > 0).nonzero()[:, 0]
        scale = found.sigma * self.length[active] / size[active].sqrt()
        return self.x[active] + scale[:, None] * down[active], active

    def learn(self, x: Tensor, told: Told, active: Tensor) -> None:
        """Take steps that went down, shorten those that did not, and let new points in for the worst lines."""
        n = len(active)
        down = told.loss[:n] < self.loss[active]
        self.length[active] *= torch.where(down, 2.0, 0.5)
        self._put(active[down], x, told, torch.arange(n)[down])
        fresh = told.returns[n:].argsort(descending=True, stable=True)[: len(self.x) // 2] + n
        worst = self.returns.argsort(stable=True)[: len(fresh)]
        better = told.returns[fresh] > self.returns[worst]
        self.length[worst[better]] = self.first
        self._put(worst[better], x, told, fresh[better])

    def _put(self, rows: Tensor, x: Tensor, told: Told, of: Tensor) -> None:
        self.x[rows], self.slope[rows] = x[of], told.slope[of]
        self.returns[rows], self.loss[rows] = told.returns[of], told.loss[of]


def _descend(plan: Plan, starts: Tensor, rng: torch.Generator) -> Search:
    """Descend in all actions from the best starts."""
    encoding, coarse, count = plan.encoding(1), plan.encoding(plan.hold), plan.population
    lines = max(1, count // _TRIES)
    tries = count // lines

    def noise() -> Tensor:
        return 0.2 * coarse.decode(walks(plan, rng)).flatten(1)

    x = starts[torch.arange(count) % len(starts)]
    x = encoding.project(torch.cat([x[: len(starts)], (x + noise())[len(starts) :]]))
    told = yield Ask(encoding, x, graded=True)
    best = told.returns.argsort(descending=True, stable=True)[:lines]
    x, loss, slope = x[best], told.loss[best], told.slope[best]
    past: list[tuple[Tensor, Tensor]] = []
    step = torch.full_like(loss, plan.rate)
    factor = 4.0 ** torch.linspace(1, -2, tries, dtype=x.dtype)
    while True:
        down = _direction(slope, past)
        # The first step is as long as Adam's: its largest component is the rate.
        unit = down / down.abs().amax(-1, keepdim=True).clamp(min=1e-300)
        lengths = step[:, None] * factor
        tried = encoding.project((x[:, None] + lengths[..., None] * unit[:, None]).flatten(0, 1))
        told = yield Ask(encoding, tried, graded=True)
        row = torch.arange(lines)
        pick = told.loss.reshape(lines, tries).argmin(-1)
        at = row * tries + pick
        gain = (told.loss[at] < loss)[:, None]
        moved, turned = torch.where(gain, tried[at] - x, 0.0), torch.where(gain, told.slope[at] - slope, 0.0)
        past = [*past, (moved, turned)][-_PAIRS:]
        x, slope, loss = x + moved, slope + turned, torch.where(gain[:, 0], told.loss[at], loss)
        step = torch.where(gain[:, 0], lengths[row, pick], lengths[:, -1] / 4)


def _direction(slope: Tensor, past: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Return the direction of L-BFGS, shape (L, n), from steps and changes of slope, oldest first.

    Pairs without positive curvature count nothing, line by line.
    """
    q, weights = slope, []
    for moved, turned in reversed(past):
        curved = (moved * turned).sum(-1, keepdim=True)
        rho = torch.where(curved > 0, 1 / curved.clamp(min=1e-300), 0.0)
        alpha = rho * (moved * q).sum(-1, keepdim=True)
        weights.append((rho, alpha))
        q = q - alpha * turned
    scale = torch.ones_like(q[:, :1])
    for moved, turned in past:
        curved = (moved * turned).sum(-1, keepdim=True)
        scale = torch.where(curved > 0, curved / turned.square().sum(-1, keepdim=True).clamp(min=1e-300), scale)
    q = scale * q
    for (moved, turned), (rho, alpha) in zip(past, reversed(weights), strict=True):
        q = q + moved * (alpha - rho * (turned * q).sum(-1, keepdim=True))
    return -q
