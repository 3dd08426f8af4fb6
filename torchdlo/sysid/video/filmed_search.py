"""Searches for the numbers that films tell: many starts, wrong frames, ranges, and errors in pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.levenberg_marquardt import Point
from torchdlo.sysid.estimation.observation import Spines, View
from torchdlo.sysid.video.filmed_problem import Problem
from torchdlo.sysid.video.filmed_start import refine_start

__all__ = ["gate", "intervals", "picture_errors", "scout", "solve"]

Callback = Callable[[str, int, int, str], None]

_REACH = (np.log(40.0), np.log(4.0), np.log(10.0))
"""How far starts go either way of the guess."""

_BLOCK = 0.5
"""Time over which what simulations get wrong is one and the same error [s]."""

_GATE = 3.0
"""Times the usual distance in a picture from which it is a wrong one."""

_NEAR = 4e-3
"""Distance that is never taken for that of a wrong picture [m]."""


def solve(
    own: Problem, raws: np.ndarray, iterations: int, *, seconds: float | None = None, tolerance: float = 2e-3
) -> list[Point]:
    """Improve coordinates (S, K + Q) on the readings of the first seconds; return where they end."""
    simulate, target = own.readings(seconds)
    points = levenberg_marquardt.evaluate(simulate, target, own.space, raws, own.extent)
    limits: dict[str, Any] = {"iterations": iterations, "tolerance": tolerance, "whole": own.extent}
    for points in levenberg_marquardt.improve(simulate, target, own.space, points, **limits):  # noqa: B007, B020
        pass
    return points


def scout(own: Problem, starts: int, rng: np.random.Generator, report: Callback) -> np.ndarray:
    """Return coordinates (K + Q,) in the basin of the best fit."""
    space, count, total = own.space, len(own.free), 4
    lasts = float(own.motion.markers.shape[1] - 1) * own.model.dt
    first = np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))])
    raws = np.repeat(space.to_raw(first)[None], starts, 0)
    for k in range(min(count, 3)):
        share = (rng.permutation(starts) + rng.uniform(size=starts)) / starts - 0.5
        raws[1:, k] += 2 * _REACH[k] * share[1:]
    raws[1:, 1] += raws[1:, 0] - raws[0, 0]
    raws = space.clip(raws)
    report("trying starts", 0, total, "")
    simulate, target = own.readings(0.35 * lasts)
    cost = levenberg_marquardt.costs(simulate(space.to_values(raws)), target, own.extent)
    raws = raws[np.argsort(cost, kind="stable")[: max(2, starts // 4)]]
    report("trying starts", 1, total, f"{1e3 * cost.min():.2f} mm")
    points = solve(own, raws, 4, seconds=0.35 * lasts, tolerance=1e-2)
    points = _different(points, max(2, starts // 9))
    report("trying starts", 2, total, f"{1e3 * points[0].cost:.2f} mm over 35 % of the time")
    refine_start(own, space.to_values(points[0].raw))
    points = solve(own, np.array([p.raw for p in points]), 3, seconds=0.7 * lasts, tolerance=1e-2)
    points = _different(points, 2)
    report("trying starts", 3, total, f"{1e3 * points[0].cost:.2f} mm over 70 % of the time")
    refine_start(own, space.to_values(points[0].raw))
    points = solve(own, np.array([p.raw for p in points]), 4, tolerance=1e-2)
    best = min(points, key=lambda p: p.cost)
    report("trying starts", total, total, f"{1e3 * best.cost:.2f} mm")
    return best.raw


def _different(points: Sequence[Point], most: int) -> list[Point]:
    """Return the best points that are not in the same place."""
    kept: list[Point] = []
    for p in sorted(points, key=lambda p: p.cost):
        if np.isfinite(p.cost) and all(np.abs(p.raw[:3] - o.raw[:3]).max() > 0.02 for o in kept):
            kept.append(p)
    return kept[:most] or [min(points, key=lambda p: p.cost)]


def gate(own: Problem, values: np.ndarray) -> int:
    """Take out frames in which films stay far from the rope while others are near; return how many."""
    found, target = own.readings()[0](values[None])[0], own.spines.target
    lost, start = 0, 0
    for view in own.spines.views:
        width = 2 * view.places.shape[2]
        part = slice(start, start + width)
        start += width + int(own.spines.count_free)
        with np.errstate(invalid="ignore"):
            known = np.isfinite(target[:, :, part, 0])
            size = np.where(known, np.abs(found[:, :, part, 0]), np.nan)
            distance = np.full(known.shape[:2], np.nan)
            some = known.any(2)
            distance[some] = np.nanmean(size[some], 1)
        for b, trial in enumerate(own.trials):
            rows = np.flatnonzero(some[b])
            around = np.array([np.median(distance[b, rows[max(0, k - 4) : k + 5]]) for k in range(len(rows))])
            bad = rows[distance[b, rows] > np.maximum(_GATE * around, _NEAR)]
            if len(bad):
                view.good[b, bad] = False
                lost += len(bad)
                own.dropped.setdefault(f"{trial.name}, camera {view.camera.name}", []).extend(bad.tolist())
    if lost:
        free = np.ones(own.model.count, bool)
        free[own.model.gripped] = False
        own.spines = Spines(own.spines.views, own.model.dt, own.extent, free)
    return lost


def _blocks(own: Problem, raw: np.ndarray) -> Point:
    """Return the point at coordinates, with stretches of time in the place of trials: they scatter independently."""
    simulate, target = own.readings()
    look = levenberg_marquardt.Look(own.space, raw[None])
    sims = simulate(look.values)
    frames = target.shape[1]
    length = max(3, round(_BLOCK * own.spines.views[0].camera.fps))
    priors = own.spines.priors
    parts, reads = [], []
    for b in range(len(target)):
        for k in range(0, frames, length):
            part = target[b, k : k + length].copy()
            part[:, priors] = np.nan
            if np.isfinite(part).sum() < 0.3 * np.isfinite(target[b]).sum() * length / frames:
                continue
            pad = [(0, length - len(part)), (0, 0), (0, 0)]
            parts.append(np.pad(part, pad, constant_values=np.nan))
            reads.append(np.pad(sims[:, b, k : k + length], [(0, 0), *pad]))
    data, read = np.stack(parts), np.stack(reads, 1)
    return look.points(read, data, own.extent)[0]


def intervals(own: Problem, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return 90 % limits of the fitted numbers, and how much their range is of what it may be [1], shape (K + Q,) each.

    Stretches of time scatter; what cameras may be off shifts all of them in the same way.
    """
    point, space = _blocks(own, raw), own.space
    count, blocks = len(own.free), len(point.gradient)
    # Priors: a standard deviation of one coordinate, weighed as a few independent readings of each picture are.
    pictures = sum(float(v.good.sum()) for v in own.spines.views)
    precision = 2 * (5e-4) ** 2 / (2e-3) / (2.0 * pictures)
    prior = np.diag(np.concatenate([np.zeros(count), np.full(len(space.names) - count, 0.5 * precision)]))
    whole = replace(point, curvature=point.curvature + prior[None])
    curvature = whole.curvature.sum(0)
    drifts = np.linalg.solve(levenberg_marquardt.firm(curvature), blocks * prior)[count:]
    if own.discretisation_correction is not None:
        look, target = levenberg_marquardt.Look(space, raw[None]), own.spines.target
        read = own.readings()[0](look.values)
        sims, numbers = own.simulate(look.values[:1]), look.values[:1, count:]
        # Next to clamps the mesh's error may be of first order: extrapolating to that would change twice as much.
        parts = [
            factor * np.nan_to_num(e)
            for factor, e in zip((1.0, 2.0), own.discretisation_correction.unsure, strict=True)
        ]
        wrong = [own.spines.read(sims + e[None], numbers)[0] - read[0] for e in parts]
        drifts = np.concatenate([drifts, levenberg_marquardt.drift(look, read, target, wrong, own.extent)])
    low, high = levenberg_marquardt.interval(whole, space, drifts=drifts)
    ratio = np.abs(space.to_raw(high) - space.to_raw(low))
    return np.minimum(low, high), np.maximum(low, high), ratio


def picture_errors(own: Problem, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean distance of the films' centre lines from the rope by trial [m] and [px], (B,) each."""
    sims = own.simulate(values[None])
    read = own.spines.read(sims, values[None, len(own.free) :])[0]
    metres, start = [], 0
    for view in own.spines.views:
        width = 2 * view.places.shape[2]
        part = np.where(np.isfinite(own.spines.target), read, np.nan)[:, :, start : start + width, 0]
        pairs = part.reshape(*part.shape[:2], -1, 2)
        metres.append(np.nanmean(np.linalg.norm(pairs, axis=-1), (1, 2)))
        start += width + int(own.spines.count_free)
    focal = np.mean([v.camera.fx for v in own.spines.views])
    depth = np.mean([_depth(own, v) for v in own.spines.views])
    mean = np.mean(metres, 0)
    return mean, mean * focal / depth


def _depth(own: Problem, view: View) -> float:
    held = np.concatenate([t.markers[:, t.gripped].reshape(-1, 3) for t in own.trials])
    return float(np.mean(held @ np.array(view.camera.rotation)[2] + view.camera.translation[2]))
