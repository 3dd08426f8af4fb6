"""Ropes and matter in one scene: the effect that lets them touch, and the substep of the matter around it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import BodyState
from torchdlo.coupling.mpm import substep as mpm
from torchdlo.coupling.mpm.particles import Grid, MpmDomain, ParticleParams, Particles, stored
from torchdlo.coupling.mpm.rod_coupling_solver import Lines, RodParticleTouch, block_size, exchange, near_size
from torchdlo.coupling.mpm.substep import Nodes
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, Effect, EffectKind, Param, PredictedMotion, Values
from torchdlo.physics.rod.kinematics import RodParams, RodState, View


@dataclass(frozen=True)
class PredictedParticles:
    """Matter in the middle of a substep, before ropes touch it."""

    grid: Grid
    nodes: Nodes
    particles: Particles


@tree.struct
class TouchedParticles:
    """What ropes leave of it."""

    nodes: Nodes
    lost: Tensor
    """Edges near matter that found no room [1], shape (B, 1)."""


@dataclass(frozen=True)
class RodMpmCoupling(Effect):
    """Ropes and matter push each other and rub with Coulomb friction, see `exchange`."""

    sweeps: int = 3
    """Jacobi sweeps per substep."""
    room: int = 0
    """Edges per scene that there is room for, those next to matter; 0: all. The C++ kernel has room for all."""
    thickness: float = 1.0
    """How far off the rope's surface matter is held, in node spacings."""
    block: int = 0
    """Nodes along each axis that are looked at around an edge; 0: found from the ropes when the scene is made."""
    near: int = 0
    """Nodes of them that there is room for where an edge is the nearest; 0: found likewise."""

    name: ClassVar[str] = "rod_mpm_coupling"
    kind: ClassVar[EffectKind] = "force"
    is_contact: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "mu": Param(0.3, 0.0, 2.0, "1", "linear", 0.0, "Coefficient of friction between ropes and matter."),
    }

    def __post_init__(self) -> None:
        for name, least in (("sweeps", 1), ("room", 0), ("thickness", 0.0), ("block", 0), ("near", 0)):
            if not getattr(self, name) >= least:
                raise ValueError(f"RodMpmCoupling: {name} is {getattr(self, name)}; expected at least {least}")

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> ContactForces:
        """Return the forces on vertices [N] and what they leave of the matter."""
        state, topology, dt = view.state, view.topology, view.dt
        nodes = motion.material_points.nodes
        batch, size, count = state.pos.shape[:-2], topology.size, nodes.mass.shape[0]

        def all_scenes(x: Tensor) -> Tensor:
            return x.expand(*batch, *x.shape[-2:]).reshape(count, *x.shape[-2:])

        after = torch.tensor(topology.successor(), device=state.pos.device)
        lines = Lines(
            all_scenes(state.pos),
            all_scenes(motion.change) / dt,
            all_scenes(motion.answer.amax(-1, keepdim=True)) / (dt * dt),
            all_scenes(view.params.material.radius),
            view.params.rest.edge_mask,
            after,
        )
        touch = RodParticleTouch(self.block, self.room or size, self.sweeps, self.thickness, self.near)
        impulse, nodes, lost = exchange(motion.material_points.grid, nodes, lines, touch, all_scenes(values["mu"]))
        none = impulse.new_zeros(1, 3)
        return ContactForces(
            (impulse / dt).reshape(*batch, size, 3), none, none, TouchedParticles(nodes, lost.to(impulse.dtype))
        )


def fitted(effects: Sequence[Effect], medium: MpmDomain | None, rods: RodParams) -> tuple[Effect, ...]:
    """Return the effects with the block of nodes that `RodMpmCoupling` needs for these ropes."""
    found = []
    for e in effects:
        if e.name in ("rod_mpm_coupling", "body_mpm_coupling") and medium is None:
            raise ValueError(
                f"scene: {type(e).__name__} is among the effects, but there is no matter; give make(..., matter=...)"
            )
        if isinstance(e, RodMpmCoupling) and not (e.block and e.near):
            longest = float((rods.rest.length * rods.rest.edge_mask).max())
            # Edges that stretch by more than a tenth are not seen to their ends.
            sizes = (1.1 * longest, float(rods.material.radius.max()), tree.part(medium).grid.spacing, e.thickness)
            e = dataclasses.replace(e, block=e.block or block_size(*sizes), near=e.near or near_size(*sizes))
        found.append(e)
    return tuple(found)


def _foresee(
    medium: MpmDomain, material_points: ParticleParams, particles: Particles, first: Tensor, dt: float, acceleration
) -> PredictedParticles:
    acceleration = torch.as_tensor(acceleration, dtype=particles.pos.dtype, device=particles.pos.device)
    if acceleration.dim() < 2:
        acceleration = acceleration.expand(1, 3)
    nodes, strained = mpm.to_grid(medium, material_points, particles, acceleration, dt, 1 - 0.5 * first)
    return PredictedParticles(medium.grid, nodes, strained)


def predict_free_motion(
    medium: MpmDomain, material_points: ParticleParams, particles: Particles, first: Tensor, dt: float
):
    """Return a function that turns an acceleration into where matter would go in a substep.

    Args:
        medium: static choices.
        material_points: constant numbers.
        particles: matter now.
        first: 1 in the very first substep, else 0, shape (..., 1, 1).
        dt: substep [s].
    """
    return partial(_foresee, medium, material_points, particles, first, dt)


def finish(
    medium: MpmDomain,
    material_points: ParticleParams,
    now: PredictedParticles,
    push: ContactForces,
    dt: float,
    missed: Tensor,
) -> tuple[Particles, Tensor]:
    """Return the particles after a substep and what was missed so far, see `watch.diagnostics`."""
    nodes = now.nodes
    if push.material_points != ():
        nodes, lost = push.material_points.nodes, push.material_points.lost.detach()
        lost = lost.reshape(*missed.shape[:-2], 1, 1)
        missed = torch.maximum(missed, torch.nn.functional.pad(lost, (0, missed.shape[-1] - 1)))
    return mpm.from_grid(medium, material_points, now.particles, nodes, dt), missed


def expand_batches(
    rods: RodState, bodies: BodyState | tuple[()], particles: Particles, *numbers: object
) -> tuple[RodState, BodyState | tuple[()], Particles]:
    """Return all with the batch axes of all, those of numbers (..., n, d) of laws and effects among them."""
    all_of = (x for x in tree.leaves((rods.pos, particles.pos, numbers)) if isinstance(x, Tensor))
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in all_of))
    wide = tree.map(lambda x: tree.batch_innermost(x.expand(*batch, *x.shape[-2:])), (rods, bodies))
    particles = tree.to(particles, rods.pos.dtype)
    return *wide, tree.map(lambda x: stored(x.expand(*batch, *x.shape[-2:])), particles)
