"""The effects that a recording may need beyond the baseline model.

What an effect is, its equation and how it is looked for is declared beside it, in `torchdlo.physics.effects`: here that
meets a recording. An effect with a `spec` is looked for as soon as it is in `EFFECTS`.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from torchdlo.coupling.rod_contact.self_contact import SelfContact
from torchdlo.errors import InputError
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import Effect, EffectKind, Param
from torchdlo.physics.effects.effect_spec import RopeEffectSpec, RopeScales
from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.model.discretisation import Mesh
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.sysid.recordings.self_approach import near_itself

EFFECTS[SelfContact.name] = SelfContact  # it stands above `physics.effects`, as contact of ropes does

PARAMETERS: dict[str, Param] = {
    "bending_stiffness": Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, "Uniform bending stiffness EI."),
    "twisting_stiffness": Param(1e-3, 1e-7, 1.0, "N m^2", "log", None, "Uniform twisting stiffness GJ."),
    "damping_rate": Param(0.5, 1e-2, 20.0, "1/s", "log", None, "Rate at which all velocities decay."),
    "mass": Param(0.1, 1e-6, 1e5, "kg", "log", None, "Mass of the rope without markers."),
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

_GAS = 20.0
"""Density above which what surrounds a rope is a liquid, in which air does nothing [kg/m^3]."""

MEANING: dict[EffectKind, str] = {
    "force": "a force from outside",
    "material": "a law of the rope",
    "boundary": "a law of its grips",
    "measurement": "how it is measured, no force",
}
"""What the kinds of effects are."""


@dataclass(frozen=True)
class Number:
    """One number of a model that may be fitted."""

    which: ParameterName
    """Which one."""
    param: Param
    """Its declaration, for a component by itself."""
    off: float
    """Value at which its effect does nothing, or at which it is while the effect is off."""

    @property
    def name(self) -> str:
        """Its name as text."""
        return str(self.which)


@dataclass(frozen=True, eq=False)
class Perturbation:
    """A small dose of an effect: where its search begins."""

    values: dict[str, float]
    """Numbers that differ from their off values."""
    signed: bool
    """Whether the opposite dose is possible too."""


def library() -> tuple[str, ...]:
    """Return the names of the effects that may be found missing."""
    return tuple(name for name, effect in EFFECTS.items() if effect.spec is not None)


def spec(name: str) -> RopeEffectSpec:
    """Return how an effect of the library is looked for."""
    found = EFFECTS[name].spec
    if found is None:
        raise ValueError(f"{name}: expected an effect that a diagnosis looks for, one with a `spec`.")
    return found


def check_known(what: str, name: str) -> None:
    """Raise an `InputError` that begins with `what` if there is no such effect in the library."""
    if name not in library():
        close = difflib.get_close_matches(name, library(), n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(library())}."
        raise InputError(f"{what}: {name} is no effect that can be looked for; {hint}")


def applicable(name: str, recording: Recording, mesh: Mesh) -> bool:
    """Return whether an effect can show in a recording."""
    required = spec(name).requires
    if required == "near_itself":
        return near_itself(recording)
    here = {
        "table": recording.table_height is not None,
        "clamps": bool(mesh.clamp_hinges),
        "fluid": recording.fluid_density is not None,
        "air": recording.fluid_density is None or recording.fluid_density < _GAS,
        "rest": recording.still,
        None: True,
    }
    return here[required]


def instance(name: str, mesh: Mesh) -> Effect:
    """Return the effect for the rope of a recording."""
    kind = EFFECTS[name]
    if kind.spec is not None and kind.spec.requires == "clamps":
        return replace(kind(), hinges=mesh.clamp_hinges)  # type: ignore[type-var]  # effects are dataclasses
    return kind()


def known(name: str, recording: Recording) -> Mapping[str, object]:
    """Return the numbers of an effect that the recording gives."""
    found = EFFECTS[name].spec
    return {} if found is None else found.known(recording)


def numbers(name: str, recording: Recording) -> list[Number]:
    """Return the numbers of an effect that are fitted."""
    kind, found = EFFECTS[name], []
    fixed = () if kind.spec is None else kind.spec.fixed
    limits = {} if kind.spec is None else kind.spec.limits(recording)
    for key, param in kind.params.items():
        if key in fixed:
            continue
        if key in limits:
            default, high = limits[key]
            param = replace(param, default=default, high=high)
        components = param.default if isinstance(param.default, tuple) else (param.default,)
        for k, value in enumerate(components):
            off = value if param.off is None else param.off
            single = replace(param, default=value)
            found.append(Number(ParameterName(name, key, k if param.size > 1 else None), single, float(off)))
    return found


def greatest(name: str, number: str, recording: Recording) -> float:
    """Return the greatest size that a number of an effect may have, whatever its sign, as declared or as recorded."""
    param = EFFECTS[name].params[number]
    return max(abs(param.low), abs(spec(name).limits(recording).get(number, (0.0, param.high))[1]))


def perturbations(
    name: str, recording: Recording, mesh: Mesh, curvature: float, baseline: Mapping[str, float]
) -> list[Perturbation]:
    """Return doses of an effect that together show what it can do.

    Args:
        name: the effect.
        recording: the rope.
        mesh: its vertices.
        curvature: a large one of the recording [1/m].
        baseline: calibrated numbers of the baseline.
    """
    weight = max(recording.mass * float(np.linalg.norm(recording.gravity)), 1e-3)
    inside = tuple(float(x) for x in np.linspace(0.1, 0.9, 7))
    loose = inside if len(mesh.clamps) > 1 else (*inside, 1.0)
    scales = RopeScales(recording, baseline["bending_stiffness"], curvature, weight, inside, loose)
    how = spec(name)
    return [
        Perturbation({f"{name}.{key}": float(value) for key, value in dose.items()}, how.signed)
        for dose in how.perturbations(scales)
    ]


def confusable(name: str, other: str) -> bool:
    """Return whether two effects do alike things: small doses of them are hard to tell apart, fits are not."""
    return other in spec(name).confusable or name in spec(other).confusable


def special_case(name: str) -> tuple[str | None, Mapping[str, float]]:
    """Return the effect that a more general one contains, None if it contains none, and what it is in numbers.

    Where those numbers may be these, they fit noise.
    """
    return spec(name).special_case or (None, {})


def effect_equation(name: str) -> str:
    """Return the equation of an effect. The letters are names of its numbers where they are spelled out."""
    equation = EFFECTS[name].equation if name in EFFECTS else ""
    return equation or name.replace("_", " ")


def separating_experiment(name: str, other: str) -> str:
    """Return the experiment that would tell two effects apart."""
    for one, two in ((name, other), (other, name)):
        how = EFFECTS[one].spec if one in EFFECTS else None
        if how is not None and two in how.experiments:
            return how.experiments[two]
    return "record motions of other speeds, amplitudes and directions"
