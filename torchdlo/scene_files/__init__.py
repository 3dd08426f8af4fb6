"""Scene files: a whole simulation as plain data that a person writes.

Ropes, effects, bodies, matter, robots, and what is held and moved. A `Description` becomes a scene, its parameters, its
first state and the controls of all steps by `build`, and a JSON file by `save`. Numbers are SI, angles in radians. What
a file does not say has the value that the field has in `kinds`.
"""

from __future__ import annotations

from torchdlo.scene_files.assembly import Simulation, assemble, build, load
from torchdlo.scene_files.json_files import FORMAT, parse, plain, read, save, text
from torchdlo.scene_files.rope_models import cable
from torchdlo.scene_files.schema import Body, Box, Description, Hold, Key, Matter, Robot, Rope, Weight

__all__ = [
    "FORMAT",
    "Body",
    "Box",
    "Description",
    "Hold",
    "Key",
    "Matter",
    "Robot",
    "Rope",
    "Simulation",
    "Weight",
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
