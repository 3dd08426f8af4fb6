"""What all contacts have in common: no overlap, rebound, Coulomb friction."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo.physics.linalg.numerics import safe_norm

FASTEST = 0.1
"""Speed at which implicit steps, and those of bodies, undo overlaps at most [m/s]: what parts in a step keeps it."""

THICK = 5e-3
"""Radius at which speeds are compared with those that are given [m]: what falls by its own size is as fast as the root
of that."""


def compared(speed: float, radius: Tensor) -> Tensor:
    """Return a speed [m/s] for ropes of some radius [m], so that scenes of any size do alike things."""
    return speed * (radius.detach() / THICK).sqrt()


def separation_needed(gap: Tensor, shallow: Tensor, recovery: float) -> Tensor:
    """Return by how much surfaces have to part at least in a substep, negative if they may come closer [m].

    Of an overlap, a share goes at once, and all of it that is not shallow: small shares let piles come to rest.

    Args:
        gap: distance of the surfaces, negative if they overlap [m].
        shallow: overlap up to which only a share goes [m].
        recovery: that share.
    """
    overlap = (-gap).clamp(min=0.0)
    deep = (overlap - shallow).clamp(min=0.0)
    return torch.where(gap > 0, -gap, recovery * overlap + (1 - recovery) * deep)


def overlap_recovery(wanted: Tensor, dt: float) -> Tensor:
    """Return how far overlaps part in a substep where they keep the speed with which they do [m]: at most `FASTEST`.

    Args:
        wanted: by how much surfaces should part, negative if they may come closer [m].
        dt: substep [s].
    """
    asked, most = wanted.clamp(min=0.0), FASTEST * dt
    return torch.where(wanted > 0, asked * most / (asked + most), wanted)


def rebound_separation(
    wanted: Tensor, pressed: Tensor, approach: Tensor, restitution: Tensor, slowest: float | Tensor, dt: float
) -> Tensor:
    """Return `wanted` [m], or how far surfaces part if they rebound from their approach [m/s] within `dt` [s].

    Args:
        wanted: by how much they have to part at least.
        pressed: 1 where they would touch.
        approach: speed of approach.
        restitution: speed of parting over speed of approach.
        slowest: approach below which nothing rebounds.
        dt: substep.
    """
    rebound = pressed * (approach > slowest) * restitution * approach * dt
    return torch.maximum(wanted, torch.where(rebound > 0, rebound, wanted))


def friction_force(trial: Tensor, normal: Tensor, mu_s: Tensor, mu_k: Tensor) -> Tensor:
    """Return Coulomb friction [N], shape (..., 3): `trial`, which stops the slip, if static friction can be that much.

    Else sliding friction, mu_k times the normal force in the direction of `trial`.
    """
    size = safe_norm(trial)
    sticks = (normal > 0) & (size <= mu_s * normal)
    sliding = mu_k * normal * trial / torch.where(size > 0, size, 1.0)
    return torch.where(sticks, trial, sliding)
