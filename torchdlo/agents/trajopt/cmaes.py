"""Covariance matrix adaptation evolution strategy (Hansen 2016, arXiv:1604.00772) over way-points, by package `cma`."""

from __future__ import annotations

import math
import warnings
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.problem import Encoding
from torchdlo.agents.trajopt.proposals import Ask, Search, SearchPlan, Told
from torchdlo.errors import InputError

__all__ = ["cmaes", "draw_population", "import_cma", "make_strategy"]


_NEAR = 0.2
"""First spread about a trajectory that is given, over that of other beginnings."""


def import_cma() -> Any:
    """Return the module `cma`; says so if there is none."""
    try:
        import cma
    except ModuleNotFoundError:
        raise InputError("cmaes and hybrid need the package cma; pip install 'torchdlo[cmaes]', or use gd.") from None
    # From 300 numbers on the strategy proposes two points itself and misses them, as it is told of what was played.
    warnings.filterwarnings("ignore", category=cma.evolution_strategy.InjectionWarning)
    warnings.filterwarnings("ignore", message="TPA: apparent inconsistency")
    return cma


def make_strategy(start: Tensor, sigma: float, population: int, rng: torch.Generator) -> Any:
    """Return a `cma.CMAEvolutionStrategy` that draws from `rng` and writes nothing."""

    def randn(*shape: int) -> Any:
        return torch.randn(*shape, generator=rng, dtype=torch.float64).numpy()

    options = {
        "popsize": population,
        "randn": randn,
        "seed": math.nan,
        "verbose": -9,
        "verb_log": 0,
        # Returns may stay flat until something is touched; that is no reason to give up.
        "tolflatfitness": math.inf,
        "tolfun": 0.0,
        "tolfunhist": 0.0,
        "tolstagnation": math.inf,
        "maxiter": math.inf,
    }
    return import_cma().CMAEvolutionStrategy(start.numpy(), sigma, options)


def draw_population(found: Any, encoding: Encoding, given: Tensor | None = None) -> Tensor:
    """Return the next population within the limits, shape (P, size); points that are given come first.

    The strategy is told of what was played, not of what it drew: it would else go on where limits make all alike.
    """
    count = 0 if given is None else len(given)
    if given is not None and count:
        found.inject(list(given.numpy()), force=True)
    x = torch.stack([torch.as_tensor(x) for x in found.ask()])
    # Points that were given are known to the strategy by their last bit.
    return torch.cat([x[:count], encoding.project(x[count:])])


def cmaes(plan: SearchPlan, rng: torch.Generator) -> Search:
    """Search way-points without gradients; starts again when the spread has shrunk to nothing.

    Where there are trajectories to begin with, a first strategy searches what is best to add to one of them.
    """
    encoding = plan.encoding(plan.hold)
    if plan.first is not None:
        yield from _about(plan, plan.first[0], rng)
    while True:
        found = make_strategy(torch.zeros(encoding.size, dtype=torch.float64), plan.sigma, plan.population, rng)
        while not found.stop():
            x = draw_population(found, encoding)
            told = yield Ask(encoding, x)
            found.tell(list(x.numpy()), _costs(told).tolist())


def _about(plan: SearchPlan, first: Tensor, rng: torch.Generator) -> Search:
    """Search way-points that are added to actions (T A,)."""
    encoding, whole = plan.encoding(plan.hold), plan.encoding(1)
    zero = torch.zeros(1, encoding.size, dtype=torch.float64)
    found = make_strategy(zero[0], _NEAR * plan.sigma, plan.population, rng)
    given: Tensor | None = zero
    while not found.stop():
        x = draw_population(found, encoding, given)
        given = None
        told = yield Ask(whole, whole.project(first + encoding.decode(x).flatten(1)))
        found.tell(list(x.numpy()), _costs(told).tolist())


def _costs(told: Told) -> Tensor:
    """Return costs to be minimised, shape (P,): what has no number is worse than everything that has one."""
    good = torch.isfinite(told.returns)
    worst = (-told.returns[good]).max() if bool(good.any()) else told.returns.new_zeros(())
    return torch.where(good, -told.returns, worst + 1)
