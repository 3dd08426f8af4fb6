"""How large an effect would have to be to be named on a recording: what a diagnosis that names nothing rules out.

Doses of every effect are simulated for the screening anyway. What a dose changes, after the baseline's own numbers have
taken up what they can, grows with the dose to first order; it is named from where it closes more than the floor leaves
open and the least share of the gap that counts. Sizes beyond the greatest sensible one that an effect declares, or that
the recording gives, are not said: there it cannot be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import Param
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.recordings.recording import Recording

__all__ = ["HIDDEN", "DetectionLimit", "ProbedEffect", "detection_limits", "least_gap", "limit_gap"]

HIDDEN = "cannot be seen in this recording"
"""Of an effect that would have to be larger than it can be to be named."""


@dataclass(frozen=True)
class DetectionLimit:
    """From which size on an effect is named on a recording."""

    name: str
    """The effect."""
    number: str
    """The number that says how large it is."""
    unit: str
    """Its unit."""
    easiest: float | None
    """The size of this number from which it is named at the best, where it is placed or directed so that it shows most;
    of a stiffness in series, up to which. None where that is more than there can be: it cannot be seen."""
    hardest: float | None
    """The same where it shows least."""
    greatest: float
    """The greatest size that there can be; of a stiffness in series, the least."""


@dataclass(frozen=True)
class ProbedEffect:
    """Doses of an effect, and what they show."""

    name: str
    """The effect."""
    probes: tuple[tuple[dict[str, float], float], ...]
    """Its doses by themselves: numbers, and the gap that each leaves after all other numbers took up their part [m]."""


def least_gap(rest: float, noise: float, level: float, share: float) -> float:
    """Return the gap that an effect has to leave to be named, root mean square per coordinate [m].

    Args:
        rest: gap that is left without it [m].
        noise: of the markers [m].
        level: gap of a perfect model [m].
        share: least share of the gap above noise that an effect has to close [1].
    """
    return float(np.sqrt(max(level**2, share / (1 - share) * max(rest**2 - noise**2, 0.0))))


def limit_gap(gaps: np.ndarray, noise: float, level: float, share: float) -> float:
    """Return `least_gap` for the gaps of the test trials (B,), also where a simulation failed or no floor is known.

    Trials that no simulation gets through are left out; where finer simulations failed, noise is all that is known of
    the floor, so that limits are lower ones.
    """
    ran = gaps[np.isfinite(gaps)]
    rest = float(np.sqrt(np.mean(ran**2))) if len(ran) else float("inf")
    return least_gap(rest, noise, level if np.isfinite(level) else noise, share)


def detection_limits(scores: Sequence[Score | ProbedEffect], gap: float, recording: Recording) -> list[DetectionLimit]:
    """Return from which size on each of the screened effects leaves this gap [m], in the order of the library."""
    found = [limit for score in scores if (limit := _limit(score, gap, recording)) is not None]
    order = {name: k for k, name in enumerate(effect_library.library())}
    return sorted(found, key=lambda limit: order.get(limit.name, len(order)))


def _limit(score: Score | ProbedEffect, gap: float, recording: Recording) -> DetectionLimit | None:
    """Return the limit of one effect, None where no gap is known or it has no number that tells its size."""
    if not np.isfinite(gap):
        return None
    how, sizes = effect_library.spec(score.name), []
    if not how.strength:
        return None
    key = how.strength[0]
    param = EFFECTS[score.name].params[key]
    series, high = param.scale == "reciprocal", effect_library.greatest(score.name, key, recording)
    greatest = param.low if series else high * float(np.sqrt(param.size))
    for numbers, shown in score.probes:
        own = np.array([v for name, v in numbers.items() if ParameterName.parse(name).number == key])
        if len(own) and np.isfinite(shown):
            sizes.append(_size(own, (gap / shown) ** (1 / how.power) if shown > 0 else np.inf, param))
    if not sizes:
        return None
    best, worst = (max, min) if series else (min, max)

    def possible(size: float) -> float | None:
        return size if (size >= greatest if series else size <= greatest) else None

    return DetectionLimit(score.name, key, param.unit, possible(best(sizes)), possible(worst(sizes)), greatest)


def _size(dose: np.ndarray, times: float, param: Param) -> float:
    """Return how large a dose is, of one number or of a vector (K,), that is so many times as large."""
    if param.scale == "reciprocal":
        return float(dose[0] / times)
    if param.scale == "log" and param.off is not None and param.off < 1e3:
        # Of a ratio, its logarithm grows with the dose.
        with np.errstate(over="ignore"):
            return float(np.exp(np.abs(np.log(dose[0] / param.off)) * times) * param.off)
    return float(np.linalg.norm(dose) * times)
