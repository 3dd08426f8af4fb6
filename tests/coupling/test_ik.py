"""Inverse kinematics: how often and how well poses are reached, limits, and derivatives."""

from __future__ import annotations

import functools
import math

import pytest
import torch

pytest.importorskip("pytorch_kinematics")

from torchdlo.coupling.bodies.dynamics import turn_between
from torchdlo.coupling.common.pose import Pose
from torchdlo.coupling.robot import ik_op, inverse_kinematics
from torchdlo.coupling.robot import robot_kinematics as robot
from torchdlo.coupling.robot.inverse_kinematics import IkSearch
from torchdlo.physics import tree

F64 = torch.float64
arm = functools.cache(robot.panda)


def reachable(count: int, seed: int = 0, dtype=F64) -> tuple[torch.Tensor, Pose]:
    """Random joint positions over the whole ranges, and the poses there."""
    share = torch.rand(count, 8, generator=torch.Generator().manual_seed(seed), dtype=F64)
    q = arm().lower + (arm().upper - arm().lower) * share
    return q, tree.map(lambda x: x.to(dtype), robot.tool_pose(arm(), q))


def middle(count: int, dtype=F64) -> torch.Tensor:
    return (0.5 * (arm().lower + arm().upper)).to(dtype).expand(count, 8)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_random_poses_are_reached(dtype):
    # The bar is 98 %; 1000 poses measure a rate of 99.5 % to 0.2 % (one standard deviation).
    _, target = reachable(1000, dtype=dtype)
    found = inverse_kinematics.solve_ik(arm(), target, middle(1000, dtype), search=IkSearch(starts=8))
    assert found.joints.dtype == dtype
    assert float(found.converged.double().mean()) >= 0.98
    good = found.converged
    again = robot.tool_pose(arm(), found.joints)
    assert float((again.pos - target.pos).norm(dim=-1)[good].max()) <= 1e-4 * 1.01
    assert float(turn_between(again.quat, target.quat).norm(dim=-1)[good].max()) <= 1e-3 * 1.01
    assert (found.joints <= arm().upper.to(dtype)).all() and (found.joints >= arm().lower.to(dtype)).all()


def test_near_poses_are_reached_in_few_steps():
    q, target = reachable(300)
    noise = 0.03 * torch.randn(300, 8, generator=torch.Generator().manual_seed(1), dtype=F64)
    start = torch.minimum(torch.maximum(q + noise, arm().lower), arm().upper)
    found = inverse_kinematics.solve_ik(arm(), target, start, search=IkSearch(steps=3, polish=2))
    assert float(found.converged.double().mean()) >= 0.98


def test_batches_equal_single_poses():
    _, target = reachable(3)
    whole = inverse_kinematics.solve_ik(arm(), target, middle(1))
    for k in range(3):
        one = inverse_kinematics.solve_ik(arm(), tree.map(lambda x, k=k: x[k], target), middle(1)[0])
        # Steps are shorter than what rounding could grow by: tens of them, factors of a few.
        assert torch.allclose(whole.joints[k], one.joints, atol=1e-8)
        assert one.converged.shape == ()


def test_a_target_out_of_reach_is_reported_and_not_handed_on():
    near, far = Pose(torch.tensor([0.4, 0, 0.4], dtype=F64), torch.tensor([0.0, 1, 0, 0], dtype=F64)), 2.0
    joints, target = middle(1)[0], near
    for _ in range(5):
        # One adds to what was handed on: it stays at the edge of what the arm reaches instead of going off.
        found = inverse_kinematics.solve_ik(arm(), target, joints)
        joints = found.joints
        target = Pose(found.handed.pos + torch.tensor([far / 5, 0, 0], dtype=F64), found.handed.quat)
    assert not bool(found.converged)
    assert torch.equal(found.handed.pos, found.pose.pos)
    assert float(found.pose.pos.norm()) < 1.3
    assert torch.isfinite(found.joints).all()
    inside = inverse_kinematics.solve_ik(arm(), near, joints, search=IkSearch(steps=40))
    assert bool(inside.converged) and torch.equal(inside.handed.pos, near.pos)


def test_the_answer_does_not_depend_on_the_way_there():
    # A closed path of the tool is one of the joints, too.
    down = torch.tensor([0.0, 1, 0, 0], dtype=F64)
    angle = torch.linspace(0, 2 * torch.pi, 9, dtype=F64)[:, None]
    path = torch.tensor([0.45, 0.0, 0.4], dtype=F64) + 0.1 * torch.cat(
        [torch.cos(angle), torch.sin(angle), 0.3 * torch.sin(angle)], -1
    )
    joints, first = (
        inverse_kinematics.solve_ik(
            arm(), Pose(path[0], down), middle(1)[0], search=IkSearch(steps=60, polish=8)
        ).joints,
        None,
    )
    for pos in path:
        found = inverse_kinematics.solve_ik(arm(), Pose(pos, down), joints)
        assert bool(found.settled)
        joints, first = found.joints, found.joints if first is None else first
    assert torch.allclose(joints, first, atol=1e-6)


def test_joints_go_no_further_than_their_speeds_allow():
    _, target = reachable(20)
    found = inverse_kinematics.solve_ik(arm(), target, middle(20), within_time=0.02)
    # Joints that may not go far are looked for from where they are, and no longer.
    one = inverse_kinematics.solve_ik(arm(), target, middle(20), within_time=0.02, search=IkSearch())
    assert torch.equal(found.joints, one.joints)
    assert ((found.joints - middle(20)).abs() <= arm().velocity * 0.02 * (1 + 1e-12)).all()
    assert not found.converged.all()


def test_fingers_stay_where_they_are():
    _, target = reachable(2)
    start = middle(2).clone()
    start[:, 7] = 0.013
    assert (inverse_kinematics.solve_ik(arm(), target, start).joints[:, 7] == 0.013).all()


def settled_poses(count: int) -> tuple[Pose, torch.Tensor]:
    """Poses at which the posture is settled, with one joint at a limit in some, and starts near the answers."""
    _, target = reachable(60, seed=4)
    found = inverse_kinematics.solve_ik(arm(), target, middle(60), search=IkSearch(steps=60, polish=10))
    some = found.settled.nonzero()[:count, 0]
    assert len(some) == count
    return tree.map(lambda x: x[some], target), found.joints[some]


def turned(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    from torchdlo.coupling.bodies.dynamics import turn_by
    from torchdlo.physics.linalg.rotation import multiply

    return multiply(turn_by(vector), quat)


def test_derivatives_by_the_target_are_those_of_differences():
    target, start = settled_poses(12)
    weight = torch.randn(12, 8, generator=torch.Generator().manual_seed(2), dtype=F64)
    search = IkSearch(steps=6, polish=6)

    def joints(shift):
        moved = Pose(target.pos + shift[:, :3], turned(target.quat, shift[:, 3:]))
        return inverse_kinematics.solve_ik(arm(), moved, start, search=search).joints

    shift = torch.zeros(12, 6, dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad((weight * joints(shift)).sum(), shift)
    h = 1e-5
    with torch.no_grad():
        for k in range(6):
            step = torch.zeros(12, 6, dtype=F64)
            step[:, k] = h
            wanted = (weight * (joints(step) - joints(-step))).sum(-1) / (2 * h)
            # Central differences: h^2 times third derivatives of some 1e2 to 1e4 near singular postures.
            scale = found.abs().amax(-1)
            assert ((found[:, k] - wanted).abs() <= 1e-4 * scale).all(), k


def test_second_derivatives_are_refused_and_not_wrong():
    target, start = settled_poses(1)
    pos = target.pos.clone().requires_grad_()
    found = inverse_kinematics.solve_ik(arm(), Pose(pos, target.quat), start).joints
    (first,) = torch.autograd.grad(found.square().sum(), pos, create_graph=True)
    with pytest.raises(RuntimeError):
        torch.autograd.grad(first.sum(), pos)


def test_gradients_are_finite_where_the_target_is_out_of_reach():
    pos = torch.tensor([2.0, 0, 0.3], dtype=F64, requires_grad=True)
    found = inverse_kinematics.solve_ik(arm(), Pose(pos, torch.tensor([0.0, 1, 0, 0], dtype=F64)), middle(1)[0])
    (gradient,) = torch.autograd.grad(found.joints.sum() + found.handed.pos.sum(), pos)
    assert torch.isfinite(gradient).all()


def test_joints_at_their_limits_leave_single_precision_all_its_digits():
    # Five free joints make a singular matrix, which had random digits in single precision, and sometimes no inverse:
    # so at the first of these poses, a turn of the wrist away from where the arm is.
    search, limits = IkSearch(steps=4, closing=2, polish=2), [0, 6]
    posture = torch.tensor([1.56, -0.72, -0.02, -2.09, 0.04, 1.33, 2.4, 0.0])
    start = reachable(200)[0].float()
    start[:, limits] = arm().upper[limits].float()
    start[0] = torch.tensor([2.8973, 0.33648232, -0.38172328, -2.3516445, 0.43148533, 2.6547818, 2.8972995, 0.0])
    target = tree.map(lambda x: x.float(), robot.tool_pose(arm(), start))
    target = Pose(target.pos + 0.02 * torch.randn(200, 3, generator=torch.Generator().manual_seed(3)), target.quat)
    target.pos[0] = torch.tensor([-0.40955785, 0.30928865, 0.09328924])
    target.quat[0] = torch.tensor([0.02178209, 0.99901599, 0.02058091, -0.03269737])
    found = inverse_kinematics.solve_ik(arm(), target, start, search=search, posture=posture)
    wanted = inverse_kinematics.solve_ik(
        arm(), tree.map(torch.Tensor.double, target), start.double(), search=search, posture=posture
    )
    assert bool(found.converged[0]) and 0 < int(found.converged.sum()) < 200
    assert torch.equal(found.joints, wanted.joints.float())


LIMITS = (2.96706, 2.0944, 2.96706, 2.0944, 2.96706, 2.0944, 3.05433)
OFFSETS = ("0 0 0.1575", "0 0 0.2025", "0 0.2045 0", "0 0 0.2155", "0 0.1845 0", "0 0 0.2155", "0 0.081 0")
TURNS = ("0 0 0", "{q} 0 {p}", "{q} 0 {p}", "{q} 0 0", "-{q} {p} 0", "{q} 0 0", "-{q} {p} 0")


@functools.cache
def iiwa14() -> robot.Robot:
    """KUKA's LBR iiwa 14 by its published lengths and limits, without shapes."""
    links = "".join(f'<link name="l{k}"/>' for k in range(8))
    joints = ""
    for k, (limit, offset, turn) in enumerate(zip(LIMITS, OFFSETS, TURNS, strict=True)):
        turn = turn.format(p=math.pi, q=math.pi / 2)
        joints += (
            f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="{offset}" rpy="{turn}"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" effort="100" velocity="1.5"/></joint>'
        )
    return robot.load_robot(f'<robot name="iiwa14">{links}{joints}</robot>')


@pytest.mark.parametrize("position_only", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("make", [arm, iiwa14])
def test_all_of_a_hundred_reachable_poses_are_reached_and_settle_by_default(make, position_only):
    # From the middle of the ranges, one start brings 89 of them there and settles a third.
    chain = make()
    share = torch.rand(100, len(chain.joints), generator=torch.Generator().manual_seed(7), dtype=F64)
    target = robot.tool_pose(chain, chain.lower + (chain.upper - chain.lower) * share)
    start = (0.5 * (chain.lower + chain.upper)).expand(100, -1)
    found = inverse_kinematics.solve_ik(chain, target, start, position_only=position_only)
    assert bool(found.converged.all()) and (position_only or bool(found.settled.all()))
    there = robot.tool_pose(chain, found.joints)
    assert float((there.pos - target.pos).norm(dim=-1).max()) <= 1.01e-4
    if not position_only:
        assert float(turn_between(there.quat, target.quat).norm(dim=-1).max()) <= 1.01e-3
    assert torch.equal(found.handed.pos, target.pos)


@pytest.mark.parametrize("choices", [{}, {"position_only": True}, {"within_time": 0.02}], ids=str)
def test_the_kernel_gives_what_tensor_operations_give(choices, monkeypatch):
    if not ik_op.ready("cpu", F64):
        pytest.skip("needs a C++ compiler")
    # Stretched arms, whose joints answer to anything, are left out.
    start = 0.5 * (reachable(50)[0] + middle(50))
    target = robot.tool_pose(arm(), start)
    quat = torch.nn.functional.normalize(target.quat + 0.02, dim=-1)
    moved = [x.requires_grad_() for x in (target.pos + 0.02, quat)]
    weight = torch.randn(50, 8, generator=torch.Generator().manual_seed(5), dtype=F64)

    def found() -> list[torch.Tensor]:
        search = IkSearch(steps=4, closing=2, polish=2, starts=2)
        there = inverse_kinematics.solve_ik(arm(), Pose(*moved), start, search=search, **choices)
        loss = (weight * there.joints).sum() + (weight[:, :3] * there.pose.pos).sum() + there.pose.quat[:, 0].sum()
        return [*tree.leaves(there), *torch.autograd.grad(loss, moved, allow_unused=True)]

    fast = found()
    monkeypatch.setattr(ik_op, "ready", lambda *_: False)
    for one, other in zip(fast, found(), strict=True):
        off = 0.0 if one is None and other is None else float((one.double() - other.double()).detach().abs().max())
        assert off < 1e-9, off


def test_the_pose_follows_the_joints_as_forward_kinematics_say():
    _, start = settled_poses(6)
    made = robot.panda(base=(0.1, -0.2, 0.3), base_quat=(0.8, 0.0, 0.0, 0.6))
    there = robot.tool_pose(made, start)
    pos, weight = (there.pos + 0.01).requires_grad_(), torch.randn(6, 7, dtype=F64)
    found = inverse_kinematics.solve_ik(made, Pose(pos, there.quat), start)
    again = robot.tool_pose(made, found.joints)
    for pose in (found.pose, again):
        assert torch.allclose(pose.pos, again.pos, atol=1e-12) and torch.allclose(pose.quat, again.quat, atol=1e-12)
    one, other = (
        torch.autograd.grad((weight * torch.cat([p.pos, p.quat], -1)).sum(), pos, retain_graph=True)[0]
        for p in (found.pose, again)
    )
    assert torch.allclose(one, other, rtol=1e-9, atol=1e-12)
