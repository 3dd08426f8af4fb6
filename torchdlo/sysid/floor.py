"""How well a perfect model could do on a recording: noise of the markers, jitter of the grippers, and the grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchdlo.sysid.pool import Fitted, Pool, Simulation
from torchdlo.sysid.recording import Recording, Trial


@dataclass(frozen=True)
class Floor:
    """Parts of the error that no effect explains, root mean square per coordinate [m]."""

    noise: float
    """Noise of the markers."""
    step: float
    """Change with half the substep."""
    grid: float
    """Change with more vertices."""

    @property
    def total(self) -> float:
        """All parts together."""
        return float(np.sqrt(self.noise**2 + self.step**2 + self.grid**2))


def noise(recording: Recording) -> float:
    """Return the noise of the markers [m]: as given, or what fourth differences in time say."""
    if recording.marker_noise_std is not None:
        return recording.marker_noise_std
    parts = []
    for trial in recording.train:
        fourth = np.diff(trial.markers[:, ~trial.gripped], n=4, axis=0)
        # The variance of a fourth difference of white noise is 70 times the noise's; medians pass over jumps.
        parts.append(1.4826 * np.nanmedian(np.abs(fourth)) / np.sqrt(70))
    return float(np.median(parts))


def gap(simulated: np.ndarray, trials: tuple[Trial, ...] | list[Trial]) -> np.ndarray:
    """Return the error of each trial [m], root mean square per coordinate of the free markers, shape (B,)."""
    out = []
    for sim, trial in zip(simulated, trials, strict=True):
        free = ~trial.gripped
        error = sim[: len(trial.time)][:, free] - np.where(trial.suspect[:, None, None], np.nan, trial.markers)[:, free]
        known = np.isfinite(trial.markers[:, free]) & ~trial.suspect[:, None, None]
        out.append(float("inf") if not np.isfinite(error[known]).all() else float(np.sqrt(np.mean(error[known] ** 2))))
    return np.array(out)


def measure(pool: Pool, base: Fitted, reference: np.ndarray, start: object, split: str = "train") -> Floor:
    """Return the floor of a calibrated model.

    Args:
        pool: the simulations.
        base: the model.
        reference: its prediction of the trials, shape (B, F, M, 3).
        start: where they begin.
        split: which trials.
    """
    model = pool.local.model(base.effects)
    options = (
        (("substep", model.dt / (2 * model.substeps)),),
        (("vertices", 2 * len(model.arclength) - 1),),
    )
    jobs = [Simulation(base.effects, base.values[None], split, start, each) for each in options]
    free = np.setdiff1d(np.arange(model.count), model.gripped)
    changes = [0.0, 0.0]
    for k, sims in pool.simulate(jobs):
        change = (sims[0] - reference)[:, :, free]
        # Where a refined simulation fails the grid is far too coarse.
        changes[k] = float(np.sqrt(np.mean(change**2))) if np.isfinite(change).all() else float("inf")
    return Floor(noise(pool.recording), *changes)
