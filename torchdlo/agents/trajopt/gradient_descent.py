"""Gradient descent from several starts at once, each given up when it gains nothing more."""

from __future__ import annotations

import itertools
import math

import torch

from torchdlo.agents.trajopt.proposals import Ask, Search, SearchPlan, random_proposals

__all__ = ["descent"]


def descent(plan: SearchPlan, rng: torch.Generator) -> Search:
    """Move every action by Adam (Kingma and Ba 2015, arXiv:1412.6980) with a cosine schedule.

    The first start does nothing; the others, and those that follow on starts that were given up, are random way-points.
    """
    encoding, coarse = plan.encoding(1), plan.encoding(plan.hold)

    def fresh() -> torch.Tensor:
        return encoding.project(coarse.decode(random_proposals(plan, rng)).flatten(1))

    x = fresh()
    x[0] = 0
    mean, square = torch.zeros_like(x), torch.zeros_like(x)
    step, stall, best = x.new_zeros(len(x), 1), x.new_zeros(len(x), 1), x.new_full((len(x), 1), -math.inf)
    drifts = math.ceil(plan.drifts * plan.iterations)
    for k in itertools.count():
        if k <= drifts or k == plan.surrogates:
            best = torch.full_like(
                best, -math.inf
            )  # what was had in milder worlds, or in a surrogate task, is no measure
        told = yield Ask(encoding, x, with_gradient=len(x))
        gain = told.returns[:, None] > best
        best, stall = torch.where(gain, told.returns[:, None], best), torch.where(gain, 0, stall + 1)
        rate = plan.last + (plan.rate - plan.last) * 0.5 * (1 + torch.cos(math.pi * step / plan.steps))
        step = step + 1
        mean = 0.9 * mean + 0.1 * told.gradient
        square = 0.999 * square + 0.001 * told.gradient**2
        move = (mean / (1 - 0.9**step)) / ((square / (1 - 0.999**step)).sqrt() + 1e-8)
        over = (stall >= plan.patience) | (step >= plan.steps)
        x = torch.where(over, fresh(), encoding.project(x - rate * move))
        mean, square, step, stall = (torch.where(over, 0, y) for y in (mean, square, step, stall))
        best = torch.where(over, -math.inf, best)
