"""How what is held and moved by command moves: keys, robots, and the controls of all steps."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling.bodies.dynamics import BodyTargets, turn_by
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import inverse_kinematics
from torchdlo.coupling.robot import robot_kinematics as robots
from torchdlo.coupling.robot.attachment import Grasp
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.linalg.rotation import multiply
from torchdlo.scene_files.held_parts import Holds
from torchdlo.scene_files.schema import Keyframe, RobotSpec, SceneDescription


def times(d: SceneDescription) -> Tensor:
    """Return the ends of all steps [s], shape (T,)."""
    return torch.arange(1, max(1, round(d.duration / d.dt)) + 1, dtype=torch.float64) * d.dt


def motion(keys: tuple[Keyframe, ...], path: str, time: Tensor) -> Pose:
    """Return how far something has moved and turned at times (T,): shapes (T, 3) and (T, 4)."""
    keys = tuple(sorted(keys, key=lambda key: key.time))
    if not keys or keys[0].time > 0:
        keys = (Keyframe(0.0), *keys)
    at, rows = time.new_tensor([k.time for k in keys]), time.new_tensor([(*k.move, *k.turn) for k in keys])
    k = (torch.searchsorted(at, time, right=True) - 1).clamp(0, len(keys) - 1)
    after = (k + 1).clamp(max=len(keys) - 1)
    gap = at[after] - at[k]
    share = torch.where(gap > 0, (time - at[k]) / torch.where(gap > 0, gap, 1.0), 0.0).clamp(0, 1)[:, None]
    if path == "smooth":
        # The path of least jerk (Flash and Hogan 1985, doi:10.1523/JNEUROSCI.05-07-01688.1985).
        share = share**3 * (10 - 15 * share + 6 * share**2)
    between = rows[k] + share * (rows[after] - rows[k])
    return Pose(between[:, :3], turn_by(between[:, 3:]))


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot with its joints at the start and after every step."""

    robot: robots.Robot
    joints: Tensor
    """Joint positions, the first row those at the start [rad or m], shape (T + 1, J)."""

    @functools.cached_property
    def tool(self) -> Pose:
        """Where the tool is at the start and after every step, shapes (T + 1, 3) and (T + 1, 4)."""
        return robots.tool_pose(self.robot, self.joints)


def arms(d: SceneDescription, folder: Path) -> list[Arm]:
    """Return the robots of a description with the joints that bring their tools where its keys say."""
    found = [_arm(said, f"robots[{k}]", folder, d) for k, said in enumerate(d.robots)]
    names = [arm.robot.name for arm in found]
    return [
        arm if names.count(arm.robot.name) == 1 else dataclasses.replace(arm, robot=_named(arm.robot, k))
        for k, arm in enumerate(found)
    ]


def _named(robot: robots.Robot, k: int) -> robots.Robot:
    return dataclasses.replace(robot, name=f"{robot.name} {k}")


def _arm(said: RobotSpec, here: str, folder: Path, d: SceneDescription) -> Arm:
    stand: dict[str, Any] = {"base": said.base, "base_quat": said.base_quat}
    if said.urdf == "panda":
        robot = robots.panda(**stand)
    else:
        robot = robots.load_robot(folder / said.urdf, tool=said.tool, **stand)
    if said.joints and len(said.joints) != len(robot.joints):
        raise InputError(
            f"{here}.joints: expected {len(robot.joints)} numbers for {', '.join(robot.joints)}, given "
            f"{len(said.joints)}."
        )
    middle = 0.5 * (robot.lower.clamp(min=-math.pi) + robot.upper.clamp(max=math.pi))
    start = middle.new_tensor(said.joints) if said.joints else middle
    if said.pos is not None:
        quat = start.new_tensor(said.quat)
        target = Pose(start.new_tensor(said.pos), quat / quat.norm())
        found = inverse_kinematics.solve_ik(
            robot, target, start, search=inverse_kinematics.IkSearch(starts=16), posture=start
        )
        _check_reach(f"{here}.pos", found, start.new_zeros(1))
        start = found.joints
    if not said.keyframes:
        return Arm(robot, start.expand(len(times(d)) + 1, -1))
    time = times(d)
    shift, first = motion(said.keyframes, said.path, time), robots.tool_pose(robot, start)
    target = Pose(first.pos + shift.pos, multiply(shift.quat, first.quat.expand_as(shift.quat)))
    follow = inverse_kinematics.IkSearch()
    found = inverse_kinematics.solve_ik(robot, target, start.expand(len(time), -1), search=follow, posture=start)
    _check_reach(f"{here}.keyframes", found, time)
    joints = torch.cat([start[None], found.joints])
    speed = (joints[1:] - joints[:-1]).abs() / d.dt
    if bool((speed > robot.velocity * (1 + 1e-3)).any()):
        step, joint = divmod(int((speed / robot.velocity).argmax()), len(robot.joints))
        raise InputError(
            f"{here}.keyframes: {robot.joints[joint]} would have to move at {speed[step, joint]:.3g} rad/s (m/s if it "
            f"slides) after {time[step]:.3g} s; it can at most {robot.velocity[joint]:g}. Give it more time, or start "
            "from other joints."
        )
    return Arm(robot, joints)


def _check_reach(here: str, found: inverse_kinematics.Solution, time: Tensor) -> None:
    if bool(found.converged.all()):
        return
    missing = found.missing.reshape(-1, 2)
    worst = int((missing[:, 0] + inverse_kinematics.LEVER * missing[:, 1]).argmax())
    raise InputError(
        f"{here}: the tool cannot get there: after {time[worst]:.3g} s {1e3 * missing[worst, 0]:.3g} mm and "
        f"{missing[worst, 1]:.3g} rad are missing; move the target or the base, or start from other joints."
    )


@dataclass(frozen=True, eq=False)
class ControlPlan:
    """What is commanded in every step."""

    controls: scenes.Control
    """The controls, with time as the first axis; of holds that close later all but the grip."""
    held: Holds | None = None
    """Which attachments have which vertices and edges, if some close later."""
    tools: Pose | None = None
    """Where they are at the start and after every step, shapes (T + 1, holds, 3) and (T + 1, holds, 4)."""
    closed: Tensor | None = None
    """How firmly they grip in every step [1], shape (T, holds, 1)."""

    def follow(self, scene: scenes.Scene) -> Callable[[int, scenes.State], scenes.Control]:
        """Return a function that gives the control of step k from the state before it; steps come in their order."""
        if self.held is None:
            return lambda k, state: tree.map(lambda c: c[k], self.controls)
        holds, tools, closed = self.held, tree.part(self.tools), tree.part(self.closed)
        last: list[Grasp | None] = [None]

        def control(k: int, state: scenes.State) -> scenes.Control:
            before, after = (tree.map(lambda x, n=n: x[n], tools) for n in (k, k + 1))
            held = holds.close(scenes.stationary_control(scene, state), before, closed[k], last[0])
            last[0] = held
            pos, director, attachment_weight = holds.carry(held, after)
            usual = tree.map(lambda c: c[k], self.controls)
            return tree.replace(usual, pos=pos, director=director, attachment_weight=attachment_weight)

        return control


def plan(d: SceneDescription, scene: scenes.Scene, state: scenes.State, armed: list[Arm], holds: Holds) -> ControlPlan:
    """Return what is commanded in every step."""
    time, still = times(d), scenes.stationary_control(scene, state)
    bodies = _targets(d, still.bodies, time, state.rods.pos, armed)
    pos, director = (x.expand(len(time), -1, -1) for x in (still.pos, still.director))
    if not d.attachments:
        return ControlPlan(scenes.Control(pos, director, {}, bodies))
    tools = _tools(d, holds, still, time, armed)
    closed = holds.firm(d, still.pos)
    if any(h.close > 0 for h in d.attachments):
        return ControlPlan(scenes.Control(pos, director, {}, bodies), holds, tools, closed)
    first, later = (tree.map(lambda x, part=part: x[part], tools) for part in (0, slice(1, None)))
    held = holds.close(still, first, torch.ones_like(closed[0]))
    pos, director, attachment_weight = holds.carry(tree.replace(held, closed=closed), later)
    attachment_weight = attachment_weight if any(h.release is not None for h in d.attachments) else {}
    return ControlPlan(scenes.Control(pos, director, attachment_weight, bodies))


def _tools(d: SceneDescription, holds: Holds, still: scenes.Control, time: Tensor, armed: list[Arm]) -> Pose:
    """Return where the holds' tools are at the start and after every step, shapes (T + 1, holds, .)."""
    found, with_start = [], torch.cat([time.new_zeros(1), time])
    named, owners = holds.vertices.spread(still.pos), holds.vertices.owners
    for k, hold in enumerate(d.attachments):
        if hold.robot is not None:
            found.append(armed[hold.robot].tool)
            continue
        moved = motion(hold.keyframes, hold.path, with_start)
        found.append(Pose(named[owners.index(k)].to(moved.pos) + moved.pos, moved.quat))
    pos, quat = (torch.stack([getattr(p, part) for p in found], 1).to(still.pos) for part in ("pos", "quat"))
    return Pose(pos, quat)


def _targets(d: SceneDescription, still: Any, time: Tensor, like: Tensor, armed: list[Arm]) -> Any:
    """Return poses of kinematic bodies and then of robots' links, shapes (T, L, 3) and (T, L, 4)."""
    if not still:
        return ()
    moved = [motion(b.keyframes, b.path, time) for b in d.bodies if b.motion == "kinematic"]
    rows = []
    for k, m in enumerate(moved):
        pos, quat = still.pos[k] + m.pos.to(like), m.quat.to(like)
        rows.append(BodyTargets(pos[:, None], multiply(quat, still.quat[k].expand_as(quat))[:, None]))
    rows += [robots.body_targets(arm.robot, arm.joints[1:].to(like)) for arm in armed]
    if not rows:
        return tree.map(lambda x: x.expand(len(time), *x.shape), still)
    return tree.map(lambda *parts: torch.cat(parts, 1), *rows)
