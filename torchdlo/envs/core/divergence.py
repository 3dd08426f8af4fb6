"""Hands that are led into what does not give way, and ropes that broke down."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.physics import tree
from torchdlo.physics.effects.base import altered_params
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.rod.kinematics import edge_vectors
from torchdlo.scene import Params, Scene, State

__all__ = ["broken_lengths", "inside_bodies"]

_OFF = 0.1
"""Share by which the edges of inextensible ropes may miss their lengths; solved ones miss them by 1e-6."""

_RIGID = 1e12
"""Axial stiffness from which ropes are inextensible [N]: effects have large numbers where ropes have infinite ones."""


def inside_bodies(scene: Scene, params: Params, state: State, points: Tensor) -> Tensor:
    """Return which points [m], shape (B, N, 3), are inside a body that is not free, bool, shape (B, N)."""
    found = torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
    for k, body in enumerate(scene.bodies):
        if body.motion != "free":
            one, solid, placed = slice(k, k + 1), tree.part(params.bodies), tree.part(state.bodies)
            away = rotate(conjugate(placed.quat[:, one]), points - placed.pos[:, one])
            size, grid = (x[..., one, :] for x in (solid.size, solid.grid))
            found = found | (shape_sdf.distance(body.shape, size, away, grid, body.cells)[..., 0] < 0)
    return found


def broken_lengths(scene: Scene, params: Params, state: State) -> Tensor:
    """Return where inextensible ropes lost their lengths: numbers, but no motion; bool, shape (B,)."""
    rods = altered_params(scene.effects, scene.topology, params.rods, params.effects)
    rest = rods.rest
    length = safe_norm(edge_vectors(scene.topology, state.rods.pos, rest.edge_mask))
    fixed = (rods.material.stretch >= _RIGID) & (rest.edge_mask > 0)
    return (fixed & ((length - rest.length).abs() > _OFF * rest.length)).any(-1).any(-1)
