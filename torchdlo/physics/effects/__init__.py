"""Every effect that rods know by themselves, by name."""

from __future__ import annotations

from torchdlo.physics.effect import Effect
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch, Twist
from torchdlo.physics.effects.field import AirDrag, Damping, Gravity
from torchdlo.physics.effects.material import (
    BendingDamping,
    BendingPlasticity,
    NonuniformStiffness,
    PointMass,
    RestCurvature,
)
from torchdlo.physics.effects.table import Table, TableFriction

EFFECTS: dict[str, type[Effect]] = {
    "stretch_force": Stretch,
    "bend": Bend,
    "bend_frame": BendFrame,
    "twist": Twist,
    "gravity": Gravity,
    "damping": Damping,
    "air_drag": AirDrag,
    "table": Table,
    "table_friction": TableFriction,
    "bending_damping": BendingDamping,
    "bending_plasticity": BendingPlasticity,
    "rest_curvature": RestCurvature,
    "nonuniform_stiffness": NonuniformStiffness,
    "point_mass": PointMass,
}

__all__ = ["EFFECTS"]
