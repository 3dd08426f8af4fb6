"""Trials as inputs of simulations: what grippers do, what was measured, and where it begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

WINDOW = 0.1
"""Seconds of a trial that its start may be estimated from."""


@dataclass(frozen=True, eq=False)
class TrialBatch:
    """Trials of one recording as inputs of the simulation, stacked; short trials are padded with their last frame."""

    names: tuple[str, ...]
    held: Tensor
    """Positions of the held vertices [m], shape (B, S, H, 3) at S substeps."""
    director: Tensor
    """First directors of the held edges, shape (B, S, G, 3)."""
    markers: np.ndarray
    """Measured markers [m], NaN where not seen, padded or suspect, shape (B, F, M, 3)."""
    frames: tuple[int, ...]
    """True number of frames of each trial."""

    def pick(self, rows: np.ndarray) -> TrialBatch:
        """Return the motion with these trials, in their order, repeated as given."""
        names = tuple(self.names[i] for i in rows)
        return TrialBatch(
            names, self.held[rows], self.director[rows], self.markers[rows], tuple(self.frames[i] for i in rows)
        )


@dataclass(frozen=True, eq=False)
class Start:
    """Where trials begin."""

    pos: np.ndarray
    """Marker positions at time 0 [m], shape (B, M, 3)."""
    vel: np.ndarray
    """Marker velocities at time 0 [m/s], shape (B, M, 3)."""
    still: np.ndarray | None = None
    """Which trials begin almost in balance, at rest: they start near where the model comes to rest, (B,) bool."""
    discretisation_correction: np.ndarray | None = None
    """What finer steps on a finer mesh would change of the markers of simulations that begin here, to be added to them
    [m], shape (B, F, M, 3)."""
    frame_weights: np.ndarray | None = None
    """What errors of frames are multiplied by in fits [1], shape (B, F); 1 if not given."""

    @property
    def at_rest(self) -> np.ndarray:
        """`still`, and none where that is not given, (B,) bool."""
        return np.zeros(len(self.pos), bool) if self.still is None else self.still

    def pick(self, rows: np.ndarray) -> Start:
        """Return the starts of these trials."""
        others = (self.still, self.discretisation_correction, self.frame_weights)
        return Start(self.pos[rows], self.vel[rows], *(None if x is None else x[rows] for x in others))
