"""A rope in a liquid: what carries it, and what it drags along."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.linalg.numerics import dot, safe_norm
from torchdlo.physics.rod.kinematics import View

__all__ = ["Buoyancy", "FluidForces"]

_DENSITY = Param(1000.0, 0.0, 2e4, "kg/m^3", "linear", 0.0, "Density of the fluid.")


def _reach(view: View) -> Tensor:
    """Return the length of rope that belongs to each vertex [m], shape (..., V, 1)."""
    real = view.params.rest.length * view.params.rest.edge_mask
    return 0.5 * (real + view.prev(real))


@dataclass(frozen=True)
class Buoyancy(Effect):
    """The weight of the fluid in whose place the rope is, upwards (Archimedes)."""

    name: ClassVar[str] = "buoyancy"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "f = -density π r² g per length"
    params: ClassVar[dict[str, Param]] = {
        "density": _DENSITY,
        "acceleration": Param((0.0, 0.0, -9.81), -20.0, 20.0, "m/s^2", "linear", None, "Acceleration of free fall."),
    }

    def loads(self, view: View, values: Values) -> Values:
        """Return the force."""
        displaced = values["density"] * torch.pi * view.params.material.radius.square() * _reach(view)
        return {"force": -displaced * values["acceleration"]}


@dataclass(frozen=True)
class FluidForces(Effect):
    """Drag across and along the rope, and added mass across it, in a fluid at rest.

    The equation of Morison et al. (1950, doi:10.2118/950149-G) with the velocity and the acceleration across the rope,
    and friction along its surface. What the fluid's mass does by turning with the rope while that moves along itself is
    left out, and so is what its own wake does.

    Added mass counts as inertia in all directions, which is stable however heavy the fluid is; along the rope that is
    taken back by the acceleration a substep ago. So motion along itself lags by a substep or two: first order.
    """

    name: ClassVar[str] = "fluid_forces"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = (
        "f = -density r (across |vₙ| vₙ + π along |vₜ| vₜ) - added_mass density π r² dvₙ/dt per length; vₙ, vₜ: "
        "velocity across and along the rope"
    )
    memory: ClassVar[int] = 4
    params: ClassVar[dict[str, Param]] = {
        "across": Param(0.0, 0.0, 20.0, "1", "linear", 0.0, "Drag coefficient in cross-flow, of the width."),
        "along": Param(0.0, 0.0, 1.0, "1", "linear", 0.0, "Friction coefficient in axial flow, of the surface."),
        "added_mass": Param(0.0, 0.0, 5.0, "1", "linear", 0.0, "Added mass over that of the displaced fluid."),
        "density": Param(1000.0, 0.0, 2e4, "kg/m^3", "linear", None, "Density of the fluid."),
    }
    spec = RopeEffectSpec(
        lambda _: [{"across": 0.05}, {"along": 0.005}, {"added_mass": 0.05}],
        strength=("across", "along", "added_mass"),
        fixed=("density",),
        known=lambda rope: {"density": rope.fluid_density},
        confusable=("bending_damping", "air_drag"),
        experiments={
            "air_drag": "repeat it in air: what the fluid does disappears",
            "bending_damping": "repeat it in air: inner damping stays",
        },
        special_case=("air_drag", {"along": 0.0, "added_mass": 0.0}),
        requires="fluid",
    )

    def _along(self, view: View) -> Tensor:
        """Return unit tangents at vertices, zero where there is none, shape (..., V, 3)."""
        tangent = view.tangent * view.params.rest.edge_mask
        along = tangent + view.prev(tangent)
        return along / safe_norm(along).clamp(min=1e-9)

    def loads(self, view: View, values: Values) -> Values:
        """Return forces, and how they answer to velocity and acceleration."""
        along, velocity, radius = self._along(view), view.state.vel, view.params.material.radius
        share, reach = values["density"] * radius, _reach(view)
        tangential = along * dot(along, velocity)
        normal = velocity - tangential
        sideways = share * values["across"] * reach * safe_norm(normal)
        lengthways = torch.pi * share * values["along"] * reach * safe_norm(tangential)
        added = torch.pi * share * radius * values["added_mass"] * reach
        memory = view.state.memory[self.name]
        before = memory[..., 3:] * (velocity - memory[..., :3]) / view.dt
        squared = along.square()
        force = added * along * dot(along, before) - sideways * normal - lengthways * tangential
        # Drags grow twice as fast as in proportion along the velocity.
        resistance = sideways * (2 - squared) + lengthways * 2 * squared
        return {"force": force, "drag": resistance + added / view.dt}

    def update_memory(self, view: View, values: Values) -> Tensor:
        """Return the velocity and 1."""
        velocity = view.state.vel
        return tree.cat_components([velocity, torch.ones_like(velocity[..., :1])])
