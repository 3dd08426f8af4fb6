"""What a state says of ropes in the quantities of mechanics: curvature, twist, tension, contact, energies.

All are functions of a scene, its parameters and a state, follow their dtype and device, and carry gradients. Slots of
vertices, edges and hinges are those of the scene's vertex axis; dummies are zero. Masses, lengths and stiffnesses are
those with which steps go: as the scene's effects alter them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdlo.coupling.bodies.segment_distance import points_per_edge
from torchdlo.coupling.rod_body.rod_body_effect import RodBody
from torchdlo.field_docs import with_field_docs
from torchdlo.physics import tree
from torchdlo.physics.effects.base import ContactForces, altered_params
from torchdlo.physics.effects.bending_models import StiffeningBending
from torchdlo.physics.effects.elastic import (
    Bend,
    BendFrame,
    Stretch,
    Twist,
    bending_moments,
    elastic_curvature,
    hinge_stiffness,
)
from torchdlo.physics.effects.elastic import curvature as frame_curvature
from torchdlo.physics.effects.external import Gravity, TiltedGravity
from torchdlo.physics.integrators import observed_contact
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.vector_components import axes, local
from torchdlo.physics.rod import kinematics
from torchdlo.physics.rod.kinematics import RodParams, View
from torchdlo.physics.rod.topology import preceding
from torchdlo.scene import Control, Params, Scene, State, step, substep_with_contact

__all__ = [
    "ContactPartners",
    "bending_energy",
    "bending_moment",
    "body_gravitational_energy",
    "body_kinetic_energy",
    "contact_forces",
    "contact_partners",
    "curvature",
    "gravitational_energy",
    "kinetic_energy",
    "tension",
    "twist",
    "twisting_energy",
]


def _rods(scene: Scene, params: Params) -> RodParams:
    """Return rest shape and material as steps use them."""
    return altered_params(scene.effects, scene.topology, params.rods, params.effects)


def _view(scene: Scene, params: Params, state: State) -> View:
    """Return what effects see of a state."""
    return kinematics.view(scene.topology, _rods(scene, params), state.rods, scene.dt / scene.substeps)


def _span(scene: Scene, rods: RodParams) -> Tensor:
    """Return the length of rope that each hinge stands for [m], shape (..., V, 1); 1 for dummies."""
    span = kinematics.hinge_length(scene.topology, rods.rest)
    return span * rods.rest.hinge_mask + (1 - rods.rest.hinge_mask)


def curvature(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the curvature at hinges, as a vector about which the rope bends [1/m], shape (..., V, 3)."""
    # Integrated over hinges it is 2 tan(angle / 2) (Bergou et al. 2008, eq. 1).
    return _view(scene, params, state).binormal() / _span(scene, _rods(scene, params))


def bending_moment(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the bending moment at hinges, as a vector about which it bends the rope [N m], shape (..., V, 3).

    It is stiffness times the curvature beyond the natural and the plastic one, as `Bend` or `BendFrame` has it: zero in
    scenes without either, and without what damping, friction or stiffening add. Like `curvature` it is right up to the
    square of the angle between edges.
    """
    view = _view(scene, params, state)
    if any(isinstance(e, BendFrame) for e in scene.effects):
        hinge = frame_curvature(view)
        moment = bending_moments(hinge_stiffness(view), elastic_curvature(view, hinge))
        m1, m2 = ((m + view.prev(m)) / 2 for m in view.frames())
        return moment[..., :1] * m2 - moment[..., 1:] * m1
    if any(isinstance(e, Bend) for e in scene.effects):
        return hinge_stiffness(view) * view.binormal()
    return 0 * state.rods.pos


def _twist_angle(scene: Scene, rods: RodParams, state: State) -> Tensor:
    """Return the twist across hinges [rad], shape (..., V, 1)."""
    now = state.rods
    return (now.twist - preceding(scene.topology, now.twist) + now.ref_twist) * rods.rest.hinge_mask


def twist(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the twist at hinges [rad/m], shape (..., V, 1); zero in scenes without twist."""
    if scene.twist == "none":
        return 0 * state.rods.twist
    rods = _rods(scene, params)
    return _twist_angle(scene, rods, state) / _span(scene, rods)


def tension(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the tension of edges, positive when pulled [N], shape (..., V, 1).

    That of edges whose length is solved for is the one of the last step, zero before the first; that of others follows
    from their stretch, and is zero without a `Stretch` effect.
    """
    rods = _rods(scene, params)
    if scene.constrained:
        return state.rods.tension * rods.rest.edge_mask
    if not any(isinstance(e, Stretch) for e in scene.effects):
        return 0 * state.rods.tension
    edges = kinematics.edge_vectors(scene.topology, state.rods.pos, rods.rest.edge_mask)
    strain = (safe_norm(edges) / rods.rest.length - 1) * rods.rest.edge_mask
    return rods.material.stretch * strain


def contact_forces(scene: Scene, params: Params, state: State, control: Control) -> ContactForces:
    """Return what contact exerts in the step from a state to a control, the mean over its substeps.

    On vertices, by bodies, particles and other parts of ropes (..., V, 3) [N]; and on free bodies, by ropes and
    particles, as a force (..., K, 3) [N] and a torque about the centre of mass (..., K, 3) [N m]. What fixed and guided
    bodies bear is added up in explicit steps with `contact="sweeps"` only, and zero in others. Forces of contact are
    found with the motion that they allow, so that they belong to a step and not to a state; the step costs what
    `scene.step` does. Normal forces and friction are added up; `contact_partners` tells them apart by who exerts them.
    Where there are joints, bodies feel what these exert, too, see `torchdlo.scene.joint_forces`; vertices do not.
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


@with_field_docs
@tree.struct
class ContactPartners:
    """Who exerts what on ropes by contact, the mean over a step."""

    bodies: Tensor
    """What each body exerts on all ropes [N], fixed and guided ones, too, shape (..., K, 3)."""
    by_bodies: Tensor
    """What bodies exert on vertices [N], shape (..., V, 3)."""
    by_ropes: Tensor
    """What ropes, or other parts of the same one, exert on vertices [N], shape (..., V, 3)."""
    by_material_points: Tensor
    """What matter exerts on vertices [N], shape (..., V, 3)."""


_PARTNERS = {
    **dict.fromkeys(("rod_body", "finger_pads"), "by_bodies"),
    **dict.fromkeys(("rod_contact", "self_contact"), "by_ropes"),
    "rod_mpm_coupling": "by_material_points",
}


def contact_partners(scene: Scene, params: Params, state: State, control: Control) -> ContactPartners:
    """Return between whom forces of contact act in the step from a state to a control, see `contact_forces`.

    Their sum is `contact_forces(...).force`. The step costs what `scene.step` does.
    """
    with observed_contact.observe() as seen:
        step(scene, params, state, control)
    shape = state.rods.pos.shape
    zero = state.rods.pos.new_zeros
    sums = {name: zero(shape) for name in ("by_bodies", "by_ropes", "by_material_points")}
    of = zero(*shape[:-2], len(scene.bodies), 3)
    for pushes, solved in zip(seen.pushes, seen.solved, strict=True):
        for name, push in pushes.items():
            if name in _PARTNERS:
                sums[_PARTNERS[name]] = sums[_PARTNERS[name]] + push.force
                of = of - push.body_force if _PARTNERS[name] == "by_bodies" else of
        if solved is not None:
            points, felt = solved.by_bodies()
            sums["by_bodies"], sums["by_ropes"] = sums["by_bodies"] + felt, sums["by_ropes"] + solved.by_ropes()
            of = of + _of_bodies(scene, points)
    many = max(1, len(seen.pushes))
    return ContactPartners(of / many, *(sums[name] / many for name in ("by_bodies", "by_ropes", "by_material_points")))


def _of_bodies(scene: Scene, points: Tensor) -> Tensor:
    """Return the sum over the points (..., F, V, 3) of each body, shape (..., K, 3)."""
    pieces = next((e.pieces for e in scene.effects if isinstance(e, RodBody)), None)
    if pieces is None:
        return points.new_zeros(*points.shape[:-3], len(scene.bodies), 3)
    counts = [points_per_edge(b, pieces) for b in scene.bodies]
    return torch.stack([x.sum((-3, -2)) for x in points.split(counts, -3)], -2)


def _fall(scene: Scene, params: Params, like: Tensor) -> Tensor:
    """Return the acceleration of free fall [m/s^2], shape (..., 1, 3)."""
    total = like.new_zeros(1, 3)
    for effect in scene.effects:
        if isinstance(effect, Gravity):
            total = total + params.effects[effect.name]["acceleration"]
        elif isinstance(effect, TiltedGravity):
            total = total + effect.added(params.effects[effect.name])
    return total


def kinetic_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the kinetic energy of the vertices [J], shape (...,); velocities lie half a substep before positions."""
    mass = _rods(scene, params).material.mass
    return 0.5 * (mass * state.rods.vel.square()).sum((-2, -1))


def gravitational_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of the ropes' weight, zero at the origin [J], shape (...,); zero without Gravity."""
    mass, fall = _rods(scene, params).material.mass, _fall(scene, params, state.rods.pos)
    return -(mass * fall * state.rods.pos).sum((-2, -1))


def body_kinetic_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the kinetic energy of the free bodies, of their motion and of their rotation [J], shape (...,).

    Velocities lie half a substep before poses. Fixed and kinematic bodies, whose masses mean nothing, are left out.
    """
    free = [k for k, body in enumerate(scene.bodies) if body.motion == "free"]
    if not free:
        return 0 * state.rods.pos.sum((-2, -1))
    numbers = tree.part(params.bodies)
    now = tree.map(lambda x: x[..., free, :], tree.part(state.bodies))
    mass, inertia = numbers.mass[..., free, :], numbers.inertia[..., free, :]
    spin = torch.cat(local(axes(now.quat), now.omega.split(1, -1)), -1)
    return 0.5 * (mass * now.vel.square() + inertia * spin.square()).sum((-2, -1))


def body_gravitational_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of the free bodies' weight, zero at the origin [J], shape (...,); zero without Gravity."""
    free = [k for k, body in enumerate(scene.bodies) if body.motion == "free"]
    if not free:
        return 0 * state.rods.pos.sum((-2, -1))
    fall, mass = _fall(scene, params, state.rods.pos), tree.part(params.bodies).mass[..., free, :]
    return -(mass * fall * tree.part(state.bodies).pos[..., free, :]).sum((-2, -1))


def bending_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of bending [J], shape (...,); zero in scenes without `Bend` or `BendFrame`.

    It is of the curvature beyond the natural and the plastic one, with stiffnesses of both directions, and what
    `StiffeningBending` adds.
    """
    view, total = _view(scene, params, state), 0 * state.rods.pos.sum((-2, -1))
    for effect in scene.effects:
        if isinstance(effect, Bend | BendFrame | StiffeningBending):
            total = total + effect.energy(view, params.effects[effect.name]).sum((-2, -1))
    return total


def twisting_energy(scene: Scene, params: Params, state: State) -> Tensor:
    """Return the energy of twisting [J], shape (...,); zero in scenes without twist, or without `Twist`."""
    if scene.twist == "none" or not any(isinstance(e, Twist) for e in scene.effects):
        return 0 * state.rods.pos.sum((-2, -1))
    return Twist().energy(_view(scene, params, state), {}).sum((-2, -1))
