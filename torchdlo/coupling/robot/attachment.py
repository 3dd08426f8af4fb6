"""Grasps: vertices and edges of ropes that follow tools from a moment on, until they are let go.

A welded part keeps its place in the frame of its tool, as it was when the hand closed. Which parts can be held at all
is static, `Scene.prescribed_vertices` and `Scene.prescribed_edges`; which are, may differ from scene to scene and
change at any step.
Holding an edge as well as its two vertices prescribes twist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.coupling.common.pose import Pose
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import cross
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.rod import kinematics as rod


@dataclass(frozen=True)
class Hands:
    """Which tool holds what; static. Parts of tool -1 are fixed in the world and never let go."""

    tools: int
    """How many tools there are."""
    vertices: tuple[int, ...]
    """The tool of each of the scene's held vertices."""
    edges: tuple[int, ...] = ()
    """The tool of each of the scene's held edges."""

    def __post_init__(self) -> None:
        wrong = [k for k in (*self.vertices, *self.edges) if not -1 <= k < self.tools]
        if wrong:
            raise ValueError(f"hands: parts are given to tools {wrong}; expected -1 (the world) to {self.tools - 1}")


@tree.struct
class Grasp:
    """How held parts sit in their tools."""

    offset: Tensor
    """Positions of held vertices in the frames of their tools [m], shape (..., H, 3)."""
    director: Tensor
    """First material directors of held edges in the frames of their tools [1], shape (..., G, 3)."""
    closed: Tensor
    """How firmly tools hold, 0 for open and 1 for closed hands [1], shape (..., T, 1)."""


def _with_world(tools: Pose) -> Pose:
    """Return tools (..., T, .) followed by the world's own frame."""
    still = tools.quat.new_tensor([1.0, 0.0, 0.0, 0.0]).expand_as(tools.quat[..., :1, :])
    zero = torch.zeros_like(tools.pos[..., :1, :])
    return Pose(torch.cat([tools.pos, zero], -2), torch.cat([tools.quat, still], -2))


def _check(scene: Any, hands: Hands, tools: Pose) -> None:
    wanted, given = (
        (len(scene.prescribed_vertices), len(scene.prescribed_edges)),
        (len(hands.vertices), len(hands.edges)),
    )
    if given != wanted:
        raise ValueError(
            f"hands: tools are given for {given[0]} vertices and {given[1]} edges; the scene can hold {wanted[0]} and "
            f"{wanted[1]} (held_vertices, held_edges)"
        )
    if tools.pos.shape[-2:] != (hands.tools, 3) or tools.quat.shape[-2:] != (hands.tools, 4):
        raise ValueError(
            f"hands: poses of tools are {tuple(tools.pos.shape)} and {tuple(tools.quat.shape)}; expected "
            f"(..., {hands.tools}, 3) and (..., {hands.tools}, 4)"
        )


def close_hands(scene: Any, hands: Hands, now: Any, tools: Pose, closed: Tensor, last: Grasp | None = None) -> Grasp:
    """Close or open hands: what a hand did not hold before is held as it lies now.

    Args:
        scene: the static scene, `scene.Scene`.
        hands: which tool holds what.
        now: where held parts are now, `scene.stationary_control(scene, state)`.
        tools: poses of the tools now, shapes (..., T, 3) and (..., T, 4).
        closed: how firmly each tool is to hold from now on, 0 to 1, shape (..., T, 1).
        last: the grasp until now; open hands if not given.
    """
    _check(scene, hands, tools)
    frames = _with_world(tools)
    at, edges = list(hands.vertices), list(hands.edges)
    offset = rotate(conjugate(frames.quat[..., at, :]), now.pos - frames.pos[..., at, :])
    director = rotate(conjugate(frames.quat[..., edges, :]), now.director)
    if last is None:
        return Grasp(offset, director, closed)
    kept = _grip(hands, (last.closed > 0).to(closed.dtype))
    vertices, around = kept["vertices"] > 0, kept["edges"] > 0
    return Grasp(torch.where(vertices, last.offset, offset), torch.where(around, last.director, director), closed)


def _grip(hands: Hands, closed: Tensor) -> dict[str, Tensor]:
    """Return how firmly held parts are held, shapes (..., H, 1) and (..., G, 1)."""
    every = torch.cat([closed, torch.ones_like(closed[..., :1, :])], -2)
    return {"vertices": every[..., list(hands.vertices), :], "edges": every[..., list(hands.edges), :]}


def carry_attachments(hands: Hands, grasp: Grasp, tools: Pose) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Return what `Control` is made of when tools are at these poses: positions, directors, grip."""
    frames = _with_world(tools)
    at, edges = list(hands.vertices), list(hands.edges)
    pos = frames.pos[..., at, :] + rotate(frames.quat[..., at, :], grasp.offset)
    return pos, rotate(frames.quat[..., edges, :], grasp.director), _grip(hands, grasp.closed)


def tool_wrench(scene: Any, hands: Hands, state: Any, tools: Pose) -> tuple[Tensor, Tensor]:
    """Return force [N] and torque about the tool's point [N m] that ropes exerted on each tool in the last step.

    Args:
        scene: the static scene, `scene.Scene`.
        hands: which tool holds what.
        state: the scene after the step.
        tools: where the tools are then, shapes (..., T, 3) and (..., T, 4).

    Returns:
        Means over the step, shape (..., T, 3) each. They are the opposite of the momentum that held parts were given
        beyond what all other loads give.
    """
    rods, slots = state.rods, list(scene.prescribed_edges)
    frames = _with_world(tools)
    push = -state.reaction.force
    lever = rods.pos[..., list(scene.prescribed_vertices), :] - frames.pos[..., list(hands.vertices), :]
    mask = rods.pos.new_tensor(scene.topology.edge_mask()).unsqueeze(-1)
    along = rod.edge_vectors(scene.topology, rods.pos, mask)[..., slots, :]
    couple = -state.reaction.couple * along / along.norm(dim=-1, keepdim=True)

    def gathered(values: Tensor, owners: tuple[int, ...]) -> Tensor:
        share = values.new_tensor([[float(owner == k) for owner in owners] for k in range(hands.tools)])
        return share.reshape(hands.tools, len(owners)) @ values

    torque = gathered(cross(lever, push), hands.vertices) + gathered(couple, hands.edges)
    return gathered(push, hands.vertices), torque
