"""Joint targets for real arms out of trajectories and policies: limits checked, slowed down where speeds are too great.

Times of a simulated episode are those of its actions. Arms go through the same joints, evenly slower if the speed or
the acceleration of a joint would be too great. Velocities and accelerations are those of the cubic spline through the
points that begins and ends at rest: controllers that interpolate with cubics, by positions and velocities, and with
quintics, by accelerations as well, then do the same motion, for which the limits hold between the points, too. Where a
spline would swing beyond the limits of a joint, cubics stay within them, and accelerations are not written. Whether
a slower motion still does the task is not known from the simulation at full speed: what is fast on purpose, such as a
throw, is not slowed down well.
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
_SLACK = 1e-6
"""How far joints may be beyond a limit [rad or m]."""


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
    acceleration: Tensor | None
    """Joint accelerations [rad/s^2 or m/s^2], shape (P, J); None if those before and after a point differ."""
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
                f"{1e3 * off:.0f} mm and {math.degrees(turned):.0f} degrees; place its base elsewhere, or choose "
                "another --tool: one whose z points out of the hand."
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
    names, columns, velocities, limits = [], [], [], []
    smooth, step = True, 1e-3 * task.frame_skip
    for k, robot in enumerate(robots):
        _check_speeds(robot)
        tools = Pose(path["pos"][:, k], path["quat"][:, k])
        found = _joints(robot, tools, path["joints"][:, k] if same else None)[:, robot.arm]
        _check(robot, found)
        velocity, even = _velocities(robot, found, step)
        names += [(f"arm{k}_" if len(robots) > 1 else "") + robot.joints[j] for j in robot.arm]
        columns.append(found)
        velocities.append(velocity)
        smooth = smooth and even
        limits.append(share * robot.velocity[robot.arm])
    position, velocity, limit = torch.cat(columns, -1), torch.cat(velocities, -1), torch.cat(limits)
    fastest, bends = _fastest(position, velocity, step), _bends(position, velocity, step)
    slower = max(1.0, float((fastest / limit).max()), math.sqrt(float(torch.cat(bends).abs().max()) / acceleration))
    time = slower * step * torch.arange(len(position), dtype=position.dtype)
    bend = torch.cat([bends[0], bends[1][-1:]]) / slower**2 if smooth else None
    return JointMotion(tuple(names), time, position, velocity / slower, bend, slower)


def _check_speeds(robot: Robot) -> None:
    for joint in robot.arm:
        if not float(robot.velocity[joint]) > 0:
            raise InputError(
                f"{robot.name}: joint {robot.joints[joint]}, or one that mimics it, has a greatest speed of "
                f"{float(robot.velocity[joint]):g}; give velocity= of its <limit> a positive number [rad/s or m/s]."
            )


def _velocities(robot: Robot, x: Tensor, step: float) -> tuple[Tensor, bool]:
    """Return velocities of the arm's joints at points (P, J) that begin and end at rest, and whether they are smooth.

    They are those of cubic splines, which have an acceleration at each point. Joints whose spline swings beyond a limit
    between points, as one that stops there does, get velocities with which cubics stay between their points.
    """
    lower, upper = robot.lower[robot.arm], robot.upper[robot.arm]
    found = _spline(x, step)
    least, most = _farthest(x, found, step)
    beyond = (least < lower - _SLACK) | (most > upper + _SLACK)
    return torch.where(beyond, _monotone(x, step), found), not bool(beyond.any())


def _spline(x: Tensor, step: float) -> Tensor:
    """Return velocities (P, J) with which accelerations are the same on both sides of each point."""
    velocity, count = torch.zeros_like(x), len(x) - 2
    if count > 0:
        # v[k-1] + 4 v[k] + v[k+1] = 3 (x[k+1] - x[k-1]) / step.
        matrix = 4 * torch.eye(count).to(x)
        matrix.diagonal(1).fill_(1.0)
        matrix.diagonal(-1).fill_(1.0)
        velocity[1:-1] = torch.linalg.solve(matrix, 3 * (x[2:] - x[:-2]) / step)
    return velocity


def _monotone(x: Tensor, step: float) -> Tensor:
    """Return velocities (P, J) with which cubics do not leave the range of their two points (Fritsch, Butland 1984)."""
    velocity, slope = torch.zeros_like(x), x.diff(dim=0) / step
    one, other = slope[:-1], slope[1:]
    same = one * other > 0
    velocity[1:-1] = torch.where(same, 2 * one * other / torch.where(same, one + other, 1.0), 0.0)
    return velocity


def _bends(x: Tensor, velocity: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Return accelerations at the begin and the end of each cubic between points, (P - 1, J); they change evenly."""
    way, before, after = 6 * x.diff(dim=0) / step**2, velocity[:-1] / step, velocity[1:] / step
    return way - 4 * before - 2 * after, 2 * before + 4 * after - way


def _fastest(x: Tensor, velocity: Tensor, step: float) -> Tensor:
    """Return the greatest speed of each joint at points and between them, shape (J,)."""
    begin, end = _bends(x, velocity, step)
    # Where the acceleration goes through 0 within a segment, after this share of it, the speed has an extremum.
    turns = begin * end < 0
    share = torch.where(turns, begin / torch.where(turns, begin - end, 1.0), 0.0)
    between = velocity[:-1] + 0.5 * begin * share * step
    return torch.maximum(velocity.abs().amax(0), between.abs().amax(0))


def _farthest(x: Tensor, velocity: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Return the least and the greatest position of each joint at points and between them, shape (J,)."""
    begin, end = _bends(x, velocity, step)
    v, jerk = velocity[:-1], (end - begin) / step
    # The speed v + a t + j t^2 / 2 is 0 at t = q / j and at 2 v / q, q = -a -+ sqrt(a^2 - 2 j v), without cancellation.
    root = (begin.square() - 2 * jerk * v).clamp(min=0).sqrt()
    q = -begin - torch.where(begin < 0, -root, root)
    ends = [x]
    for over, below in ((q, jerk), (2 * v, q)):
        t = (over / torch.where(below == 0, 1.0, below)).clamp(0, step)
        ends.append(x[:-1] + t * (v + t * (0.5 * begin + t * jerk / 6)))
    found = torch.cat(ends)
    return found.amin(0), found.amax(0)


def _check(robot: Robot, joints: Tensor) -> None:
    lower, upper = robot.lower[robot.arm], robot.upper[robot.arm]
    over = torch.maximum(lower - joints, joints - upper)
    worst = int(over.argmax())
    point, joint = worst // over.shape[1], worst % over.shape[1]
    if float(over.max()) > _SLACK:
        raise InputError(
            f"{robot.name}: joint {robot.joints[robot.arm[joint]]} would be {float(over.max()):.3g} beyond its limit "
            f"at point {point}; place the base elsewhere, or search another trajectory."
        )


def motion_text(motion: JointMotion, kind: str, notes: dict[str, Any]) -> str:
    """Return a motion as a file of a kind of `FORMATS`; "ros2" has the shape of trajectory_msgs/JointTrajectory."""
    bends = motion.position[:, :0] if motion.acceleration is None else motion.acceleration
    rows = zip(motion.time.tolist(), motion.position, motion.velocity, bends, strict=True)
    if kind == "csv":
        written = io.StringIO()
        table = csv.writer(written, lineterminator="\n")
        table.writerow(["time", *motion.names, *(f"{n}_velocity" for n in motion.names)])
        for time, position, velocity, _ in rows:
            table.writerow([f"{x:.9g}" for x in (time, *position.tolist(), *velocity.tolist())])
        return written.getvalue()
    if kind == "json":
        content = {"generator": "torchdlo deploy", **notes, "joints": list(motion.names), "time": motion.time.tolist()}
        parts = {"position": motion.position.tolist(), "velocity": motion.velocity.tolist()}
        parts |= {} if motion.acceleration is None else {"acceleration": motion.acceleration.tolist()}
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


def _sampled(motion: JointMotion, step: float) -> Tensor:
    """Return where joints are at the begin of every control step and at the end, on cubics between points, (K, J)."""
    time, last = motion.time, motion.time[-1]
    count = int(torch.ceil(last / step - 1e-6))
    at = (step * torch.arange(count + 1, dtype=time.dtype)).clamp(max=last)
    k = (torch.searchsorted(time, at, right=True) - 1).clamp(0, len(time) - 2)
    width = (time[k + 1] - time[k])[:, None]
    u = (at - time[k])[:, None] / width
    before, after = motion.position[k], motion.position[k + 1]
    bend = width * (motion.velocity[k] * (1 - u) - motion.velocity[k + 1] * u) + (after - before) * (2 * u - 1)
    return before + u * (after - before) + u * (1 - u) * bend


@torch.no_grad()
def replay_joints(task: Task, robots: list[Robot], motion: JointMotion, moved: Tensor) -> bool:
    """Play a motion in the simulator, at its own times; return whether the task is done.

    Tasks whose hands open and close on the way say when by actions, not by times: they are played as fast as they were
    simulated.
    """
    timed = len(task.schedule.stages) < 2
    position = _sampled(motion, 1e-3 * task.frame_skip) if timed else motion.position
    parts = position.split([len(robot.arm) for robot in robots], -1)
    tools = []
    for robot, part in zip(robots, parts, strict=True):
        full = part.new_zeros(len(part), len(robot.joints))
        full[:, robot.arm] = part
        tools.append(tool_pose(robot, full).pos)
    path = torch.stack(tools, 1)
    made = episode.prepare_at(task, moved, execution=episode.quick_execution(task))
    world = made.start
    for place in path[1:]:
        way = place.to(moved) - world.target.pos[0]
        action = torch.cat([way.flatten(), torch.zeros_like(way.flatten())])[None]
        world = episode.act(made, world, action)
    world = episode.finish(made, world)
    return bool(task.success(world.seen(task.arms.count)) & ~world.failed)
