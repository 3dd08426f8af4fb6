"""Whether the markers are as far apart as their places along the rope say, and stay so."""

from __future__ import annotations

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = ["pieces", "spacing_faults"]

_UNIT = 5.0
"""Lengths that differ by more than this factor are in different units."""

_SCALE = 0.03
"""Share by which all spacings may differ from the places along the rope."""

_STALK = 8e-3
"""How far one marker's place may be off [m]: on stalks beside the axis markers move by that when the rope bends."""

_BENT = 0.6
"""Turn over a piece of rope above which its chord says little about its length [rad]."""

Found = tuple[str, str, str]
"""Trial, kind and sentence of a fault."""


def pieces(trial: Trial) -> np.ndarray:
    """Return lengths of the pieces of rope between markers as seen [m], shape (F, M - 1); NaN where bent too much.

    The chord of an arc of angle a is shorter than the arc by the share a^2 / 24.
    """
    edge = np.diff(np.where(trial.suspect[:, None, None], np.nan, trial.markers), axis=1)
    chord = np.linalg.norm(edge, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = (edge[:, 1:] * edge[:, :-1]).sum(-1) / (chord[:, 1:] * chord[:, :-1])
    turn = np.arccos(np.clip(cosine, -1, 1))
    ds = np.diff(trial.marker_arclength)
    # A hinge's turn belongs to half of either piece; the ends bend as the hinge beside them.
    rate = turn / (0.5 * (ds[1:] + ds[:-1]))
    angle = ds * 0.5 * (np.concatenate([rate[:, :1], rate], 1) + np.concatenate([rate, rate[:, -1:]], 1))
    return np.where(angle < _BENT, chord * (1 + angle**2 / 24), np.nan)


def spacing_faults(recording: Recording, noise: float) -> list[Found]:
    """Return what is wrong with spacings; refuse lengths in different units."""
    trials = (*recording.train, *recording.test)
    seen = np.concatenate([pieces(t) for t in trials])
    ds = np.diff(recording.train[0].marker_arclength)
    known = np.isfinite(seen).mean(0) > 0.05
    if not known.any():
        return []
    length = np.where(known, np.nanmedian(np.where(known, seen, 0.0), 0), np.nan)
    ratio = length / ds
    scale = float(np.nanmedian(ratio))
    if not 1 / _UNIT < scale < _UNIT:
        unit = ", which looks like millimetres" if 300 < scale < 3000 or 300 < 1 / scale < 3000 else ""
        raise InputError(
            f"{recording.path}: markers and marker_arclength: expected both in metres, found markers {scale:.3g} times "
            f"as far apart as along the rope{unit}."
        )
    found: list[Found] = []
    spread = 1.4826 * float(np.nanmedian(np.abs(ratio - scale)))
    if abs(scale - 1) > max(_SCALE, 2 * spread):
        more = "further apart" if scale > 1 else "closer together"
        said = (
            f"markers are {abs(scale - 1):.0%} {more} than along the rope: is length, marker_arclength or a unit wrong?"
        )
        found.append(("", "length", said))
    found += _misplaced(recording, np.where(known, length - scale * ds, np.nan), ds, noise)
    for t in trials:
        found += _drift(t, ds, noise) + _unlike(t, length, ds, noise)
    return found


def _misplaced(recording: Recording, off: np.ndarray, ds: np.ndarray, noise: float) -> list[Found]:
    """Return markers whose piece before is longer by what the piece behind is shorter."""
    found = []
    for m in range(1, len(ds)):
        a, b = off[m - 1], off[m]
        bound = max(_STALK, 0.1 * min(ds[m - 1], ds[m]), 6 * noise)
        beside = [abs(off[k]) for k in (m - 2, m + 1) if 0 <= k < len(off) and np.isfinite(off[k])]
        alone = all(x < 0.5 * abs(a - b) / 2 for x in beside)
        if a * b < 0 and min(abs(a), abs(b)) > bound and abs(a + b) < 0.4 * abs(a - b) and alone:
            place = recording.train[0].marker_arclength[m]
            way = "further along" if a > 0 else "nearer to the first marker"
            said = (
                f"marker {m} sits {1e3 * abs(a - b) / 2:.0f} mm {way} than its marker_arclength of {place:.3f} m says"
            )
            found.append(("", "place", said))
    return found


def _unlike(trial: Trial, length: np.ndarray, ds: np.ndarray, noise: float) -> list[Found]:
    """Return pieces that are of another length in one trial than in most of them."""
    seen, found = pieces(trial), []
    for k in np.flatnonzero(np.isfinite(seen).mean(0) > 0.3):
        off = float(np.nanmedian(seen[:, k]) - length[k])
        if abs(off) > max(2 * _STALK, 0.2 * ds[k], 6 * noise):
            how = "further apart" if off > 0 else "closer together"
            said = f"markers {k} and {k + 1} are {1e3 * abs(off):.0f} mm {how} than in the other trials"
            found.append((trial.name, "place", said))
    return found


def _drift(trial: Trial, ds: np.ndarray, noise: float) -> list[Found]:
    """Return pieces whose length creeps through the trial: a marker slides."""
    seen, found = pieces(trial), []
    time = trial.time / trial.time[-1] - 0.5
    for k in range(len(ds)):
        good = np.isfinite(seen[:, k])
        if good.sum() < 20 or np.ptp(time[good]) < 0.7:
            continue
        slope, level = np.polyfit(time[good], seen[good, k], 1)
        rest = seen[good, k] - level - slope * time[good]
        # What a straight line leaves is no noise: spacings follow the bending of the rope.
        if abs(slope) > max(_STALK, 0.1 * ds[k], 6 * noise, 4 * float(rest.std())):
            said = f"markers {k} and {k + 1} creep {'apart' if slope > 0 else 'together'} by {1e3 * abs(slope):.0f} mm"
            found.append((trial.name, "drift", f"{said} through the trial: does one slide?"))
    return found
