"""What models say of all trials of a recording: simulated when it is asked for, and kept."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from torchdlo.sysid.estimation.jobs import Fitted, SimulationJob
from torchdlo.sysid.estimation.worker_pool import Pool, spread_jobs
from torchdlo.sysid.model.trial_batch import Start

_TORN = 0.1
"""Share of the rope's length by which markers may be further apart than along it: a simulated rope that is torn
further has missed what happened within a step."""

_FINER = 4
"""How many times shorter the steps are with which such a trial is simulated once more."""


def torn_apart(sims: np.ndarray, arclength: np.ndarray) -> np.ndarray:
    """Return which trials of simulated markers (B, F, M, 3), at places (M,) along the rope [m], tear it; shape (B,)."""
    apart = np.linalg.norm(np.diff(sims, axis=2), axis=3) - np.diff(arclength)
    return ~(apart <= _TORN * (arclength[-1] - arclength[0])).all((1, 2))


class Predictions:
    """A cache of simulations, by where the trials begin, which says how they are corrected, by options and by model.

    What began where nothing begins any more is dropped.
    """

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[Start, dict[Hashable, np.ndarray]] = WeakKeyDictionary()
        self.mended: set[str] = set()
        """Trials that were simulated once more in finer steps, with any model."""

    def of(self, pool: Pool, start: Start, fits: Sequence[Fitted]) -> list[np.ndarray]:
        """Return the simulated markers of all trials with several models, shape (B, F, M, 3) each."""
        known = self._known.setdefault(start, {})
        new = [f for f in fits if _key(pool, f) not in known]
        # Models that settle twists take longer than others, which all fit into one batch.
        kinds = [(pool.local.framed(f.effects), f.options) for f in new]
        groups = [[new[k] for k in group] for group in spread_jobs(kinds, pool.workers)]
        for k, sims in pool.simulate([pool.local.joined(g, "all", start) for g in groups]):
            known |= {_key(pool, f): sim for f, sim in zip(groups[k], sims, strict=True)}
        for fitted in new:
            self._mend(pool, start, fitted, known[_key(pool, fitted)])
        return [known[_key(pool, f)] for f in fits]

    def _mend(self, pool: Pool, start: Start, fitted: Fitted, sims: np.ndarray) -> None:
        """Simulate the trials in which the rope was torn apart once more, in finer steps, into (B, F, M, 3)."""
        model = pool.local.model(fitted.effects, fitted.options)
        torn = np.flatnonzero(torn_apart(sims[..., : model.count, :], model.mesh.marker_arclength))
        if not len(torn):
            return
        options = dict(fitted.options) | {"substep": model.dt / (_FINER * model.substeps)}
        trials = pool.recording.trials("all")
        names = tuple(trials[k].name for k in torn)
        start = replace(start.pick(torn), discretisation_correction=None)
        job = SimulationJob(fitted.effects, fitted.values[None], names, start, tuple(options.items()))
        ((_, again),) = pool.simulate([job])
        sims[torn, : again.shape[2]] = again[0]
        self.mended |= set(names)

    def notes(self) -> list[str]:
        """Return sentences on the simulations that a reader should know."""
        if not self.mended:
            return []
        return [
            f"Simulated ropes were torn apart in {', '.join(sorted(self.mended))}, by some model at least; they were "
            f"simulated once more there in steps of a {_FINER}th."
        ]


def _key(pool: Pool, fitted: Fitted) -> Hashable:
    return frozenset(pool.local.options.items()), fitted.effects, fitted.options, fitted.values.tobytes()
