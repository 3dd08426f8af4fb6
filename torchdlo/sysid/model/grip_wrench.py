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

__all__ = ["Grip", "grip_wrench", "grips"]


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
