"""Robots as kinematic chains: where links are, how joints move the tool, and which solids stand for the links.

Joints are commanded; motors, masses and forces of the arm are not modelled. Chains are those of pytorch-kinematics
(Zhong et al. 2024, doi:10.5281/zenodo.7700587), built in double precision from what `urdf` reads.
"""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import BodyTargets, RigidBody
from torchdlo.coupling.common.pose import Pose, compose_poses, from_matrix
from torchdlo.coupling.robot import urdf
from torchdlo.errors import InputError


@dataclass(frozen=True, eq=False)
class Robot:
    """A chain of links; static."""

    name: str
    joints: tuple[str, ...]
    """Joints that are commanded, in the order of every tensor of joint positions."""
    links: tuple[str, ...]
    """Links, in the order of `poses`."""
    tool: str
    """The link whose pose is commanded."""
    lower: Tensor
    """Least joint positions [rad or m], shape (J,), within which those that mimic these hold their own, too."""
    upper: Tensor
    """Greatest joint positions [rad or m], shape (J,), likewise."""
    velocity: Tensor
    """Greatest joint speeds [rad/s or m/s], shape (J,), likewise."""
    moved: tuple[int, ...]
    """Which of the moving joints, commanded or mimicking, move the tool."""
    turning: Tensor
    """1 for moving joints that turn, 0 for those that slide [1], shape (M,)."""
    axis: Tensor
    """Axes of moving joints in the frames of their links [1], shape (M, 3)."""
    mix: Tensor
    """Position of each moving joint per position of each commanded one [1], shape (M, J)."""
    shift: Tensor
    """Positions of moving joints where the commanded ones are 0 [rad or m], shape (M,)."""
    behind: tuple[int, ...]
    """For each moving joint, the number of the link that it moves."""
    path: tuple[int, ...]
    """For each joint from the first link to the tool, its number among the moving ones; -1 for fixed ones."""
    origins: Tensor
    """Where these joints are in the frames of the links before them [1, m], shape (joints of the path, 4, 4)."""
    shapes: tuple[urdf.CollisionShape, ...]
    base: Pose
    """Where the first link stands."""
    chain: Any
    """The same chain for pytorch-kinematics."""

    @property
    def arm(self) -> list[int]:
        """Which commanded joints move the tool."""
        reach = self.mix[list(self.moved)].abs().sum(0)
        return [k for k in range(len(self.joints)) if reach[k] > 0]


def load_robot(
    source: str | Path,
    *,
    tool: str | None = None,
    base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    base_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Robot:
    """Load a robot from URDF.

    Args:
        source: path of a file, or the text itself.
        tool: link whose pose is commanded; the last one if there is only one end.
        base: where the first link stands [m].
        base_quat: how it is turned, (w, x, y, z).
    """
    said = urdf.read_urdf(source)
    moving = [j for j in said.joints if j.kind != "fixed"]
    if not moving:
        raise InputError(f"{said.name}: no joint moves; expected at least one that is revolute or prismatic.")
    ends = [link for link in said.links if all(j.parent != link for j in said.joints)]
    if tool is None and len(ends) != 1:
        raise InputError(f"{said.name}: has {len(ends)} ends; give tool=, one of {', '.join(ends)}.")
    tool = ends[0] if tool is None else tool
    if tool not in said.links:
        raise InputError(f"{said.name}: has no link {tool!r}; {urdf.near(tool, said.links)}.")
    before, way = {j.child: j for j in said.joints}, list[urdf.Joint]()
    link = tool
    while link in before:
        way.insert(0, before[link])
        link = before[link].parent
    names = [j.name for j in moving]
    moved = tuple(k for k, name in enumerate(names) if name in [j.name for j in way])
    if not moved:
        raise InputError(f"{said.name}: no joint moves the link {tool!r}; choose another tool.")
    leaders = [j for j in moving if not j.mimics]
    limits = [_limits(said.name, j, moving) for j in leaders]
    mix = [[(j.factor if j.mimics else 1.0) * ((j.mimics or j.name) == k.name) for k in leaders] for j in moving]
    links = (said.joints[0].parent, *(j.child for j in said.joints))
    number = functools.partial(torch.as_tensor, dtype=torch.float64)
    quat = number(base_quat)
    return Robot(
        said.name,
        tuple(j.name for j in leaders),
        links,
        tool,
        number([low for low, _, _ in limits]),
        number([high for _, high, _ in limits]),
        number([speed for _, _, speed in limits]),
        moved,
        number([float(j.kind == "revolute") for j in moving]),
        number([j.axis for j in moving]),
        number(mix),
        number([j.offset for j in moving]),
        tuple(links.index(j.child) for j in moving),
        tuple(names.index(j.name) if j.name in names else -1 for j in way),
        torch.stack([number(j.origin) for j in way]),
        said.shapes,
        Pose(number(base), quat / quat.norm()),
        _chain(said.joints),
    )


def _limits(name: str, leader: urdf.Joint, moving: list[urdf.Joint]) -> tuple[float, float, float]:
    """Return the least and the greatest position and the greatest speed of a joint and of those that mimic it."""
    lower, upper, velocity = leader.lower, leader.upper, leader.velocity
    for joint in moving:
        if joint.mimics != leader.name or joint.factor == 0:
            continue
        ends = [(end - joint.offset) / joint.factor for end in (joint.lower, joint.upper)]
        lower, upper = max(lower, min(ends)), min(upper, max(ends))
        velocity = min(velocity, joint.velocity / abs(joint.factor))
    if lower > upper:
        raise InputError(
            f"{name}: joint {leader.name!r} and those that mimic it have limits that nowhere hold together; check "
            "their <limit>, and the sign of multiplier= in <mimic>."
        )
    return lower, upper, velocity


def panda(
    *,
    base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    base_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Robot:
    """Return a seven-joint arm of the size of the Franka Emika Panda with a parallel gripper.

    Commanded are seven joints and the opening of one finger, which the other mimics.
    """
    text = resources.files("torchdlo").joinpath("data/robots/panda.urdf").read_text(encoding="utf-8")
    return load_robot(text, tool="tool", base=base, base_quat=base_quat)


def _chain(joints: tuple[urdf.Joint, ...]) -> Any:
    """Return the chain of pytorch-kinematics.

    Its own reader is not used: it rounds angles to single precision, and stops at parts that kinematics do not need.
    """
    try:
        import pytorch_kinematics as pk
    except ImportError:
        raise InputError("robot: needs pytorch-kinematics; install it with pip install 'torchdlo[robots]'.") from None
    double = {"dtype": torch.float64}
    frames = {joints[0].parent: pk.Frame(joints[0].parent, link=pk.Link(joints[0].parent), joint=pk.Joint(**double))}
    for joint in joints:
        origin = pk.Transform3d(matrix=joint.origin)
        made = pk.Joint(joint.name, offset=origin, joint_type=joint.kind, axis=joint.axis, **double)
        frames[joint.child] = pk.Frame(joint.child, link=pk.Link(joint.child), joint=made)
        frames[joint.parent].add_child(frames[joint.child])
    return pk.Chain(frames[joints[0].parent], **double)


@functools.cache
def _placed(robot: Robot, dtype: torch.dtype, device: torch.device) -> tuple[Any, list[int], list[int]]:
    """Return the chain on a device, which joint of ours each of its joints is, and which frame each of our links is."""
    chain = copy.deepcopy(robot.chain).to(dtype=dtype, device=device)
    names = [chain.idx_to_frame[f] for f in range(len(robot.links))]
    ours = [robot.links[link] for link in robot.behind]
    theirs = [-1] * len(ours)
    for frame, joint in enumerate(chain.joint_indices.tolist()):
        if joint >= 0:
            theirs[joint] = ours.index(names[frame])
    return chain, theirs, [names.index(link) for link in robot.links]


def check_joints(robot: Robot, joints: Tensor) -> None:
    """Raise if joint positions do not fit the robot."""
    if joints.dim() < 1 or joints.shape[-1] != len(robot.joints):
        raise ValueError(
            f"{robot.name}: joint positions are {tuple(joints.shape)}; expected (..., {len(robot.joints)}) for "
            f"{', '.join(robot.joints)}"
        )


def transforms(robot: Robot, joints: Tensor) -> Tensor:
    """Return the links' transforms in the frame of the base, shape (..., L, 4, 4).

    Differentiable any number of times.
    """
    check_joints(robot, joints)
    chain, theirs, frames = _placed(robot, joints.dtype, joints.device)
    moving = joints @ robot.mix.to(joints).T + robot.shift.to(joints)
    # Its own backward pass would make second derivatives wrong without a word.
    found = chain.forward_kinematics_tensor(moving[..., theirs].reshape(-1, len(theirs)), analytical_grad=False)
    return found[frames].transpose(0, 1).reshape(*joints.shape[:-1], len(frames), 4, 4)


def poses(robot: Robot, joints: Tensor) -> Pose:
    """Return where all links are in the world: positions (..., L, 3) and orientations (..., L, 4).

    Args:
        robot: the robot.
        joints: joint positions [rad or m], shape (..., J).
    """
    found = transforms(robot, joints)
    base = Pose(robot.base.pos.to(joints), robot.base.quat.to(joints))
    return compose_poses(base, Pose(found[..., :3, 3], from_matrix(found[..., :3, :3])))


def tool_pose(robot: Robot, joints: Tensor) -> Pose:
    """Return where the tool is in the world: position (..., 3) and orientation (..., 4)."""
    found, k = poses(robot, joints), robot.links.index(robot.tool)
    return Pose(found.pos[..., k, :], found.quat[..., k, :])


def jacobian(robot: Robot, found: Tensor) -> Tensor:
    """Return how moving joints move the tool, in the frame of the base: velocity above angular velocity.

    Args:
        robot: the robot.
        found: what `transforms` returned, shape (..., L, 4, 4).

    Returns:
        Derivatives by the moving joints [m, m/rad, rad/m or 1], shape (..., 6, M); 0 for those that do not move it.
    """
    at = found[..., list(robot.behind), :, :]
    turning, tip = robot.turning.to(found)[:, None], found[..., robot.links.index(robot.tool), :3, 3]
    on = turning.new_tensor([[float(k in robot.moved)] for k in range(len(robot.behind))])
    axis = (at[..., :3, :3] @ robot.axis.to(found)[:, :, None]).squeeze(-1) * on
    arm = tip[..., None, :] - at[..., :3, 3]
    linear = turning * torch.linalg.cross(axis, arm) + (1 - turning) * axis
    return torch.cat([linear, turning * axis], -1).transpose(-1, -2)


def solids(robot: Robot, joints: Tensor, **fields: Any) -> list[RigidBody]:
    """Return a kinematic solid for every collision shape.

    Args:
        robot: the robot.
        joints: where it is at the start [rad or m], shape (..., J).
        fields: other fields of `RigidBody`, such as the coefficients of friction.
    """
    at = body_targets(robot, joints)
    return [
        RigidBody(
            shape.kind,
            shape.size,
            pos=at.pos[..., k, :],
            quat=at.quat[..., k, :],
            motion="kinematic",
            name=f"{robot.name} {shape.link} {k}",
            **fields,
        )
        for k, shape in enumerate(robot.shapes)
    ]


def body_targets(robot: Robot, joints: Tensor) -> BodyTargets:
    """Return where the solids of `solids` are, shape (..., number of shapes, 3) and (..., number of shapes, 4)."""
    found = poses(robot, joints)
    k = [robot.links.index(shape.link) for shape in robot.shapes]
    origins = torch.stack([shape.origin for shape in robot.shapes]).to(joints)
    inner = Pose(origins[:, :3, 3], from_matrix(origins[:, :3, :3]))
    at = compose_poses(Pose(found.pos[..., k, :], found.quat[..., k, :]), inner)
    return BodyTargets(at.pos, at.quat)
