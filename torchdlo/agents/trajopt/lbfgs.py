"""Descent by L-BFGS from several points at once (Nocedal and Wright 2006, algorithm 7.4).

Several step lengths of each line are tried side by side, as a batch costs little more than one episode. Where tools go
as far as they can, as they do on most good ways, lines follow the limit: what leads beyond it is taken off gradients
and directions, as it would hide what is left (the projection of Bertsekas 1982, doi:10.1137/0320018).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchdlo.agents.trajopt.proposals import SearchPlan, Told, random_proposals, rank_proposals

__all__ = ["TRIES", "Descent"]

_PAIRS = 8
"""Steps that a line remembers."""
TRIES = 4
"""Step lengths that are tried side by side, from four times the last one to a sixteenth of it."""
_NOISE = 0.5
"""How far from the best point a line starts again, over the first steps of CMA-ES: so far times lengths of steps."""


class Descent:
    """Lines that descend in all actions from the best points that were offered; asked and told by turns."""

    def __init__(self, plan: SearchPlan, rng: torch.Generator) -> None:
        """Begin without any line."""
        self.plan, self.rng, self.encoding = plan, rng, plan.encoding(1)
        self.count = max(1, plan.population // TRIES)
        self.tries = plan.population // self.count
        self.clear()

    def clear(self) -> None:
        """Forget all lines."""
        empty = torch.zeros(0, self.encoding.size, dtype=torch.float64)
        self.x = self.gradient = empty
        self.halves = torch.zeros(0, dtype=torch.int)
        self.value = self.loss = self.step = empty[:, 0]
        # Steps and changes of gradient, oldest first; zero where there are none.
        self.moved = self.turned = torch.zeros(_PAIRS, *empty.shape, dtype=torch.float64)
        self.best = (-math.inf, empty.new_zeros(self.encoding.size))

    def offer(self, x: Tensor, told: Told) -> None:
        """Take what is better than the lines; told gradients are by actions, shape (P, T A), of the best at least.

        Points from where lines get on are better than all others: where episodes hold and have gradients by most
        actions.
        """
        halves = self._halves(told)
        told = self._noted(x, told)
        value, loss = torch.cat([self.value, told.value]), torch.cat([self.loss, told.loss])
        halves = torch.cat([self.halves, halves])
        best = rank_proposals(value, loss, halves)[: self.count]
        none = torch.zeros(_PAIRS, *x.shape, dtype=x.dtype)
        self.x, self.gradient = torch.cat([self.x, x])[best], torch.cat([self.gradient, told.gradient])[best]
        self.value, self.loss, self.halves = value[best], loss[best], halves[best]
        self.step = torch.cat([self.step, torch.full_like(told.loss, self.plan.rate)])[best]
        self.moved, self.turned = (torch.cat([old, none], 1)[:, best] for old in (self.moved, self.turned))

    def ask(self) -> Tensor:
        """Return what to play: step lengths of each line, or points about the best in the place of lines that end."""
        factor = 4.0 ** torch.linspace(1, -2, self.tries, dtype=self.x.dtype)
        self.lengths = self.step[:, None] * factor
        self.over = (self.step < self.plan.last) | (self.gradient == 0).all(-1)
        down = self.encoding.inward(self.x, _direction(self.gradient, self.moved, self.turned))
        # The first step is as long as Adam's: its largest component is the rate.
        unit = down / down.abs().amax(-1, keepdim=True).clamp(min=1e-300)
        tried = self.x[:, None] + self.lengths[..., None] * unit[:, None]
        away = (
            random_proposals(self.plan, self.rng, tried[..., 0].numel()).unflatten(0, tried.shape[:2]) * factor[:, None]
        )
        away = self.plan.encoding(self.plan.hold).decode(_NOISE * away.flatten(0, 1)).reshape(tried.shape)
        tried = torch.where(self.over[:, None, None], self.best[1] + away, tried)
        return self.encoding.project(tried.flatten(0, 1))

    def pick(self, told: Told, _: int = 0) -> Tensor:
        """Return which of a line's step lengths went furthest down, shape (L,); no other gradients are needed."""
        losses = told.loss.reshape(-1, self.tries)
        return torch.arange(len(losses)) * self.tries + losses.argmin(-1)

    def tell(self, x: Tensor, told: Told) -> None:
        """Take steps that went down, and shorten those that did not."""
        halves = self._halves(told)
        told = self._noted(x, told)
        row, at = torch.arange(len(self.x)), self.pick(told)
        tried = at - row * self.tries
        down = ~self.over & (told.loss[at] < self.loss)
        # A line that failed goes on along its plain gradient, with lengths that it has not tried.
        self.moved, self.turned = (
            torch.where(down[:, None], torch.cat([old[1:], (new[at] - was)[None]]), 0.0)
            for old, new, was in ((self.moved, x, self.x), (self.turned, told.gradient, self.gradient))
        )
        taken = down | self.over
        self.x, self.gradient = (
            torch.where(taken[:, None], new[at], was) for new, was in ((x, self.x), (told.gradient, self.gradient))
        )
        self.value, self.loss = (
            torch.where(taken, new[at], was) for new, was in ((told.value, self.value), (told.loss, self.loss))
        )
        self.halves = torch.where(taken, halves[at], self.halves)
        step = torch.where(down, self.lengths[row, tried], self.lengths[:, -1] / 16)
        self.step = torch.where(self.over, self.plan.rate, step)

    def _halves(self, told: Told) -> Tensor:
        """Return over how many halves of an episode there are gradients, 0 of one that failed; shape (P,)."""
        gradients = (told.gradient.unflatten(-1, (self.plan.horizon, -1)) != 0).any(-1)
        return torch.where(told.failed, 0, (2 * gradients.double().mean(-1)).ceil().int())

    def _noted(self, x: Tensor, told: Told) -> Told:
        """Note the best; return what was told without gradients that lead out of what can be reached."""
        best = int(told.value.argmax())
        if float(told.value[best]) > self.best[0]:
            self.best = float(told.value[best]), x[best]
        return replace(told, gradient=-self.encoding.inward(x, -told.gradient))


def _direction(gradient: Tensor, moved: Tensor, turned: Tensor) -> Tensor:
    """Return the direction of L-BFGS, shape (L, n), from steps and changes of gradient (pairs, L, n), oldest first.

    Pairs without positive curvature count nothing, line by line.
    """
    curved = (moved * turned).sum(-1, keepdim=True)
    rho = torch.where(curved > 0, 1 / curved.clamp(min=1e-300), 0.0)
    q, alpha = gradient, torch.zeros_like(rho)
    for k in reversed(range(len(moved))):
        alpha[k] = rho[k] * (moved[k] * q).sum(-1, keepdim=True)
        q = q - alpha[k] * turned[k]
    scale = torch.ones_like(q[:, :1])
    for k in range(len(moved)):
        square = turned[k].square().sum(-1, keepdim=True).clamp(min=1e-300)
        scale = torch.where(curved[k] > 0, curved[k] / square, scale)
    q = scale * q
    for k in range(len(moved)):
        q = q + moved[k] * (alpha[k] - rho[k] * (turned[k] * q).sum(-1, keepdim=True))
    return -q
