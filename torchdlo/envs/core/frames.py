"""Frames of an action: tools move evenly with what they hold, hands may lose it, and gradients of what broke stop."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling.bodies.dynamics import BodyTargets, turn_between, turn_by
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import attachment as grasp
from torchdlo.coupling.robot.attachment import Grasp
from torchdlo.envs.core.stages import repeated
from torchdlo.physics import tree
from torchdlo.physics.execution.replay import rollout
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import multiply, rotate
from torchdlo.scene import Control, State

if TYPE_CHECKING:
    from torchdlo.envs.core.episode import Episode, EpisodeState

__all__ = ["guarded", "run", "slipped"]

T = TypeVar("T")


def guarded(inputs: T, count: int, lost: list[Tensor]) -> T:
    """Return inputs, (B, ...) each, whose gradients are 0 for scenes that broke in what is made of them.

    A scene without numbers earns nothing, but 0 times NaN is NaN: it would reach what scenes share, as parameters of a
    policy.

    Args:
        inputs: tree of tensors.
        count: how many scenes there are, B.
        lost: gets which scenes broke, bool, shape (B,), before gradients are asked for.
    """

    def sound(gradient: Tensor | None) -> Tensor | None:
        # There is none where a function has no use for an input.
        return (
            None if gradient is None else torch.where(lost[0].reshape(-1, *[1] * (gradient.dim() - 1)), 0.0, gradient)
        )

    def guard(x: Tensor) -> Tensor:
        if not x.requires_grad:
            return x
        alias = x.expand(count, *x.shape[1:])
        if alias.requires_grad:  # not where nothing is recorded
            alias.register_hook(sound)
        return alias

    return tree.map(guard, inputs)


def run(episode: Episode, world: EpisodeState, tool: Pose, held: Grasp, count: int) -> State:
    """Return the scenes after frames in which the tools move evenly to their poses."""
    x = world.tool.pos
    share = torch.linspace(0, 1, count + 1, dtype=x.dtype, device=x.device)[1:].reshape(-1, 1, 1, 1)
    turn = turn_between(world.tool.quat, tool.quat)
    last = world.tool.quat.expand(count, *world.tool.quat.shape)
    poses = Pose(x + share * (tool.pos - x), multiply(turn_by(share * turn), last))
    pos, director, attachment_weight = grasp.carry_attachments(
        episode.hands, held, repeated(poses, episode.task.schedule.room)
    )
    bodies: Any = ()
    if episode.scene.bodies:
        still = tree.part(scenes.stationary_control(episode.scene, world.state).bodies)
        bodies = BodyTargets(*(p.expand(count, *p.shape) for p in (still.pos, still.quat)))
    attachment_weight = {name: g.expand(count, *g.shape) for name, g in attachment_weight.items()}
    controls = Control(pos, director.expand(count, *director.shape[-3:]), attachment_weight, bodies)
    # Nothing is kept; what has a history would be followed back to its start from every segment.
    none = tree.leaves(world.state)[0].detach()[..., :0, :0]
    state, _ = rollout(
        episode.step, episode.params, world.state, controls, segment=episode.segment, keep=lambda _: none
    )
    return state


def slipped(episode: Episode, state: State, tool: Pose, closed: Tensor) -> Tensor:
    """Return how firmly hands still hold: those whose friction was not enough in the last frame are open."""
    task = episode.task
    if math.isinf(task.arms.grip_force):
        return closed
    tool = repeated(tool, task.schedule.room)
    force, _ = grasp.tool_wrench(episode.scene, episode.hands, state, tool)
    normal = rotate(tool.quat, force.new_tensor([0.0, 1.0, 0.0]).expand_as(force))
    along = force - normal * (force * normal).sum(-1, keepdim=True)
    return torch.where(safe_norm(along) > 2 * task.arms.mu * task.arms.grip_force, 0.0, closed)
