"""When an effect is worth its name: rules that know nothing of ropes, from the gaps that models leave trial by trial.

`torchdlo.sysid.diagnosis.effect_search` applies them to ropes, `torchdlo.sysid.diagnosis.other_systems` to anything
else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchdlo.sysid.diagnosis.error_floor import gap_rms

__all__ = [
    "MATTERS",
    "NEARLY_ALL",
    "PAYS",
    "compared",
    "gain",
    "helps_on_most",
    "matters",
    "nothing_can_matter",
    "refused",
    "tells_of_kin",
]

PAYS = 0.15
"""Share of the excess gap that an effect has to close, on the train and on the test trials."""

MATTERS = 0.03
"""Share of the baseline's excess gap that each effect has to close, whatever the others leave."""

NEARLY_ALL = 0.8
"""Share of what is left above the floor."""

_AKIN = 0.1
"""The same share from which an effect tells of others that do alike things: two thirds of what it takes to be named."""

_MOST = 0.6
"""Share of the train trials on which an effect has to help."""

_OVERFIT = 0.9
"""Share of the squared noise that a fit with a few numbers leaves at least."""

_NOISE = 0.3
"""Share of the noise below which an excess gap is none."""


def gain(before: np.ndarray, after: np.ndarray, noise: float) -> float:
    """Return the share of the excess gap (squared, above noise) that is closed, of gaps by trial (B,) [m].

    Trials that the model before does not get through are left out; NaN where that is none.
    """
    kept = np.isfinite(before)
    if not kept.any():
        return float("nan")
    old, new = gap_rms(before[kept]) ** 2, gap_rms(after[kept]) ** 2
    return float((old - new) / max(old - noise**2, (_NOISE * noise) ** 2, 1e-12))


def compared(first: Sequence[np.ndarray], before: np.ndarray, after: np.ndarray) -> tuple[float, float, float]:
    """Return the gaps that `matters` compares [m], on the trials that the model before gets through.

    Args:
        first: gaps of baselines, of which the smallest counts, shape (B,) each [m].
        before: gaps without an effect, shape (B,) [m].
        after: gaps with it, shape (B,) [m].
    """
    kept = np.isfinite(before)
    if not kept.any():
        return (float("nan"),) * 3
    return min(gap_rms(gaps[kept]) for gaps in first), gap_rms(before[kept]), gap_rms(after[kept])


def helps_on_most(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether gaps (B,) shrink on most trials."""
    return float(np.mean(after < before)) > _MOST


def matters(first: float, before: float, after: float, noise: float, level: float) -> bool:
    """Return whether a gap shrinks by more than the floor, and by a share of the baseline's.

    What takes away nearly all that is left matters, however small that is beside the baseline's gap.

    Args:
        first: gap of the baseline [m].
        before: gap without an effect [m].
        after: gap with it [m].
        noise: of what is measured [m].
        level: gap of a perfect model [m].
    """
    closed = before**2 - after**2
    enough = min(MATTERS * (first**2 - noise**2), NEARLY_ALL * (before**2 - level**2))
    return closed > max(level**2, enough)


def tells_of_kin(gains: Sequence[float]) -> bool:
    """Return whether effects that do things alike to the ones that fit best may fit better still.

    However little the doses of such an effect explain, the one that resembles it would have made up for a part of it.

    Args:
        gains: shares of the excess gap of the train trials that the leading effects close.
    """
    # Where simulations fail, gains say nothing.
    return any(gain > _AKIN or not np.isfinite(gain) for gain in gains)


def nothing_can_matter(before: float, noise: float, level: float) -> bool:
    """Return whether a gap is so near the floor that nothing which closes it down to the noise `matters`.

    Args:
        before: the gap [m].
        noise: of what is measured, at least [m].
        level: gap of a perfect model [m].
    """
    return bool(np.isfinite(level)) and before**2 - _OVERFIT * noise**2 <= level**2


def refused(
    train: tuple[np.ndarray, np.ndarray], test: tuple[np.ndarray, np.ndarray], noise: float, enough: bool
) -> str | None:
    """Return why an effect is not worth its name, None if it is.

    Args:
        train: gaps of the train trials without and with it [m], (B,) each.
        test: the same of the test trials.
        noise: of what is measured [m].
        enough: whether what it closes `matters`.
    """
    closed, held = gain(*train, noise), gain(*test, noise)
    if np.isnan(closed) or np.isnan(held):
        return "cannot be compared, as no trial is simulated to its end without it"
    if not helps_on_most(*train):
        return "helps on too few trials"
    if closed < PAYS:
        return f"closes {max(closed, 0):.0%} of the gap"
    if held < PAYS:
        return "does not help on the test trials"
    return None if enough else "closes less than the floor leaves open"
