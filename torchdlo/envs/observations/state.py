"""What is seen of a running episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchdlo.physics import tree

if TYPE_CHECKING:
    from torchdlo.envs.core.episode import Episode, EpisodeState

__all__ = ["observe", "scene_positions"]

ELBOWS = 7
"""Joints of an arm that are observed."""


def observe(episode: Episode, world: EpisodeState) -> Tensor:
    """Return observations in single precision, shape (B, O).

    Positions and velocities of vertices, of free bodies and of the middle of matter; then positions, orientations and
    joint angles of the arms.
    """
    state = world.state
    parts = [state.rods.pos, state.rods.vel]
    free = [k for k, body in enumerate(episode.scene.bodies) if body.motion == "free"]
    if free:
        bodies = tree.part(state.bodies)
        parts += [bodies.pos[:, free], bodies.vel[:, free]]
    if state.material_points:
        parts += [state.material_points.pos.mean(-2, keepdim=True), state.material_points.vel.mean(-2, keepdim=True)]
    parts += [world.tool.pos, world.tool.quat, world.joints[..., :ELBOWS]]
    return torch.cat([p.flatten(-2) for p in parts], -1).to(torch.float32)


def scene_positions(world: EpisodeState) -> dict[str, Tensor]:
    """Return where things are: "pos" (B, V, 3) of the ropes, "tool" (B, R, 3) and "joints" (B, R, J)."""
    return {"pos": world.state.rods.pos, "tool": world.tool.pos, "joints": world.joints}
