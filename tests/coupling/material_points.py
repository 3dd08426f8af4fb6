"""Matter for tests: builders, steps and sums."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.particles import (
    Grid,
    MpmDomain,
    ParticleBlock,
    ParticleParams,
    Particles,
    assemble,
    fill_ball,
)
from torchdlo.physics import tree

DOUBLE = torch.float64
ONE = torch.ones(1, 1, dtype=DOUBLE)
OPEN = ("open",) * 6


def ball(law, radius=0.03, spacing=0.0064, batch=(), dtype=DOUBLE, shake=0.0, grid=None, **numbers):
    """A ball in the middle of a box without walls; `shake` is the size of random velocities."""
    x = fill_ball((0.1, 0.1, 0.1), radius, spacing, torch.zeros((), dtype=dtype))
    x = x.expand(*batch, *x.shape)
    velocity = shake * torch.randn(x.shape, generator=torch.Generator().manual_seed(3), dtype=dtype)
    grid = grid or Grid((0.0,) * 3, (0.2,) * 3, 0.01, OPEN)
    return assemble([ParticleBlock(x, law, spacing**3, velocity=velocity, numbers=numbers)], grid)


def run(
    medium: MpmDomain,
    material_points: ParticleParams,
    state: Particles,
    steps: int,
    dt: float,
    gravity=(0.0, 0.0, 0.0),
    keep=None,
):
    """Advance from rest at time 0; also return what `keep` says after each substep."""
    seen = []
    g = state.pos.new_tensor([list(gravity)])
    for k in range(steps):
        share = state.pos.new_full((1, 1), 0.5 if k == 0 else 1.0)
        state = mpm.advance(medium, material_points, state, g, dt, share)
        if keep:
            seen.append(keep(state))
    return (state, torch.stack(seen)) if keep else state


def momenta(medium: MpmDomain, material_points: ParticleParams, state: Particles) -> tuple[Tensor, Tensor]:
    """Linear and angular momentum; an affine field C has the angular momentum m h^2/4 of its skew part."""
    mass = mpm.density(medium, material_points) * material_points.volume
    c = state.affine * medium.grid.spacing**2 / 4
    spin = torch.stack([c[..., 7] - c[..., 5], c[..., 2] - c[..., 6], c[..., 3] - c[..., 1]], -1)
    turn = torch.linalg.cross(state.pos, state.vel) + spin
    return (mass * state.vel).sum(-2), (mass * turn).sum(-2)


def derivative(value, number: Tensor, step: float) -> Tensor:
    """Central difference of fourth order of value(number + x) by x."""
    with torch.no_grad():
        f = {k: value(number + k * step) for k in (-2, -1, 1, 2)}
    return (8 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12 * step)


def with_number(material_points: ParticleParams, name: str, value: Tensor) -> ParticleParams:
    """Matter of one group with one number of its law exchanged."""
    ((group, numbers),) = material_points.laws.items()
    return tree.replace(material_points, laws={group: {**numbers, name: value}})
