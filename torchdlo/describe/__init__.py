"""Scene files: a whole simulation as plain data that a person writes.

Ropes, effects, bodies, matter, robots, and what is held and moved. A `Description` becomes a scene, its parameters, its
first state and the controls of all steps by `build`, and a JSON file by `save`. Numbers are SI, angles in radians. What
a file does not say has the value that the field has in `kinds`.
"""

from __future__ import annotations

from torchdlo.describe.assembly import Simulation, assemble, build, load
from torchdlo.describe.files import FORMAT, parse, plain, read, save, text
from torchdlo.describe.kinds import Body, Box, Description, Hold, Key, Matter, Robot, Rope, Weight
from torchdlo.describe.model import cable

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
