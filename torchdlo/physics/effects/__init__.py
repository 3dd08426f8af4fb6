"""Every effect that rods know by themselves, by name."""

from __future__ import annotations

from torchdlo.physics.effects.base import Effect
from torchdlo.physics.effects.bending_models import AnisotropicBending, InternalFriction, StiffeningBending
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch, Twist
from torchdlo.physics.effects.external import AirDrag, Damping, Gravity, TiltedGravity, Wind
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.physics.effects.link_chain import LinkChain
from torchdlo.physics.effects.material import (
    AxialStiffness,
    BendingDamping,
    BendingPlasticity,
    NonuniformStiffness,
    PointMass,
    RestCurvature,
)
from torchdlo.physics.effects.measurement import MarkerOffset, TimeDelay
from torchdlo.physics.effects.table import Table, TableFriction

EFFECTS: dict[str, type[Effect]] = {
    "stretch_force": Stretch,
    "bend": Bend,
    "bend_frame": BendFrame,
    "twist": Twist,
    "gravity": Gravity,
    "damping": Damping,
    "tilted_gravity": TiltedGravity,
    "air_drag": AirDrag,
    "wind": Wind,
    "table": Table,
    "table_friction": TableFriction,
    "bending_damping": BendingDamping,
    "bending_plasticity": BendingPlasticity,
    "rest_curvature": RestCurvature,
    "nonuniform_stiffness": NonuniformStiffness,
    "point_mass": PointMass,
    "stretch": AxialStiffness,
    "internal_friction": InternalFriction,
    "stiffening_bending": StiffeningBending,
    "anisotropic_bending": AnisotropicBending,
    "gripper_compliance": GripperCompliance,
    "link_chain": LinkChain,
    "time_delay": TimeDelay,
    "marker_offset": MarkerOffset,
}

__all__ = [
    "EFFECTS",
    "AirDrag",
    "AnisotropicBending",
    "AxialStiffness",
    "Bend",
    "BendFrame",
    "BendingDamping",
    "BendingPlasticity",
    "Damping",
    "Gravity",
    "GripperCompliance",
    "InternalFriction",
    "LinkChain",
    "MarkerOffset",
    "NonuniformStiffness",
    "PointMass",
    "RestCurvature",
    "StiffeningBending",
    "Stretch",
    "Table",
    "TableFriction",
    "TiltedGravity",
    "TimeDelay",
    "Twist",
    "Wind",
]
