"""Where trials in motion and fits begin: starts of several basins by trial, and numbers from many places.

How a rope moves at the start is seen badly by one camera: pictures of its first tenths of a second may be explained by
quite different depths and speeds. So starts are looked for in many places, trial by trial, and the best is kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.video import fit_memory
from torchdlo.sysid.video.filmed_fit import Fit, fit, look, total
from torchdlo.sysid.video.filmed_problem import FilmedProblem, begin_from_balance, correct

__all__ = [
    "START_WINDOW",
    "fit_starts",
    "refine_start",
    "restart",
    "scout",
    "search_starts",
    "start_window",
]

Callback = Callable[[str, int, int, str], None]

START_WINDOW = 0.4
"""Seconds of a film that a start in motion is first estimated from."""

_REACH = (np.log(40.0), np.log(4.0), np.log(10.0))
"""How far starts go either way of the guess."""

_MOST = 9
"""Most stiffnesses that a fit with starts in motion begins from."""

_LOST = 1e-3
"""Cost [m] from which a trial may have a wrong start: readings of 3 mm."""

_STANDS_OUT, _SLIGHT = 4.0, 1e-4
"""Times the least cost of all trials from which one may have a wrong start, too, and the least such cost [m]: errors of
0.64 mm."""

_RESTARTS = 3
"""How often starts of lost trials are looked for."""

_PAYS = 0.9
"""Share of a trial's cost that is left where another start is better."""

_NEARER, _FASTER = 1.0, 2.0
"""How far off places and speeds along a camera's axis are tried, in standard deviations of their priors."""


def start_window(own: FilmedProblem) -> float:
    """Return the seconds of films that starts in motion are first estimated from: longer where pictures begin late."""
    first = np.min([v.first for v in own.spines.views], 0)
    return START_WINDOW + 2 * max(0.0, float(first[np.isfinite(first)].max(initial=0.0)) - own.model.dt)


def fit_starts(
    own: FilmedProblem, raw: np.ndarray, passes: int, *, seconds: float | None = None, tolerance: float = 1e-2
) -> np.ndarray:
    """Improve the starts of the problem, which are set to what is found, and return their costs by trial [m], (B,).

    Numbers (N,) stay as they are. Each trial goes its own way: what one of them gains does not hide what another one
    loses.
    """
    job = fit_memory.task(own, "fit starts", raw, passes, seconds, tolerance)
    if (known := fit_memory.recall(job)) is not None:
        own.offset, costs = known
        return costs
    own.offset = own.offset.copy()
    now = look(own, raw, own.offset, seconds, fixed=True)
    count = own.offset.shape[1]
    damping, rows = np.full(len(now.costs), 1e-2), np.flatnonzero(np.isfinite(now.costs) & ~own.start.at_rest)
    part = own
    for _ in range(passes if count else 0):
        if not len(rows):
            break
        if len(rows) < len(part.trials):
            part = own.picked(rows)
        here = _of(now, rows)
        moved = here.offset + _moves(here, part.prior, damping[rows])
        least = here.costs
        tried = look(part, raw, moved, seconds, fixed=True, worth=partial(_any_less, least))
        better = tried.costs < least
        slow = better & (least - tried.costs < tolerance * least)
        if better.any():
            for name in ("offset", "costs", "residual", "jacobian"):
                getattr(now, name)[rows[better]] = getattr(tried, name)[better]
        damping[rows] = np.where(better, np.maximum(damping[rows] / 5, 1e-6), 8 * damping[rows])
        rows = rows[~slow & (damping[rows] < 1e3)]
    own.offset = now.offset
    fit_memory.keep(job, now.offset, now.costs)
    return now.costs


def _any_less(least: np.ndarray, costs: np.ndarray) -> bool:
    return bool((costs < least).any())


def _of(found: Fit, rows: np.ndarray) -> Fit:
    """Return the fit of some trials."""
    return Fit(found.raw, *(getattr(found, name)[rows] for name in ("offset", "costs", "residual", "jacobian")))


def _moves(now: Fit, prior: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return steps of starts (B, J), each trial damped by its own, (B,)."""
    gradient, curvature = now.normal(prior)
    inner = np.arange(now.offset.shape[1])
    curvature[:, inner, inner] *= 1 + damping[:, None]
    curvature[:, inner, inner] += 1e-12
    moves = -np.linalg.solve(curvature, gradient[..., None])[..., 0]
    return moves / np.maximum(1.0, np.abs(moves).max(1, keepdims=True))


def refine_start(own: FilmedProblem, values: np.ndarray, passes: int = 8, *, search: bool = False) -> None:
    """Estimate the starts of trials in motion from their first seconds, with numbers (N,) as they are.

    Args:
        own: the problem.
        values: numbers of rope and cameras.
        passes: most steps.
        search: whether to look for better ones far away, too, of trials that stay far from their films.
    """
    if not own.offset.shape[1]:
        return
    raw = own.space.to_raw(values)
    for share in (0.5, 1.0):
        costs = fit_starts(own, raw, passes, seconds=share * start_window(own))
    far = np.flatnonzero(~own.start.at_rest & ~(costs < _SLIGHT))
    if search and len(far):
        _begin_elsewhere(own, raw, far, passes, start_window(own))


def restart(own: FilmedProblem, found: Fit, iterations: int, enough: float = _LOST) -> Fit:
    """Return the fit with the starts of lost trials anew, and all of it improved, where that is better.

    Args:
        own: the problem.
        found: its fit.
        iterations: most steps of each improvement.
        enough: cost [m] from which a trial may have a wrong start; less if it stands out.
    """
    for _ in range(_RESTARTS if own.offset.shape[1] else 0):
        lost = np.flatnonzero(~own.start.at_rest & ~(found.costs < min(enough, _standing_out(found.costs))))
        if not len(lost):
            break
        part = own.picked(lost)
        search_starts(part, found.raw, seconds=start_window(part))
        costs = fit_starts(part, found.raw, 8)
        better = costs < _PAYS * found.costs[lost]
        if not better.any():
            break
        own.offset = own.offset.copy()
        own.offset[lost[better]] = part.offset[better]
        found = fit(own, found.raw, iterations)
    return found


def follow_starts(own: FilmedProblem, raw: np.ndarray) -> bool:
    """Set the starts of the problem to the better ones of two ways there: from where they are, and afresh.

    Trials that are near their films do with the first. Fresh starts are followed over more and more of the time, to its
    end where they are ahead by then. Numbers (N,) stay as they are.

    Returns:
        Whether any begins elsewhere, which corrections do not know of.
    """
    if not own.offset.shape[1]:
        return False
    costs = fit_starts(own, raw, 8)
    rows = np.flatnonzero(~own.start.at_rest & ~(costs < _SLIGHT))
    if not len(rows):
        return False
    led, window = own.picked(rows), start_window(own)
    fresh = replace(led, offset=led.fresh)
    correct(fresh, None)  # what is known of finer simulations is not of these
    for seconds in (window, 2 * window):
        found = fit_starts(fresh, raw, 8, seconds=seconds)
    # What was fitted to these seconds alone and is no nearer there will not be over all of them.
    ahead = found < look(led, raw, led.offset, 2 * window, worth=lambda costs: False).costs
    if not ahead.any():
        return False
    fresh, rows = fresh.picked(np.flatnonzero(ahead)), rows[ahead]
    better = fit_starts(fresh, raw, 8) < costs[rows]
    own.offset = own.offset.copy()
    own.offset[rows[better]] = fresh.offset[better]
    return bool(better.any())


def _standing_out(costs: np.ndarray) -> float:
    """Return the cost from which a trial stands out."""
    return float(max(_STANDS_OUT * np.nanmin(costs), _SLIGHT))


def search_starts(own: FilmedProblem, raw: np.ndarray, passes: int = 8, *, seconds: float | None = None) -> np.ndarray:
    """Look for better starts far from those of the problem, which are set to the best; return their costs [m], (B,).

    What one camera does not see is how far away the rope is and how fast it comes or goes. Starts are followed for a
    while, then the two best of them, and each trial keeps its best. Numbers (N,) stay as they are.
    """
    trials = len(own.trials)
    offset = _places(own, seconds)
    for keep, share in ((2, 0.6), (1, 1.0)):
        copies = own.picked(np.tile(np.arange(trials), len(offset)))
        copies.offset = offset.reshape(-1, offset.shape[-1])
        found = fit_starts(copies, raw, math.ceil(share * passes), seconds=seconds)
        costs = np.where(np.isfinite(found), found, np.inf).reshape(len(offset), trials)
        rows = np.argsort(costs, axis=0, kind="stable")[:keep] * trials + np.arange(trials)
        offset = copies.offset[rows]
    own.offset = offset[0]
    return found[rows[0]]


def _begin_elsewhere(own: FilmedProblem, raw: np.ndarray, rows: np.ndarray, passes: int, seconds: float) -> None:
    """Let some trials begin where a search for other starts finds the best, see `search_starts`."""
    part = own.picked(rows)
    search_starts(part, raw, passes, seconds=seconds)
    own.offset = own.offset.copy()
    own.offset[rows] = part.offset


def _places(own: FilmedProblem, seconds: float | None) -> np.ndarray:
    """Return starts (P, B, J): those of the problem, fresh ones, ropes in balance, and others nearer and farther.

    The last are not needed where two cameras see each trial in time: they tell how far away it is. None of them has the
    shapes with which a rope that was begun wrongly made up for that.
    """
    out = [own.offset, own.fresh, *([] if own.shown is None else [np.zeros_like(own.offset)])]
    if (np.sum([v.first < (np.inf if seconds is None else seconds) for v in own.spines.views], 0) > 1).all():
        return np.stack(out)
    away = np.array(own.spines.views[0].camera.rotation)[2]
    for place in (-_NEARER, _NEARER):
        for speed in (-_FASTER, _FASTER):
            each = np.zeros((len(own.offset), 2, own.offset.shape[1] // 6, 3))
            # The first of the shapes is the whole rope's; the others follow.
            each[:, :, 0] = np.array([[place], [speed]]) * away
            out.append(own.fresh + each.reshape(own.offset.shape))
    return np.stack(out)


def scout(own: FilmedProblem, raw: np.ndarray, starts: int, rng: np.random.Generator, report: Callback) -> np.ndarray:
    """Return coordinates (N,) in the basin of the best fit, from many starts on the beginning of the trials.

    There a cost has few local minima; the best go on over longer and longer times. Of trials in motion, cameras begin
    where coordinates (N,) have them.
    """
    return _scout_moving(own, raw, starts, report) if own.offset.shape[1] else _scout_resting(own, starts, rng, report)


def _scout_moving(own: FilmedProblem, raw: np.ndarray, starts: int, report: Callback) -> np.ndarray:
    """Fit rope, cameras and starts of trials in motion together, from several stiffnesses."""
    lasts, stage = own.lasts, "trying starts"
    shares = (min(1.0, start_window(own) / lasts), 0.5, 0.7)
    first = np.concatenate([own.fixed[list(own.free)], own.space.to_values(raw)[len(own.free) :]])
    bend = own.free.index(own.model.parameters.index("bending_stiffness"))
    found: list[tuple[Fit, np.ndarray, Start]] = []
    factors = np.exp(_REACH[0] * np.linspace(-1, 1, int(np.clip(starts // 4, 3, _MOST))))
    for k, factor in enumerate(factors):
        report(stage, k, len(factors) + 2, "")
        values = first.copy()
        values[bend : bend + 2] *= factor  # twisting stiffness follows
        begin_from_balance(own, own.full(values[None])[0])
        raw = own.space.clip(own.space.to_raw(values))
        _begin_scouting(own, raw)
        found.append((fit(own, raw, 6, seconds=shares[0] * lasts, tolerance=2e-2), own.offset, own.start))
    for share, keep, passes in ((shares[1], 3, 6), (shares[2], 2, 8)):
        found = sorted(found, key=lambda each: total(each[0]))[:keep]
        better = []
        for each, own.offset, own.start in found:
            improved = fit(own, each.raw, passes, seconds=share * lasts, tolerance=1e-2)
            better.append((improved, own.offset, own.start))
        found = better
        report(stage, len(factors) + 2 - (share < shares[2]), len(factors) + 2, f"{1e3 * _least(found):.2f} mm")
    best, own.offset, own.start = min(found, key=lambda each: total(each[0]))
    return best.raw


def _begin_scouting(own: FilmedProblem, raw: np.ndarray) -> None:
    """Let trials begin as their first pictures say with numbers (N,), or elsewhere where one is far off and others not.

    A shape that first pictures fit may be one from which a stiff rope springs. Where all are off, numbers are wrong.
    """
    window = 0.5 * start_window(own)
    costs = fit_starts(own, raw, 3, seconds=window)
    lost = np.flatnonzero(~own.start.at_rest & ~(costs < max(_LOST, _standing_out(costs))))
    if len(lost):
        _begin_elsewhere(own, raw, lost, 4, window)


def _least(found: Sequence[tuple[Fit, np.ndarray, Start]]) -> float:
    return min(total(each[0]) for each in found)


def _scout_resting(own: FilmedProblem, starts: int, rng: np.random.Generator, report: Callback) -> np.ndarray:
    """Fit the rope of trials that begin at rest first, cameras being where they are said to be."""
    whole, count = own.space, len(own.free)
    space = ParameterSpace(whole.names[:count], whole.params[:count], whole.sizes and whole.sizes[:count])
    zero, lasts, looks = np.zeros(len(whole.names) - count), own.lasts, 3
    raws = np.repeat(space.to_raw(own.fixed[list(own.free)])[None], starts, 0)
    for k in range(min(count, 3)):
        share = (rng.permutation(starts) + rng.uniform(size=starts)) / starts - 0.5
        raws[1:, k] += 2 * _REACH[k] * share[1:]
    raws[1:, 1] += raws[1:, 0] - raws[0, 0]
    raws = space.clip(raws)

    def full(raw: np.ndarray) -> np.ndarray:
        return whole.to_raw(np.concatenate([space.to_values(raw), zero]))

    def over(share: float) -> tuple[levenberg_marquardt.Simulate, np.ndarray]:
        simulate, target = own.readings(share * lasts)
        return lambda v: simulate(np.concatenate([v, np.zeros((len(v), len(zero)))], 1)), target

    report("trying starts", 0, looks, "")
    simulate, target = over(0.35)
    cost = levenberg_marquardt.costs(simulate(space.to_values(raws)), target, own.extent)
    raws = raws[np.argsort(cost, kind="stable")[: max(2, starts // 4)]]
    report("trying starts", 1, looks, f"{1e3 * cost.min():.2f} mm")
    points: list[Point] = levenberg_marquardt.evaluate(simulate, target, space, raws, own.extent)
    limits: dict[str, Any] = {"iterations": 4, "tolerance": 1e-2, "whole": own.extent}
    for points in levenberg_marquardt.improve_points(simulate, target, space, points, **limits):  # noqa: B007, B020
        pass
    points = _different(points, 3)
    report("trying starts", 2, looks, f"{1e3 * points[0].cost:.2f} mm over 35 % of the time")
    best = min((fit(own, full(p.raw), 4, seconds=0.7 * lasts, tolerance=2e-2) for p in points), key=total)
    report("trying starts", looks, looks, f"{1e3 * best.cost:.2f} mm over 70 % of the time")
    return best.raw


def _different(points: Sequence[Point], most: int) -> list[Point]:
    """Return the best points that are not in the same place."""
    kept: list[Point] = []
    for p in sorted(points, key=lambda p: p.cost):
        if np.isfinite(p.cost) and all(np.abs(p.raw[:3] - o.raw[:3]).max() > 0.1 for o in kept):
            kept.append(p)
    return [p for p in kept[:most] if p.cost < 2 * kept[0].cost] or [min(points, key=lambda p: p.cost)]
