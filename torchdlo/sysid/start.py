"""Where a trial begins: positions and velocities from its first tenth of a second, and from nothing else of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchdlo.sysid.model import Motion, RopeModel, Start
from torchdlo.sysid.recording import Trial

WINDOW = 0.1
"""Seconds of a trial that its start may be estimated from."""

_NOISE = 2e-3
"""How far model and markers may be apart within the window [m]."""

_DOUBT = 0.1
"""How wrong the velocities read off the markers may be [m/s]."""


def read_off(trials: Sequence[Trial]) -> Start:
    """Fit a parabola in time to each marker over the window; markers that were not seen follow their neighbours."""
    pos, vel = [], []
    for trial in trials:
        frames = max(3, int(np.searchsorted(trial.time, WINDOW + 1e-9)))
        time, seen = trial.time[:frames], trial.markers[:frames]
        p = np.full(seen.shape[1:], np.nan)
        v = p.copy()
        for marker in range(seen.shape[1]):
            good = np.isfinite(seen[:, marker, 0])
            degree = min(2, int(good.sum()) - 1)
            if degree >= 0:
                terms = np.vander(time[good], degree + 1, increasing=True)
                fit = np.linalg.lstsq(terms, seen[good, marker], rcond=None)[0]
                p[marker], v[marker] = fit[0], fit[1] if degree else 0.0
        pos.append(_fill(p, trial.marker_arclength))
        vel.append(_fill(v, trial.marker_arclength))
    return Start(np.stack(pos), np.stack(vel))


def _fill(values: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Interpolate missing rows of (M, 3) along the rope."""
    known = np.isfinite(values[:, 0])
    return np.stack([np.interp(arclength, arclength[known], values[known, c]) for c in range(3)], -1)


def refine(model: RopeModel, motion: Motion, start: Start, values: np.ndarray) -> Start:
    """Return velocities with which the simulation follows the markers best through the window.

    One Gauss-Newton step: all velocities of the free markers are varied in one batch; what the markers say at first
    glance counts as a measurement of its own.

    Args:
        model: the rope.
        motion: B trials.
        start: first estimate.
        values: the rope's numbers, shape (K,).
    """
    frames = min(max(3, round(WINDOW / model.dt) + 1), motion.held.shape[1])
    free = np.setdiff1d(np.arange(model.count), model.gripped)
    trials, unknowns, nudge = len(motion.names), 3 * len(free), 1e-3
    vel = np.repeat(start.vel[None], unknowns + 1, 0)
    for u in range(unknowns):
        vel[u + 1, :, free[u // 3], u % 3] += nudge
    varied = Start(np.tile(start.pos, (unknowns + 1, 1, 1)), vel.reshape(-1, *start.vel.shape[1:]))
    sim = model.simulate(motion, varied, np.tile(values, (unknowns + 1, 1)), frames=frames)
    residual = np.nan_to_num(motion.markers[:, :frames] - sim[0]).reshape(trials, -1)
    slope = (sim[1:] - sim[0]).reshape(unknowns, trials, -1).transpose(1, 2, 0) / nudge
    seen = np.isfinite(motion.markers[:, :frames]).reshape(trials, -1, 1)
    slope = np.where(seen, slope, 0.0)
    # Errors of neighbouring frames are alike: a window counts as one measurement per marker.
    weight = 1 / (_NOISE**2 * frames)
    normal = weight * slope.transpose(0, 2, 1) @ slope + np.eye(unknowns) / _DOUBT**2
    step = np.linalg.solve(normal, weight * np.einsum("bru,br->bu", slope, residual)[..., None])[..., 0]
    better = start.vel.copy()
    better[:, free] += np.nan_to_num(step).reshape(trials, len(free), 3)
    return Start(start.pos, better)
