"""Whether a recorded rope comes near itself."""

from __future__ import annotations

import numpy as np

from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = ["near_itself"]

_NEAR = 4.0
"""Radii by which parts of a rope are apart at most that are near each other: two diameters, as markers are sparse."""

_ALONG = 12.0
"""Radii along the rope from which on parts may come back to each other."""

_EVERY = 0.05
"""Time between the frames that are looked at [s]."""

_MOST = 100
"""Most points along the rope that are looked at."""


def near_itself(recording: Recording) -> bool:
    """Return whether parts of a rope are about as near as to touch in a train trial.

    The rope is taken to go straight from marker to marker. Nothing is known of films, and without a radius.
    """
    radius = recording.radius
    if recording.filmed or radius is None or _ALONG * radius >= recording.length:
        return False
    return any(_near(trial, radius) for trial in recording.train)


def _near(trial: Trial, radius: float) -> bool:
    arclength = trial.marker_arclength
    apart = float(arclength[-1] - arclength[0])
    if apart <= _ALONG * radius:
        return False
    places = np.linspace(arclength[0], arclength[-1], min(_MOST, max(len(arclength), round(apart / radius) + 1)))
    # Those that are sparse miss how near parts come by half of their distance at most.
    reach = _NEAR * radius + 0.5 * (places[1] - places[0])
    far = np.abs(places[:, None] - places) > _ALONG * radius
    step = max(1, round(_EVERY / float(trial.time[1] - trial.time[0]))) if len(trial.time) > 1 else 1
    for points in trial.markers[~trial.suspect][::step]:
        seen = np.isfinite(points).all(-1)
        if seen.sum() < 2:
            continue
        curve = np.stack([np.interp(places, arclength[seen], points[seen, c]) for c in range(3)], -1)
        square = ((curve[:, None] - curve) ** 2).sum(-1)
        if (square[far] < reach**2).any():
            return True
    return False
