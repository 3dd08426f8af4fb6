"""Levenberg-Marquardt over a few numbers of a rope, with all trials, starts and varied numbers in one batch.

Marquardt 1963, doi:10.1137/0111030. The residuals are weighted so that the cost grows linearly with large errors
(Huber-like, as the mean absolute error that is reported), which also keeps mis-tracked markers from leading the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchdlo.physics.effects.base import Param

KNEE = 2e-3
"""Error [m] from which the cost grows linearly."""

_FIRM = 5e-3
"""Share of the cost that a number has to save per squared coordinate to be followed as far as its gradient says."""

_LOST = 0.3
"""What a trial costs whose simulation fails while others run through, as a share of what is measured there: so that
numbers may lead away from there."""

_WILD = 0.1
"""Mean change of a trial by a step of finite differences, likewise, from which it is no gradient: what grows without
end may stay finite, but small changes of numbers change all of it."""

Simulate = Callable[[np.ndarray], np.ndarray]
"""Maps parameter sets (P, K) to simulated markers (P, B, F, M, 3) [m]."""


@dataclass(frozen=True, eq=False)
class ParameterSpace:
    """Declared numbers as coordinates without units: logarithms, or shares of a size."""

    names: tuple[str, ...]
    params: tuple[Param, ...]
    sizes: tuple[float, ...] | None = None
    """What counts as much of each number, in the terms of its scale; its whole range if not given."""

    @property
    def units(self) -> np.ndarray:
        """What one coordinate is worth: 1 for logarithms, a size for the others, shape (K,)."""
        ranges = {"log": lambda p: 1.0, "linear": lambda p: p.high - p.low, "reciprocal": lambda p: 1 / p.low}
        sizes = self.sizes or [ranges[p.scale](p) for p in self.params]
        return np.array([1.0 if p.scale == "log" else s for s, p in zip(sizes, self.params, strict=True)])

    def _map(self, values: np.ndarray, rules: dict[str, Callable[[np.ndarray], np.ndarray]]) -> np.ndarray:
        return np.stack([rules[p.scale](values[..., k]) for k, p in enumerate(self.params)], -1)

    def to_raw(self, values: np.ndarray) -> np.ndarray:
        """Return coordinates of values, both (..., K)."""
        return self._map(values, {"log": np.log, "linear": np.asarray, "reciprocal": np.reciprocal}) / self.units

    def to_values(self, raw: np.ndarray) -> np.ndarray:
        """Return values of coordinates, both (..., K)."""
        return self._map(raw * self.units, {"log": np.exp, "linear": np.asarray, "reciprocal": np.reciprocal})

    def clip(self, raw: np.ndarray) -> np.ndarray:
        """Keep coordinates within the declared bounds; angles turn round instead."""
        ends = self.to_raw(np.array([[p.low for p in self.params], [p.high for p in self.params]]))
        low, high = ends.min(0), ends.max(0)
        turned = low + (raw - low) % (high - low)
        return np.where([p.periodic for p in self.params], turned, np.clip(raw, low, high))

    def nudges(self) -> np.ndarray:
        """Return the steps of finite differences, shape (K,)."""
        share = 0.01 if self.sizes is None else 0.1
        return np.array([0.02 if p.scale == "log" else share for p in self.params])

    def limits(self) -> np.ndarray:
        """Return how far a coordinate may go at a time: a factor of three, a fifth of the range, or ten sizes."""
        far = 0.2 if self.sizes is None else 10.0
        return np.array([1.1 if p.scale == "log" else far for p in self.params])


@dataclass(frozen=True, eq=False)
class Point:
    """A parameter set with everything that is known about it."""

    raw: np.ndarray
    """Coordinates, shape (K,)."""
    cost: float
    """Robust cost [m], mean over trials; infinite where the simulation failed on all of them."""
    gradient: np.ndarray
    """Of the cost by trial, shape (B, K)."""
    curvature: np.ndarray
    """Gauss-Newton curvature by trial, shape (B, K, K)."""
    trial_costs: np.ndarray
    """Cost by trial [m], shape (B,)."""
    flatter: np.ndarray | None = None
    """How much of the Gauss-Newton curvature is left where large errors cost only in proportion, by trial [1], (B,);
    all of it if not given."""


def robust(residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cost and weight of each residual [m]: cost ~ r^2 / (2 knee) near zero, |r| - knee/2 beyond."""
    size = np.sqrt(residual**2 + KNEE**2)
    return size - KNEE, 1 / size


def cost_of(error: float) -> float:
    """Return the cost [m] of an error of a coordinate [m]."""
    return float(robust(np.array(error))[0])


def error_of(cost: np.ndarray) -> np.ndarray:
    """Return the error of a coordinate [m] that costs so much [m], any shape."""
    return np.sqrt((cost + KNEE) ** 2 - KNEE**2)


def costs(sims: np.ndarray, measured: np.ndarray, whole: float | None = None) -> np.ndarray:
    """Return the cost [m] of simulations (S, B, F, M, 3), shape (S,); `whole` as in `Look.points`."""
    seen = np.isfinite(measured)
    residual = np.where(seen, sims - measured, 0.0).reshape(len(sims), len(measured), -1)
    mean = robust(residual)[0].sum(-1) / seen.reshape(len(measured), -1).sum(1)
    whole = extent(measured) if whole is None else whole
    return together(np.where(np.isfinite(mean), np.minimum(mean, whole), np.inf), _LOST * whole)


def extent(measured: np.ndarray) -> float:
    """Return the largest range of a coordinate of the markers (B, F, M, 3) in a trial [m]."""
    return float(np.max(np.nanmax(measured, (1, 2)) - np.nanmin(measured, (1, 2))))


def together(of_trial: np.ndarray, lost: float) -> np.ndarray:
    """Return the mean cost of trials (..., B), of which those that failed cost `lost`; infinite if all did."""
    ran = np.isfinite(of_trial)
    return np.where(ran.any(-1), np.where(ran, of_trial, lost).mean(-1), np.inf)


class PointEvaluation:
    """What it takes to know costs and their gradients at S points (S, K): S (K + 1) simulations of each trial."""

    def __init__(self, space: ParameterSpace, raws: np.ndarray, share: float = 1.0) -> None:
        """Prepare to look at these coordinates, with a share of the usual steps of finite differences."""
        self.raws, k = raws, raws.shape[1]
        nudge = np.diag(share * space.nudges())
        # Difference inwards where a number stands at its upper bound.
        upward = space.clip(raws[:, None] + nudge)
        moved = np.where(np.isclose(upward, raws[:, None] + nudge), upward, raws[:, None] - nudge)
        self.steps = np.einsum("skk->sk", moved - raws[:, None])
        """Steps of finite differences, shape (S, K)."""
        self.values = space.to_values(np.concatenate([raws[:, None], moved], 1).reshape(-1, k))
        """What to simulate, shape (S (K + 1), K)."""

    def points(self, sims: np.ndarray, measured: np.ndarray, whole: float | None = None) -> list[Point]:
        """Return the points, from simulations of `values`.

        Args:
            sims: what is simulated, shape (S (K + 1), B, F, M, C) [m].
            measured: the same as measured, NaN where it was not, shape (B, F, M, C) [m].
            whole: how far what is measured moves [m]; the largest range of a coordinate in a trial if not given.
        """
        count, k = self.raws.shape
        sims = sims.reshape(count, k + 1, *measured.shape)
        seen = np.isfinite(measured)
        per_trial = seen.reshape(len(measured), -1).sum(1)
        whole = extent(measured) if whole is None else whole
        points = []
        for s in range(count):
            residual = np.where(seen, sims[s, 0] - measured, 0.0).reshape(len(measured), -1)
            cost, weight = robust(residual)
            of_trial = cost.sum(1) / per_trial
            change = np.where(seen, sims[s, 1:] - sims[s, 0], 0.0).reshape(k, len(measured), -1)
            # A trial that ran at the point but failed beside it tells nothing about gradients.
            useless = ~(np.isfinite(of_trial) & (np.abs(change).sum(-1) < _WILD * whole * per_trial).all(0))
            # Nor does what it costs where it is far off, if a little beside it is quite another motion.
            of_trial = np.where(useless & (of_trial > _LOST * whole), np.inf, of_trial)
            jacobian = change / self.steps[s][:, None, None]
            jacobian, weight = np.where(useless[None, :, None], 0.0, jacobian), np.where(useless[:, None], 0.0, weight)
            residual = np.where(useless[:, None], 0.0, residual)
            gradient = np.einsum("kbr,br,br->bk", jacobian, weight, residual, optimize=True) / per_trial[:, None]
            curvature = (
                np.einsum("kbr,br,lbr->bkl", jacobian, weight, jacobian, optimize=True) / per_trial[:, None, None]
            )
            # The second derivative of the cost is knee^2 / size^3, where Gauss-Newton takes 1 / size.
            weight = np.where(seen.reshape(weight.shape), weight, 0.0)
            flatter = (weight**3 * KNEE**2).sum(-1) / np.maximum(weight.sum(-1), 1e-300)
            cost_of_all = float(together(of_trial, _LOST * whole))
            points.append(Point(self.raws[s], cost_of_all, gradient, curvature, of_trial, flatter))
        return points


def evaluate(
    simulate: Simulate, measured: np.ndarray, space: ParameterSpace, raws: np.ndarray, whole: float | None = None
) -> list[Point]:
    """Return costs and their gradients at S parameter sets, shape (S, K); `whole` as in `Look.points`."""
    look = PointEvaluation(space, raws)
    return look.points(simulate(look.values), measured, whole)


class Climb:
    """Levenberg-Marquardt from several points at once, until each stands still."""

    def __init__(self, space: ParameterSpace, points: Sequence[Point], tolerance: float = 2e-3) -> None:
        """Begin.

        Args:
            space: the numbers.
            points: where to start.
            tolerance: a point stands still when its cost falls by less than this share.
        """
        self.space, self.points, self._tolerance = space, list(points), tolerance
        self._damping = [1e-2] * len(self.points)
        self._active = [np.isfinite(p.cost) for p in self.points]

    def tries(self) -> np.ndarray:
        """Return the coordinates to look at next, shape (S, K); none when all points stand still."""
        tries = [
            _step(p, d, self.space) for p, d, on in zip(self.points, self._damping, self._active, strict=True) if on
        ]
        return np.array(tries).reshape(-1, len(self.space.names))

    def take(self, found: Sequence[Point]) -> None:
        """Go on from what was found there."""
        for i, new in zip([i for i, on in enumerate(self._active) if on], found, strict=True):
            old = self.points[i]
            if new.cost < old.cost:
                self._active[i] = old.cost - new.cost > self._tolerance * old.cost
                self.points[i], self._damping[i] = new, max(self._damping[i] / 5, 1e-6)
            else:
                self._damping[i] *= 8
                self._active[i] = self._damping[i] < 1e3


def improve_points(
    simulate: Simulate,
    measured: np.ndarray,
    space: ParameterSpace,
    points: Sequence[Point],
    *,
    iterations: int,
    tolerance: float = 2e-3,
    whole: float | None = None,
) -> Iterator[list[Point]]:
    """Improve every point until it stands still; yield all of them after each iteration.

    Args:
        simulate: the model.
        measured: markers [m], NaN where they do not count, shape (B, F, M, 3).
        space: the numbers.
        points: where to start, see `evaluate`.
        iterations: at most so many.
        tolerance: a point stands still when its cost falls by less than this share.
        whole: see `Look.points`.
    """
    climb = Climb(space, points, tolerance)
    for _ in range(iterations):
        tries = climb.tries()
        if not len(tries):
            return
        climb.take(evaluate(simulate, measured, space, tries, whole))
        yield list(climb.points)


def _step(point: Point, damping: float, space: ParameterSpace) -> np.ndarray:
    curvature, gradient = point.curvature.mean(0), point.gradient.mean(0)
    scale = np.diag(curvature) + 1e-9 * np.trace(curvature) + 1e-12
    # Numbers that hardly matter stay where they are instead of following noise far away.
    firm = damping * scale + _FIRM * point.cost
    step = -np.linalg.solve(curvature + np.diag(firm), gradient)
    return space.clip(point.raw + step / max(1.0, float(np.abs(step / space.limits()).max())))


def drift(
    look: PointEvaluation,
    sims: np.ndarray,
    measured: np.ndarray,
    errors: Sequence[np.ndarray],
    whole: float | None = None,
) -> np.ndarray:
    """Return how far the minimum moves when simulations are wrong, shape (E, K): one step of Gauss-Newton.

    Args:
        look: at the minimum.
        sims: simulations of its values, shape (K + 1, B, F, M, 3) [m].
        measured: markers, shape (B, F, M, 3) [m].
        errors: E ways in which simulations may be wrong, shape (B, F, M, 3) each [m].
        whole: see `Look.points`.
    """
    here, *others = (look.points(sims, measured - e, whole)[0] for e in (0.0, *errors))
    curvature = firm(here.curvature.sum(0))
    return np.array([np.linalg.solve(curvature, (here.gradient - p.gradient).sum(0)) for p in others])


def firm(curvature: np.ndarray) -> np.ndarray:
    """Return a curvature (K, K) that can be inverted."""
    return curvature + (1e-9 * np.trace(curvature) + 1e-12) * np.eye(len(curvature))


def interval(point: Point, space: ParameterSpace, drifts: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return low and high 90 % limits of the values, shape (K,) each, within what is declared; see `reach`."""
    far = reach(point, space, drifts)
    if far is None:
        return np.array([p.low for p in space.params]), np.array([p.high for p in space.params])
    ends = np.stack([point.raw - far, point.raw + far])
    # Angles that turn round have no bounds; a spring in series whose coordinate passed 0 would be negative.
    ends = space.to_values(np.where([p.periodic for p in space.params], ends, space.clip(ends)))
    return ends.min(0), ends.max(0)


def reach(point: Point, space: ParameterSpace, drifts: np.ndarray | None = None) -> np.ndarray | None:
    """Return how far 90 % limits are from the minimum, in coordinates, shape (K,); None where trials are too few.

    How trials differ says how far the minimum may be off (linearised jackknife, leaving out one trial at a time). What
    every trial gets wrong in the same way that cannot show.

    Args:
        point: the minimum.
        space: its numbers.
        drifts: standard deviations that all trials have in common, shape (E, K).
    """
    # Trials that were lost tell nothing.
    ran = np.trace(point.curvature, axis1=1, axis2=2) > 0
    trials = int(ran.sum())
    if trials < 2:
        return None
    flatter = np.ones(len(ran)) if point.flatter is None else point.flatter
    curvature = (flatter[:, None, None] * point.curvature)[ran].sum(0)
    moves = np.linalg.solve(firm(curvature), point.gradient[ran].T).T
    # Without trial b the minimum moves by moves[b] n / (n - 1); their scatter times (n - 1)^2 / n is the variance.
    deviation = np.sqrt(trials / (trials - 1) * ((moves - moves.mean(0)) ** 2).sum(0))
    quantile = _STUDENT_95[min(trials - 1, len(_STUDENT_95)) - 1]
    common = np.zeros(0) if drifts is None else _NORMAL_95 * drifts
    # Fits end a little before the minimum.
    left = space.clip(point.raw - moves.sum(0)) - point.raw
    left = np.where([p.periodic for p in space.params], moves.sum(0), left)
    return np.minimum(np.linalg.norm([quantile * deviation, left, *common], axis=0), 10.0)


_STUDENT_95 = (6.31, 2.92, 2.35, 2.13, 2.02, 1.94, 1.89, 1.86, 1.83, 1.81, 1.80, 1.78, 1.77, 1.76, 1.75, 1.70)
"""95 % quantiles of Student's t for 1, 2, ... degrees of freedom."""

_NORMAL_95 = 1.645
"""95 % quantile of the normal distribution."""
