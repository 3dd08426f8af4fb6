"""How much work a diagnosis does, and which models suit a recording."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchdlo.sysid.model.rope_model import AHEAD
from torchdlo.sysid.recordings.recording import Recording, Trial


@dataclass(frozen=True)
class Budget:
    """How much work to do."""

    starts: int
    """Starts of the baseline fit, of which the best third is fitted."""
    candidates: int
    """Effects that are fitted in each round."""
    iterations: int
    """Iterations of each first fit."""
    more: int
    """Iterations more of the baseline and of the fits that lead."""
    rounds: int
    """Most effects that are added one after the other."""
    trials: int = 8
    """Most train trials that are used."""


BUDGETS = {"fast": Budget(36, 4, 4, 6, 2), "full": Budget(96, 8, 6, 12, 3, 16)}

TAUT = 0.95
"""Share of the rope's length between two grippers from which it may be jerked taut."""

_AHEAD = 0.05
"""How far steps look ahead where it is not: short waves of starts that are measured badly would otherwise ring on, and
drive friction within the rope to and fro. More of it costs accuracy."""


def pick_trials(recording: Recording, most: int) -> Recording:
    """Return the recording with at most so many train trials, evenly picked."""
    if len(recording.train) <= most:
        return recording
    picked = np.linspace(0, len(recording.train) - 1, most).round().astype(int)
    return replace(recording, train=tuple(recording.train[k] for k in picked))


def model_options(recording: Recording, vertices: int | None) -> dict[str, Any]:
    """Return options of the models that suit a recording."""
    taut = any(_stretched(trial) > TAUT for trial in recording.train)
    return {
        "vertices": vertices or _vertices(recording),
        "rest": "straight" if recording.rest_positions is None else "given",
        "numerical_damping": AHEAD if taut else _AHEAD,
        "clamp_fraction": 0.0,
    }


def _vertices(recording: Recording) -> int:
    """Return how many vertices suit the closest free or gripped neighbours among the markers, 40 to 80."""
    nearest = float(np.diff(recording.train[0].marker_arclength).min())
    return int(np.clip(round(recording.length / nearest) + 1, 41, 81))


def _stretched(trial: Trial) -> float:
    """Return the greatest share of the rope's length between two neighbouring grippers that their distance takes up."""
    held, at = np.flatnonzero(trial.gripped), trial.marker_arclength
    shares = [
        float(np.linalg.norm(trial.markers[:, a] - trial.markers[:, b], axis=-1).max() / (at[b] - at[a]))
        for a, b in itertools.pairwise(held)
        if b > a + 1
    ]
    return max(shares, default=0.0)
