"""Momentum between ropes and matter, on the nodes of the grid.

A node with mass that is nearer to a rope's centreline than its radius and one node spacing, and comes nearer, gets an
impulse along the line from the nearest point of the nearest edge to it; friction acts across. The two ends of the edge
get the opposite by their shares in that point. Impulses are found by projected Jacobi sweeps, as contact among ropes is
(see `contact`): node i answers with n_i / m_i, n_i the number of edges that are equally near, and an edge with
sum w_k W_k / m_k, W_k the shares of all nodes that press vertex k, so that sweeps do not overshoot however many nodes
press one light vertex.

Momentum is exact. Normal impulses act along the line between the points at which they act. Friction acts on the node,
off the centreline by d; the couple d x J is exerted by the ends of the edge as opposite impulses across it. About its
own direction a centreline exerts nothing: as if it spun freely, that part of the friction is taken out of all nodes of
an edge in proportion to how hard they press.

Tensor operations, used on a GPU and where there is no C++ compiler, look only at edges near matter, as many as there is
room for, and at nodes of a small block around each; sweeps work on those of them that are near, as many as a capsule
round the edge can hold. The kernel of `node_sweeps` has room for all.

Only velocities are exchanged, so matter is held off the rope but not drawn to its surface: a rope in a liquid displaces
a cylinder that is wider than itself, by up to `thickness` node spacings in radius, and heavy matter sinks in slowly
where sweeps have not converged.

Hu et al. 2018, doi:10.1145/3197517.3201293, section 5.3 (coupling on nodes); Tonge, Benevolenski, Voroshilov 2012,
doi:10.1145/2185520.2185601 (Jacobi sweeps with split masses).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdlo.coupling.mpm import rod_coupling_op
from torchdlo.coupling.mpm.particles import Grid
from torchdlo.coupling.mpm.substep import Nodes
from torchdlo.coupling.rod_contact.broad_phase import take
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import cross, dot, safe_norm

RELAXATION = 1.5
"""Change per sweep over that of a Jacobi step with row sums; below 2 energy never grows."""


@dataclass(frozen=True)
class RodParticleTouch:
    """How ropes and matter touch; static."""

    block: int
    """Nodes along each axis that are looked at around an edge; see `block_size`."""
    room: int
    """Edges per scene that there is room for."""
    sweeps: int = 3
    """Jacobi sweeps; more of them make light ropes follow heavy matter more closely within a substep."""
    thickness: float = 1.0
    """How far off the rope's surface nodes are pushed, in node spacings."""
    near: int = 0
    """Nodes of a block that there is room for, those to which its edge is the nearest; see `near_size`. 0: all."""


@tree.struct
class Lines:
    """Edges of ropes in a substep, all scenes on one axis; slot s goes from vertex s to vertex `after`."""

    pos: Tensor
    """Vertices [m], shape (B, V, 3)."""
    vel: Tensor
    """Where they would go in the substep, over its length [m/s], shape (B, V, 3)."""
    inverse: Tensor
    """Change of velocity per impulse, 0 if held [1/kg], shape (B, V, 1)."""
    radius: Tensor
    """Radius of edges [m], shape (B or 1, V or 1, 1)."""
    real: Tensor
    """1 for edges, 0 for gaps between ends [1], shape (V, 1)."""
    after: Tensor
    """Next vertex [1], int64, shape (V,)."""


@tree.struct
class _Pairs:
    """A node and an edge each, M nodes for each of R edges."""

    node: Tensor
    """Number of the node [1], int64, shape (B, R M)."""
    ends: Tensor
    """Numbers of the two vertices [1], int64, shape (B, 2 R)."""
    real: Tensor
    """1 if the node is near and has mass, else 0 [1], shape (B, R, M, 1)."""
    share: Tensor
    """Place of the nearest point on the edge, 0 to 1 [1], shape (B, R, M, 1)."""
    arm: Tensor
    """From that point to the node [m], shape (B, R, M, 3)."""
    normal: Tensor
    """Direction of `arm` [1], shape (B, R, M, 3)."""
    edge: Tensor
    """From the first to the second end [m], shape (B, R, 1, 3)."""
    inverse: Tensor
    """Change of the node's velocity per impulse [1/kg], shape (B, R, M, 1)."""


def block_size(longest: float, radius: float, spacing: float, thickness: float = 1.0) -> int:
    """Return how many nodes along an axis lie within reach of an edge at most.

    Args:
        longest: length of the longest edge [m].
        radius: greatest radius [m].
        spacing: of the nodes [m].
        thickness: as in `RodParticleTouch`.
    """
    return math.floor((longest + 2 * radius) / spacing + 2 * thickness) + 1


def near_size(longest: float, radius: float, spacing: float, thickness: float = 1.0) -> int:
    """Return how many nodes an edge can be the nearest to: those of a capsule half a spacing wider than its reach.

    Args:
        longest: as in `block_size`, like the others.
        radius: of edges [m].
        spacing: of nodes [m].
        thickness: as in `RodParticleTouch`.
    """
    reach = radius + (thickness + 0.5) * spacing
    capsule = math.pi * reach**2 * longest + 4 / 3 * math.pi * reach**3
    return min(math.ceil(capsule / spacing**3), block_size(longest, radius, spacing, thickness) ** 3)


def _take(x: Tensor, index: Tensor) -> Tensor:
    """Return rows (B, K, C) of x (B, N, C) by their numbers (B, K)."""
    return x.gather(1, index.unsqueeze(-1).expand(-1, -1, x.shape[-1]))


def _give(values: Tensor, index: Tensor, size: int) -> Tensor:
    """Return (B, size, C) with rows (B, K, C) added at their numbers (B, K)."""
    zero = values.new_zeros(values.shape[0], size, values.shape[-1])
    return zero.scatter_add(1, index.unsqueeze(-1).expand_as(values), values)


def nearest_edges(lines: Lines, low: Tensor, high: Tensor, reach: Tensor, room: int) -> tuple[Tensor, Tensor]:
    """Return the edges nearest to a box, (B, room), and how many within reach found no room, (B, 1); no derivative.

    Args:
        lines: the ropes.
        low: lower corner of the box around the matter [m], shape (B, 1, 3).
        high: upper corner.
        reach: how far off an edge matter is felt [m], shape (B or 1, V or 1, 1).
        room: edges per scene.
    """
    with torch.no_grad():
        following = lines.pos[:, lines.after]
        below = low - torch.maximum(lines.pos, following)
        above = torch.minimum(lines.pos, following) - high
        off = torch.maximum(below, above).amax(-1)
        off = torch.where(lines.real[:, 0] > 0, off, torch.inf)
        # The farthest slots come last; ties keep the order of slots.
        chosen = off.argsort(dim=-1, stable=True)[:, :room]
        lost = ((off <= reach[..., 0]).sum(-1, keepdim=True) - room).clamp(min=0)
    return chosen, lost


def _nearest(distance: Tensor, node: Tensor, mass: Tensor) -> Tensor:
    """Return which pairs are of a node and its nearest edge, or edges that are equally near; shapes (B, R, M, 1)."""
    with torch.no_grad():
        least = torch.full_like(mass, torch.inf).scatter_reduce(1, node, distance.flatten(1), "amin")
        return distance <= (1 + 1e-6) * least.gather(1, node).reshape(distance.shape)


def _pair(grid: Grid, nodes: Nodes, lines: Lines, touch: RodParticleTouch) -> tuple[_Pairs, Tensor]:
    """Return the pairs that can exchange momentum, and how many edges found no room, (B, 1)."""
    h, size = grid.spacing, nodes.at.new_tensor(grid.size)
    corner = nodes.origin * h + nodes.at.new_tensor(grid.first)
    reach = (lines.radius + touch.thickness * h).expand(lines.pos.shape[0], lines.pos.shape[1], 1)
    low = (nodes.at.detach().amin(-1) - 1.5) * h + corner
    high = (nodes.at.detach().amax(-1) + 1.5) * h + corner
    slots, lost = nearest_edges(lines, low[:, None], high[:, None], reach, touch.room)
    ends = torch.cat([slots, lines.after[slots]], 1)
    first, second = _take(lines.pos, ends).chunk(2, 1)
    reach = _take(reach, slots)[:, :, None]
    real = lines.real[slots][:, :, None]
    with torch.no_grad():
        base = ((torch.minimum(first, second) - corner[:, None] - reach[:, :, 0]) / h).ceil()
        steps = torch.arange(touch.block, device=base.device)
        number = base[:, :, None] + torch.cartesian_prod(steps, steps, steps)
        inside = ((number >= 0) & (number < size)).all(-1, keepdim=True)
        place = torch.minimum(number.nan_to_num(0.0).clamp(min=0.0), size - 1).long()
        node = ((place[..., 0] * grid.size[1] + place[..., 1]) * grid.size[2] + place[..., 2]).flatten(1)
    edge = (second - first)[:, :, None]
    away = number * h + (corner[:, None] - first)[:, :, None]
    s = (dot(away, edge) / dot(edge, edge).clamp(min=torch.finfo(edge.dtype).tiny)).clamp(0.0, 1.0)
    arm = away - s * edge
    distance = safe_norm(arm)
    mass = _take(nodes.mass.unsqueeze(-1), node).unflatten(1, number.shape[1:3])
    near = (real > 0) & inside & (distance < reach) & (distance > 0) & (mass > 0)
    real = (near & _nearest(torch.where(near, distance.detach(), torch.inf), node, nodes.mass)).to(mass.dtype)
    inverse = real * nodes.share.unsqueeze(-1) / torch.where(real > 0, mass, 1.0)
    normal = arm / torch.where(distance > 0, distance, 1.0)
    if not 0 < touch.near < real.shape[2]:
        return _Pairs(node, ends, real, s, arm, normal, edge, inverse), lost
    chosen, there, crowded = take(real[..., 0] > 0, touch.near)

    def kept(x: Tensor) -> Tensor:
        return x.gather(2, chosen.unsqueeze(-1).expand(*chosen.shape, x.shape[-1]))

    node, real = node.unflatten(1, number.shape[1:3]).gather(2, chosen).flatten(1), there.unsqueeze(-1).to(real.dtype)
    pairs = _Pairs(node, ends, real, kept(s), kept(arm), kept(normal), edge, real * kept(inverse))
    return pairs, lost + crowded.sum(1)


def _exert(pairs: _Pairs, impulse: Tensor, size: int) -> Tensor:
    """Return what impulses (B, R, M, 3) on nodes exert on the vertices [N s], shape (B, size, 3)."""
    whole, second = impulse.sum(2), (pairs.share * impulse).sum(2)
    # The couple -arm x J, as impulses of no sum across the edge.
    edge = pairs.edge[:, :, 0]
    couple = -cross(pairs.arm, impulse).sum(2)
    across = cross(couple, edge) / dot(edge, edge).clamp(min=torch.finfo(edge.dtype).tiny)
    return _give(torch.cat([second - whole - across, across - second], 1), pairs.ends, size)


def _softness(pairs: _Pairs, lines: Lines, count: int) -> tuple[Tensor, Tensor]:
    """Return how fast pairs part and slip under a unit impulse on every pair at most [1/kg], shape (B, R, M, 1)."""
    s, real = pairs.share, pairs.real
    each = _give(real.flatten(1, 2), pairs.node, count)
    node = pairs.inverse * _take(each, pairs.node).unflatten(1, real.shape[1:3])
    lever = safe_norm(pairs.arm) / safe_norm(pairs.edge).clamp(min=torch.finfo(s.dtype).tiny)

    def rope(first: Tensor, second: Tensor) -> Tensor:
        load = torch.cat([(real * first).sum(2), (real * second).sum(2)], 1)
        heavy = _give(load, pairs.ends, lines.pos.shape[1]) * lines.inverse
        at = _take(heavy, pairs.ends).unsqueeze(2)
        half = pairs.ends.shape[1] // 2
        return first * at[:, :half] + second * at[:, half:]

    return node + rope(1 - s, s), node + rope(1 - s + lever, s + lever)


def _by_kernel(
    grid: Grid, nodes: Nodes, lines: Lines, touch: RodParticleTouch, friction: Tensor
) -> tuple[Tensor, Nodes, Tensor]:
    """Return what `exchange` does; no edge and no node lacks room."""
    scenes, vertices = lines.pos.shape[:2]
    corner = nodes.origin * grid.spacing + nodes.at.new_tensor(grid.first)
    reach = lines.radius[..., 0] + touch.thickness * grid.spacing
    inputs = (
        nodes.vel,
        nodes.mass,
        nodes.share[:, 0].expand(scenes, 1),
        corner,
        lines.pos,
        lines.vel,
        lines.inverse[..., 0],
        reach.detach().expand(scenes, vertices),
        friction[:, 0].expand(scenes, 1),
        torch.where(lines.real[:, 0] > 0, lines.after, -1),
    )
    given, vel = rod_coupling_op.sweep(inputs, grid.size, touch.sweeps, grid.spacing, RELAXATION)
    return given, tree.replace(nodes, vel=vel), torch.zeros_like(corner[:, :1])


def exchange(
    grid: Grid, nodes: Nodes, lines: Lines, touch: RodParticleTouch, friction: Tensor
) -> tuple[Tensor, Nodes, Tensor]:
    """Return impulses on vertices [N s], shape (B, V, 3), the nodes after it, and how many edges found no room.

    Args:
        grid: box and nodes.
        nodes: the grid with what moves it but for the ropes.
        lines: the ropes.
        touch: static choices.
        friction: coefficient [1], shape (B or 1, 1, 1).
    """
    if rod_coupling_op.ready(nodes.vel.device.type, nodes.vel.dtype):
        return _by_kernel(grid, nodes, lines, touch, friction)
    pairs, lost = _pair(grid, nodes, lines, touch)
    count, size = nodes.vel.shape[1], lines.pos.shape[1]
    soft_normal, soft_slip = (torch.where(pairs.real > 0, x, 1.0) for x in _softness(pairs, lines, count))
    direction = pairs.edge / safe_norm(pairs.edge).clamp(min=torch.finfo(soft_slip.dtype).tiny)
    around = cross(direction, pairs.arm)
    mu = friction.reshape(-1, 1, 1, 1)
    normal, rub = torch.zeros_like(pairs.share), torch.zeros_like(pairs.arm)
    given, vel = torch.zeros_like(lines.vel), nodes.vel
    half = pairs.ends.shape[1] // 2
    for _ in range(touch.sweeps):
        ends = _take(lines.vel + lines.inverse * given, pairs.ends).unsqueeze(2)
        rope = (1 - pairs.share) * ends[:, :half] + pairs.share * ends[:, half:]
        turn = cross((ends[:, half:] - ends[:, :half]) / dot(pairs.edge, pairs.edge), pairs.edge)
        apart = _take(vel, pairs.node).unflatten(1, pairs.real.shape[1:3]) - rope
        along = dot(apart, pairs.normal)
        normal = pairs.real * (normal - RELAXATION * along / soft_normal).clamp(min=0.0)
        slip = apart + cross(turn, pairs.arm)
        slip = slip - dot(slip, pairs.normal) * pairs.normal
        trial = pairs.real * (rub - RELAXATION * slip / soft_slip)
        held = safe_norm(trial)
        rub = trial * torch.where(held > mu * normal, mu * normal / torch.where(held > 0, held, 1.0), 1.0)
        # What would spin the edge about itself, out of all its nodes.
        stationary_control = (normal * dot(around, around)).sum(2, keepdim=True)
        spin = dot(rub, around).sum(2, keepdim=True) / torch.where(stationary_control > 0, stationary_control, 1.0)
        rub = rub - torch.where(stationary_control > 0, normal * spin * around, rub)
        impulse = normal * pairs.normal + rub
        given = _exert(pairs, impulse, size)
        vel = nodes.vel + _give((pairs.inverse * impulse).flatten(1, 2), pairs.node, count)
    return given, tree.replace(nodes, vel=vel), lost
