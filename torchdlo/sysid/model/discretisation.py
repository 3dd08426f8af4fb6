"""Where the vertices of a recorded rope are, which of them grippers hold, and how its clamps turn."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import normalize
from torchdlo.sysid.recordings.recording import Trial

MOST_VERTICES = 100_000
"""Most vertices of a rope."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A rope's vertices, with one at every marker."""

    arclength: np.ndarray
    """Arclength of the vertices [m], shape (V,)."""
    marker_vertex: np.ndarray
    """The vertex at each marker, shape (M,)."""
    held: tuple[int, ...]
    """Vertices at gripped markers and between neighbouring ones."""
    clamps: tuple[tuple[int, int], ...]
    """Per pair or run of gripped markers: the held edge next to the free rope, and the clamp's outermost marker."""
    runs: tuple[np.ndarray, ...]
    """The gripped markers of each clamp, in their order along the rope."""

    @property
    def marker_arclength(self) -> np.ndarray:
        """Arclength of the markers [m], shape (M,)."""
        return self.arclength[self.marker_vertex]

    @property
    def clamp_hinges(self) -> tuple[int, ...]:
        """The held vertex next to the free rope, of each clamp."""
        # A clamp is named by its outermost marker; the free rope is on the other side.
        return tuple(
            edge + 1 if marker == run[0] else edge for (edge, marker), run in zip(self.clamps, self.runs, strict=True)
        )

    def clamp_shares(self, clamp_fraction: float) -> np.ndarray:
        """Return what the hinges at clamps stand for, over what hinges between their edges do, shape (V,).

        A clamp's direction is that of the chord between its two markers next to the free rope. A rope that bends
        between them has that direction in their middle (`clamp_fraction` 0), one that is held stiffly up to the last of
        them has it there (`clamp_fraction` 1). The hinge stands for the rope from that point to the middle of the first
        free edge.
        """
        share, length = np.ones(len(self.arclength)), np.diff(self.arclength)
        for (edge, _), markers, vertex in zip(self.clamps, self.runs, self.clamp_hinges, strict=True):
            after = vertex == edge + 1
            if not 0 < vertex < len(self.arclength) - 1:
                continue
            at = self.marker_arclength[markers]
            gap = at[-1] - at[-2] if after else at[1] - at[0]
            free = length[vertex] if after else length[vertex - 1]
            whole = 0.5 * (length[vertex - 1] + length[vertex])
            share[vertex] = (0.5 * gap * (1 - clamp_fraction) + 0.5 * free) / whole
        return share

    def along(self, markers: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Interpolate known markers, shape (F, M, 3), linearly to all vertices, (F, V, 3)."""
        s, m = self.marker_arclength[known], markers[:, known]
        if len(s) == 1:
            return np.repeat(m, len(self.arclength), 1)
        right = np.clip(np.searchsorted(s, self.arclength), 1, len(s) - 1)
        share = (self.arclength - s[right - 1]) / (s[right] - s[right - 1])
        return m[:, right - 1] + share[:, None] * (m[:, right] - m[:, right - 1])

    def directors(self, trial: Trial) -> np.ndarray:
        """Return a material director per clamp, shape (F, G, 3).

        It is the clamp's measured y axis, or one carried along without turning about the clamp's own axis.
        """
        out = []
        for edge, marker in self.clamps:
            where = np.flatnonzero(trial.gripper_marker == marker)  # none if no marker has a quaternion
            if trial.gripper_quaternion is not None and len(where):
                which = int(where[0])
                quat = torch.as_tensor(trial.gripper_quaternion[:, which])
                out.append(rotation.rotate(quat, quat.new_tensor([0.0, 1.0, 0.0]).expand(len(quat), 3)).numpy())
                continue
            ends = self.along(trial.markers, trial.gripped)[:, [edge, edge + 1]]
            tangent = normalize(torch.as_tensor(ends[:, 1] - ends[:, 0]))
            d = [level_normal(tangent[:1])]
            for a, b in itertools.pairwise(tangent):
                d.append(rotation.transport(d[-1], a[None], b[None]))
            out.append(torch.cat(d).numpy())
        return np.stack(out, 1) if out else np.zeros((len(trial.time), 0, 3))


def make_mesh(trial: Trial, length: float, vertices: int | None) -> Mesh:
    """Return a mesh with a vertex at every marker of a trial, and about `vertices` evenly spaced ones in all."""
    if vertices is not None and not 2 <= vertices <= MOST_VERTICES:
        raise InputError(f"vertices: expected 2 to {MOST_VERTICES} for a rope, given {vertices:g}.")
    markers = trial.marker_arclength
    stations = list(markers)
    if length > markers[-1] * 1.01:
        stations.append(length)
    wanted = length / ((vertices or 2 * len(markers)) - 1)
    parts: list[np.ndarray] = []
    at: list[int] = []
    for a, b in itertools.pairwise(stations):
        at.append(sum(len(p) for p in parts))
        pieces = max(1, round((b - a) / wanted))
        parts.append(np.linspace(a, b, pieces, endpoint=False))
    at.append(sum(len(p) for p in parts))
    vertex = np.array(at[: len(markers)])
    return Mesh(np.concatenate([*parts, stations[-1:]]), vertex, *_grips(np.flatnonzero(trial.gripped), vertex))


def _grips(
    gripped: np.ndarray, at: np.ndarray
) -> tuple[tuple[int, ...], tuple[tuple[int, int], ...], tuple[np.ndarray, ...]]:
    """Return held vertices, clamps of gripped markers and their runs of markers, see `Mesh`."""
    held: set[int] = set()
    clamps: list[tuple[int, int]] = []
    runs: list[np.ndarray] = []
    for run in np.split(gripped, np.flatnonzero(np.diff(gripped) > 1) + 1):
        held |= set(range(int(at[run[0]]), int(at[run[-1]]) + 1))
        if len(run) > 1:
            # The free rope is on the side of the longer rest of it.
            after = run[0] == 0 or run[0] < len(at) - 1 - run[-1]
            edge = int(at[run[-1]]) - 1 if after else int(at[run[0]])
            clamps.append((edge, int(run[0] if after else run[-1])))
            runs.append(run)
    return tuple(sorted(held)), tuple(clamps), tuple(runs)


def level_normal(tangent: Tensor) -> Tensor:
    """Return the unit normal of tangents (..., 3) that points up most; towards x for vertical ones."""
    up = tangent.new_tensor([0.0, 0.0, 1.0]).expand_as(tangent)
    steep = tangent[..., 2:].abs() > 0.999
    axis = torch.where(steep, tangent.new_tensor([1.0, 0.0, 0.0]), up)
    return normalize(axis - tangent * (axis * tangent).sum(-1, keepdim=True))
