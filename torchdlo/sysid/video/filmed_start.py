"""Starts in motion of filmed trials: balance between the grippers, plus smooth shapes, from the first frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.model import equilibrium
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.video.filmed_problem import Problem, start_of

__all__ = ["WINDOW", "refine_start"]

WINDOW = 0.2
"""Seconds of a film that a start in motion is estimated from."""

_SHIFT, _DRIFT = 0.05, 0.5
"""How far shapes [m] and speeds [m/s] at the start may be from those of a rope at rest that is carried along."""

_PRIOR = 2e-5
"""What a squared standard deviation of a start costs [m], against the mean cost of readings."""


class _Window:
    """The first frames of filmed trials, and starts that differ from balance by smooth shapes."""

    def __init__(self, own: Problem, values: np.ndarray, shapes: np.ndarray, spots: int) -> None:
        """Prepare, with numbers (K + Q,), and smooth shapes at the vertices (V, J)."""
        model, start = own.model, own.start
        self._own, self._values = own, values
        self._at = shapes[list(model.marker_vertex)] * np.sqrt(spots)  # of size one
        self.count = 6 * self._at.shape[1]
        self.sizes = np.repeat([_SHIFT, _DRIFT], self.count // 2)
        plain, self._row = start_of(model, own.trials, own.spines.views), own.full(values[None])
        resting = Start(plain.pos, 0 * plain.vel, np.ones(len(plain.pos), bool))
        balance = model.simulate(own.motion, resting, self._row, frames=1)[0, :, 0]
        sound = np.isfinite(balance).all((1, 2))[:, None, None] & ~start.still[:, None, None]
        self._pos, self._vel = np.where(sound, balance, plain.pos), plain.vel
        self._frames = min(own.motion.markers.shape[1], round(WINDOW / model.dt) + 3)
        target = own.spines.target.copy()
        target[:, :, own.spines.priors] = np.nan
        target[:, np.arange(target.shape[1]) / own.spines.views[0].camera.fps > WINDOW] = np.nan
        self.seen = np.isfinite(target)

    def begin(self, offsets: np.ndarray) -> Start:
        """Return starts of (R, B, 6 J) offsets, for R B simulations."""
        mode = offsets.reshape(*offsets.shape[:2], 2, -1, 3)
        parts = (
            x[None] + np.einsum("mj,rbjc->rbmc", self._at, mode[:, :, k]) for k, x in enumerate((self._pos, self._vel))
        )
        pos, vel = (p.reshape(-1, *self._pos.shape[1:]) for p in parts)
        return Start(pos, vel, np.tile(self._own.start.still, len(offsets)))

    def read(self, offsets: np.ndarray) -> np.ndarray:
        """Return readings (R, B, F, X, 1) of (R, B, 6 J) offsets."""
        own, rows = self._own, len(offsets)
        sims = own.model.simulate(own.motion, self.begin(offsets), np.repeat(self._row, rows, 0), frames=self._frames)
        return own.spines.read(sims, np.repeat(self._values[None, len(own.free) :], rows, 0))

    def cost(self, found: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the cost of trials [m], (B,)."""
        seen = self.seen
        mean = [
            levenberg_marquardt.robust(found[b][seen[b]])[0].mean() if seen[b].any() else 0.0 for b in range(len(found))
        ]
        return np.nan_to_num(np.array(mean), nan=np.inf) + 0.5 * _PRIOR * ((offset / self.sizes) ** 2).sum(1)

    def steps(self, found: np.ndarray, offset: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """Return a step of each trial (B, 6 J), from readings at an offset and with each of its numbers nudged."""
        out = np.zeros_like(offset)
        for b in np.flatnonzero(~self._own.start.still):
            residual = found[0, b][self.seen[b]]
            gradient = (found[1:, b] - found[:1, b])[:, self.seen[b]] / (0.05 * self.sizes[:, None])
            if not len(residual) or not np.isfinite(gradient).all():
                continue
            weight = levenberg_marquardt.robust(residual)[1]
            normal = (gradient * weight) @ gradient.T / len(residual) + _PRIOR * np.diag(1 / self.sizes**2)
            pull = (gradient * weight) @ residual / len(residual) + _PRIOR * offset[b] / self.sizes**2
            step = -np.linalg.solve(normal + damping[b] * np.diag(np.diag(normal)), pull)
            out[b] = step / max(1.0, float(np.abs(step / self.sizes).max()))
        return out


def refine_start(own: Problem, values: np.ndarray, passes: int = 3) -> None:
    """Estimate shapes and motions at the start of trials that do not begin at rest, by Levenberg-Marquardt.

    Args:
        own: the problem; its start is replaced.
        values: numbers of the rope and the cameras, shape (K + Q,).
        passes: most steps.
    """
    moving = ~own.start.still
    spots = np.setdiff1d(np.arange(own.model.count), own.model.gripped)
    shapes = equilibrium.smooth_shapes(own.model.mesh, spots)
    if not moving.any() or shapes is None:
        return
    window = _Window(own, values, shapes, len(spots))
    trials = len(moving)
    offset = own.offset if own.offset is not None else np.zeros((trials, window.count))
    nudges = np.concatenate([np.zeros((1, window.count)), np.diag(0.05 * window.sizes)])
    damping = np.full(trials, 1e-2)
    for _ in range(passes):
        found = window.read(offset[None] + nudges[:, None])
        now, steps = window.cost(found[0], offset), window.steps(found, offset, damping)
        # Whole steps, or shorter ones where those lead astray.
        tries = offset[None] + np.array([1.0, 0.3, 0.1])[:, None, None] * steps
        costs = np.stack([window.cost(f, o) for f, o in zip(window.read(tries), tries, strict=True)])
        best, better = costs.argmin(0), costs.min(0) < now
        offset = np.where(better[:, None], tries[best, np.arange(trials)], offset)
        damping = np.where(better, damping / 3, damping * 10)
        if not (costs.min(0) < 0.98 * now)[moving].any():
            break
    own.offset = offset
    own.start = replace(window.begin(offset[None]), discretisation_correction=own.start.discretisation_correction)
