"""Where the joints of a task's arms have to be, and what arms reach."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import inverse_kinematics
from torchdlo.coupling.robot.robot_kinematics import Robot, panda
from torchdlo.physics import tree

if TYPE_CHECKING:
    from torchdlo.envs.core.task import Task

__all__ = ["FOLLOW", "reachable", "solve_reach", "standing"]

POSTURE = (1.56, -0.72, -0.02, -2.09, 0.04, 1.33, 2.4, 0.0)
"""Where joints would like to be [rad], and how far the fingers are open [m]."""
FIND = inverse_kinematics.IkSearch(starts=8)
"""How hard to look for the joints of the start."""
FOLLOW = inverse_kinematics.IkSearch(steps=4, closing=2, polish=2)
"""The same for those of an action, which are near the last ones."""


@functools.cache
def _robot() -> Robot:
    return panda()


def _bases(task: Task, like: Tensor) -> Tensor:
    return like.new_tensor(task.arms.base)


def solve_reach(
    task: Task, target: Pose, joints: Tensor, search: inverse_kinematics.IkSearch
) -> inverse_kinematics.Solution:
    """Return where joints bring the tools to their targets. All arms are alike, so they are one more batch axis."""
    base = _bases(task, joints)
    wanted = Pose(target.pos - base, target.quat)
    found = inverse_kinematics.solve_ik(_robot(), wanted, joints, search=search, posture=joints.new_tensor(POSTURE))
    moved = [Pose(p.pos + base, p.quat) for p in (found.pose, found.handed)]
    return tree.replace(found, pose=moved[0], handed=moved[1])


def standing(task: Task, target: Pose) -> inverse_kinematics.Solution:
    """Return how arms stand whose tools are at poses, found from nothing."""
    # An arm that faces its tool has the most room to move; contorted ones may be nearer to the posture.
    posture = target.pos.new_tensor(POSTURE).expand(*target.pos.shape[:-1], -1)
    off = target.pos - _bases(task, target.pos)
    facing = torch.cat([torch.atan2(off[..., 1:2], off[..., :1]), posture[..., 1:]], -1)
    plain = tree.detach(solve_reach(task, target, facing, inverse_kinematics.IkSearch()))
    if bool(plain.converged.all()):
        return plain
    found = tree.detach(solve_reach(task, target, posture, FIND))
    return tree.where(plain.converged, plain, found)


def reachable(task: Task, pos: Tensor) -> Tensor:
    """Return which hands reach places with their tools oriented as at the start, bool, shape (N, R).

    Args:
        task: the task.
        pos: places, such as those of vertices [m], shape (N, 3).
    """
    quat = pos.new_tensor(task.arms.quats)
    where = pos.unsqueeze(1).expand(-1, task.arms.count, -1)
    target = Pose(where, (quat / quat.norm(dim=-1, keepdim=True)).expand(*where.shape[:-1], 4))
    with torch.no_grad():
        return standing(task, target).converged
