"""What a residual looks like, in sentences that hold whether or not an effect has been named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import rankdata

from torchdlo.sysid.recordings.recording import Recording, Trial

if TYPE_CHECKING:
    from torchdlo.sysid.diagnosis.error_floor import ErrorFloor

__all__ = ["STATES", "Residual", "by_marker", "describe_residual"]

STATES = {
    "place": ("place along the rope", "m"),
    "time": ("time", "s"),
    "speed": ("speed", "m/s"),
    "curvature": ("curvature", "1/m"),
    "curvature_rate": ("rate of curvature", "1/(m s)"),
    "height": ("height", "m"),
    "table": ("height above the table", "m"),
}
"""What a residual is held against: name in words and unit."""

_AT_FLOOR = 1.3
"""Times the floor up to which nothing is there to be described."""

_NARROW = 0.25
"""Share of the rope on which most of a residual must lie to be called local."""


@dataclass(frozen=True, eq=False)
class Residual:
    """What one trial measured beyond the simulation, and the states it happened in; NaN where nothing was seen."""

    name: str
    """The trial."""
    error: np.ndarray
    """Measured minus simulated positions of all markers [m], shape (F, M, 3)."""
    free: np.ndarray
    """Markers that no gripper holds, shape (M,) bool."""
    states: dict[str, np.ndarray]
    """States by name, see `STATES`, each (F, M)."""
    fields: dict[str, np.ndarray]
    """Vectors that the parts are made of: velocity, acceleration, bend; each (F, M, 3)."""

    @property
    def distance(self) -> np.ndarray:
        """Return distances of the free markers [m], shape (F, M)."""
        return np.linalg.norm(self.error[:, self.free], axis=-1)


def describe_residual(
    recording: Recording,
    found: Sequence[Residual],
    against: Sequence[tuple[str, float, np.ndarray, np.ndarray]],
    parts: Mapping[str, tuple[float, np.ndarray]],
    floor: ErrorFloor,
) -> list[str]:
    """Return sentences on a residual.

    Args:
        recording: what was measured.
        found: the residuals.
        against: name, share, centres and root mean squares of each state.
        parts: see `_parts`.
        floor: see `localise`.
    """
    squares = np.concatenate([(r.distance**2).ravel() for r in found])
    size = float(np.sqrt(np.nanmean(squares) / 3))
    if size <= _AT_FLOOR * floor.total:
        return [
            f"Nothing above the floor: {1e3 * size:.2f} mm per coordinate, the floor is {1e3 * floor.total:.2f} mm."
        ]
    said = [f"{1e3 * size:.1f} mm per coordinate over all trials, {size / floor.total:.1f} times the floor."]
    said += [_where(recording, found), *_shape(recording, found, floor), _when(found)]
    return [*said, *_state(against), *_fields(parts)]


def _where(recording: Recording, found: Sequence[Residual]) -> str:
    """Return on which part of the rope most of it lies."""
    trial = (recording.train + recording.test)[0]
    energy = by_marker(found)
    place, gripped = trial.marker_arclength[~trial.gripped], trial.marker_arclength[trial.gripped]
    away = np.abs(place[:, None] - gripped[None]).min(1)
    local, free_end = _concentrated(recording, trial, place, energy, "Largest"), any(_ends(trial))
    rising = len(place) > 3 and _rank(away, energy) > 0.9
    # A shape of its own in the middle is local; what has built up at an end that hangs free need not come from there.
    if local and not (rising and free_end):
        return local
    if rising and energy[away.argmax()] > 1.5 * energy.mean():
        end = "towards the free end" if free_end else "with the distance from the grippers"
        return f"It grows {end}, where whatever goes wrong nearer to the grippers adds up."
    return "It is spread along the whole rope."


def _rank(a: np.ndarray, b: np.ndarray) -> float:
    """Return the rank correlation (Spearman 1904, doi:10.2307/1412159), 0 where one of them does not vary."""
    x, y = rankdata(a) - 0.5 * (len(a) + 1), rankdata(b) - 0.5 * (len(b) + 1)
    size = np.sqrt((x @ x) * (y @ y))
    return float(x @ y / size) if size > 0 else 0.0


def by_marker(found: Sequence[Residual]) -> np.ndarray:
    """Return the mean squared distance of each free marker [m^2], shape (M,)."""
    return np.nanmean(np.concatenate([r.distance**2 for r in found]), 0)


def _ends(trial: Trial) -> tuple[bool, bool]:
    """Return whether the first and the last marker are free."""
    return not trial.gripped[0], not trial.gripped[-1]


def _concentrated(recording: Recording, trial: Trial, place: np.ndarray, energy: np.ndarray, word: str) -> str | None:
    """Return a sentence on the shortest piece of the rope with 60 % of an energy, None if it is not short."""
    if not energy.sum() > 0:
        return None
    width = np.gradient(place) if len(place) > 1 else np.ones(1)
    share = energy * width / (energy * width).sum()
    spans = [(i, j) for i in range(len(place)) for j in range(i, len(place)) if share[i : j + 1].sum() >= 0.6]
    i, j = min(spans, key=lambda s: place[s[1]] - place[s[0]] + 1e-3 * s[0] * width[0])
    if width[i : j + 1].sum() > _NARROW * width.sum():
        return None
    low, high = max(place[i] - 0.5 * width[i], 0.0), min(place[j] + 0.5 * width[j], recording.length)
    return f"{word} {_called(trial, low, high)}: {share[i : j + 1].sum():.0%} of it."


def _called(trial: Trial, low: float, high: float) -> str:
    """Return words for a piece of the rope."""
    held = np.flatnonzero(trial.gripped)
    grips = np.split(held, np.flatnonzero(np.diff(held) > 1) + 1)
    names = ["the gripper"] if len(grips) == 1 else ["the first gripper", "the second gripper", "the third gripper"]
    length = trial.marker_arclength[-1]
    marks = [(trial.marker_arclength[g], n) for g, n in zip(grips, names, strict=False)]
    marks += [(np.array([e]), "the free end") for e, free in zip((0.0, length), _ends(trial), strict=True) if free]
    reach = [(max(high - at.max(), at.min() - low), name) for at, name in marks]
    far, name = min(reach)
    if far < 0.25 * length:
        return f"within {100 * far:.0f} cm of {name}"
    return f"between {100 * low:.0f} and {100 * high:.0f} cm along the rope"


def _shape(recording: Recording, found: Sequence[Residual], floor: ErrorFloor) -> list[str]:
    """Return where the curvature itself is wrong: positions sum up what is wrong before them, curvatures do not."""
    trial = (recording.train + recording.test)[0]
    s = trial.marker_arclength
    slope = [np.diff(r.error, axis=1) / np.diff(s)[:, None] for r in found]
    bend = np.concatenate([np.diff(x, axis=1) / (0.5 * (s[2:] - s[:-2]))[:, None] for x in slope])
    with np.errstate(invalid="ignore"):
        energy = np.nanmean((bend**2).sum(-1), 0)
    numerical_damping, behind = 1 / np.diff(s)[1:], 1 / np.diff(s)[:-1]
    noise = (
        3
        * floor.noise**2
        * (numerical_damping**2 + behind**2 + (numerical_damping + behind) ** 2)
        / (0.5 * (s[2:] - s[:-2])) ** 2
    )
    energy = np.clip(np.nan_to_num(energy) - noise, 0, None)
    # The mean over all frames tells it from noise whose size is known to some 10 %.
    if not (energy > 0.3 * noise).any():
        return []
    summary = _concentrated(recording, trial, s[1:-1], energy, "Its curvature is wrong most")
    return [summary] if summary else []


def _when(found: Sequence[Residual]) -> str:
    """Return how it changes over time."""
    whole = np.nansum([np.nansum(r.error[:, r.free] ** 2) for r in found])
    seen = [np.isfinite(r.error[:, r.free]) for r in found]
    with np.errstate(invalid="ignore"):
        steady = sum(
            float((np.nansum(r.error[:, r.free], 0) ** 2 / np.maximum(s.sum(0), 1)).sum())
            for r, s in zip(found, seen, strict=True)
        )
    early, late = (
        1e3 * np.sqrt(np.nanmean(np.concatenate([np.array_split(r.distance**2, 3)[k].ravel() for r in found])) / 3)
        for k in (0, 2)
    )
    if steady > 0.6 * whole:
        return f"It is nearly constant in time ({steady / whole:.0%} of its square)."
    if not 1 / 1.5 < late / early < 1.5:
        how = "grows with time" if late > early else "dies out"
        return f"It {how}: {early:.1f} mm in the first third of the trials, {late:.1f} mm in the last."
    return "It moves, and is about as large early as late."


def _state(against: Sequence[tuple[str, float, np.ndarray, np.ndarray]]) -> list[str]:
    """Return with which states it goes."""
    said = []
    for name, share, centres, sizes in sorted(against, key=lambda a: -a[1]):
        good = np.isfinite(centres) & np.isfinite(sizes)
        if name in ("place", "time") or share < 0.1 or good.sum() < 3:
            continue
        trend = _rank(centres[good], sizes[good])
        how = "grows with" if trend > 0.7 else "shrinks with" if trend < -0.7 else "depends on"
        said.append(f"It {how} {STATES[name][0]}, which explains {share:.0%} of how large it is.")
    return said[:2]


def _fields(parts: Mapping[str, tuple[float, np.ndarray]]) -> list[str]:
    """Return which simple vector fields it consists of."""
    said = []
    share, mean = parts["shift"]
    if share > 0.25:
        along = ", ".join(f"{1e3 * x:+.1f}" for x in mean[0])
        said.append(f"One shift of all markers by ({along}) mm takes {share:.0%} of its square.")
    elif parts["offsets"][0] > 0.25:
        said.append(
            f"A fixed shift of each marker, the same in all trials, takes {parts['offsets'][0]:.0%} of its square."
        )
    share, factor = parts["lag"]
    if share > 0.1:
        how = "behind" if factor[0] < 0 else "ahead of"
        said.append(
            f"The measurement runs {1e3 * abs(factor[0]):.0f} ms {how} the simulation: {share:.0%} of its square."
        )
    share, factor = parts["bend"]
    if share > 0.1:
        side = "inner" if factor[0] > 0 else "outer"
        said.append(f"Markers are seen on the {side} side of bends; that takes {share:.0%} of its square.")
    return said
