"""Hands that are led into what does not give way."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.coupling import shapes
from torchdlo.coupling.bodies import conjugate
from torchdlo.physics.rotation import rotate
from torchdlo.scene import Params, Scene, State

__all__ = ["inside"]


def inside(scene: Scene, params: Params, state: State, points: Tensor) -> Tensor:
    """Return which points [m], shape (B, N, 3), are inside a body that is not free, bool, shape (B, N)."""
    found = torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
    for k, body in enumerate(scene.bodies):
        if body.motion != "free":
            one = slice(k, k + 1)
            away = rotate(conjugate(state.bodies.quat[:, one]), points - state.bodies.pos[:, one])
            size, grid = (x[..., one, :] for x in (params.bodies.size, params.bodies.grid))
            found = found | (shapes.distance(body.shape, size, away, grid, body.cells)[..., 0] < 0)
    return found
