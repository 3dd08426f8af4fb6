"""Moving least squares material point method (MLS-MPM) with affine transfers (APIC), explicit in time.

A substep, Hu et al. 2018, doi:10.1145/3197517.3201293: particles deform by their velocity gradient C; momentum and
stress go to the grid, p_i = sum w_ip (m v + (m C - dt V 4/h^2 tau)(x_i - x_p)) (eqs. 12 and 18); gravity, walls and
whatever touches matter change the velocities of nodes; particles take back v = sum w v_i and C = 4/h^2 sum w v_i
(x_i - x_p)^T, and move with v. Linear and angular momentum are exact (Jiang et al. 2015, doi:10.1145/2766996).

Velocities live half a substep before positions, as those of rods do: the first substep is half a kick.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdlo.coupling.mpm import transfer_op
from torchdlo.coupling.mpm.particles import Grid, MpmDomain, ParticleParams, Particles, rows_of
from torchdlo.physics import tree

COURANT = 0.6
"""Longest allowed substep times speed of sound over node spacing; elastic blocks at rest are stable up to 1, liquids,
which stiffen, up to 0.8."""


@tree.struct
class Nodes:
    """The grid in the middle of a substep."""

    at: Tensor
    """Places of the particles in node spacings from the first node [1], shape (B, 3, P)."""
    origin: Tensor
    """Number of the first node along each axis, whole [1], shape (B, 3)."""
    mass: Tensor
    """Mass of nodes [kg], shape (B, N)."""
    vel: Tensor
    """Velocity of nodes, zero where there is no matter [m/s], shape (B, N, 3)."""
    share: Tensor
    """Part of an impulse that acts in this substep, see `to_grid` [1], shape (B or 1, 1, 1)."""


def flat(x: Tensor) -> Tensor:
    """Return (..., P, C) as (B, C, P)."""
    return x.mT.reshape(-1, x.shape[-1], x.shape[-2])


def density(medium: MpmDomain, material_points: ParticleParams) -> Tensor:
    """Return the density of particles at rest [kg/m^3], shape (..., P, 1)."""
    parts = [material_points.laws[g.name]["density"] for g in medium.groups]
    lead = torch.broadcast_shapes(*(p.shape[:-2] for p in parts))
    return torch.cat([p.expand(*lead, g.count, 1) for p, g in zip(parts, medium.groups, strict=True)], -2)


def deform(
    medium: MpmDomain, material_points: ParticleParams, particles: Particles, dt: float
) -> tuple[Tensor, Particles]:
    """Return the Kirchhoff stress [Pa], shape (..., P, 6), and particles deformed by their velocity gradients."""
    stresses, strains, histories = [], [], []
    for group, here in medium.pieces():
        numbers = {n: v[..., 0] for n, v in material_points.laws[group.name].items()}
        strain, affine = (rows_of(x)[..., here] for x in (particles.strain, particles.affine))
        stress, strain, history = group.law.deformed(numbers, strain, particles.history[..., here, 0], affine, dt)
        stresses.append(stress)
        strains.append(strain)
        histories.append(history.unsqueeze(-2))
    whole = [torch.cat(parts, -1).mT for parts in (stresses, strains, histories)]
    return whole[0], tree.replace(particles, strain=whole[1], history=whole[2])


def _locate(grid: Grid, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Return places from the first computed node (B, 3, P) and the number of that node (B, 3)."""
    at = (flat(pos) - pos.new_tensor(grid.first).unsqueeze(-1)) / grid.spacing
    most = pos.new_tensor(grid.nodes) - pos.new_tensor(grid.size)
    with torch.no_grad():
        # The window is centred on the matter.
        middle = 0.5 * (at.amin(-1) + at.amax(-1)) - 0.5 * (pos.new_tensor(grid.size) - 1)
        origin = torch.minimum(middle.round().clamp(min=0.0), most)
    return at - origin.unsqueeze(-1), origin


def places(grid: Grid, nodes: Nodes, chosen: Tensor | None = None) -> Tensor:
    """Return where the computed nodes are [m], shape (B, N, 3), or those with the numbers `chosen` (B, R)."""
    _, y, z = grid.size
    each = torch.arange(math.prod(grid.size), device=nodes.vel.device) if chosen is None else chosen
    steps = (each.div(y * z, rounding_mode="floor"), each.div(z, rounding_mode="floor") % y, each % z)
    number = nodes.origin.unsqueeze(1) + torch.stack(steps, -1).to(nodes.vel.dtype)
    return number * grid.spacing + number.new_tensor(grid.first)


def to_grid(
    medium: MpmDomain,
    material_points: ParticleParams,
    particles: Particles,
    acceleration: Tensor,
    dt: float,
    share: Tensor,
) -> tuple[Nodes, Particles]:
    """Return the grid after inner forces and gravity, and the particles with their new strain.

    Args:
        medium: static choices.
        material_points: constant numbers.
        particles: matter now.
        acceleration: of all matter, shape (..., 1, 3) [m/s^2].
        dt: substep [s].
        share: part of the kick that this substep gives: 1, or 0.5 in the first one; shape (..., 1, 1).
    """
    grid, h = medium.grid, medium.grid.spacing
    at, origin = _locate(grid, particles.pos)
    stress, particles = deform(medium, material_points, particles, dt)
    mass = density(medium, material_points) * material_points.volume
    # Not by an index, whose derivative would be a sum over places.
    rows = rows_of(stress).unbind(-2)
    full = rows_of(torch.stack([rows[k] for k in (0, 3, 4, 3, 1, 5, 4, 5, 2)], -2))
    # Gradients are per node spacing.
    gradient = h * mass * particles.affine - share * (4 * dt / h) * material_points.volume * full
    moved = particles.vel + share * dt * acceleration
    said = torch.cat([(mass * moved).mT, mass.expand(*moved.shape[:-1], 1).mT], -2)
    said = said.reshape(-1, 4, said.shape[-1])
    vel, summed = transfer_op.give_to_nodes(at, said, flat(gradient), grid.size)
    return Nodes(at, origin, summed, vel, share.reshape(-1, 1, 1)), particles


def from_grid(
    medium: MpmDomain, material_points: ParticleParams, particles: Particles, nodes: Nodes, dt: float
) -> Particles:
    """Return the particles after the substep, moved with the nodes; walls act last."""
    value, gradient = transfer_op.take_from_nodes(
        medium.grid, nodes.at, nodes.vel, nodes.origin, material_points.friction
    )
    batch = particles.pos.shape[:-2]
    vel = value[:, :3].reshape(*batch, 3, -1).mT
    affine = (gradient * (4 / medium.grid.spacing)).reshape(*batch, 9, -1).mT
    return tree.replace(particles, pos=particles.pos + dt * vel, vel=vel, affine=affine)


def advance(
    medium: MpmDomain,
    material_points: ParticleParams,
    particles: Particles,
    acceleration: Tensor,
    dt: float,
    share: Tensor,
) -> Particles:
    """Advance matter that touches nothing but the walls by one substep; arguments as in `to_grid`."""
    nodes, strained = to_grid(medium, material_points, particles, acceleration, dt, share)
    return from_grid(medium, material_points, strained, nodes, dt)


def outside(grid: Grid, pos: Tensor) -> Tensor:
    """Return how many particles lie where no node is computed, shape (..., 1, 1); they no longer move rightly."""
    at, _ = _locate(grid, pos)
    most = pos.new_tensor(grid.size).reshape(3, 1) - 1.5
    lost = ~((at >= 0.5) & (at <= most)).all(1)
    return lost.sum(-1).to(pos.dtype).reshape(*pos.shape[:-2], 1, 1)


def limits(medium: MpmDomain, material_points: ParticleParams) -> dict[str, float]:
    """Return the longest stable substep [s] by the group that limits it."""
    found = {}
    for group in medium.groups:
        numbers = material_points.laws[group.name]
        speed = (group.law.modulus(numbers) / numbers["density"]).max().sqrt()
        found[f"sound in {group.name} ({float(speed):.3g} m/s)"] = COURANT * medium.grid.spacing / float(speed)
        if "viscosity" in numbers and float(numbers["viscosity"].max()) > 0:
            diffusion = float((numbers["viscosity"] / numbers["density"]).max())
            found[f"viscosity of {group.name}"] = medium.grid.spacing**2 / (8 * diffusion)
    return found


def check_step(medium: MpmDomain, material_points: ParticleParams, dt: float) -> None:
    """Raise a `ValueError` that names the limiting term if substeps of `dt` [s] are not stable."""
    for term, bound in limits(medium, material_points).items():
        if not dt < bound:
            raise ValueError(
                f"matter: a substep of {dt:.3g} s is not stable: {term} allows less than {bound:.3g} s on a grid of "
                f"{medium.grid.spacing:g} m. Use {math.ceil(dt / bound * 1.05)} times the substeps, or softer or "
                "denser matter, or a coarser grid."
            )
