"""Rigid bodies without ropes, and what they carry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchdlo.coupling.bodies.contact_effect import BodyContact, contact_forces
from torchdlo.coupling.bodies.dynamics import (
    Body,
    BodyParams,
    BodyState,
    RigidBody,
    advance_bodies,
    conjugate,
    place_bodies,
    predict_free_motion,
    stationary_control,
)
from torchdlo.physics.effects.base import ContactForces
from torchdlo.physics.linalg.rotation import rotate

F64 = torch.float64
G = 9.81
SHAPES = {
    "sphere": 0.05,
    "box": (0.05, 0.04, 0.03),
    "capsule": (0.03, 0.05),
    "cylinder": (0.04, 0.05),
    "cone": (0.05, 0.1),
    "torus": (0.06, 0.02),
    "ring": (0.06, 0.02, 4.0),
}
"""Sizes of one body of each shape."""


def ground(**numbers: Any) -> RigidBody:
    return RigidBody("plane", motion="fixed", **numbers)


def move(
    bodies: tuple[Body, ...],
    params: BodyParams,
    state: BodyState,
    count: int,
    dt: float,
    gravity: Tensor,
    contact: BodyContact,
) -> BodyState:
    """Return the state after `count` substeps, held bodies at rest."""
    targets, none = stationary_control(bodies, state), gravity.new_zeros(1, 3)
    for k in range(count):
        first = gravity.new_tensor([[float(k == 0)]])
        motion = predict_free_motion(bodies, params, state, targets, gravity, first, dt)
        state = advance_bodies(motion, targets, ContactForces(none, *contact_forces(contact, motion)))
    return state


def run(
    solids: Sequence[RigidBody],
    time: float,
    dt: float = 1e-3,
    gravity: Sequence[float] = (0.0, 0.0, -G),
    dtype: torch.dtype = F64,
    **choices: Any,
) -> tuple[BodyParams, BodyState, BodyState]:
    """Return the numbers of bodies, and their states at the start and after a time."""
    like = torch.zeros(1, dtype=dtype)
    bodies, params, state = place_bodies(solids, like)
    with torch.no_grad():
        pulled = like.new_tensor([gravity])
        return params, state, move(bodies, params, state, round(time / dt), dt, pulled, BodyContact(**choices))


def momenta(params: BodyParams, state: BodyState, first: int = 0) -> tuple[Tensor, Tensor]:
    """Linear momentum of bodies from `first` on, and their angular momentum about the origin."""
    mass, inertia = params.mass[..., first:, :], params.inertia[..., first:, :]
    pos, quat, vel, omega = (x[..., first:, :] for x in (state.pos, state.quat, state.vel, state.omega))
    spin = rotate(quat, inertia * rotate(conjugate(quat), omega))
    return (mass * vel).sum(-2), (torch.linalg.cross(pos, mass * vel) + spin).sum(-2)


def energy(params: BodyParams, state: BodyState, first: int = 0) -> Tensor:
    """Kinetic energy of bodies from `first` on."""
    local = rotate(conjugate(state.quat), state.omega)
    whole = params.mass * state.vel.square() + params.inertia * local.square()
    return 0.5 * whole[..., first:, :].sum((-1, -2))
