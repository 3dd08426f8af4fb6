"""Model files: a rope with its fitted parameters and effects, as every command writes and reads it."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.parameter_name import ParameterName, values_of
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.effect_library import PARAMETERS
from torchdlo.sysid.estimation.evaluation import rope_content
from torchdlo.sysid.model.discretisation import make_mesh
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.untrusted import one_line, read_json

__all__ = ["FORMAT", "VERSION", "ModelFile", "content", "load"]

FORMAT = "torchdlo-model"
"""What a model file says it is."""

VERSION = 3
"""Version of the format; files of version 2 are read, too."""

_OLDER = {"ahead": "numerical_damping", "grip": "clamp_fraction"}
"""Options of version 2 that are called otherwise today."""

_OPTIONS = {"vertices": int, "rest": str, "numerical_damping": float, "clamp_fraction": float, "substep": float}
"""How the model is built, see `RopeModel`."""

_OPTIONAL = {"mass": float}
"""Those that a file may lack."""

_OPTION_RANGES = {"vertices": (2, 100_000), "substep": (1e-9, 1.0), "mass": (1e-12, 1e5)}
"""Least and greatest values, 0 and 1 where nothing is said."""

_BASELINE = ("bending_stiffness", "twisting_stiffness", "damping_rate")


@dataclass(frozen=True)
class ModelFile:
    """A model that was read from a file."""

    path: Path
    """The file."""
    effects: tuple[str, ...]
    """Effects that it has besides the baseline."""
    values: dict[str, float]
    """Its parameters, those of effects as `effect.number`."""
    options: dict[str, Any]
    """How it is built, see `RopeModel`."""

    def model(self, recording: Recording, **options: Any) -> RopeModel:
        """Return the model for the rope and the grippers of a recording; options replace those of the file."""
        if self.options["rest"] == "given" and recording.rest_positions is None:
            raise InputError(
                f"{self.path}: the model has a given rest shape; expected rest_positions in "
                f"{recording.path / 'rope.json'}, found none."
            )
        model = RopeModel(recording, effects=self.effects, **(self.options | options))
        for name in self.effects:
            if name not in effect_library.library():
                continue
            # Whether a rope comes near itself is a matter of its motion, which may be another one here.
            near = effect_library.spec(name).requires == "near_itself"
            acts = recording.radius is not None if near else effect_library.applicable(name, recording, model.mesh)
            if not acts:
                raise InputError(
                    f"{self.path}: {name}: expected a recording in which it can act, but {recording.path} has nothing "
                    "that it acts on (no table, no clamp of two markers, no liquid, or no radius)."
                )
        return model

    def start(self, model: RopeModel) -> np.ndarray:
        """Return the numbers in the order of a model's, shape (K,); what the file lacks is the model's guess."""
        guess = dict(zip(model.parameters, model.guess(), strict=True))
        return np.array([self.values.get(name, guess[name]) for name in model.parameters], dtype=float)

    def sizes(self, model: RopeModel) -> dict[str, float]:
        """Return the numbers that are worth fitting, with what counts as much of each, see `fit.ParameterSpace`.

        Those of effects at which they are off stay off.
        """
        found = {}
        for number, value in zip(model.numbers, self.start(model), strict=True):
            param = number.param
            if number.which.effect in self.effects and param.off is not None and value == param.off:
                continue
            if param.scale == "log":
                found[number.name] = 1.0
            elif param.scale == "reciprocal":
                found[number.name] = 1 / min(value, 1e6 * param.low)
            else:
                found[number.name] = abs(value) or 0.1 * (param.high - param.low)
        return found


def content(model: RopeModel, values: np.ndarray) -> dict[str, Any]:
    """Return what a model file holds, for JSON."""
    numbers = dict(zip(model.parameters, map(float, values), strict=True))
    # A mass that forces told is one of the rope, whichever recording it is simulated on.
    mass = numbers.pop("mass", model.mass)
    own = {} if mass == model.recording.mass else {"mass": mass}
    return {
        "format": FORMAT,
        "version": VERSION,
        "rope": rope_content(model.recording, model.rest) | {"mass": mass},
        "parameters": values_of("", numbers),
        "effects": {name: values_of(name, numbers) for name in model.effects},
        "options": {
            "vertices": _asked(model),
            "rest": model.rest,
            "numerical_damping": model.numerical_damping,
            "clamp_fraction": model.clamp_fraction,
            "substep": model.dt / model.substeps,
            **own,
        },
        "mesh": {"arclength": model.arclength, "marker_vertex": model.marker_vertex},
        "step": model.step,
    }


def _asked(model: RopeModel) -> int:
    """Return a number of vertices that, asked for, gives this mesh again."""
    trial, count = model.recording.train[0], len(model.arclength)
    for vertices in sorted(range(2, 4 * count), key=lambda v: abs(v - count)):
        if np.array_equal(make_mesh(trial, model.recording.length, vertices).arclength, model.arclength):
            return vertices
    return count


def load(path: str | Path) -> ModelFile:
    """Read a model file.

    Raises:
        InputError: The file is not a model, or not one that this version knows.
    """
    path = Path(path)
    found = _read(path)
    parameters = _object(path, found, "parameters")
    effects = _object(path, found, "effects")
    options = _object(path, found, "options")
    values: dict[str, float] = {}
    for name, value in parameters.items():
        _check_name(path, "parameters", name, PARAMETERS)
        values[name] = _number(path, f"parameters.{name}", value, PARAMETERS[name].low, PARAMETERS[name].high)
    missing = [name for name in _BASELINE if name not in values]
    if missing:
        raise InputError(f"{path}: parameters: expected {', '.join(_BASELINE)}, found no {', '.join(missing)}.")
    known = {name: EFFECTS[name] for name in EFFECTS}
    for name, numbers in effects.items():
        _check_name(path, "effects", name, known)
        if not isinstance(numbers, dict):
            _refuse(path, f"effects.{name}", "an object with its numbers", repr(numbers))
        for key, value in numbers.items():
            _check_number(path, name, key)
            limit = 10 * max(1.0, *(abs(v) for v in _bounds(name, key)))
            values[f"{name}.{key}"] = _number(path, f"effects.{name}.{key}", value, -limit, limit)
    return ModelFile(path, tuple(effects), values, _options(path, options))


def _read(path: Path) -> dict[str, Any]:
    if path.is_dir():
        raise InputError(f"{path}: expected a model file, found a folder; give the model.json in it.")
    found = read_json(path, "a model file", cure="torchdlo calibrate and diagnose write one")
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        hint = ""
        if isinstance(found, dict) and str(found.get("generator", "")).startswith("torchdlo"):
            hint = "; it is another result of torchdlo: give the model.json beside it"
        raise InputError(f'{path}: expected a model file ("format": "{FORMAT}"), found something else{hint}.')
    if found.get("version") == 2 and isinstance(found.get("options"), dict):
        options = {_OLDER.get(name, name): value for name, value in found["options"].items()}
        return found | {"version": VERSION, "options": options}
    if found.get("version") != VERSION:
        given = one_line(repr(found.get("version")), 60)
        raise InputError(
            f"{path}: version: expected {VERSION}, found {given}; write the model again with this version of torchdlo."
        )
    return found


def _options(path: Path, given: dict[str, Any]) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for name, kind in (_OPTIONS | _OPTIONAL).items():
        if name not in given and name in _OPTIONAL:
            continue
        if name not in given:
            _refuse(path, f"options.{name}", "this entry", "none")
        value = given[name]
        if kind is str:
            if value not in ("straight", "given"):
                _refuse(path, f"options.{name}", "straight or given", repr(value))
            options[name] = value
        else:
            low, high = _OPTION_RANGES.get(name, (0.0, 1.0))
            if kind is int and type(value) is not int:
                _refuse(path, f"options.{name}", f"a whole number from {low:g} to {high:g}", repr(value)[:40])
            options[name] = kind(_number(path, f"options.{name}", value, low, high))
    # A quotient of frame times by substeps may round down: one substep more would be another model.
    options["substep"] *= 1 + 1e-9
    for name in given:
        _check_name(path, "options", name, _OPTIONS | _OPTIONAL)
    return options


def _object(path: Path, found: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(found.get(name), dict):
        _refuse(path, name, "an object", "none" if name not in found else repr(found[name])[:40])
    return found[name]


def _check_name(path: Path, where: str, name: str, known: Mapping[str, Any]) -> None:
    if name not in known:
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}."
        raise InputError(f"{path}: {where}: unknown name {name}; {hint}")


def _check_number(path: Path, effect: str, key: str) -> None:
    """Refuse a number that an effect does not have; those with components are called `number.0`, `number.1`, ..."""
    name, params = key.partition(".")[0], EFFECTS[effect].params
    _check_name(path, f"effects.{effect}", name, params)
    size = params[name].size
    parts = [f"{name}.{k}" for k in range(size)] if size > 1 else [name]
    if key not in parts:
        _refuse(path, f"effects.{effect}", ", ".join(parts), key)


def _bounds(effect: str, key: str) -> tuple[float, ...]:
    param = EFFECTS[effect].params[ParameterName.parse(f"{effect}.{key}").number]
    return param.low, param.high, param.off or 0.0


def _number(path: Path, name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    limits = f" from {low:g} to {high:g}" if math.isfinite(high) else f" of at least {low:g}" if low > -math.inf else ""
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    # A fit may stop at a bound, and a file rounds.
    if not good or not low - 1e-9 * abs(low) <= value <= high + 1e-9 * abs(high):
        _refuse(path, name, f"a number{limits}", repr(value))
    return float(value)


def _refuse(path: Path, name: str, expected: str, found: str) -> NoReturn:
    raise InputError(f"{path}: {name}: expected {expected}, found {one_line(found, 100)}.")
