"""Whether what an effect explains could be chance: a test on trials that had no part in choosing it.

The train trials choose effects and fit their numbers; the test trials judge them. There, what an effect changes of a
simulation is held against what the model without it leaves over. If the effect is not there, these two agree as often
as they disagree, so that signs may be flipped at will (Fisher 1935; Winkler et al. 2014,
doi:10.1016/j.neuroimage.2014.01.060): by trials where there are enough, else by blocks of time. Beside it stands an
exact F test of the doses that the trials ask for. All candidates that were looked at count (Benjamini and Hochberg
1995, doi:10.1111/j.2517-6161.1995.tb02031.x).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from torchdlo.sysid.recordings.recording import Trial

__all__ = ["RATE", "Agreement", "agreement", "benjamini_hochberg", "f_test", "sign_flips"]

RATE = 0.05
"""False discovery rate up to which effects are named: of so many names, one may be chance."""

_KNEE = 2e-3
"""Residual from which it counts less [m], as in fits."""

_BLOCK = 0.4
"""Time after which what a rope does is taken to be another sample [s]: half a period of a swinging rope of 0.6 m."""

_TRIALS = 8
"""Trials from which whole ones are flipped: 1 of 2^8 is below one of a hundred."""

_ALL = 16
"""Units up to which all flips are counted; of more, some are drawn."""

_DRAWN = 1 << _ALL


@dataclass(frozen=True, eq=False)
class Agreement:
    """How what an effect changes agrees with what a model without it leaves over, on trials that did not choose it."""

    p: float
    """Share of sign flips that agree at least as well [1]."""
    unit: str
    """What was flipped: "trial" or "block"."""
    units: int
    """How many there are."""
    doses: np.ndarray
    """By trial: the dose that it asks for, over the one that was fitted [1], shape (B,); NaN where it is not known."""
    p_trials: float
    """Of an exact F test that the mean dose of trials is above 0 [1]; NaN of fewer than two trials."""


def agreement(
    less: np.ndarray, more: np.ndarray, trials: Sequence[Trial], frame_weights: np.ndarray | None = None
) -> Agreement:
    """Hold what an effect changes against what is left over without it.

    Args:
        less: markers simulated without the effect [m], shape (B, F, M, 3).
        more: the same with it.
        trials: B trials.
        frame_weights: what errors of frames are multiplied by [1], shape (B, F); 1 if not given.
    """
    blocks, of_trial = [], []
    for k, trial in enumerate(trials):
        free, count = ~trial.gripped, len(trial.time)
        left = np.where(trial.suspect[:, None, None], np.nan, trial.markers)[:, free] - less[k][:count, free]
        change = (more[k] - less[k])[:count, free]
        known = np.isfinite(left) & np.isfinite(change)
        left, change = np.where(known, left, 0.0), np.where(known, change, 0.0)
        trust = np.ones(count) if frame_weights is None else frame_weights[k][:count]
        weight = trust[:, None, None] ** 2 / np.sqrt((trust[:, None, None] * left) ** 2 + _KNEE**2)
        agree, power = (weight * left * change).sum((1, 2)), (weight * change**2).sum((1, 2))
        parts = max(1, round((trial.time[-1] - trial.time[0]) / _BLOCK))
        blocks += [float(x.sum()) for x in np.array_split(agree, parts)]
        of_trial.append((float(agree.sum()), float(power.sum())))
    sums, powers = np.array(of_trial).T
    doses = np.divide(sums, powers, out=np.full(len(sums), np.nan), where=powers > 0)
    unit, scores = ("trial", sums) if len(trials) >= _TRIALS else ("block", np.array(blocks))
    return Agreement(sign_flips(scores), unit, len(scores), doses, f_test(doses[np.isfinite(doses)]))


def sign_flips(scores: np.ndarray) -> float:
    """Return the share of flips of signs with a sum at least as large as that of the scores (N,), these included."""
    scores = np.asarray(scores, float)
    if not np.isfinite(scores).all() or not np.any(scores):
        return 1.0
    total = scores.sum()
    if len(scores) <= _ALL:
        sums = np.zeros(1)
        for score in scores:
            sums = np.concatenate([sums + score, sums - score])
        return float(np.mean(sums >= total - 1e-12 * np.abs(scores).sum()))
    signs = np.random.default_rng(0).integers(0, 2, (_DRAWN, len(scores)), dtype=np.int8) * 2.0 - 1.0
    return float((1 + np.sum(signs @ scores >= total - 1e-12 * np.abs(scores).sum())) / (1 + _DRAWN))


def f_test(doses: np.ndarray) -> float:
    """Return how likely a mean of doses (B,) that far above 0 is if they scatter about 0; NaN of fewer than two.

    F = n mean^2 / variance with 1 and n - 1 degrees of freedom, exact for normal doses; one side of it.
    """
    count = len(doses)
    if count < 2:
        return float("nan")
    spread = float(np.std(doses, ddof=1)) / np.sqrt(count)
    t = float(np.mean(doses)) / max(spread, 1e-12)
    return float(stats.t.sf(t, count - 1))


def benjamini_hochberg(p: Sequence[float] | np.ndarray, looked_at: int) -> np.ndarray:
    """Return the false discovery rate at which each of some tests counts (N,), of all that were looked at.

    Args:
        p: of the tests that were done, shape (N,).
        looked_at: candidates in all; those that were not tested count as tests that found nothing.
    """
    given = np.asarray(p, float)
    order = np.argsort(given)
    rates = given[order] * max(looked_at, len(given)) / np.arange(1, len(given) + 1)
    found = np.empty(len(given))
    found[order] = np.minimum(np.minimum.accumulate(rates[::-1])[::-1], 1.0)
    return found
