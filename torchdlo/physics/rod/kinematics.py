"""Discrete elastic rods: state, rest shape, material, and the geometry that every force is made of.

Bergou et al. 2008, doi:10.1145/1360612.1360662 (rods, frames); Bergou et al. 2010, doi:10.1145/1778765.1778853
(curvature from averaged material frames, time-parallel reference frames).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import cross, dot, normalize, safe_norm, wrap
from torchdlo.physics.rod.topology import Topology, following, preceding


@tree.struct
class RodState:
    """What evolves; slots as in `topology`."""

    pos: Tensor
    """Vertex positions [m], shape (..., V, 3)."""
    vel: Tensor
    """Vertex velocities half a substep before `pos` (at the start: with it) [m/s], shape (..., V, 3)."""
    twist: Tensor
    """Angle from the reference director to the material frame, per edge [rad], shape (..., V, 1)."""
    twist_rate: Tensor
    """Rate of `twist` [rad/s], shape (..., V, 1)."""
    director: Tensor
    """Reference directors, unit and normal to their edge [1], shape (..., V, 3)."""
    ref_twist: Tensor
    """Twist of the reference frames across each hinge, unwrapped [rad], shape (..., V, 1)."""
    plastic: Tensor
    """Plastic part of the natural curvature, as `RodRest.curvature` [1], shape (..., V, 2)."""
    tension: Tensor
    """Tension of edges whose length is a constraint, positive when pulled [N], shape (..., V, 1)."""
    memory: dict[str, Tensor] = field(default_factory=dict)
    """What effects remember, by their name, in units of their own; shape (..., V, C) each."""


@tree.struct
class RodRest:
    """The undeformed shape."""

    length: Tensor
    """Edge lengths, 1 for dummies [m], shape (..., V, 1)."""
    curvature: Tensor
    """Curvature integrated over each hinge, in the material frame: 2 tan(angle/2) [1], shape (..., V or 1, 2)."""
    twist: Tensor
    """Twist across each hinge [rad], shape (..., V or 1, 1)."""
    share: Tensor
    """Length of rope that a hinge stands for, over half the sum of the edges next to it [1], shape (..., V or 1, 1)."""
    edge_mask: Tensor
    """1 for real edges, 0 for dummies [1], shape (V, 1)."""
    hinge_mask: Tensor
    """1 for real hinges, 0 for dummies [1], shape (V, 1)."""


@tree.struct
class Material:
    """Stiffness and inertia; every number may vary along the rod and from scene to scene."""

    stretch: Tensor
    """Axial stiffness EA of edges [N], shape (..., V or 1, 1); infinite where the length is fixed."""
    bend: Tensor
    """Bending stiffness EI of hinges [N m^2], shape (..., V or 1, 1); or 2 for bending towards the two material
    directors, or 3: these two and the one that couples them."""
    twist: Tensor
    """Twisting stiffness GJ of hinges [N m^2], shape (..., V or 1, 1)."""
    mass: Tensor
    """Vertex masses [kg], shape (..., V, 1)."""
    inertia: Tensor
    """Rotational inertia of edges about their axis [kg m^2], shape (..., V, 1)."""
    radius: Tensor
    """Radius of the cross-section [m], shape (..., V or 1, 1)."""


@tree.struct
class RodParams:
    """Everything about the rods that one may learn."""

    rest: RodRest
    material: Material


@dataclass(frozen=True)
class View:
    """The state of one substep with its geometry, computed once and read by every effect."""

    topology: Topology
    state: RodState
    params: RodParams
    dt: float
    """Substep [s]."""
    length: Tensor
    """Current edge lengths [m], shape (..., V, 1)."""
    tangent: Tensor
    """Unit tangents; an arbitrary unit vector on dummy edges [1], shape (..., V, 3)."""
    before: Tensor
    """Unit tangents of the preceding edges [1], shape (..., V, 3)."""
    hinge_length: Tensor
    """Rest length of rope that a hinge stands for, see `RodRest.share` [m], shape (..., V, 1)."""

    def next(self, x: Tensor) -> Tensor:
        """Return at each slot the value of the following one."""
        return following(self.topology, x)

    def prev(self, x: Tensor) -> Tensor:
        """Return at each slot the value of the preceding one."""
        return preceding(self.topology, x)

    def binormal(self) -> Tensor:
        """Return the curvature binormals 2 t x t' / (1 + t.t') (Bergou 2008, eq. 1), shape (..., V, 3)."""
        chi = (1 + dot(self.before, self.tangent)).clamp(min=1e-6)
        return 2 * cross(self.before, self.tangent) / chi * self.params.rest.hinge_mask

    def frames(self) -> tuple[Tensor, Tensor]:
        """Return the two material directors of each edge, shape (..., V, 3) each."""
        c, s = torch.cos(self.state.twist), torch.sin(self.state.twist)
        u = self.state.director
        v = cross(self.tangent, u)
        return c * u + s * v, c * v - s * u


def edge_vectors(topology: Topology, pos: Tensor, edge_mask: Tensor) -> Tensor:
    """Return x_{i+1} - x_i per slot, a unit vector on dummy edges; shape (..., V, 3)."""
    e = following(topology, pos) - pos
    if all(topology.closed):
        return e
    unit = pos.new_tensor([1.0, 0.0, 0.0])
    return torch.where(edge_mask > 0, e, unit)


def directors(topology: Topology, state: RodState, edges: Sequence[int]) -> Tensor:
    """Return the first material directors of some edges, shape (..., E, 3)."""
    if not edges:
        return tree.take_vertices(state.director, edges)
    after = topology.successor()
    begin, end = (tree.take_vertices(state.pos, slots) for slots in (edges, [after[k] for k in edges]))
    twist, reference = tree.take_vertices(state.twist, edges), tree.take_vertices(state.director, edges)
    return torch.cos(twist) * reference + torch.sin(twist) * cross(normalize(end - begin), reference)


def hinge_length(topology: Topology, rest: RodRest) -> Tensor:
    """Return the rest length of rope that each hinge stands for [m], shape (..., V, 1)."""
    return 0.5 * (rest.length + preceding(topology, rest.length)) * rest.share


def view(topology: Topology, params: RodParams, state: RodState, dt: float) -> View:
    """Compute the geometry of a state."""
    rest = params.rest.length
    if lanes.ready(state.pos):
        inputs = state.pos, rest, params.rest.share, params.rest.edge_mask
        return View(topology, state, params, dt, *lanes.apply("look", topology.name, inputs, (1, 3, 3, 1)))
    e = edge_vectors(topology, state.pos, params.rest.edge_mask)
    length = safe_norm(e).clamp(min=1e-12)
    tangent = e / length
    return View(
        topology,
        state,
        params,
        dt,
        length,
        tangent,
        preceding(topology, tangent),
        hinge_length(topology, params.rest),
    )


def advance_frames(topology: Topology, params: RodParams, old: View, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Carry the reference directors from the tangents of `old` to those of `pos`, and the reference twist with them.

    Returns:
        Directors (..., V, 3) and unwrapped reference twist [rad], (..., V, 1).
    """
    if lanes.ready(pos):
        inputs = old.state.director, old.tangent, pos, params.rest.edge_mask
        director, sine, cosine = lanes.apply("carry", topology.name, inputs, (3, 1, 1))
        return director, _nearest(torch.atan2(sine, cosine), old.state.ref_twist, params)
    e = edge_vectors(topology, pos, params.rest.edge_mask)
    tangent = e / safe_norm(e).clamp(min=1e-12)
    director = rotation.transport(old.state.director, old.tangent, tangent)
    director = normalize(director - tangent * dot(tangent, director))  # rounding only
    return director, reference_twist(topology, params, tangent, director, old.state.ref_twist)


def reference_twist(topology: Topology, params: RodParams, tangent: Tensor, director: Tensor, last: Tensor) -> Tensor:
    """Return the angle [rad] of the directors across each hinge that is nearest to `last`, shape (..., V, 1)."""
    carried = rotation.transport(preceding(topology, director), preceding(topology, tangent), tangent)
    return _nearest(rotation.signed_angle(carried, director, tangent), last, params)


def _nearest(angle: Tensor, last: Tensor, params: RodParams) -> Tensor:
    return (last + wrap(angle - last)) * params.rest.hinge_mask
