"""Whether what an effect explains could be chance: a test on trials that had no part in choosing it.

The train trials choose effects and fit their numbers; the test trials judge them. There, what an effect changes of a
simulation is held against what the model without it leaves over. If the effect is not there, these two agree as often
as they disagree, so that signs may be flipped at will (Fisher 1935; Winkler et al. 2014,
doi:10.1016/j.neuroimage.2014.01.060): by trials where there are enough, else by blocks of time, as long as it takes for
what one dose leaves over to be independent from block to block. Beside it stands an exact F test of the doses that the
trials ask for. All candidates that were looked at count (Benjamini and Hochberg 1995,
doi:10.1111/j.2517-6161.1995.tb02031.x).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from torchdlo.sysid.recordings.recording import Trial

__all__ = [
    "RATE",
    "TOO_FEW",
    "Agreement",
    "agreement",
    "benjamini_hochberg",
    "chance",
    "f_test",
    "independent",
    "sign_flips",
]

RATE = 0.05
"""False discovery rate up to which effects are named: of so many names, one may be chance."""

_KNEE = 2e-3
"""Residual from which it counts less [m], as in fits."""

_BLOCK = 0.4
"""Length of the shortest blocks [s]: half a period of a swinging rope of 0.6 m."""

TOO_FEW = "too few test trials to exclude chance"
"""What is said where no flip at all could tell an effect from chance."""

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
    """How many there are that say anything."""
    doses: np.ndarray
    """By trial: the dose that it asks for, over the one that was fitted [1], shape (B,); NaN where it is not known."""
    p_trials: float
    """Of an exact F test that the mean dose of trials is above 0 [1]; NaN of fewer than two trials."""
    p_short: float = 1.0
    """Share of flips likewise if the shortest blocks were independent: less than there is, where they are not."""
    short_units: int = 0
    """How many of these there are."""

    def could_tell(self, looked_at: int) -> bool:
        """Return whether flips could tell an effect from chance at all, among so many candidates."""
        return looked_at * 2.0**-self.units <= RATE


def agreement(
    less: np.ndarray,
    more: np.ndarray,
    trials: Sequence[Trial],
    frame_weights: np.ndarray | None = None,
    *,
    looked_at: int = 1,
) -> Agreement:
    """Hold what an effect changes against what is left over without it.

    Args:
        less: markers simulated without the effect [m], shape (B, F, M, 3).
        more: the same with it.
        trials: B trials.
        frame_weights: what errors of frames are multiplied by [1], shape (B, F); 1 if not given.
        looked_at: candidates in all: trials are flipped whole where that can tell one from chance among so many.
    """
    scores, powers = [], []
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
        scores.append(np.array([x.sum() for x in np.array_split(agree, parts)]))
        powers.append(np.array([x.sum() for x in np.array_split(power, parts)]))
    sums, whole = (np.array([x.sum() for x in each]) for each in (scores, powers))
    doses = np.divide(sums, whole, out=np.full(len(sums), np.nan), where=whole > 0)
    short = np.concatenate(scores)
    few = looked_at * 2.0 ** -np.count_nonzero(sums) > RATE
    unit, units = ("block", np.concatenate(independent(scores, powers))) if few else ("trial", sums)
    p, count, known = sign_flips(units), int(np.count_nonzero(units)), doses[np.isfinite(doses)]
    merged = len(units) < len(short)
    p_short, short_units = (sign_flips(short), int(np.count_nonzero(short))) if merged else (p, count)
    return Agreement(p, unit, count, doses, f_test(known), p_short, short_units)


def independent(scores: Sequence[np.ndarray], powers: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return scores of blocks merged until what one dose leaves over is independent from block to block.

    How much the blocks of a trial go together is the sum of their autocorrelations up to the first that is not above 0,
    or does not stand out of what independent blocks show. Of one trial alone no dose can be told from what is wrong in
    that trial. A dose that differs from trial to trial makes blocks of whole trials.

    Args:
        scores: of blocks, by trial, shape (N,) each.
        powers: what a dose of 1 would make of them, likewise.
    """
    total, power = (sum(float(x.sum()) for x in each) for each in (scores, powers))
    dose = total / power if len(scores) > 1 and power > 0 else 0.0
    left = [s - dose * p for s, p in zip(scores, powers, strict=True)]
    square, together = sum(float(x @ x) for x in left), 1.0
    for lag in range(1, max(map(len, left))):
        pairs = sum(max(len(x) - lag, 0) for x in left)
        alike = sum(float(x[lag:] @ x[:-lag]) for x in left if len(x) > lag)
        if square == 0 or alike <= (square / np.sqrt(pairs) if lag == 1 else 0.0):
            break
        together += 2 * alike / square
    # Longer rather than shorter: the one dose has taken its share of what goes together.
    length = int(np.ceil(together))
    return [np.array([x.sum() for x in np.array_split(s, max(1, round(len(s) / length)))]) for s in scores]


def chance(tests: Mapping[str, Agreement], looked_at: int) -> dict[str, str]:
    """Return which of the tested effects may explain the test trials by chance, and why that is thought.

    What even the shortest blocks do not tell from chance is none either. Where no flip at all could tell, nothing is
    held against an effect but that this is said.

    Args:
        tests: by effect.
        looked_at: candidates in all.
    """
    found: dict[str, str] = {}
    for p, units in (
        ([t.p for t in tests.values()], [t.units for t in tests.values()]),
        ([t.p_short for t in tests.values()], [t.short_units for t in tests.values()]),
    ):
        rates = benjamini_hochberg(p, looked_at)
        for name, own, rate, count in zip(tests, p, rates, units, strict=True):
            if rate > RATE >= looked_at * 2.0**-count:
                said = f"may explain the test trials by chance (p {own:.2g}, false discovery rate {rate:.2g})"
                found.setdefault(name, said)
    return found


def sign_flips(scores: np.ndarray) -> float:
    """Return the share of flips of signs with a sum at least as large as that of the scores (N,), these included."""
    scores = np.asarray(scores, float)
    # What says nothing flips into itself.
    scores = scores[scores != 0]
    if not len(scores) or not np.isfinite(scores).all():
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
