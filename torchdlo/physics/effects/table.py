"""A horizontal table: it carries the rope, and it may rub."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.linalg.numerics import total
from torchdlo.physics.rod.kinematics import View

_HEIGHT = Param(0.0, -10.0, 10.0, "m", "linear", None, "Height of the table's surface.")
_HARDNESS = Param(500.0, 50.0, 1e4, "rad/s", "log", None, "Frequency at which a vertex would bounce on it.")


def _pressure(view: View, values: Values) -> tuple[Tensor, Tensor]:
    """Return the upward force on vertices [N] and its stiffness [N/m], shape (..., V, 1) each."""
    stiffness = view.params.material.mass * values["hardness"].square()
    depth = values["height"] + view.params.material.radius - view.state.pos[..., 2:]
    touching = depth > 0
    stiffness = torch.where(touching, stiffness, 0.0)
    return stiffness * depth, stiffness


@dataclass(frozen=True)
class Table(Effect):
    """Support without friction: a stiff spring per vertex, damped at half its critical value while it is pressed."""

    name: ClassVar[str] = "table"
    kind: ClassVar[EffectKind] = "force"
    params: ClassVar[dict[str, Param]] = {"height": _HEIGHT, "hardness": _HARDNESS}

    def loads(self, view: View, values: Values) -> Values:
        """Return the upward force, its stiffness and resistance."""
        force, stiffness = _pressure(view, values)
        resistance = torch.where(stiffness > 0, view.params.material.mass * values["hardness"], 0.0)
        up = force - resistance * view.state.vel[..., 2:]
        none = torch.zeros_like(up)
        return {
            "force": tree.cat_components([none, none, up]),
            "stiffness": tree.cat_components([none, none, stiffness]),
            "drag": tree.cat_components([none, none, resistance]),
        }


@dataclass(frozen=True)
class TableFriction(Effect):
    """Coulomb friction on the table, -mu N v / sqrt(|v|^2 + slip^2) along the surface."""

    name: ClassVar[str] = "table_friction"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "f = -mu N v / √(|v|² + slip²) along the table"
    params: ClassVar[dict[str, Param]] = {
        "mu": Param(0.0, 0.0, 2.0, "1", "linear", 0.0, "Coefficient of friction."),
        "slip": Param(1e-3, 1e-5, 0.1, "m/s", "log", None, "Speed below which friction grows with speed: creep."),
        "height": _HEIGHT,
        "hardness": _HARDNESS,
    }
    spec = RopeEffectSpec(
        lambda _: [{"mu": 0.05}],
        strength=("mu",),
        fixed=("slip", "height", "hardness"),
        known=lambda rope: {"height": rope.table_height},
        requires="table",
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return the friction force and how it answers to velocity."""
        pressure, _ = _pressure(view, values)
        along = view.state.vel[..., :2]
        speed = (total(along.square()) + values["slip"].square()).sqrt()
        resistance = values["mu"] * pressure / speed
        none = torch.zeros_like(resistance)
        return {
            "force": tree.cat_components([-resistance * along, none]),
            "drag": tree.cat_components([resistance, resistance, none]),
        }
