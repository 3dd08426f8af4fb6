"""The last stage of a calibration: a finer mesh, what steps and mesh still get wrong, and how exact the numbers are.

A coarse mesh finds the numbers quickly, but not exactly. From there the fit goes on with as many vertices as markers
are close, each trial corrected by what still finer steps and a finer mesh change of it (Richardson's extrapolation), as
in a diagnosis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchdlo.sysid.diagnosis import budget as plans
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import Point, firm
from torchdlo.sysid.estimation.model_uncertainty import CLAMP_SPREAD, radius_of_clamps, shear_share
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model.rope_model import MAX_SUBSTEP
from torchdlo.sysid.recordings.recording import Recording

Report = Callable[[str, int, int, str], None]
"""Called with stage, steps done, steps in all, and a word on how it goes."""

_FIRST = 3
"""Iterations on the finer mesh before it is corrected."""

_SMALL = 200_000
"""Vertices, frames and trials, multiplied, up to which steps are halved: that takes seconds."""

_LEFT = (0.4, 1.0)
"""Share of what was extrapolated for steps and mesh that may be wrong with it,"""
_ALL = (1.5, 4.0)
"""and that simulations which are not corrected may be wrong by: all that finer ones change."""

_INDEPENDENT = 100
"""Readings of a trial that are independent of each other: about ten moments, three shapes, three coordinates."""

_WILD = 0.1
"""Change of a trial from which it says nothing of small ones [m]."""


@dataclass(frozen=True, eq=False)
class Refined:
    """What the last stage found."""

    pool: Pool
    """Simulates with the options that were found to suit."""
    fitted: Fitted
    """Numbers, where they stand, and how trials pull at them."""
    drifts: np.ndarray
    """Standard deviations of the coordinates by steps, mesh, clamps, shear, noise, shape (E, K)."""
    corrected: bool
    """Whether the numbers are those of an exact simulation of the model, else of one with its mesh and steps."""


def finer_options(recording: Recording) -> dict[str, Any]:
    """Return the options of the finer models."""
    options = plans.model_options(recording, None)
    return {name: options[name] for name in ("vertices", "numerical_damping")}


def refine(
    pool: Pool, first: FitJob, clamp_fractions: tuple[float, ...], iterations: int, correct: bool, report: Report
) -> Refined:
    """Fit on, correct simulations by what still finer ones change, fit again, and see how wrong the numbers may be.

    Args:
        pool: the simulations.
        first: where to start, which numbers to fit, and with which options.
        clamp_fractions: where clamps may hold the rope, see `Mesh.clamp_shares`; the best is kept. None: as it is.
        iterations: most iterations of the last fit.
        correct: whether the numbers shall be those of an exact simulation; else they stay as they are.
        report: told how it goes.
    """
    stage = "refining the fit"
    report(stage, 0, 3, "")
    bench = Workspace(pool.with_options(**dict(first.options))).begin(first.values[0], first.effects)

    def job(most: int, **options: float) -> FitJob:
        start, free = bench.starts["train"], first.free
        return FitJob(first.effects, first.values, free, first.sizes, most, start, options=tuple(options.items()))

    jobs = [job(_FIRST, clamp_fraction=c) for c in clamp_fractions] or [job(_FIRST if correct else 0)]
    best = min(bench.fit(jobs), key=lambda f: f.point.cost)
    if clamp_fractions:
        bench = bench.with_options({"clamp_fraction": dict(best.options)["clamp_fraction"]})
    if correct and _size(bench.pool) <= _SMALL:
        bench = bench.with_options({"substep": MAX_SUBSTEP / 2})
    report(stage, 1, 3, f"{1e3 * best.point.cost:.2f} mm")
    if correct:
        bench = bench.begin(best.values, best.effects)
    bench = bench.correct(best)
    report(stage, 2, 3, "")
    if correct:
        best = bench.fit([bench.further(best, iterations)])[0]
    own = np.stack([_thickness(bench, best), noise_of(best.point)])
    drifts = np.concatenate([bench.drift(best, _clamped(bench, best), _LEFT if correct else _ALL), own])
    report(stage, 3, 3, f"{1e3 * best.point.cost:.2f} mm")
    return Refined(bench.pool, best, drifts, correct)


def _size(pool: Pool) -> int:
    vertices = len(pool.local.model(()).arclength)
    return vertices * sum(len(t.time) for t in pool.recording.train)


def noise_of(point: Point) -> np.ndarray:
    """Return standard deviations of the coordinates by what is left over, shape (K,).

    It says what a few trials, which may be wrong alike by chance, cannot; and that numbers which do not show are not
    known. Residuals r of size s, weighted by w, have the cost w r^2 / 2 and the curvature w J^2.
    """
    curvature = firm(point.curvature.sum(0))
    return np.sqrt(np.diag(np.linalg.inv(curvature)) * 2 * point.cost / _INDEPENDENT)


def _clamped(bench: Workspace, fitted: Fitted) -> list[np.ndarray]:
    """Return what it changes of the train trials where clamps begin to hold the rope: a standard deviation [m].

    That is known to about half a radius either way, as ropes are as thick as that.
    """
    less = radius_of_clamps(bench.pool.local.model(fitted.effects, fitted.options), bench.recording.radius)
    if not less:
        return []
    options = dict(fitted.options)
    options["clamp_fraction"] = bench.pool.local.model(fitted.effects, fitted.options).clamp_fraction - less
    start = bench.starts["train"]
    jobs = [SimulationJob(fitted.effects, fitted.values[None], "train", start, tuple(options.items()))]
    ((_, (moved,)),) = bench.pool.simulate(jobs)
    change = CLAMP_SPREAD * (moved - bench.prediction(fitted, "train"))
    return [np.where((np.abs(change).max((1, 2, 3)) < _WILD)[:, None, None, None], change, 0.0)]


def _thickness(bench: Workspace, fitted: Fitted) -> np.ndarray:
    """Return what may be wrong with the bending stiffness, as the model's rope does not shear, shape (K,).

    Shear adds to what bending stores the share (EI / GA) k^2, if k is the wavenumber at which curvature varies.
    """
    space = fitted.space
    out, radius = np.zeros(len(space.names)), bench.recording.radius
    if not radius or "bending_stiffness" not in space.names:
        return out
    arclength = bench.pool.local.model(fitted.effects).mesh.marker_arclength
    out[space.names.index("bending_stiffness")] = shear_share(bench.prediction(fitted, "train"), arclength, radius)
    return out
