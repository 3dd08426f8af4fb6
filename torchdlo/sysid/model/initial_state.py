"""Where a trial begins: positions and velocities from its first tenth of a second, and from nothing else of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import WINDOW, Start, TrialBatch
from torchdlo.sysid.recordings.recording import Recording, Trial

Simulator = Callable[[Start, np.ndarray, int | None], np.ndarray]
"""Maps beginnings of trials, parameter sets (P, K) and a number of frames to markers, see `RopeModel.simulate`."""

_CALM = 0.05
"""Speed below which a rope is taken to start almost in balance [m/s], if no marker moves by more in the window."""

_NOISE = 2e-3
"""How far model and markers may be apart within the window [m]."""

_POSITION = 1e-3
"""How far off the first positions may be [m]."""

_VELOCITY = 0.2
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
                # A parabola bends away from quick motion at its end: the first frame itself is nearer.
                p[marker] = seen[0, marker] if good[0] else fit[0]
                v[marker] = fit[1] if degree else 0.0
        pos.append(_fill(p, trial.marker_arclength))
        vel.append(_fill(v, trial.marker_arclength))
    return Start(np.stack(pos), np.stack(vel))


def calm(recording: Recording, trials: Sequence[Trial]) -> np.ndarray:
    """Return which trials begin almost at rest, hanging free, shape (B,) bool.

    Where a table carries the rope, friction may hold it in any shape: it starts as measured.
    """
    out = []
    for trial in trials:
        frames = max(4, int(np.searchsorted(trial.time, WINDOW + 1e-9)))
        seen, time = trial.markers[:frames], trial.time[:frames]
        good = np.isfinite(seen).all((0, 2))
        gradient = np.tensordot(time - time.mean(), seen[:, good], axes=(0, 0)) / ((time - time.mean()) ** 2).sum()
        low = np.nanmin(trial.markers[:frames, ~trial.gripped, 2])
        lying = recording.table_height is not None and low < recording.table_height + 3 * (recording.radius or 0.005)
        enough = good.sum() >= 0.5 * len(good)
        # Of noise of 1 mm the gradient over eleven frames would be 1 cm/s.
        out.append(bool(enough and not lying and np.sqrt((gradient**2).sum(-1)).mean() < _CALM))
    return np.array(out)


def begin(model: RopeModel, trials: Sequence[Trial]) -> Start:
    """Return the first estimate of where trials begin."""
    start = read_off(trials)
    return Start(start.pos, start.vel, calm(model.recording, trials))


def _fill(values: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Interpolate missing rows of (M, 3) along the rope."""
    known = np.isfinite(values[:, 0])
    return np.stack([np.interp(arclength, arclength[known], values[known, c]) for c in range(3)], -1)


def simulator(model: RopeModel, motion: TrialBatch) -> Simulator:
    """Return a function that simulates trials with a model, in this process."""
    return lambda start, values, frames: model.simulate(motion, start, values, frames=frames)


def refine(
    model: RopeModel, motion: TrialBatch, start: Start, values: np.ndarray, simulate: Simulator | None = None
) -> Start:
    """Return positions and velocities with which the simulation follows the markers best through the window.

    One Gauss-Newton step: positions and velocities of all free markers are varied in one batch; what the markers say
    at first glance counts as a measurement of its own.

    Args:
        model: the rope.
        motion: B trials.
        start: first estimate.
        values: the rope's numbers, shape (K,).
        simulate: what simulates the trials; the model itself if not given.
    """
    simulate = simulate or simulator(model, motion)
    if start.still is not None and start.still.all():
        return start
    frames = min(max(3, round(WINDOW / model.dt) + 1), motion.markers.shape[1])
    free = np.setdiff1d(np.arange(model.count), model.gripped)
    trials, half = len(motion.names), 3 * len(free)
    nudge = np.repeat([1e-4, 1e-3], half)
    pos, vel = (np.repeat(x[None], 2 * half + 1, 0) for x in (start.pos, start.vel))
    for u in range(half):
        pos[u + 1, :, free[u // 3], u % 3] += nudge[u]
        vel[half + u + 1, :, free[u // 3], u % 3] += nudge[half + u]
    still = None if start.still is None else np.tile(start.still, 2 * half + 1)
    varied = Start(pos.reshape(-1, *start.pos.shape[1:]), vel.reshape(-1, *start.vel.shape[1:]), still)
    sim = simulate(varied, np.tile(values, (2 * half + 1, 1)), frames)[..., : model.count, :]
    measured = motion.markers[:, :frames]
    seen = np.isfinite(measured).reshape(trials, -1)
    residual = np.where(seen, (measured - sim[0]).reshape(trials, -1), 0.0)
    gradient = (sim[1:] - sim[0]).reshape(2 * half, trials, -1).transpose(1, 2, 0) / nudge
    gradient = np.where(seen[..., None], gradient, 0.0)
    prior = np.repeat([1 / _POSITION**2, 1 / _VELOCITY**2], half)
    normal = gradient.transpose(0, 2, 1) @ gradient / _NOISE**2 + np.diag(prior)
    step = np.linalg.solve(normal, (gradient.transpose(0, 2, 1) @ residual[..., None]) / _NOISE**2)[..., 0]
    step = np.nan_to_num(step).reshape(trials, 2, len(free), 3)
    better = Start(start.pos.copy(), start.vel.copy(), start.still)
    better.pos[:, free] += step[:, 0]
    better.vel[:, free] += step[:, 1]
    return better
