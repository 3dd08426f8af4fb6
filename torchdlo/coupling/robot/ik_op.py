"""Inverse kinematics as a C++ kernel, pose by pose: all steps of a search, and what its answer's derivative is made of.

The formulas stand in `inverse_kinematics`, as tensor operations; these are used where there is no C++ compiler. Of a
few poses they take some tens of milliseconds, and the kernel some tens of microseconds. Poses on a GPU are brought to
the CPU and the answers back, once per search.
"""

from __future__ import annotations

import ctypes
import functools

import torch
from torch import Tensor

from torchdlo.coupling.common import scene_packing
from torchdlo.coupling.robot.robot_kinematics import Robot

_function, _ready = scene_packing.kernel("ik", "inverse kinematics")


def ready(device: str, dtype: torch.dtype) -> bool:
    """Return whether the kernel works for tensors of a kind of device and a dtype."""
    return _ready("cpu" if device == "cuda" else device, dtype)


class _Chain(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("count", "moving", "joints", "turns")),
        *((name, ctypes.c_void_p) for name in ("mover", "origin", "turning", "axis", "mix", "shift", "give")),
        *((name, ctypes.c_double) for name in ("lever", "still")),
    )


class _Search(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in ("steps", "closing", "polish")),
        *((name, ctypes.c_double) for name in ("pull", "stride", "near", "aligned")),
    )


@functools.cache
def _parts(robot: Robot) -> tuple[Tensor, ...]:
    """Return what the kernel reads of a robot, in its order."""
    origins = torch.cat([robot.origins[:, :3, :3].flatten(1), robot.origins[:, :3, 3]], -1)
    numbers = origins, robot.turning, robot.axis, robot.mix, robot.shift
    return torch.tensor(robot.path), *(x.contiguous() for x in numbers)


def solve(
    robot: Robot,
    give: Tensor,
    turns: bool,
    scales: tuple[float, float],
    search: tuple[tuple[int, int, int], tuple[float, float, float, float]],
    given: tuple[Tensor, ...],
) -> tuple[Tensor, ...]:
    """Return joint positions after the steps of a search, and what is known there.

    Args:
        robot: the robot.
        give: squared halves of the joints' ranges [rad^2 or m^2], shape (J,).
        turns: whether the orientation of the target counts.
        scales: `LEVER` and `STILL`.
        search: `steps`, `closing`, `polish`, and `pull`, `stride`, `near`, `aligned` of `IkSearch`.
        given: the tool's positions [m] and orientations [1], (B, 3) and (B, 4), the posture, least and greatest
            positions, (B or 1, J), and positions to start from [rad or m], shape (B, J).

    Returns:
        Joint positions [rad or m], (B, J), position [m] and orientation [1] of the tool, (B, 3) and (B, 4), how far the
        next Newton step goes [rad or m], (B,), how the tool moves with the joints, turns times `LEVER` [-, m],
        (B, 6, J), and how that step follows the error, (B, J, 6).
    """
    device = given[-1].device
    if device.type != "cpu":
        # In one piece there and back: each copy waits for the device.
        rows = torch.cat([x.detach().expand(len(given[-1]), -1) for x in given], -1).cpu()
        given, give = rows.split([x.shape[-1] for x in given], -1), give.cpu()
    pos, quat, posture, lower, upper, start = (x.detach() for x in given)
    joints, n = start.clone(memory_format=torch.contiguous_format), start.shape[-1]
    target = torch.cat([pos, quat], -1)
    fixed = [x.expand_as(joints).contiguous() for x in (posture, lower, upper)]
    out, give, parts = joints.new_empty(len(joints), 8 + 12 * n), give.contiguous(), _parts(robot)
    at = [x.data_ptr() for x in (*parts, give)]
    chain = _Chain(len(robot.path), len(robot.behind), n, turns, *at, *scales)
    _function("solve", torch.float64)(
        ctypes.byref(chain),
        ctypes.byref(_Search(*search[0], *search[1])),
        *(ctypes.c_void_p(x.data_ptr()) for x in (target, *fixed, joints, out)),
        ctypes.c_int64(len(joints)),
        torch.get_num_threads(),
    )
    if device.type != "cpu":
        joints, out = torch.cat([joints, out], -1).to(device).split((n, out.shape[-1]), -1)
    tip, quat, left, slope, matrix = out.split((3, 4, 1, 6 * n, 6 * n), -1)
    return joints, tip, quat, left[:, 0], slope.unflatten(-1, (6, n)), matrix.unflatten(-1, (n, 6))
