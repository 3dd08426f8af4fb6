"""Bodies that are linked by contacts: how points move with bodies, and the linear system of their displacements."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import Body, PredictedBodyMotion
from torchdlo.physics.linalg import banded
from torchdlo.physics.linalg.numerics import added, cross
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.tree import cat_vertices


@dataclass(frozen=True)
class Links:
    """Contacts of bodies, with everything that stays the same while their forces are found."""

    pairs: tuple[tuple[int, int], ...]
    counts: tuple[int, ...]
    """Contacts per pair."""
    bodies: tuple[Body, ...]
    normal: Tensor
    """From the second body to the first [1], shape (..., C, 3)."""
    arms: tuple[Tensor, Tensor]
    """From the centres of the two bodies to the contact [m], shape (..., C, 3) each."""
    wanted: Tensor
    """By how much the two have to part at least, along the normal [m], shape (..., C, 1)."""
    free: Tensor
    """By how much they would move against each other without contact [m], shape (..., C, 3)."""
    mu_s: Tensor
    """Coefficient of static friction [1], shape (..., C, 1)."""
    mu_k: Tensor
    """Coefficient of sliding friction [1], shape (..., C, 1)."""
    stiff: Tensor
    """Stiffness that stands for rigidity [N/m], shape (..., C, 1)."""

    def seen(self, change: Tensor, turn: Tensor) -> Tensor:
        """Return how points of first bodies move against those of second ones [m], shape (..., C, 3).

        Args:
            change: displacements of the bodies [m], shape (..., K, 3).
            turn: their rotation vectors [rad], shape (..., K, 3).
        """
        sides = []
        for side in (0, 1):
            parts = [gather(x, self.pairs, self.counts, side) for x in (change, turn)]
            sides.append(parts[0] + cross(parts[1], self.arms[side]))
        return sides[0] - sides[1]

    def summed(self, x: Tensor) -> Tensor:
        """Return the sums over the points of each pair, at all of its points, shape (..., C, 1)."""
        parts = [p.sum(-2, keepdim=True).expand_as(p) for p in x.split(self.counts, -2)]
        return cat_vertices(parts)

    def exerted(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Return forces [N] and torques [N m] on the bodies of forces on the first of each pair, (..., K, 3) each."""
        torques = [cross(arm, force) for arm in self.arms]
        parts: list[list[Tensor]] = [[] for _ in self.bodies]
        start = 0
        for pair, count in zip(self.pairs, self.counts, strict=True):
            part = slice(start, start + count)
            for body, torque, sign in zip(pair, torques, (1.0, -1.0), strict=True):
                both = torch.cat([force[..., part, :], torque[..., part, :]], -1)
                parts[body].append(sign * both.sum(-2, keepdim=True))
            start += count
        none = force.new_zeros(*force.shape[:-2], 1, 6)
        push, torque = cat_vertices([added(t) if t else none for t in parts]).split(3, -1)
        return push, torque


def gather(x: Tensor, pairs: tuple[tuple[int, int], ...], counts: tuple[int, ...], side: int) -> Tensor:
    """Return what bodies have (..., K, c) at their contacts, for one side of all pairs, shape (..., C, c)."""
    rows = [x[..., pair[side] : pair[side] + 1, :] for pair in pairs]
    return cat_vertices([r.expand(*r.shape[:-2], n, r.shape[-1]) for r, n in zip(rows, counts, strict=True)])


def _skew(r: Tensor) -> Tensor:
    """Return the matrices of the vector product r x, shape (..., 3, 3)."""
    x, y, z = r.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return torch.stack(rows, -2)


def inertia(motion: PredictedBodyMotion, free: list[int]) -> Tensor:
    """Return by how much free bodies, and what stands behind them, resist displacements and turns [N/m, N m/rad].

    Shape (..., F, 6, 6).
    """
    quat = motion.state.quat[..., free, :]
    axes = torch.eye(3, dtype=quat.dtype, device=quat.device)
    turn = torch.stack([rotate(quat, axis.expand(*quat.shape[:-1], 3)) for axis in axes], -1)
    torque = (turn / motion.inverse_inertia[..., free, :].unsqueeze(-2)) @ turn.mT
    force = axes / motion.mobility[..., free, :].unsqueeze(-1)
    batch = torch.broadcast_shapes(force.shape[:-2], torque.shape[:-2])
    force, torque = (x.expand(*batch, 3, 3) for x in (force, torque))
    none = torch.zeros_like(force)
    own = torch.cat([torch.cat([force, none], -1), torch.cat([none, torque], -1)], -2)
    return own if motion.hold is None else own + motion.hold


def _coupled(links: Links, free: list[int]) -> list[tuple[int, int]]:
    """Return pairs of free bodies that may touch, by their places among the free ones."""
    return [(free.index(a), free.index(b)) for a, b in links.pairs if a in free and b in free]


def assembled(links: Links, inertia: Tensor, gradients: Tensor, free: list[int]) -> Tensor:
    """Return the matrix of the displacements of free bodies as `bodies` patterns want it, shape (..., m)."""
    unit = torch.eye(3, dtype=gradients.dtype, device=gradients.device).expand(*links.arms[0].shape, 3)
    seen = torch.cat([unit, -_skew(links.arms[0]), -unit, _skew(links.arms[1])], -1)
    pushed = gradients @ seen
    diagonal = list(inertia.unbind(-3))
    beside = []
    start = 0
    for pair, count in zip(links.pairs, links.counts, strict=True):
        part = slice(start, start + count)
        block = seen[..., part, :, :].flatten(-3, -2).mT @ pushed[..., part, :, :].flatten(-3, -2)
        halves = (slice(0, 6), slice(6, 12))
        for body, half in zip(pair, halves, strict=True):
            if body in free:
                k = free.index(body)
                diagonal[k] = diagonal[k] + block[..., half, half]
        if pair[0] in free and pair[1] in free:
            beside += [block[..., halves[0], halves[1]], block[..., halves[1], halves[0]]]
        start += count
    blocks = [x.flatten(-2) for x in (*diagonal, *beside)]
    batch = torch.broadcast_shapes(*(x.shape[:-1] for x in blocks))
    return torch.cat([x.expand(*batch, 36) for x in blocks], -1)


def _pattern(name: str) -> banded.Pattern:
    """Pattern of bodies with six unknowns each: blocks of all bodies, then of pairs, first to second and back."""
    count, _, rest = name.partition(":")
    blocks = [(k, k) for k in range(int(count))]
    for pair in filter(None, rest.split(",")):
        a, b = (int(x) for x in pair.split("-"))
        blocks += [(a, b), (b, a)]
    places = [
        (6 * a + i, 6 * b + j, 36 * n + 6 * i + j)
        for n, (a, b) in enumerate(blocks)
        for i in range(6)
        for j in range(6)
    ]
    return banded.make_pattern(6 * int(count), places, range(6 * int(count)))


banded.register_pattern("bodies", functools.cache(_pattern))


@dataclass(frozen=True)
class BodySystem:
    """The equations of the displacements of the free bodies."""

    links: Links
    free: list[int]
    inertia: Tensor
    """Resistance of free bodies to displacements and turns [N/m, N m/rad], shape (..., F, 6, 6)."""

    def solve(self, gradients: Tensor, load: Tensor) -> Tensor:
        """Return displacements and turns under forces that fall with the motion, shape (..., F, 6)."""
        name = f"bodies:{len(self.free)}:" + ",".join(f"{a}-{b}" for a, b in _coupled(self.links, self.free))
        entries = assembled(self.links, self.inertia, gradients, self.free)
        load = load.flatten(-2)
        batch = torch.broadcast_shapes(entries.shape[:-1], load.shape[:-1])
        matrix, rhs = (x.expand(*batch, x.shape[-1]).reshape(-1, x.shape[-1]).T for x in (entries.detach(), load))
        found = banded.solve(matrix, rhs, name)
        return found.T.reshape(*batch, len(self.free), 6)

    def moved(self, q: Tensor) -> Tensor:
        """Return by how much points move against each other [m], shape (..., C, 3)."""
        none = q.new_zeros(*q.shape[:-2], 1, 6)
        count = len(self.links.bodies)
        rows = [q[..., self.free.index(k), None, :] if k in self.free else none for k in range(count)]
        change, turn = cat_vertices(rows).split(3, -1)
        return self.links.free + self.links.seen(change, turn)

    def load(self, force: Tensor) -> Tensor:
        """Return forces and torques on the free bodies, shape (..., F, 6)."""
        return torch.cat(self.links.exerted(force), -1)[..., self.free, :]
