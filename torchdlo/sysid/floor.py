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


def rms(gaps: np.ndarray) -> float:
    """Return the root mean square of the gaps of trials."""
    return float(np.sqrt(np.mean(np.square(gaps))))


def measure(pool: Pool, base: Fitted, start: object, split: str, chain: str) -> Floor:
    """Return the floor of a calibrated model.

    Args:
        pool: the simulations.
        base: the model.
        start: where they begin.
        split: which trials.
        chain: effect that belongs to one grid and is left out on two that are compared.
    """
    model = pool.local.model(base.effects)
    plain = tuple(e for e in base.effects if e != chain)
    kept = [k for k, name in enumerate(model.parameters) if name.split(".")[0] != chain]
    finer = (("vertices", 2 * len(model.arclength) - 1),)
    half = (("substep", model.dt / (2 * model.substeps)),)
    whole, smooth = base.values[None], base.values[None, kept]
    jobs = [
        Simulation(base.effects, whole, split, start),
        Simulation(base.effects, whole, split, start, half),
        Simulation(plain, smooth, split, start),
        Simulation(plain, smooth, split, start, finer),
    ]
    sims = dict(pool.simulate(jobs if plain != base.effects else [jobs[0], jobs[1], jobs[3]]))
    free = np.setdiff1d(np.arange(model.count), model.gripped)
    pairs = ((0, 1), (2, 3)) if plain != base.effects else ((0, 1), (0, 2))
    return Floor(noise(pool.recording), *(_apart(sims[a][0], sims[b][0], free) for a, b in pairs))


def _apart(sims: np.ndarray, others: np.ndarray, free: np.ndarray) -> float:
    """Return how far two predictions are apart [m], root mean square per coordinate of the free markers."""
    change = (others - sims)[:, :, free]
    # Where a refined simulation fails the grid is far too coarse.
    return float(np.sqrt(np.mean(change**2))) if np.isfinite(change).all() else float("inf")
