"""Loads from outside that act on every vertex: gravity, damping, air at rest and in motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.linalg.numerics import cross, dot, safe_norm
from torchdlo.physics.rod.kinematics import View

AIR_DENSITY = 1.2
"""Density of air at 20 degrees Celsius [kg/m^3]."""


@dataclass(frozen=True)
class Gravity(Effect):
    """Uniform gravity."""

    name: ClassVar[str] = "gravity"
    kind: ClassVar[EffectKind] = "force"
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
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "dv/dt = -rate · v"
    params: ClassVar[dict[str, Param]] = {
        "rate": Param(0.5, 1e-3, 50.0, "1/s", "log", 0.0, "Rate at which velocities decay."),
        "twist_rate": Param(0.5, 1e-3, 1e4, "1/s", "log", 0.0, "Rate at which twist rates decay."),
    }

    def loads(self, view: View, values: Values) -> Values:
        """Return the rates."""
        return {"rate": values["rate"], "twist_decay": values["twist_rate"]}


@dataclass(frozen=True)
class TiltedGravity(Effect):
    """Gravity turned by a small rotation: the frame in which positions were measured is not level.

    Returns what the turn R adds to gravity g, R g - g; R turns by |a| about the horizontal axis a = (angles, 0).
    """

    name: ClassVar[str] = "tilted_gravity"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "g → R(angles) g"
    params: ClassVar[dict[str, Param]] = {
        "angles": Param((0.0, 0.0), -0.2, 0.2, "rad", "linear", 0.0, "Turn of gravity about the x and the y axis."),
        "acceleration": Param((0.0, 0.0, -9.81), -20.0, 20.0, "m/s^2", "linear", None, "Gravity that is turned."),
    }
    spec = RopeEffectSpec(
        lambda _: [{"angles.0": 0.01}, {"angles.1": 0.01}],
        signed=True,
        strength=("angles",),
        fixed=("acceleration",),
        known=lambda rope: {"acceleration": list(rope.gravity)},
        confusable=("rest_curvature", "marker_offset"),
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return the acceleration that is added."""
        return {"acceleration": self.added(values)}

    def added(self, values: Values) -> Tensor:
        """Return the acceleration that is added [m/s^2], shape (..., 1, 3)."""
        angles, g = values["angles"], values["acceleration"]
        axis = torch.cat([angles, torch.zeros_like(angles[..., :1])], -1)
        angle = safe_norm(axis)
        # Rodrigues: R g = g + a x g sin|a|/|a| + a x (a x g) (1 - cos|a|)/|a|^2.
        first = torch.sinc(angle / torch.pi)
        second = 0.5 * torch.sinc(0.5 * angle / torch.pi).square()
        turned = cross(axis, g)
        return first * turned + second * cross(axis, turned)


def _drag(view: View, c_d: Tensor, velocity: Tensor) -> Values:
    """Return drag at velocities against the air [m/s], shape (..., V, 3), and how it answers to them."""
    rest = view.params.rest
    tangent = view.tangent * rest.edge_mask
    along = tangent + view.prev(tangent)
    along = along / safe_norm(along).clamp(min=1e-9)
    normal = velocity - along * dot(along, velocity)
    real = rest.length * rest.edge_mask
    reach = 0.5 * (real + view.prev(real))
    scale = AIR_DENSITY * c_d * view.params.material.radius * reach * safe_norm(normal)
    return {"force": -scale * normal, "drag": scale * (2 - along.square())}


@dataclass(frozen=True)
class AirDrag(Effect):
    """Quadratic drag across the rope, -rho c_d r |v_n| v_n per length, v_n the velocity normal to the rope."""

    name: ClassVar[str] = "air_drag"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "f = -½ rho c_d 2r |vₙ| vₙ per length; vₙ: velocity across the rope; rho = 1.2 kg/m³"
    params: ClassVar[dict[str, Param]] = {
        "c_d": Param(1.2, 0.0, 20.0, "1", "linear", 0.0, "Drag coefficient of the rope in cross-flow.")
    }
    spec = RopeEffectSpec(
        lambda _: [{"c_d": 0.5}],
        strength=("c_d",),
        confusable=("bending_damping", "internal_friction", "bending_plasticity"),
        experiments={
            "bending_damping": "pluck short waves, then swing the whole rope slowly: air brakes what is fast, inner "
            "damping what bends quickly",
            "internal_friction": "let it swing freely from a large and from a small amplitude: air brakes the large "
            "one more, friction the small one",
        },
        requires="air",
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return drag forces and how they answer to velocity."""
        return _drag(view, values["c_d"], view.state.vel)


@dataclass(frozen=True)
class Wind(Effect):
    """The drag of `AirDrag` against air that flows steadily.

    It is the whole drag, not what the flow adds: in air at rest it equals `AirDrag` with the same c_d. The law is
    quadratic, so it cannot be split in two. Use one of them; where both are listed, leave one with c_d = 0.
    """

    name: ClassVar[str] = "wind"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = (
        "f = -½ rho c_d 2r |wₙ| wₙ per length; w = v - velocity of the air, wₙ: its part across the rope"
    )
    params: ClassVar[dict[str, Param]] = {
        "velocity": Param((0.0, 0.0, 0.0), -20.0, 20.0, "m/s", "linear", None, "Velocity of the air."),
        "c_d": Param(1.2, 0.0, 20.0, "1", "linear", 0.0, "Drag coefficient of the rope in cross-flow."),
    }
    spec = RopeEffectSpec(
        lambda _: [{"c_d": 1.2, f"velocity.{k}": v} for k in range(3) for v in (-1.0, 1.0)],
        strength=("velocity",),
        power=2.0,
        confusable=("tilted_gravity", "rest_curvature", "marker_offset"),
        experiments={
            "tilted_gravity": "hang a known weight on the rope: what a tilt does grows with it, what air does shrinks",
            "air_drag": "repeat the motion in the opposite direction: a flow of air favours one",
        },
        special_case=("air_drag", {"velocity": 0.0}),
        requires="air",
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return drag forces and how they answer to velocity."""
        return _drag(view, values["c_d"], view.state.vel - values["velocity"])
