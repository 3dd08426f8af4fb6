"""How well a perfect model could do on a recording: noise of the markers, and what steps and mesh get wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchdlo.sysid.motion import Start
from torchdlo.sysid.pool import Fitted, Pool, Simulation
from torchdlo.sysid.recording import Recording, Trial


@dataclass(frozen=True)
class Floor:
    """Parts of the error that no effect explains, root mean square per coordinate [m]."""

    noise: float
    """Noise of the markers."""
    step: float
    """What may be left of the error of the steps."""
    grid: float
    """The same of the mesh."""

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


_WILD = 0.05
"""Change of a trial from which the finer simulation is not to be trusted [m]."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """What finer steps and a finer mesh change of the markers of all trials [m], shape (B, F, M, 3) each."""

    step: np.ndarray
    grid: np.ndarray
    noise: float
    """Noise of the markers [m]."""
    order: int
    """Order of the simulation's errors in its steps; 2 in its mesh."""

    @property
    def _rest(self) -> tuple[float, float]:
        """What halving leaves over, of the change that it makes."""
        return 1 / (2**self.order - 1), 1 / 3

    @property
    def correction(self) -> np.ndarray:
        """What is to be added to simulations [m], shape (B, F, M, 3); nothing where that is not known.

        Richardson's extrapolation (1911, doi:10.1098/rsta.1911.0009).
        """
        step, grid = ((1 + rest) * np.nan_to_num(x) for rest, x in zip(self._rest, (self.step, self.grid), strict=True))
        return step + grid

    def floor(self, trials: slice, free: np.ndarray) -> Floor:
        """Return the floor on some of the trials: of the corrections, what was extrapolated may be wrong.

        Args:
            trials: which ones.
            free: which markers are not held.
        """
        parts = []
        for rest, change in zip(self._rest, (self.step, self.grid), strict=True):
            known = np.isfinite(change).all((1, 2, 3))
            chosen = change[trials][known[trials]] if known[trials].any() else change[known]
            parts.append(rest * float(np.sqrt(np.mean(chosen[:, :, free] ** 2))) if known.any() else float("inf"))
        return Floor(self.noise, *parts)


def refine(pool: Pool, base: Fitted, start: Start, chain: str) -> Refinement:
    """Return what half the steps, and with them twice the vertices, change of a calibrated model's markers.

    Args:
        pool: the simulations.
        base: the model.
        start: where all trials begin.
        chain: effect that belongs to one mesh and is left out.
    """
    model = pool.local.model(base.effects)
    plain = tuple(e for e in base.effects if e != chain)
    values = base.values[None, [k for k, name in enumerate(model.parameters) if name.split(".")[0] != chain]]
    half = ("substep", model.dt / (2 * model.substeps))
    finer = ("vertices", 2 * len(model.arclength) - 1)
    start = replace(start, finer=None)
    jobs = [Simulation(plain, values, "all", start, options) for options in ((half, finer), (half,), ())]
    sims = dict(pool.simulate(jobs))
    step, grid = _tame(sims[1][0] - sims[2][0]), _tame(sims[0][0] - sims[1][0])
    return Refinement(step, grid, noise(pool.recording), 1 if model.ahead else 2)


def _tame(change: np.ndarray) -> np.ndarray:
    """Return the changes (B, F, M, 3); NaN for trials in which a simulation failed."""
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.sqrt(np.mean(change**2, (1, 2, 3)))
    return np.where((size < _WILD)[:, None, None, None], change, np.nan)
