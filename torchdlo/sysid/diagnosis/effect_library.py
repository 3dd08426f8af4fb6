"""The effects that a recording may need beyond the baseline model: which can be in it, with which numbers.

The laws are the simulator's own (`torchdlo.physics.effects`). Here stands what only a recording tells: whether an
effect can show in it at all, numbers that are known, and where a search for the others begins.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import Effect, Param
from torchdlo.physics.effects.gripper_compliance import GripperCompliance
from torchdlo.sysid.model.discretisation import Mesh
from torchdlo.sysid.recordings.recording import Recording

PARAMETERS: dict[str, Param] = {
    "bending_stiffness": Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, "Uniform bending stiffness EI."),
    "twisting_stiffness": Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, "Uniform twisting stiffness GJ."),
    "damping_rate": Param(0.5, 1e-2, 20.0, "1/s", "log", None, "Rate at which all velocities decay."),
    "rest_share": Param(1.0, 0.0, 2.0, "1", "linear", 0.0, "Share of the given rest shape's curvature that is real."),
    "rest_roll": Param(
        0.0,
        -np.pi,
        np.pi,
        "rad",
        "linear",
        None,
        "Angle from the vertical to the normal of the rest shape's plane, about the first clamp.",
        periodic=True,
    ),
}
"""Numbers that calibration may fit."""

LIBRARY: tuple[str, ...] = (
    "air_drag",
    "wind",
    "tilted_gravity",
    "bending_damping",
    "rest_curvature",
    "bending_plasticity",
    "internal_friction",
    "stiffening_bending",
    "nonuniform_stiffness",
    "anisotropic_bending",
    "point_mass",
    "stretch",
    "table_friction",
    "gripper_compliance",
    "time_delay",
    "marker_offset",
)
"""Names of the effects that may be found missing."""

KIN: tuple[frozenset[str], ...] = (
    frozenset({"air_drag", "bending_damping", "internal_friction", "bending_plasticity"}),
    frozenset({"wind", "tilted_gravity", "rest_curvature", "marker_offset"}),
    frozenset({"nonuniform_stiffness", "stiffening_bending", "anisotropic_bending", "gripper_compliance"}),
    frozenset({"point_mass", "nonuniform_stiffness"}),
)
"""Effects that do alike things: take up energy, push or bend to one side, change how firm the rope is, or where it is
slow. Small doses of them are hard to tell apart, fits are not."""

CONTAINED = {"wind": ("air_drag", {"velocity": 0.0})}
"""Effects by more general ones, and which of their numbers are what where they are the same: more numbers fit noise."""

STRENGTHS = {
    "air_drag": ("c_d", 1.0),
    "wind": ("velocity", 2.0),
    "tilted_gravity": ("angles", 1.0),
    "bending_damping": ("coefficient", 1.0),
    "rest_curvature": ("curvature", 1.0),
    "internal_friction": ("moment", 1.0),
    "stiffening_bending": ("c", 1.0),
    "nonuniform_stiffness": ("factor", 1.0),
    "anisotropic_bending": ("ratio", 1.0),
    "point_mass": ("mass", 1.0),
    "stretch": ("EA", 1.0),
    "table_friction": ("mu", 1.0),
    "gripper_compliance": ("stiffness", 1.0),
    "time_delay": ("delay", 1.0),
    "marker_offset": ("offset", 1.0),
}
"""By effect: the number that says how large it is, and the power of it with which the gap grows; plasticity has none,
as what flows beyond a yield point does not grow with it evenly."""

_KNOWN = {
    "tilted_gravity": ("acceleration",),
    "bending_plasticity": ("hardening",),
    "table_friction": ("slip", "height", "hardness"),
}
"""Numbers of effects that are not fitted: what the recording says, or what motion hardly shows."""


@dataclass(frozen=True)
class Number:
    """One number of a model that may be fitted."""

    name: str
    """`effect.number`, with `.k` for a component, or the name of a baseline number."""
    param: Param
    """Its declaration, for a component by itself."""
    off: float
    """Value at which its effect does nothing, or at which it is while the effect is off."""


def check_known(what: str, name: str) -> None:
    """Raise an `InputError` that begins with `what` if there is no such effect in the library."""
    if name not in LIBRARY:
        close = difflib.get_close_matches(name, LIBRARY, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(LIBRARY)}."
        raise InputError(f"{what}: {name} is no effect that can be looked for; {hint}")


def applicable(name: str, recording: Recording, mesh: Mesh) -> bool:
    """Return whether an effect can show in a recording."""
    if name == "table_friction":
        return recording.table_height is not None
    if name == "gripper_compliance":
        return bool(mesh.clamp_hinges)
    return True


def instance(name: str, mesh: Mesh) -> Effect:
    """Return the effect for the rope of a recording."""
    if name == "gripper_compliance":
        return GripperCompliance(hinges=mesh.clamp_hinges)
    return EFFECTS[name]()


def known(name: str, recording: Recording) -> dict[str, object]:
    """Return the numbers of an effect that the recording gives."""
    if name == "tilted_gravity":
        return {"acceleration": list(recording.gravity)}
    if name in ("table_friction", "table"):
        return {"height": recording.table_height}
    return {}


def numbers(name: str, recording: Recording) -> list[Number]:
    """Return the numbers of an effect that are fitted."""
    found = []
    for key, param in EFFECTS[name].params.items():
        if key in _KNOWN.get(name, ()):
            continue
        if name == "point_mass":
            high = {"position": recording.length, "mass": 2 * recording.mass}[key]
            param = replace(param, high=high, default=0.5 * high if key == "position" else 0.0)
        default = param.default if isinstance(param.default, tuple) else (param.default,)
        for k, value in enumerate(default):
            off = value if param.off is None else param.off
            single = replace(param, default=value)
            found.append(Number(f"{name}.{key}.{k}" if param.size > 1 else f"{name}.{key}", single, float(off)))
    return found


@dataclass(frozen=True, eq=False)
class Perturbation:
    """A small dose of an effect: where its search begins."""

    values: dict[str, float]
    """Numbers that differ from their off values."""
    signed: bool
    """Whether the opposite dose is possible too."""


def probes(
    name: str, recording: Recording, mesh: Mesh, curved: float, baseline: dict[str, float]
) -> list[Perturbation]:
    """Return doses of an effect that together show what it can do.

    Args:
        name: the effect.
        recording: the rope.
        mesh: its vertices.
        curved: a large curvature of the recording [1/m].
        baseline: calibrated numbers of the baseline.
    """
    bend, length = baseline["bending_stiffness"], recording.length
    weight = max(recording.mass * float(np.linalg.norm(recording.gravity)), 1e-3)
    inner = [float(x) for x in np.linspace(0.1, 0.9, 7)]
    tips = inner if len(mesh.clamps) > 1 else [*inner, 1.0]
    signed: dict[str, list[dict[str, float]]] = {
        "tilted_gravity": [{"angles.0": 0.01}, {"angles.1": 0.01}],
        "rest_curvature": [{"curvature.0": 0.05 * curved}, {"curvature.1": 0.05 * curved}],
        "marker_offset": [
            {"offset.0": 0.5 * (recording.radius or 5e-3)},
            {"offset.1": 0.5 * (recording.radius or 5e-3)},
        ],
        "nonuniform_stiffness": [{"position": x, "factor": 0.3, "width": 0.08} for x in inner] + [{"slope": 0.3}],
        "anisotropic_bending": [{"ratio": 1.2, "direction": 0.0}, {"ratio": 1.2, "direction": 0.25 * np.pi}],
        "time_delay": [{"delay": 2e-3}],
    }
    positive: dict[str, list[dict[str, float]]] = {
        "air_drag": [{"c_d": 0.5}],
        "wind": [{"c_d": 1.2, f"velocity.{k}": v} for k in range(3) for v in (-1.0, 1.0)],
        "bending_damping": [{"coefficient": 3e-3 * bend}],
        "bending_plasticity": [
            {"yield_curvature": share * curved, "rate": rate} for share in (0.3, 0.6) for rate in (0.5, 10.0)
        ],
        "internal_friction": [{"moment": 0.1 * bend * curved, "kappa_c": share * curved} for share in (0.03, 0.2)],
        "stiffening_bending": [{"c": 0.2 / curved**2}],
        "point_mass": [{"position": x * length, "mass": 0.05 * recording.mass} for x in tips],
        "stretch": [{"EA": 100 * weight}],
        "table_friction": [{"mu": 0.05}],
        "gripper_compliance": [{"stiffness": 100 * bend / length}],
    }
    doses = signed.get(name) or positive[name]
    return [Perturbation({f"{name}.{key}": float(v) for key, v in dose.items()}, name in signed) for dose in doses]
