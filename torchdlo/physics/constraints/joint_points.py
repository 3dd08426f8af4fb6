"""Points of ropes that are joined to free bodies or to points of other ropes: bilateral constraints of a substep.

Each constraint says where a point is at the end of the substep: a weighted sum of vertices is a point of a body, or
nothing, so that weights of two ropes with opposite signs join them. The force acts on the rope and, the other way
round, on the body, at the place where the point of the rope is at the start of the substep: linear and angular momentum
are exact. It is found with the edge lengths, and in implicit steps with contact too, as the tensions are: Newton's
method on all of them, with the derivative of the implicit function theorem on the last step. Bodies turn by
`linalg.free_rotation`, of which the derivative is exact, so that joints hold to rounding at any speed of rotation.

A ball joint is one such point. A weld is several: a body that carries two neighbouring vertices carries their edge, and
its frame. That edge is then no part of the lengths that are solved for.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.constraints.contact_penalty import blocks
from torchdlo.physics.constraints.edge_lengths import Lengths, solve_slots
from torchdlo.physics.linalg.free_rotation import matrix, skew, spin_freely, spin_gradient
from torchdlo.physics.linalg.numerics import cross, dot, total
from torchdlo.physics.rod.topology import following, preceding


@tree.struct
class JointPoints:
    """A points that are joined, of ropes with V vertices and J free bodies."""

    weight: Tensor
    """How vertices count in the points [1], shape (A, V)."""
    on: Tensor
    """1 where a point belongs to a body [1], shape (A, J)."""
    local: Tensor
    """The points in the frames of their bodies, 0 without a body [m], shape (..., A, 3)."""
    arm: Tensor
    """From the centres of the bodies to the points at the start of the substep, likewise [m], shape (..., A, 3)."""
    pos: Tensor
    """Where centres would be without joints [m], shape (..., J, 3)."""
    quat: Tensor
    """Orientations of bodies at the start [1], shape (..., J, 4)."""
    inertia: Tensor
    """Principal moments of inertia [kg m^2], shape (..., J, 3)."""
    omega: Tensor
    """Angular velocities without joints [rad/s], shape (..., J, 3)."""
    resist: Tensor
    """How bodies resist displacements and turns [N/m, N m/rad], shape (..., J, 6, 6)."""
    force: Tensor
    """Forces of the last substep on the ropes [N], shape (..., A, 3)."""
    carries: Tensor
    """1 where a body carries the frame of an edge, W of them [1], shape (W, J)."""
    director: Tensor
    """First material directors of these edges in the frames of the bodies [1], shape (..., W, 3)."""

    @property
    def count(self) -> int:
        """How many points there are, A."""
        return self.weight.shape[0]

    @property
    def batch(self) -> torch.Size:
        """Axes of scenes."""
        two = (self.local, self.arm, self.pos, self.quat, self.inertia, self.omega, self.force)
        return torch.broadcast_shapes(*(x.shape[:-2] for x in two), self.resist.shape[:-3])

    def pulls(self, force: Tensor) -> Tensor:
        """Return what forces (..., A, 3) do to vertices, shape (..., V, 3)."""
        return self.weight.mT @ force

    def wrench(self, force: Tensor) -> Tensor:
        """Return forces and torques on bodies of forces on the ropes, shape (..., J, 6)."""
        force, arm = torch.broadcast_tensors(force, self.arm)
        return -(self.on.mT @ torch.cat([force, cross(arm, force)], -1))

    def resisted(self, moved: Tensor) -> Tensor:
        """Return forces and torques that displace and turn bodies by (..., J, 6)."""
        return (self.resist @ moved.unsqueeze(-1)).squeeze(-1)

    def _spin(self, moved: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor, float]:
        omega = self.omega + moved[..., 3:] / dt
        quat, inertia = self.quat.expand(*omega.shape[:-1], 4), self.inertia.expand(omega.shape)
        return quat, inertia, omega, dt

    def orientation(self, moved: Tensor, dt: float) -> Tensor:
        """Return orientations at the end, of bodies that are displaced and turned by (..., J, 6); (..., J, 4)."""
        return spin_freely(*self._spin(moved, dt))[0]

    def directors(self, moved: Tensor, dt: float) -> Tensor:
        """Return the first material directors at the end of edges whose frames bodies carry [1], shape (..., W, 3)."""
        if not self.carries.shape[0]:
            return self.director
        quat = self.carries @ self.orientation(moved, dt)
        return (matrix(quat) @ self.director.unsqueeze(-1)).squeeze(-1)

    def _swung(self, quat: Tensor) -> Tensor:
        return (matrix(self.on @ quat) @ self.local.unsqueeze(-1)).squeeze(-1)

    def gap(self, pos: Tensor, moved: Tensor, end: Tensor) -> Tensor:
        """Return by how far points of the ropes miss where they have to be [m], shape (..., A, 3).

        Args:
            pos: vertices at the end [m], shape (..., V, 3).
            moved: displacements and turns of bodies by joints and contact [m, rad], shape (..., J, 6).
            end: what `orientation` returns for these.
        """
        return self.weight @ pos - self.on @ (self.pos + moved[..., :3]) - self._swung(end)

    def reach(self, moved: Tensor, end: Tensor, dt: float) -> Tensor:
        """Return how points of bodies move with displacements and turns, shape (..., 3 A, 6 J)."""
        swung = self._swung(end)
        turns = torch.einsum("aj,...jcd->...acd", self.on, spin_gradient(*self._spin(moved, dt), end) / dt)
        unit = torch.eye(3, dtype=swung.dtype, device=swung.device).expand_as(turns)
        whole = torch.cat([unit, -skew(swung) @ turns], -1)
        return torch.einsum("...acd,aj->...acjd", whole, self.on).flatten(-2).flatten(-3, -2)

    def levers(self) -> Tensor:
        """Return forces and torques, the other way round, on bodies of unit forces, shape (..., 6 J, 3 A)."""
        unit = torch.eye(3, dtype=self.arm.dtype, device=self.arm.device)
        whole = torch.cat([unit.expand(*self.arm.shape, 3), skew(self.arm)], -2)
        return torch.einsum("...aic,aj->...jiac", whole, self.on).flatten(-2).flatten(-3, -2)


@tree.struct
class JointForces:
    """What joints do in a substep."""

    force: Tensor
    """Forces on the ropes [N], shape (..., A, 3)."""
    director: Tensor
    """First material directors of carried edges at the end [1], shape (..., W, 3)."""
    couple: Tensor | tuple[()] = ()
    """Torques on the edges whose frames bodies carry, about their axes [N m], shape (..., W, 1)."""


FIELDS = tuple(field.name for field in dataclasses.fields(JointPoints))


@dataclasses.dataclass(frozen=True)
class Joined:
    """What `project_joined` looks for."""

    tension: Tensor
    """Tensions [N], shape (..., V, 1)."""
    force: Tensor
    """Forces of joints on the ropes [N], shape (..., A, 3)."""
    moved: Tensor
    """By how much joints displace and turn free bodies [m, rad], shape (..., J, 6)."""


def project_joined(
    lengths: Lengths,
    moved: Tensor,
    answer: Tensor,
    direction: Tensor,
    tension: Tensor,
    joints: JointPoints,
    steps: int,
    dt: float,
) -> tuple[Tensor, Joined]:
    """Enforce lengths and joints where every vertex moves by itself; returns positions, (..., V, 3), and the forces.

    Arguments as in `edge_lengths.project`. The tridiagonal system of tensions has a border of three unknowns per point.
    """

    def place(now: Joined) -> Tensor:
        pull = now.tension * direction
        return moved + answer * (pull - preceding(lengths.topology, pull) + joints.pulls(now.force))

    with torch.no_grad():
        batch = torch.broadcast_shapes(moved.shape[:-2], tension.shape[:-2], answer.shape[:-2], joints.batch)
        bodies = moved.new_zeros(*batch, joints.on.shape[-1], 6)
        now = Joined(lengths.guess(tension), joints.force.expand(*batch, joints.count, 3), bodies)
        for _ in range(steps):
            now = _newton(lengths, answer, direction, joints, now, place(now), dt)
    now = _newton(lengths, answer, direction, joints, now, place(now), dt)
    return place(now), now


def _newton(
    lengths: Lengths, answer: Tensor, direction: Tensor, joints: JointPoints, now: Joined, pos: Tensor, dt: float
) -> Joined:
    """Return the unknowns after a step of Newton's method, whose matrices are constants."""
    topology, tension = lengths.topology, now.tension
    excess, along = lengths.error(pos, tension)
    end = joints.orientation(now.moved, dt)
    gap, wrench = joints.gap(pos, now.moved, end), joints.resisted(now.moved) - joints.wrench(now.force)

    def moves(pull: Tensor) -> Tensor:
        return answer * (pull - preceding(topology, pull))

    with torch.no_grad():
        both, active = answer + following(topology, answer), lengths.active
        soft = lengths.compliance + lengths.yielding(tension)[1]
        diagonal = active * ((1 + lengths.shift) * total(along * direction * both) + soft) + 1 - active
        to_next = -active * dot(along, following(topology, direction * answer))
        to_prev = -active * total(along * answer * preceding(topology, direction))
        unit = torch.eye(3, dtype=pos.dtype, device=pos.device)
        # A unit force at each point along each axis, on an axis in front of all others.
        each = (joints.weight[:, None, :, None] * unit[:, None]).flatten(0, 1)
        each = each.reshape(-1, *[1] * (pos.dim() - 2), *each.shape[-2:]) * answer
        longer = active * dot(along, following(topology, each) - each)
        pulled = solve_slots(topology, diagonal, to_next, to_prev, longer)
        way = joints.weight @ (each + moves(pulled * direction))
        reach, levers = joints.reach(now.moved, end, dt), joints.levers()
        mobile = blocks(torch.linalg.inv(joints.resist))
        system = way.flatten(-2).movedim(0, -1) + reach @ mobile @ levers
    alone = solve_slots(topology, diagonal, to_next, to_prev, excess)
    batch = now.moved.shape[:-2]
    left = gap + joints.weight @ moves(alone * direction)
    turned = (mobile @ wrench.flatten(-2).unsqueeze(-1)).squeeze(-1)
    left = left.expand(*batch, joints.count, 3).flatten(-2) + (reach @ turned.unsqueeze(-1)).squeeze(-1)
    force = -torch.linalg.solve(system.expand(*batch, *system.shape[-2:]), left.unsqueeze(-1)).squeeze(-1)
    change = alone + (pulled * force.movedim(-1, 0)[..., None, None]).sum(0)
    bodies = turned + (mobile @ levers @ force.unsqueeze(-1)).squeeze(-1)
    return Joined(tension + change, now.force + force.unflatten(-1, (-1, 3)), now.moved - bodies.unflatten(-1, (-1, 6)))
