"""Joint targets for real arms out of trajectories and policies: limits checked, slowed down where speeds are too great.

Times of a simulated episode are those of its actions. Arms go through the same joints, evenly slower if the speed or
the acceleration of a joint would be too great; velocities are central differences, 0 at both ends. Whether a slower
motion still does the task is not known from the simulation at full speed: what is fast on purpose, such as a throw, is
not slowed down well.
"""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.policies import Policy
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import inverse_kinematics
from torchdlo.coupling.robot.robot_kinematics import Robot, load_robot, panda, tool_pose
from torchdlo.envs import Task
from torchdlo.envs.core import episode
from torchdlo.envs.observations.state import observe
from torchdlo.errors import InputError

__all__ = ["FORMATS", "JointMotion", "arms_of", "motion_text", "play_motion", "replay_joints", "time_scale"]

FORMATS = ("csv", "json", "ros2")
"""Names of the kinds of files."""
_SEARCH = inverse_kinematics.IkSearch(starts=8)
_NEAR = 1e-3
"""How far a tool may be from where it should be [m]."""
_ALIGNED = 1e-2
"""How far a tool may be turned from how it should be [rad]."""


@dataclass(frozen=True, eq=False)
class JointMotion:
    """How the joints of all arms move, point after point."""

    names: tuple[str, ...]
    """Of the joints, arm after arm."""
    time: Tensor
    """Time of each point [s], shape (P,)."""
    position: Tensor
    """Joint positions [rad or m], shape (P, J)."""
    velocity: Tensor
    """Joint velocities [rad/s or m/s], shape (P, J)."""
    acceleration: Tensor
    """Joint accelerations [rad/s^2 or m/s^2], shape (P, J)."""
    slower: float
    """How many times longer it takes than in the simulation."""


def arms_of(task: Task, urdf: Path | None = None, tool: str | None = None) -> list[Robot]:
    """Return the arms of a task where they stand, of another kind if a URDF file is given."""
    bases = task.arms.base
    return [panda(base=b) if urdf is None else load_robot(urdf, tool=tool, base=b) for b in bases]


@torch.no_grad()
def play_motion(task: Task, what: Tensor | Policy, moved: Tensor) -> tuple[dict[str, Tensor], bool]:
    """Play a trajectory (T, A) or a policy once; return tools and joints at all times, and whether it succeeded.

    Args:
        task: the task.
        what: actions, or who chooses them.
        moved: how far things are off their places at the start [m], shape (1, things, 3).
    """
    made = episode.prepare_at(task, moved, execution=episode.quick_execution(task))
    world, rows = made.start, [made.start]
    for k in range(task.horizon):
        if isinstance(what, Policy):
            share = torch.full((1, 1), k / task.horizon)
            action = what.act(observe(made, world), share, observe(made, made.start))
        else:
            action = what[k : k + 1]
        world = episode.act(made, world, action.to(moved))
        rows.append(world)
    world = episode.finish(made, world)
    good = bool(task.success(world.seen(task.arms.count)) & ~world.failed)
    pos, quat, joints = (
        torch.stack(parts)[:, 0].double()
        for parts in zip(*((w.tool.pos, w.tool.quat, w.joints) for w in rows), strict=True)
    )
    return {"pos": pos, "quat": quat, "joints": joints}, good


def _joints(robot: Robot, tools: Pose, known: Tensor | None) -> Tensor:
    """Return joints of one arm that bring its tool along poses (P, ...), (P, J)."""
    if known is not None:
        return known
    middle = torch.where(torch.isfinite(robot.lower + robot.upper), 0.5 * (robot.lower + robot.upper), 0.0)
    last, rows = middle[None], []
    for k in range(len(tools.pos)):
        target = Pose(tools.pos[k : k + 1], tools.quat[k : k + 1])
        search = _SEARCH if k == 0 else inverse_kinematics.IkSearch()
        found = inverse_kinematics.solve_ik(robot, target, last, search=search)
        last = found.joints
        off, turned = found.missing[0].tolist()
        if not (off <= _NEAR and turned <= _ALIGNED):
            raise InputError(
                f"{robot.name}: its tool cannot get to point {k} of the path turned as it has to be, by "
                f"{1e3 * off:.0f} mm and {math.degrees(turned):.0f} degrees; place its base elsewhere, or choose another "
                "--tool: one whose z points out of the hand."
            )
        rows.append(last[0])
    return torch.stack(rows)


def time_scale(
    task: Task,
    robots: list[Robot],
    path: dict[str, Tensor],
    *,
    same: bool,
    share: float = 1.0,
    acceleration: float = 10.0,
) -> JointMotion:
    """Return how joints move, slowed down evenly until all speeds are within the limits.

    Args:
        task: whose actions these are.
        robots: its arms.
        path: what `play_motion` returned.
        same: whether these are the arms that were simulated, whose joints are known.
        share: of the greatest speeds of the joints to use, 0 to 1.
        acceleration: greatest one of each joint [rad/s^2 or m/s^2].
    """
    if not 0 < share <= 1 or not acceleration > 0:
        raise InputError(
            f"speed {share} and acceleration {acceleration}: expected a share up to 1, and a positive one."
        )
    names, columns, limits = [], [], []
    for k, robot in enumerate(robots):
        tools = Pose(path["pos"][:, k], path["quat"][:, k])
        found = _joints(robot, tools, path["joints"][:, k] if same else None)[:, robot.arm]
        _check(robot, found)
        names += [(f"arm{k}_" if len(robots) > 1 else "") + robot.joints[j] for j in robot.arm]
        columns.append(found)
        limits.append(share * robot.velocity[robot.arm])
    position, limit = torch.cat(columns, -1), torch.cat(limits)
    step = 1e-3 * task.frame_skip
    velocity, bend = _derivatives(position, step)
    # Between points joints move evenly: the speed there counts as well.
    fastest = torch.maximum(velocity.abs().amax(0), (position.diff(dim=0) / step).abs().amax(0))
    slower = max(1.0, float((fastest / limit).max()), math.sqrt(float(bend.abs().max()) / acceleration))
    time = slower * step * torch.arange(len(position), dtype=position.dtype)
    return JointMotion(tuple(names), time, position, velocity / slower, bend / slower**2, slower)


def _derivatives(x: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Return velocities and accelerations of a motion (P, J) that begins and ends at rest."""
    held = torch.cat([x[:1], x, x[-1:]])
    velocity = (held[2:] - held[:-2]) / (2 * step)
    velocity[0] = velocity[-1] = 0.0
    return velocity, (held[2:] - 2 * x + held[:-2]) / step**2


def _check(robot: Robot, joints: Tensor) -> None:
    lower, upper = robot.lower[robot.arm], robot.upper[robot.arm]
    over = torch.maximum(lower - joints, joints - upper)
    worst = int(over.argmax())
    point, joint = worst // over.shape[1], worst % over.shape[1]
    if float(over.max()) > 1e-6:
        raise InputError(
            f"{robot.name}: joint {robot.joints[robot.arm[joint]]} would be {float(over.max()):.3g} beyond its limit "
            f"at point {point}; place the base elsewhere, or search another trajectory."
        )


def motion_text(motion: JointMotion, kind: str, notes: dict[str, Any]) -> str:
    """Return a motion as a file of a kind of `FORMATS`; "ros2" has the shape of trajectory_msgs/JointTrajectory."""
    rows = zip(motion.time.tolist(), motion.position, motion.velocity, motion.acceleration, strict=True)
    if kind == "csv":
        written = io.StringIO()
        table = csv.writer(written, lineterminator="\n")
        table.writerow(["time", *motion.names, *(f"{n}_velocity" for n in motion.names)])
        for time, position, velocity, _ in rows:
            table.writerow([f"{x:.9g}" for x in (time, *position.tolist(), *velocity.tolist())])
        return written.getvalue()
    if kind == "json":
        content = {"generator": "torchdlo deploy", **notes, "joints": list(motion.names), "time": motion.time.tolist()}
        parts = {n: getattr(motion, n).tolist() for n in ("position", "velocity", "acceleration")}
        return json.dumps(content | parts) + "\n"
    points = [
        {
            "positions": position.tolist(),
            "velocities": velocity.tolist(),
            "accelerations": acceleration.tolist(),
            "effort": [],
            "time_from_start": {"sec": int(time), "nanosec": min(999_999_999, round(1e9 * (time - int(time))))},
        }
        for time, position, velocity, acceleration in rows
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    return json.dumps({"header": header, "joint_names": list(motion.names), "points": points}, indent=1) + "\n"


@torch.no_grad()
def replay_joints(task: Task, robots: list[Robot], position: Tensor, moved: Tensor) -> bool:
    """Play joint positions (P, J) in the simulator; return whether the task is done."""
    parts = position.split([len(robot.arm) for robot in robots], -1)
    tools = []
    for robot, part in zip(robots, parts, strict=True):
        full = part.new_zeros(len(part), len(robot.joints))
        full[:, robot.arm] = part
        tools.append(tool_pose(robot, full).pos)
    path = torch.stack(tools, 1)
    made = episode.prepare_at(task, moved, execution=episode.quick_execution(task))
    world = made.start
    for k in range(task.horizon):
        way = path[k + 1].to(moved) - world.target.pos[0]
        action = torch.cat([way.flatten(), torch.zeros_like(way.flatten())])[None]
        world = episode.act(made, world, action)
    world = episode.finish(made, world)
    return bool(task.success(world.seen(task.arms.count)) & ~world.failed)
