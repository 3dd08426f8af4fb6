"""What the grippers of a simulated rope exert on it, as sensors at them would say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import cross, normalize
from torchdlo.sysid.model.discretisation import Mesh
from torchdlo.sysid.recordings.recording import Trial
from torchdlo.sysid.recordings.wrench import ForceSensor, world_wrench

__all__ = ["ForceWorth", "Grip", "grip_wrench", "grips", "measured_wrench", "packed", "unpacked"]

ForceWorth = tuple[float, float | None]
"""What a newton and a newton metre are worth beside markers [m/N, m/(N m)]; None: torques do not count."""


@dataclass(frozen=True)
class Grip:
    """One gripper with a sensor, by places among the held vertices and the held edges of a mesh."""

    vertices: tuple[int, ...]
    """Held vertices that are its."""
    edges: tuple[tuple[int, int], ...]
    """Held edges whose frames it prescribes: place among those, and place of the edge's first vertex."""
    reference: int
    """Held vertex about which torques are."""


def grips(mesh: Mesh, trial: Trial) -> tuple[Grip, ...]:
    """Return the grippers whose forces were measured in a trial, in the order of `wrench_marker`."""
    gripped, place = np.flatnonzero(trial.gripped), {vertex: k for k, vertex in enumerate(mesh.held)}
    runs = np.split(gripped, np.flatnonzero(np.diff(gripped) > 1) + 1)
    found = []
    for marker in () if trial.wrench_marker is None else trial.wrench_marker:
        run = next(r for r in runs if marker in r)
        first, last = (int(mesh.marker_vertex[k]) for k in (run[0], run[-1]))
        edges = [(k, place[edge]) for k, (edge, _) in enumerate(mesh.clamps) if first <= edge < last]
        inside = tuple(place[v] for v in range(first, last + 1))
        found.append(Grip(inside, tuple(edges), place[int(mesh.marker_vertex[marker])]))
    return tuple(found)


def grip_wrench(found: Sequence[Grip], held: Tensor, force: Tensor, couple: Tensor) -> Tensor:
    """Return force [N] and torque [N m] that grippers exert on the rope, shape (..., W, 6).

    Args:
        found: the grippers.
        held: places of the held vertices [m], shape (..., H, 3).
        force: on them [N], shape (..., H, 3).
        couple: on the held edges about themselves [N m], shape (..., G, 1).
    """
    if not found:
        raise InputError("forces: expected a gripper whose force was measured, found none.")
    out = []
    for grip in found:
        at = list(grip.vertices)
        lever = held[..., at, :] - held[..., [grip.reference], :]
        torque = cross(lever, force[..., at, :]).sum(-2)
        for edge, vertex in grip.edges:
            along = normalize(held[..., vertex + 1, :] - held[..., vertex, :])
            torque = torque + couple[..., edge, :] * along
        out.append(tree.cat_components([force[..., at, :].sum(-2), torque]))
    return torch.stack(out, -2)


def measured_wrench(trials: Sequence[Trial], sensor: ForceSensor, frames: int, count: int) -> np.ndarray:
    """Return force [N] and torque [N m] as measured, in the world, NaN where they do not count, shape (B, F, W, 6).

    Args:
        trials: B trials; those without forces do not count.
        sensor: how forces were measured.
        frames: F, at least as many as those of any trial.
        count: W, sensors of a trial.
    """
    found = np.full((len(trials), frames, count, 6), np.nan)
    for k, trial in enumerate(trials):
        if trial.wrench is not None:
            own = np.where(trial.suspect[:, None, None], np.nan, world_wrench(trial, sensor))
            # The last frame's would be felt in a step that is not simulated any more.
            found[k, : len(own) - 1] = own[:-1]
    return found


def packed(markers: np.ndarray, wrench: np.ndarray, worth: ForceWorth) -> np.ndarray:
    """Return readings (..., R, 3) [m]: markers (..., M, 3), then forces and torques of wrenches (..., W, 6)."""
    parts = [markers, worth[0] * wrench[..., :3]]
    return np.concatenate(parts if worth[1] is None else [*parts, worth[1] * wrench[..., 3:]], -2)


def unpacked(readings: np.ndarray, count: int, worth: ForceWorth) -> np.ndarray:
    """Return force [N] and torque [N m] (..., W, 6) of readings (..., R, 3); NaN for torques that do not count."""
    felt = readings[..., count:, :]
    if worth[1] is None:
        return np.concatenate([felt / worth[0], np.full_like(felt, np.nan)], -1)
    force, torque = np.split(felt, 2, -2)
    return np.concatenate([force / worth[0], torque / worth[1]], -1)
