"""Every effect that rods know by themselves, by name."""

from __future__ import annotations

from torchdlo.physics.effects.base import Effect
from torchdlo.physics.effects.bending_models import AnisotropicBending, InternalFriction, StiffeningBending
from torchdlo.physics.effects.elastic import Bend, BendFrame, Stretch, Twist
from torchdlo.physics.effects.external import AirDrag, Damping, Gravity, TiltedGravity, Wind
from torchdlo.physics.effects.fluid import Buoyancy, FluidForces
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.physics.effects.link_chain import LinkChain
from torchdlo.physics.effects.loose_clamps import GripperDamping, GripperPlay
from torchdlo.physics.effects.material import (
    AxialStiffness,
    BendingDamping,
    BendingPlasticity,
    NonuniformStiffness,
    PointMass,
    RestCurvature,
    StiffnessProfile,
    VaryingRestCurvature,
)
from torchdlo.physics.effects.measurement import MarkerOffset, TimeDelay
from torchdlo.physics.effects.point_forces import PointForce, PointForces
from torchdlo.physics.effects.table import Table, TableFriction

EFFECTS: dict[str, type[Effect]] = {
    "stretch_force": Stretch,
    "bend": Bend,
    "bend_frame": BendFrame,
    "twist": Twist,
    "gravity": Gravity,
    "damping": Damping,
    "table": Table,
    "link_chain": LinkChain,
    "buoyancy": Buoyancy,
    "stiffness_profile": StiffnessProfile,
    # Those that a diagnosis looks for, in the order in which it does.
    "air_drag": AirDrag,
    "wind": Wind,
    "tilted_gravity": TiltedGravity,
    "bending_damping": BendingDamping,
    "rest_curvature": RestCurvature,
    "bending_plasticity": BendingPlasticity,
    "internal_friction": InternalFriction,
    "stiffening_bending": StiffeningBending,
    "nonuniform_stiffness": NonuniformStiffness,
    "anisotropic_bending": AnisotropicBending,
    "point_mass": PointMass,
    "stretch": AxialStiffness,
    "table_friction": TableFriction,
    "fluid_forces": FluidForces,
    "gripper_compliance": GripperCompliance,
    "gripper_play": GripperPlay,
    "gripper_damping": GripperDamping,
    "time_delay": TimeDelay,
    "marker_offset": MarkerOffset,
    "varying_rest_curvature": VaryingRestCurvature,
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
    "Buoyancy",
    "Damping",
    "FluidForces",
    "Gravity",
    "GripperCompliance",
    "GripperDamping",
    "GripperPlay",
    "InternalFriction",
    "LinkChain",
    "MarkerOffset",
    "NonuniformStiffness",
    "PointForce",
    "PointForces",
    "PointMass",
    "RestCurvature",
    "StiffeningBending",
    "StiffnessProfile",
    "Stretch",
    "Table",
    "TableFriction",
    "TiltedGravity",
    "TimeDelay",
    "Twist",
    "VaryingRestCurvature",
    "Wind",
]
