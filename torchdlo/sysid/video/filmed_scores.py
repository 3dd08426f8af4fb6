"""What doses of effects say of films: how much of what a model leaves over they explain, beyond what all else can.

Numbers of the rope, cameras and starts in motion take up what they can first (an efficient score).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from torchdlo.sysid.diagnosis import effect_library, score_test
from torchdlo.sysid.diagnosis.effect_library import Perturbation
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.video.filmed_fit import Fit, look
from torchdlo.sysid.video.filmed_model import FilmedModel
from torchdlo.sysid.video.filmed_problem import FilmedProblem
from torchdlo.sysid.video.fit_pool import FitPool

__all__ = ["LeftOver", "film_scores"]


class LeftOver:
    """What a fit leaves over of films, weighed robustly, beyond what its own numbers, cameras and starts can change."""

    def __init__(self, own: FilmedProblem, here: Fit) -> None:
        self.seen = np.isfinite(here.residual)
        knee = levenberg_marquardt.KNEE
        self.weight = np.where(self.seen, 1 / (np.nan_to_num(here.residual) ** 2 + knee**2) ** 0.25, 0.0)
        self._numbers = here.raw.size
        tangents = self._tangents(own, here)
        self._q, self._r = np.linalg.qr(tangents)
        self._pad = np.zeros(len(tangents) - int(self.seen.sum()))
        left = self.column(-np.nan_to_num(here.residual))
        self.left = left - self._q @ (self._q.T @ left)
        """Weighted readings, priors below them, shape (R,)."""

    def _tangents(self, own: FilmedProblem, here: Fit) -> np.ndarray:
        """Return what numbers, cameras and starts can change of weighted readings, (R, N), their priors below."""
        count, moving = self._numbers, here.offset.shape[1]
        columns = [(here.jacobian[:, k] * self.weight)[self.seen] for k in range(count)]
        for b in range(len(self.seen)):
            only = np.zeros_like(self.weight)
            only[b] = self.weight[b]
            if not own.start.at_rest[b]:
                columns += [(here.jacobian[:, count + k] * only)[self.seen] for k in range(moving)]
        jacobian = np.stack(columns, 1).astype(float)
        priors = np.zeros((jacobian.shape[1], jacobian.shape[1]))
        per_trial = float(self.seen.sum()) / len(self.seen)
        priors[range(count, len(priors)), range(count, len(priors))] = np.sqrt(own.prior.mean() * per_trial)
        return np.concatenate([jacobian, priors])

    def column(self, change: np.ndarray) -> np.ndarray:
        """Return a change of readings (B, F, R) as `left` is."""
        return np.concatenate([(np.nan_to_num(change) * self.weight)[self.seen], self._pad])

    def beyond(self, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what nothing else can change of columns (R, J), and their parts that something else can, (N, J)."""
        absorbed = self._q.T @ changes
        return changes - self._q @ absorbed, absorbed

    def taken_up(self, absorbed: np.ndarray) -> np.ndarray:
        """Return the coordinates (N,) of numbers and cameras that do what was absorbed (N + starts,)."""
        return np.linalg.lstsq(self._r, absorbed, rcond=1e-6)[0][: self._numbers]

    def explained(self, change: np.ndarray) -> float:
        """Return the share of what is left over that a change of readings (B, F, R), at any size, explains."""
        beyond = self.beyond(self.column(change)[:, None])[0][:, 0]
        whole = float(beyond @ beyond) * float(self.left @ self.left)
        return max(float(beyond @ self.left), 0.0) ** 2 / max(whole, 1e-300)


def film_scores(
    base: FilmedModel, names: Sequence[str], seconds: float, report: Callable[[int, int], None], pool: FitPool
) -> list[Score]:
    """Return the scores of effects, best first: what their doses explain beyond what all other numbers can.

    Args:
        base: the model.
        names: effects to try.
        seconds: over which films are compared.
        report: told how many groups are done, and in all.
        pool: who simulates them.
    """
    own, values = base.own, base.values
    here = look(own, base.fit.raw, own.offset, seconds)
    known = dict(zip(own.model.parameters, own.full(values[None])[0], strict=True))
    sims = own.simulate(values[None])
    step = max(1, sims.shape[2] // 50)
    curved = score_test.curvature_scale(sims[0][:, ::step])
    doses = {n: effect_library.perturbations(n, own.model.recording, own.model.mesh, curved, known) for n in names}
    groups = score_test.groups_of(names, doses)
    rest = LeftOver(own, here)
    found = []
    report(0, len(groups))
    probed = [(own, values, {n: doses[n] for n in group}, seconds) for group in groups]
    for done, (g, read) in enumerate(pool.map(_dose_readings, probed)):
        owner = [name for name in groups[g] for _ in doses[name]]
        for name in groups[g]:
            picked = [k + 1 for k, o in enumerate(owner) if o == name]
            beyond, absorbed = rest.beyond(np.stack([rest.column(read[k] - read[0]) for k in picked], 1))
            mixtures = score_test._mixtures(doses[name], beyond, rest.left)
            starts = []
            for mixture in mixtures[: score_test._PLACES]:
                back = rest.taken_up(absorbed @ mixture.amounts)
                for share in score_test._ON_THE_WAY:
                    raw = here.raw - np.clip(share * back, -1.0, 1.0)
                    starts.append((score_test._mixture(name, doses[name], share * mixture.amounts), raw))
            best, sizes = mixtures[0], score_test._sizes(name, doses[name])
            found.append(Score(name, best.share, starts[0][0], tuple(starts), sizes, best.direction))
        report(done + 1, len(groups))
    return sorted(found, key=lambda s: (-s.share, s.name))


def _dose_readings(
    own: FilmedProblem, values: np.ndarray, doses: Mapping[str, Sequence[Perturbation]], seconds: float
) -> np.ndarray:
    """Return readings at the numbers (N,) of a problem and with each dose of some effects, (1 + doses, B, F, R)."""
    known = dict(zip(own.model.parameters, own.full(values[None])[0], strict=True))
    more = own.with_effects((*own.model.effects, *doses), {}, [])
    more.fixed[:] = [known.get(n, f) for n, f in zip(more.model.parameters, more.fixed, strict=True)]
    rows = [more.fixed.copy()]
    for probes in doses.values():
        for probe in probes:
            rows.append(more.fixed.copy())
            for key, value in probe.values.items():
                rows[-1][more.model.parameters.index(key)] = value
    every = replace(more, free=tuple(range(len(more.fixed))))
    cameras = np.repeat(values[None, len(own.free) :], len(rows), 0)
    offsets = np.repeat(own.offset[None], len(rows), 0)
    moved = every.simulate(np.concatenate([np.stack(rows), cameras], 1), own.frames(seconds), offsets)
    return own.spines.changes(moved, cameras)[..., 0]
