"""What a state says of ropes in the quantities of mechanics: curvature, twist, tension, contact, energies.

All are functions of a scene, its parameters and a state, follow their dtype and device, and carry gradients. Slots of
vertices, edges and hinges are those of the scene's vertex axis; dummies are zero.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdlo.physics.effects.base import ContactForces
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.rod import kinematics
from torchdlo.physics.rod.topology import preceding
from torchdlo.scene import Control, Params, Scene, State, step, substep_with_contact

__all__ = [
    "bending_energy",
    "contact_forces",
    "curvature",
    "gravitational_energy",
    "kinetic_energy",
    "tension",
    "twist",
    "twisting_energy",
]


def _span(scene: Scene, params: Params) -> Tensor:
    """Return the length of rope that each hinge stands for [m], shape (..., V, 1); 1 for dummies."""
    rest = params.rods.rest
    length = rest.length * rest.edge_mask
    span = 0.5 * (length + preceding(scene.topology, length)) * rest.share
    return span * rest.hinge_mask + (1 - rest.hinge_mask)


def _turns(scene: Scene, params: Params, state: State) -> Tensor:
    """Return curvature vectors integrated over hinges, 2 tan(angle / 2) [1], shape (..., V, 3)."""
    edges = kinematics.edge_vectors(scene.topology, state.rods.pos, params.rods.rest.edge_mask)
    length = safe_norm(edges)
    tangent = edges / length.where(length > 0, length.new_ones(()))
    before = preceding(scene.topology, tangent)
    # Bergou et al. 2008, eq. 1.
    across = 2 * before.cross(tangent, dim=-1)
    return across / (1 + (before * tangent).sum(-1, keepdim=True)).clamp(min=1e-6) * params.rods.rest.hinge_mask


def curvature(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the curvature at hinges, as a vector about which the rope bends [1/m], shape (..., V, 3)."""
    return _turns(scene, params, state) / _span(scene, params)


def _twist_angle(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the twist across hinges [rad], shape (..., V, 1)."""
    rods = state.rods
    return (rods.twist - preceding(scene.topology, rods.twist) + rods.ref_twist) * params.rods.rest.hinge_mask


def twist(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the twist at hinges [rad/m], shape (..., V, 1); zero in scenes without twist."""
    if scene.twist == "none":
        return 0 * state.rods.twist
    return _twist_angle(scene, params, state) / _span(scene, params)


def tension(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the tension of edges, positive when pulled [N], shape (..., V, 1).

    That of edges whose length is solved for is the one of the last step, zero before the first; that of others follows
    from their stretch.
    """
    rest = params.rods.rest
    if scene.constrained:
        return state.rods.tension * rest.edge_mask
    edges = kinematics.edge_vectors(scene.topology, state.rods.pos, rest.edge_mask)
    strain = (safe_norm(edges) / rest.length - 1) * rest.edge_mask
    return params.rods.material.stretch * strain


def contact_forces(scene: Scene, params: Params, state: State, control: Control) -> ContactForces:
    """Return what contact exerts in the step from a state to a control, the mean over its substeps.

    On vertices, by bodies, particles and other parts of ropes (..., V, 3) [N]; and on free bodies, by ropes and
    particles, as a force (..., K, 3) [N] and a torque about the centre of mass (..., K, 3) [N m]. What fixed and guided
    bodies bear is added up in explicit steps only, and zero in implicit ones. Forces of contact are found with the
    motion that they allow, so that they belong to a step and not to a state; the step costs what `scene.step` does.
    Normal forces and friction are added up. To see what one partner does, leave out the effects of the others. Where
    there are joints, bodies feel what these exert, too, see `torchdlo.scene.joint_forces`; vertices do not.
    """
    felt: list[ContactForces] = []

    def noting(*given: Any) -> State:
        after, push = substep_with_contact(*given)
        felt.append(push)
        return after

    step(scene, params, state, control, advance=noting)
    parts = zip(*((p.force, p.body_force, p.body_torque) for p in felt), strict=True)
    force, body_force, body_torque = (torch.stack(torch.broadcast_tensors(*x)).mean(0) for x in parts)
    batch = torch.broadcast_shapes(state.rods.pos.shape[:-2], force.shape[:-2], body_force.shape[:-2])

    def rows(x: Tensor, count: int) -> Tensor:
        return x.expand(*batch, count, 3) if count else x.new_zeros(*batch, 0, 3)

    count = len(scene.bodies)
    return ContactForces(rows(force, state.rods.pos.shape[-2]), rows(body_force, count), rows(body_torque, count))


def kinetic_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the kinetic energy of the vertices [J], shape (...,); velocities lie half a substep before positions."""
    mass = params.rods.material.mass
    return 0.5 * (mass * state.rods.vel.square()).sum((-2, -1))


def gravitational_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of the ropes' weight, zero at the origin [J], shape (...,); zero without Gravity."""
    if "gravity" not in params.effects:
        return 0 * state.rods.pos.sum((-2, -1))
    pull = params.effects["gravity"]["acceleration"]
    return -(params.rods.material.mass * pull * state.rods.pos).sum((-2, -1))


def bending_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of bending of ropes that are straight at rest and bend alike to all sides [J], shape (...,).

    Raises:
        ValueError: Ropes have a rest curvature, or two stiffnesses.
    """
    rest, stiffness = params.rods.rest, params.rods.material.bend
    if stiffness.shape[-1] > 1 or bool((rest.curvature != 0).any()):
        raise ValueError("bending_energy: expected ropes that are straight at rest, with one bending stiffness each")
    turns = _turns(scene, params, state).square().sum(-1, keepdim=True)
    return 0.5 * (stiffness * rest.hinge_mask * turns / _span(scene, params)).sum((-2, -1))


def twisting_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of twisting [J], shape (...,); zero in scenes without twist."""
    if scene.twist == "none":
        return 0 * state.rods.pos.sum((-2, -1))
    off = (_twist_angle(scene, params, state) - params.rods.rest.twist) * params.rods.rest.hinge_mask
    return 0.5 * (params.rods.material.twist * off.square() / _span(scene, params)).sum((-2, -1))
