"""How well a perfect model could do on a recording: noise of the markers, and what steps and mesh get wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb

import numpy as np

from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.estimation.jobs import Fitted, SimulationJob
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial

_ORDERS = (4, 6)
"""Of differences in time that show noise."""

_OVERESTIMATED = 3.0
"""Times what a fit leaves from which a noise that is given is too large."""

_LITTLE = 2e-4
"""Noise of markers below which it is not asked how much it is [m]."""


@dataclass(frozen=True)
class ErrorFloor:
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


def marker_noise(recording: Recording) -> float:
    """Return the noise of the markers [m]: as given, or as it shows."""
    return shown_noise(recording) if recording.marker_noise_std is None else recording.marker_noise_std


def shown_noise(recording: Recording) -> float:
    """Return the noise of the markers [m] that differences in time say; less than there is if it is coloured.

    Of the fourth and the sixth differences the smaller: at low frame rates they show motion, too.
    """
    parts = []
    for trial in recording.train:
        free = trial.markers[:, ~trial.gripped]
        orders = [order for order in _ORDERS if len(free) > 2 * order] or [_ORDERS[0]]
        # The variance of a fourth difference of white noise is 70 times the noise's; medians pass over jumps.
        sizes = [np.nanmedian(np.abs(np.diff(free, n=n, axis=0))) / np.sqrt(comb(2 * n, n)) for n in orders]
        parts.append(1.4826 * float(np.min(sizes)))
    return float(np.median(parts))


def noise_beside(recording: Recording, gaps: np.ndarray) -> float:
    """Return the noise of the markers [m] beside a fit: no more than the fit leaves of the markers.

    A noise that is given stands unless it is three times that.

    Args:
        recording: with the noise, if it is given.
        gaps: of the fit by trial, shape (B,) [m].
    """
    noise, left = marker_noise(recording), gaps[np.isfinite(gaps)]
    if not len(left):
        return noise
    bound = gap_rms(left)
    if recording.marker_noise_std is not None and noise <= _OVERESTIMATED * bound:
        return noise
    return min(noise, bound)


def noise_notes(recording: Recording, noise: float) -> list[str]:
    """Return a sentence where the noise that was taken [m] is less than what is given, or shows."""
    claimed = marker_noise(recording)
    if recording.filmed or noise >= claimed:
        return []
    whose = "what neighbouring frames show" if recording.marker_noise_std is None else "what rope.json gives"
    return [
        f"The noise of the markers is taken to be {1e3 * noise:.2g} mm, as the model leaves no more; {whose}, "
        f"{1e3 * claimed:.2g} mm, is {'motion, too' if recording.marker_noise_std is None else 'too much'}."
    ]


def noise_ratio(recording: Recording) -> float:
    """Return how many times the noise that shows the given one is [1]; 0 where none is given, or no markers are free.

    Smooth markers show less noise than they may have: below 0.2 mm it is not asked how much it is.
    """
    if recording.marker_noise_std is None or recording.filmed:
        return 0.0
    shown = shown_noise(recording)
    return recording.marker_noise_std / max(shown, _LITTLE) if np.isfinite(shown) else 0.0


def trial_gaps(
    simulated: np.ndarray | Sequence[np.ndarray],
    trials: tuple[Trial, ...] | list[Trial],
    frame_weights: np.ndarray | None = None,
) -> np.ndarray:
    """Return the error of each trial [m], root mean square per coordinate of the free markers, shape (B,).

    Args:
        simulated: markers [m], shape (B, F, M, 3).
        trials: B trials.
        frame_weights: what errors of frames are multiplied by [1], shape (B, F); 1 if not given.
    """
    out = []
    for sim, trial, of_frame in zip(
        simulated, trials, [None] * len(trials) if frame_weights is None else frame_weights, strict=True
    ):
        free = ~trial.gripped
        error = sim[: len(trial.time)][:, free] - np.where(trial.suspect[:, None, None], np.nan, trial.markers)[:, free]
        error = error if of_frame is None else of_frame[: len(error), None, None] * error
        known = np.isfinite(trial.markers[:, free]) & ~trial.suspect[:, None, None]
        out.append(float("inf") if not np.isfinite(error[known]).all() else float(np.sqrt(np.mean(error[known] ** 2))))
    return np.array(out)


def gap_rms(gaps: np.ndarray) -> float:
    """Return the root mean square of the gaps of trials."""
    return float(np.sqrt(np.mean(np.square(gaps))))


_AHEAD = 1.5
"""Order of steps that look ahead: they have errors of first and of second order."""

_WILD = 0.05
"""Change of a trial from which the finer simulation is not to be trusted [m]."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """What finer steps and a finer mesh change of the markers of all trials [m], shape (B, F, M, 3) each."""

    step: np.ndarray
    grid: np.ndarray
    noise: float
    """Noise of the markers [m]."""
    order: float
    """Order of the simulation's errors in its steps; 2 in its mesh."""
    edge: float
    """Mean length of the mesh's edges [m]."""
    links: float = 0.0
    """Length of the links if the rope is taken for a chain of stiff ones [m]."""

    @property
    def wrong(self) -> float:
        """Share of the mesh's error that is one.

        It grows with the squared length of edges, and a chain's own difference to a rope with that of its links: a
        mesh with edges as long as the links has none.
        """
        return max(1 - (self.links / self.edge) ** 2, -1.0)

    @property
    def _rest(self) -> tuple[float, float]:
        """What halving leaves over, of the change that it makes."""
        return 1 / (2**self.order - 1), 1 / 3

    @property
    def unsure(self) -> tuple[np.ndarray, np.ndarray]:
        """What may be wrong with corrections [m], shape (B, F, M, 3) each: what was extrapolated.

        How a chain's errors go with its links is not known that well.
        """
        step, grid = self._rest
        return step * self.step, (1.0 if self.links else grid) * self.grid

    @property
    def correction(self) -> np.ndarray:
        """What is to be added to simulations [m], shape (B, F, M, 3); nothing where that is not known.

        Richardson's extrapolation (1911, doi:10.1098/rsta.1911.0009).
        """
        step, grid = ((1 + rest) * np.nan_to_num(x) for rest, x in zip(self._rest, (self.step, self.grid), strict=True))
        return step + self.wrong * grid

    @property
    def lost(self) -> int:
        """Trials of which a finer simulation failed, or differed too much."""
        return int((~np.isfinite(self.step + self.grid)).any((1, 2, 3)).sum())

    def floor(self, trials: slice, free: np.ndarray) -> ErrorFloor:
        """Return the floor on some of the trials.

        Args:
            trials: which ones.
            free: which markers are not held.
        """
        parts = []
        for unsure in self.unsure:
            known = np.isfinite(unsure).all((1, 2, 3))
            chosen = unsure[trials][known[trials]] if known[trials].any() else unsure[known]
            parts.append(float(np.sqrt(np.mean(chosen[:, :, free] ** 2))) if known.any() else float("inf"))
        return ErrorFloor(self.noise, *parts)

    def frame_weights(self, free: np.ndarray) -> tuple[np.ndarray, float]:
        """Return what errors of frames count [1], shape (B, F), and the gap that leaves a perfect model [m].

        Where finer simulations differ much, as some motions magnify small errors, measurements tell little. Squares of
        weights have a mean of 1.
        """
        with np.errstate(invalid="ignore"):
            unsure = sum(np.mean(part[:, :, free] ** 2, (2, 3)) for part in self.unsure)
        known = np.isfinite(unsure).all(1)
        if not known.any():
            return np.ones(unsure.shape), float("inf")
        # Of trials that are not known, as much as of others.
        variance = self.noise**2 + np.where(known[:, None], unsure, np.median(unsure[known], 0))
        level = float(1 / np.sqrt(np.mean(1 / variance)))
        return level / np.sqrt(variance), level


def refine(pool: Pool, base: Fitted, start: Start, chain: str) -> Refinement:
    """Return what half the steps, and with them twice the vertices, change of a calibrated model's markers.

    Args:
        pool: the simulations.
        base: the model.
        start: where all trials begin.
        chain: effect that makes the rope a chain of links, by their length; it is left out.
    """
    model = pool.local.model(base.effects)
    plain = tuple(e for e in base.effects if e != chain)
    links = np.array([ParameterName.parse(name).effect == chain for name in model.parameters])
    values = base.values[None, ~links]
    edge, length = float(np.mean(np.diff(model.arclength))), float(np.abs(base.values[links]).sum())
    half = ("substep", model.dt / (2 * model.substeps))
    discretisation_correction = ("vertices", 2 * len(model.arclength) - 1)
    start = replace(start, discretisation_correction=None)
    jobs = [
        SimulationJob(plain, values, "all", start, options)
        for options in ((half, discretisation_correction), (half,), ())
    ]
    sims = dict(pool.simulate(jobs))
    fine, half_steps, as_it_is = (sims[k][0][..., : model.count, :] for k in range(3))
    found = refinement(fine, half_steps, as_it_is, model.numerical_damping, edge)
    gaps = trial_gaps(as_it_is, pool.recording.trials("all"))
    return replace(found, noise=noise_beside(pool.recording, gaps), links=length)


def refinement(
    fine: np.ndarray, half: np.ndarray, plain: np.ndarray, numerical_damping: float, edge: float
) -> Refinement:
    """Return what refining changes, of simulated markers (B, F, M, 3) [m].

    Args:
        fine: with half the steps and twice the vertices.
        half: with half the steps.
        plain: as they are.
        numerical_damping: how far steps look ahead, see `torchdlo.scene.Scene`.
        edge: mean length of the mesh's edges [m].
    """
    return Refinement(_tame(half - plain), _tame(fine - half), 0.0, _AHEAD if numerical_damping else 2, edge)


def _tame(change: np.ndarray) -> np.ndarray:
    """Return the changes (B, F, M, 3); NaN for trials in which a simulation failed."""
    with np.errstate(invalid="ignore", over="ignore"):
        size = np.sqrt(np.mean(change**2, (1, 2, 3)))
    return np.where((size < _WILD)[:, None, None, None], change, np.nan)
