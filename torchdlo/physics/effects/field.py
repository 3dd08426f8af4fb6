"""Loads from outside that act on every vertex: gravity, damping, air."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torchdlo.physics.effect import Effect, Param, Values
from torchdlo.physics.numerics import dot, safe_norm
from torchdlo.physics.rod import View

AIR_DENSITY = 1.2
"""Density of air at 20 degrees Celsius [kg/m^3]."""


@dataclass(frozen=True)
class Gravity(Effect):
    """Uniform gravity."""

    name: ClassVar[str] = "gravity"
    params: ClassVar[dict[str, Param]] = {
        "acceleration": Param((0.0, 0.0, -9.81), -20.0, 20.0, "m/s^2", "linear", 0.0, "Acceleration of free fall.")
    }

    def loads(self, view: View, values: Values) -> Values:
        """Return the acceleration."""
        return {"acceleration": values["acceleration"]}


@dataclass(frozen=True)
class Damping(Effect):
    """Uniform decay of all velocities, v -> v exp(-rate t); of twist rates as well."""

    name: ClassVar[str] = "damping"
    params: ClassVar[dict[str, Param]] = {
        "rate": Param(0.5, 1e-3, 50.0, "1/s", "log", 0.0, "Rate at which velocities decay."),
        "twist_rate": Param(0.5, 1e-3, 1e4, "1/s", "log", 0.0, "Rate at which twist rates decay."),
    }

    def loads(self, view: View, values: Values) -> Values:
        """Return the rates."""
        return {"rate": values["rate"], "twist_decay": values["twist_rate"]}


@dataclass(frozen=True)
class AirDrag(Effect):
    """Quadratic drag across the rope, -rho c_d r |v_n| v_n per length, v_n the velocity normal to the rope."""

    name: ClassVar[str] = "air_drag"
    params: ClassVar[dict[str, Param]] = {
        "c_d": Param(1.2, 0.0, 20.0, "1", "linear", 0.0, "Drag coefficient of the rope in cross-flow.")
    }

    def loads(self, view: View, values: Values) -> Values:
        """Return drag forces and how they answer to velocity."""
        rest = view.params.rest
        tangent = view.tangent * rest.edge_mask
        along = tangent + view.prev(tangent)
        along = along / safe_norm(along).clamp(min=1e-9)
        normal = view.state.vel - along * dot(along, view.state.vel)
        real = rest.length * rest.edge_mask
        reach = 0.5 * (real + view.prev(real))
        scale = AIR_DENSITY * values["c_d"] * view.params.material.radius * reach * safe_norm(normal)
        return {"force": -scale * normal, "drag": (scale * (2 - along.square())).expand_as(normal)}
