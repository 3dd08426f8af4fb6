"""Inverse kinematics: joint positions that bring the tool to a pose, in batches, with gradients.

Wanted are the joint positions q nearest to a posture p, in units of half the joints' ranges, at which the tool has its
pose: min (q - p)^T D (q - p) / 2 with e(q) = 0 and lower <= q <= upper, e the error of the pose. So the answer does not
depend on the way there, but for the choice among separate solutions, and redundant arms do not drift.

1.  Damped steps of Gauss and Newton: dq = a + D^-1 J^T (J D^-1 J^T + m)^-1 (e - J a), a part of the way to the posture.
    The damping m = |e|^2 / 2 + const (Sugihara 2011, doi:10.1109/TRO.2011.2148230) needs no trial steps and is good for
    targets out of reach. Joints at a limit that would go beyond it are left where they are.
2.  A few Newton steps for the same problem with its second derivatives: they settle the posture.
3.  What is not there, or not settled, may begin again from other postures, with more steps (`IkSearch.restarts`).
4.  One more Newton step is the only one with a graph: it puts the derivative of the implicit function theorem on the
    answer. The derivative by the target is exact where the tool is there and the posture is settled; it is one-sided
    where a joint just reaches a limit. Second derivatives are refused.

All of it is done in double precision. Where an arm is stretched, or two of seven joints are at a limit, J D^-1 J^T is
singular but for m, and single precision has no digits for that. Results have the precision of the start.

The second derivatives of a chain are products of the columns of its Jacobian: for joint j before i, the velocity v_i
and the angular velocity w_i of joint i change by w_j x v_i and w_j x w_i per unit of joint j.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import turn_between
from torchdlo.coupling.common.pose import Pose, compose_poses, from_matrix, relative_pose
from torchdlo.coupling.robot import ik_op
from torchdlo.coupling.robot.robot_kinematics import Robot, check_joints, jacobian, tool_pose, transforms
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import multiply

LEVER = 0.3
"""How many metres of error a radian counts as [m/rad]."""
STILL = 1e-9
"""Damping that stays when the tool is there [m^2]."""
SEEDS = 8
"""Starts of a restart."""
_RESTARTS = 16
"""Restarts where nothing is said and joints may go anywhere."""


@dataclass(frozen=True)
class IkSearch:
    """How hard to look; static."""

    steps: int = 20
    """Damped steps."""
    closing: int = 4
    """Damped steps after them that do not pull to the posture."""
    polish: int = 4
    """Newton steps after them."""
    starts: int = 1
    """Postures from which to start, spread over the joints' ranges after the given one; the best answer counts."""
    restarts: int = 0
    """How often what is not there and settled begins again with more steps, first where it is, then from `SEEDS` other
    starts each time; of positions alone, what is not there."""
    pull: float = 0.05
    """Most that a joint is pulled to the posture in a step, over half its range."""
    stride: float = 0.5
    """Most that a joint moves in a step, over half its range."""
    near: float = 1e-4
    """Error of the position at which the tool counts as there [m]."""
    aligned: float = 1e-3
    """Error of the orientation at which it does [rad]."""


@tree.struct
class Solution:
    """Where the joints have to be, and how near that brings the tool."""

    joints: Tensor
    """Joint positions [rad or m], shape (..., J)."""
    pose: Pose
    """The pose of the tool there, in the world."""
    handed: Pose
    """What further motion is to be added to: the target where it was reached, else the pose that was."""
    missing: Tensor
    """Errors of position [m] and orientation [rad], shape (..., 2)."""
    converged: Tensor
    """Whether both are small enough [-], bool, shape (...)."""
    settled: Tensor
    """Whether the posture is at rest too, so that gradients are exact [-], bool, shape (...)."""


@dataclass(frozen=True)
class _Problem:
    """A target in the frame of the base, with what joints may do; batches are flat."""

    robot: Robot
    target: Pose
    posture: Tensor
    """Where joints would like to be [rad or m], shape (B or 1, J)."""
    give: Tensor
    """Squared halves of the joints' ranges [rad^2 or m^2], 0 for joints that do not move the tool, shape (J,)."""
    lower: Tensor
    """Least positions [rad or m], shape (B or 1, J)."""
    upper: Tensor
    """Greatest positions [rad or m], shape (B or 1, J)."""
    turns: bool = True
    """Whether the orientation of the target counts."""


@tree.struct
class _Here:
    """The problem at joint positions."""

    error: Tensor
    """What is missing to the target, orientations times `LEVER` [m], shape (B, 6)."""
    slope: Tensor
    """How moving joints change the tool's pose, rotations times `LEVER` [-, m], shape (B, 6, M)."""
    tip: Pose
    """The pose of the tool, (B, 3) and (B, 4)."""


@tree.struct
class _End:
    """Where a search ends."""

    joints: Tensor
    """Joint positions [rad or m], shape (B, J)."""
    tip: Pose
    """The pose of the tool, (B, 3) and (B, 4)."""
    left: Tensor
    """How far the next Newton step goes [rad or m], shape (B,)."""
    slope: Tensor
    """How commanded joints change the tool's pose, rotations times `LEVER` [-, m], shape (B, 6, J)."""
    matrix: Tensor
    """How the next Newton step follows the error [1/m or -], shape (B, J, 6)."""


class _Answer(torch.autograd.Function):
    """Multiply a vector by a matrix whose own derivative does not count; refuses second derivatives."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, error: Tensor) -> Tensor:
        ctx.save_for_backward(matrix)
        return (matrix @ error.unsqueeze(-1)).squeeze(-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:
        (matrix,) = ctx.saved_tensors
        return None, (matrix.transpose(-1, -2) @ gradient.unsqueeze(-1)).squeeze(-1)


def _error(problem: _Problem, tip: Pose) -> Tensor:
    """Return what is missing to the target, orientations times `LEVER` [m], shape (B, 6)."""
    turn = LEVER * turn_between(tip.quat, problem.target.quat)
    return torch.cat([problem.target.pos - tip.pos, turn if problem.turns else 0 * turn], -1)


def _look(problem: _Problem, joints: Tensor) -> _Here:
    robot = problem.robot
    found = transforms(robot, joints)
    at = found[..., robot.links.index(robot.tool), :, :]
    tip = Pose(at[..., :3, 3], from_matrix(at[..., :3, :3]))
    scale = at.new_tensor([1.0] * 3 + [LEVER * problem.turns] * 3)
    return _Here(_error(problem, tip), jacobian(robot, found) * scale[:, None], tip)


def _stopped(problem: _Problem, joints: Tensor, change: Tensor) -> Tensor:
    """Return which joints are at a limit and would go beyond it, bool, shape (B, J)."""
    rounding = 1e3 * torch.finfo(joints.dtype).eps * problem.give.sqrt()
    below, above = joints <= problem.lower + rounding, joints >= problem.upper - rounding
    return (below & (change < 0)) | (above & (change > 0))


def _inverse(slope: Tensor, give: Tensor, damping: Tensor) -> Tensor:
    """Return (J G J^T + m)^-1, shape (B, 6, 6)."""
    square = (slope * give[..., None, :]) @ slope.transpose(-1, -2)
    # A singular pose does not settle, and must not stop the others.
    eye = torch.eye(6, dtype=slope.dtype, device=slope.device)
    return torch.linalg.inv_ex(square + damping[..., None] * eye).inverse


def _damping(here: _Here, give: Tensor) -> Tensor:
    """Return the damping of a step, shape (B, 1)."""
    return (0.5 * here.error.square().sum(-1, keepdim=True) + STILL) * give.mean()


def _damped(problem: _Problem, joints: Tensor, pull: float, stride: float) -> Tensor:
    """Return the change of joint positions in a damped step, shape (B, J)."""
    robot, here = problem.robot, _look(problem, joints)
    slope = here.slope @ robot.mix.to(joints)
    wish = _limited(problem, 0.5 * (problem.posture - joints) * (problem.give > 0), pull)
    give = problem.give.expand_as(joints)
    damping = _damping(here, problem.give)

    def solve(wish: Tensor, give: Tensor) -> Tensor:
        left = here.error - (slope @ wish.unsqueeze(-1)).squeeze(-1)
        pushed = _inverse(slope, give, damping) @ left.unsqueeze(-1)
        return wish + give * (slope.transpose(-1, -2) @ pushed).squeeze(-1)

    held = _stopped(problem, joints, solve(wish, give))
    return _limited(problem, solve(wish * ~held, give * ~held), stride)


def _bounded(problem: _Problem, joints: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(joints, problem.lower), problem.upper)


def _limited(problem: _Problem, change: Tensor, stride: float) -> Tensor:
    """Return a change that moves no joint further than `stride` halves of its range, shape (B, J)."""
    half = problem.give.sqrt()
    most = (change.abs() / torch.where(half > 0, half, 1.0)).amax(-1, keepdim=True)
    return change * (stride / most.clamp(min=stride)) if stride > 0 else torch.zeros_like(change)


def _bending(robot: Robot, slope: Tensor, force: Tensor) -> Tensor:
    """Return the derivative of J^T f by the joints for a fixed f, shape (B, J, J).

    Args:
        robot: the robot.
        slope: J of the moving joints with rotations times `LEVER`, shape (B, 6, M).
        force: f, shape (B, 6).
    """
    v, w = slope[:, :3].transpose(-1, -2), slope[:, 3:].transpose(-1, -2) / LEVER
    across = torch.linalg.cross(force[:, None, :3].expand_as(w), w)
    linear = across @ v.transpose(-1, -2)
    about = torch.linalg.cross(LEVER * force[:, None, 3:].expand_as(w), w) @ w.transpose(-1, -2)
    # Rows: whose column changes; columns: by which joint. Moving joints are listed from the base outwards.
    change = linear.triu() + linear.triu(1).transpose(-1, -2) + about.triu(1).transpose(-1, -2)
    mix = robot.mix.to(slope)
    return mix.T @ change @ mix


def _newton(problem: _Problem, joints: Tensor, here: _Here) -> tuple[Tensor, Tensor]:
    """Return the parts of a Newton step dq = r + G e: r (B, J) and G (B, J, 6)."""
    n, used = joints.shape[-1], problem.give > 0
    slope, damping = here.slope @ problem.robot.mix.to(joints), _damping(here, problem.give)
    stiff = torch.where(used, 1 / torch.where(used, problem.give, 1.0), 1.0)

    def parts(held: Tensor) -> tuple[Tensor, Tensor]:
        free = (~held).to(joints.dtype) * used
        give, wish = problem.give * free, (problem.posture - joints) * free
        # At the answer D (q - p) + J^T f = 0 for some f.
        force = (_inverse(slope, give, damping) @ (slope @ wish.unsqueeze(-1))).squeeze(-1)
        curved = torch.diag_embed(stiff.expand_as(joints)) + _bending(problem.robot, here.slope, force)
        both = free[:, :, None] * free[:, None, :]
        matrix = curved * both + torch.diag_embed(1 - free)
        on = slope * free[:, None, :]
        low = torch.diag_embed(-damping.expand(-1, 6))
        whole = torch.cat([torch.cat([matrix, on.transpose(-1, -2)], -1), torch.cat([on, low], -1)], -2)
        inverse = torch.linalg.inv_ex(whole).inverse[:, :n]
        pull = stiff * wish - (on.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1)
        return (inverse[..., :n] @ pull.unsqueeze(-1)).squeeze(-1), inverse[..., n:]

    rest, matrix = parts(torch.zeros_like(joints, dtype=torch.bool))
    change = rest + (matrix @ here.error.unsqueeze(-1)).squeeze(-1)
    return parts(_stopped(problem, joints, change))


def _by_kernel(problem: _Problem, joints: Tensor, search: IkSearch) -> _End:
    """Return where all steps lead, and what is known there, by the kernel."""
    target, counts = problem.target, (search.steps, search.closing, search.polish)
    sizes = search.pull, search.stride, search.near, search.aligned
    given = target.pos, target.quat, problem.posture, problem.lower, problem.upper, joints
    found = ik_op.solve(problem.robot, problem.give, problem.turns, (LEVER, STILL), (counts, sizes), given)
    return _End(found[0], Pose(found[1], found[2]), *found[3:])


def _ended(problem: _Problem, joints: Tensor, search: IkSearch) -> _End:
    """Return where all steps lead, and what is known there."""
    if ik_op.ready(joints.device.type, joints.dtype):
        return _by_kernel(problem, joints, search)
    joints = _descend(problem, joints, search)
    here = _look(problem, joints)
    return _End(joints, here.tip, *_left(problem, joints, here))


def _descend(problem: _Problem, joints: Tensor, search: IkSearch) -> Tensor:
    """Return joint positions after all steps, shape (B, J)."""
    if ik_op.ready(joints.device.type, joints.dtype):
        return _by_kernel(problem, joints, search).joints
    for pull in [search.pull] * search.steps + [0.0] * search.closing:
        joints = _bounded(problem, joints + _damped(problem, joints, pull, search.stride))
    here = _look(problem, joints)
    for _ in range(search.polish):
        rest, matrix = _newton(problem, joints, here)
        change = rest + (matrix @ here.error.unsqueeze(-1)).squeeze(-1)
        there = _bounded(problem, joints + _limited(problem, change, 2 * search.pull))
        # Where the problem is not convex a Newton step may lead away: it counts only if the tool stays.
        seen = _look(problem, there)
        good = _reached(_missing(seen.error), search) | (seen.error.norm(dim=-1) < here.error.norm(dim=-1))
        joints, here = tree.where(good, (there, seen), (joints, here))
    return joints


def _spread(problem: _Problem, start: Tensor, count: int, before: int = 0) -> Tensor:
    """Return `count` starts: the given one, then others spread evenly over the joints' ranges, (count B, J).

    `before` of these others are left out.
    """
    roots = start.new_tensor([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0]).sqrt()
    n = start.shape[-1]
    roots = roots.repeat(-(-n // len(roots)))[:n]
    share = torch.arange(1 + before, count + before, dtype=start.dtype, device=start.device)
    share = torch.frac(share[:, None] * roots)
    half = problem.give.sqrt()
    others = problem.posture[:1] + (2 * share - 1) * half
    others = torch.where(half > 0, others[:, None, :], start)
    whole = torch.cat([start[None], others.expand(count - 1, *start.shape)])
    return _bounded(problem, whole).reshape(-1, n)


def _best(problem: _Problem, found: Tensor, search: IkSearch, settled: bool = False) -> Tensor:
    """Return of several answers (S, B, J) the one that is there and nearest to the posture, or else nearest to it.

    With `settled`, one that is at rest comes before one that is not.
    """
    repeated = _repeated(problem, len(found))
    here = _look(repeated, found.flatten(0, 1))
    missing = _missing(here.error).reshape(*found.shape[:2], 2)
    there = _reached(missing, search)
    used = problem.give > 0
    far = ((found - problem.posture).square() / torch.where(used, problem.give, 1.0) * used).sum(-1)
    if settled:
        moves = ~_still(_left(repeated, found.flatten(0, 1), here)[0])
        far = far + 1e3 * moves.reshape(far.shape)
    cost = torch.where(there, far, 1e6 * (1 + missing[..., 0] + LEVER * missing[..., 1]))
    return torch.take_along_dim(found, cost.argmin(0)[None, :, None], 0)[0]


def _left(problem: _Problem, joints: Tensor, here: _Here) -> tuple[Tensor, Tensor, Tensor]:
    """Return `left`, `slope` and `matrix` of `_End`."""
    rest, matrix = _newton(problem, joints, here)
    left = (rest + (matrix @ here.error.unsqueeze(-1)).squeeze(-1)).abs().amax(-1)
    return left, here.slope @ problem.robot.mix.to(joints), matrix


def _still(left: Tensor) -> Tensor:
    """Return whether a posture is settled, bool: the next Newton step would find the digits that are missing."""
    return left < torch.finfo(left.dtype).eps ** 0.5 * 100


def _restarted(problem: _Problem, start: Tensor, joints: Tensor, search: IkSearch) -> Tensor:
    """Return joint positions (B, J) of which those that are not there and settled have begun again, time after time."""
    longer = {name: 5 * getattr(search, name) for name in ("closing", "polish")}
    patient = dataclasses.replace(search, steps=2 * search.steps, **longer)
    for again in range(search.restarts):
        here = _look(problem, joints)
        done = _reached(_missing(here.error), search)
        if problem.turns:  # where the tool may turn, postures seldom settle
            done = done & _still(_left(problem, joints, here)[0])
        rows = (~done).nonzero()[:, 0]
        if not len(rows):
            break

        def cut(x: Tensor, rows: Tensor = rows) -> Tensor:
            return x if len(x) == 1 else x[rows]

        part = dataclasses.replace(
            problem,
            target=tree.map(cut, problem.target),
            posture=cut(problem.posture),
            lower=cut(problem.lower),
            upper=cut(problem.upper),
        )
        # More steps from where it was may be all that it lacks.
        count, here_or_there = (1, joints) if again == 0 else (SEEDS, start)
        begin = _spread(part, here_or_there[rows], count, max(0, again - 1) * SEEDS)
        found = _descend(_repeated(part, count), begin, patient).reshape(count, len(rows), -1)
        best = _best(part, torch.cat([joints[None, rows], found]), search, settled=True)
        joints = joints.index_copy(0, rows, best)
    return joints


def _missing(error: Tensor) -> Tensor:
    """Return errors of position [m] and orientation [rad], shape (..., 2)."""
    return torch.cat([safe_norm(error[..., :3]), safe_norm(error[..., 3:]) / LEVER], -1)


def _reached(missing: Tensor, search: IkSearch) -> Tensor:
    return (missing[..., 0] <= search.near) & (missing[..., 1] <= search.aligned)


def _repeated(problem: _Problem, count: int) -> _Problem:
    """Return the problem for `count` starts of each scene, one after the other."""
    if count == 1:
        return problem
    target = tree.map(lambda x: x.repeat(count, 1), problem.target)
    bounds = {name: getattr(problem, name).repeat(count, 1) for name in ("posture", "lower", "upper")}
    return dataclasses.replace(problem, target=target, **bounds)


def solve_ik(
    robot: Robot,
    target: Pose,
    start: Tensor,
    *,
    search: IkSearch | None = None,
    posture: Tensor | None = None,
    within_time: float | None = None,
    position_only: bool = False,
) -> Solution:
    """Return joint positions that bring the tool to a pose.

    Nothing here raises because a target is out of reach: the tool then comes as near as it can, `converged` says so,
    and `handed` is the pose that it has.

    Args:
        robot: the robot.
        target: the wanted pose of the tool in the world, shapes (..., 3) and (..., 4).
        start: joint positions to start from [rad or m], shape (..., J); joints that do not move the tool stay there.
        search: how hard to look. If not given, what is not there and settled begins again up to 16 times, from other
            postures, too, which may lead to another branch and takes 0.1 s out of reach; for paths, and with
            `within_time`, one start is right: `IkSearch()`.
        posture: where joints would like to be [rad or m], shape (..., J); the middle of their ranges if not given.
        within_time: if given, joints go no further than their greatest speeds allow in that time [s].
        position_only: whether the tool may be turned in any way; the orientation of the target is not looked at then,
            postures seldom settle, and derivatives are not to be relied on.
    """
    check_joints(robot, start)
    if search is None:
        search = IkSearch() if within_time is not None else IkSearch(restarts=_RESTARTS)
    given = start.dtype
    problem, start, batch = _pose(robot, target, start, posture, within_time)
    problem = dataclasses.replace(problem, turns=not position_only)
    with torch.no_grad():
        end = _found(dataclasses.replace(problem, target=tree.detach(problem.target)), start, search)
    error = _error(problem, end.tip)
    # The values of both changes are 0: the answer stays within the limits.
    change = _Answer.apply(end.matrix, error - error.detach())
    joints = (end.joints + change).reshape(*batch, -1)
    if position_only:
        pose = tool_pose(robot, joints)
    else:
        pose = tree.map(lambda x: x.reshape(*batch, -1), compose_poses(_base(robot, start), _moved(end, change)))
    missing = _missing(error.detach()).reshape(*batch, 2)
    there = _reached(missing, search)
    settled = there & _still(end.left.reshape(batch))
    joints, missing, pose = tree.map(lambda x: x.to(given), (joints, missing, pose))
    wanted = tree.map(lambda x: x.expand(*batch, x.shape[-1]).to(given), target)
    wanted = Pose(wanted.pos, pose.quat) if position_only else wanted
    return Solution(joints, pose, tree.where(there, wanted, pose), missing, there, settled)


def _found(problem: _Problem, start: Tensor, search: IkSearch) -> _End:
    """Return where the best of all starts, or of those that begin again, leads."""
    if search.starts == 1 and not search.restarts:
        return _ended(problem, start, search)
    many = _repeated(problem, search.starts)
    found = _descend(many, _spread(problem, start, search.starts), search)
    joints = _best(problem, found.reshape(search.starts, *start.shape), search)
    joints = _restarted(problem, start, joints, search)
    return _ended(problem, joints, dataclasses.replace(search, steps=0, closing=0, polish=0))


def _moved(end: _End, change: Tensor) -> Pose:
    """Return the pose of the tool with the derivative that small changes of the joints (B, J) give it."""
    if not change.requires_grad:
        return end.tip
    far, turn = _Answer.apply(end.slope, change).split(3, -1)
    spin = torch.cat([0 * turn[..., :1], 0.5 / LEVER * turn], -1)
    return Pose(end.tip.pos + far, end.tip.quat + multiply(spin, end.tip.quat))


def _base(robot: Robot, like: Tensor) -> Pose:
    return tree.map(lambda x: x.to(like), robot.base)


def _pose(
    robot: Robot, target: Pose, start: Tensor, posture: Tensor | None, within_time: float | None
) -> tuple[_Problem, Tensor, tuple[int, ...]]:
    """Return the problem and the start with flat batches, in double precision, and the batch."""
    start = start.detach().double()
    lower, upper = robot.lower.to(start), robot.upper.to(start)
    low, high = lower.clamp(min=-torch.pi), upper.clamp(max=torch.pi)
    on = start.new_tensor([float(k in robot.arm) for k in range(len(robot.joints))])
    posture = 0.5 * (low + high) if posture is None else posture.to(start)
    batch = torch.broadcast_shapes(target.pos.shape[:-1], target.quat.shape[:-1], start.shape[:-1], posture.shape[:-1])

    def flat(x: Tensor) -> Tensor:
        return x.expand(*batch, x.shape[-1]).reshape(-1, x.shape[-1])

    start = flat(start)
    lower, upper = lower.expand_as(start), upper.expand_as(start)
    if within_time is not None:
        reach = robot.velocity.to(start) * within_time
        lower, upper = torch.maximum(lower, start - reach), torch.minimum(upper, start + reach)
    seen = relative_pose(_base(robot, start), tree.map(lambda x: flat(x.to(start)), target))
    give = (0.5 * (high - low)).square() * on
    return _Problem(robot, seen, flat(posture.detach()), give, lower, upper), start, batch
