"""Scene files: a whole simulation as plain data that a person writes.

Ropes, effects, bodies, material points, robots, and what is held and moved. A `SceneDescription` becomes a scene, its
parameters, its first state and the controls of all steps by `build`, and a JSON file by `save`. Numbers are SI, angles
in radians. What a file does not say has the value that the field has in `kinds`.
"""

from __future__ import annotations

from torchdlo.scene_files.json_files import FORMAT, parse, plain, read, save, text
from torchdlo.scene_files.rope_models import cable
from torchdlo.scene_files.scene_assembly import Simulation, assemble, build, load
from torchdlo.scene_files.schema import (
    Attachment,
    BodySpec,
    GridSpec,
    HangingMass,
    JointSpec,
    Keyframe,
    ParticleBlockSpec,
    PointForceSpec,
    RobotSpec,
    RopeSpec,
    SceneDescription,
)

__all__ = [
    "FORMAT",
    "Attachment",
    "BodySpec",
    "GridSpec",
    "HangingMass",
    "JointSpec",
    "Keyframe",
    "ParticleBlockSpec",
    "PointForceSpec",
    "RobotSpec",
    "RopeSpec",
    "SceneDescription",
    "Simulation",
    "assemble",
    "build",
    "cable",
    "load",
    "parse",
    "plain",
    "read",
    "save",
    "text",
]
