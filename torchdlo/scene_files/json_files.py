"""Scene files: writing them, reading them, and saying where one does not fit."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import types
import typing
from pathlib import Path
from typing import Any, Literal

from torchdlo.coupling import EFFECTS as COUPLING
from torchdlo.coupling.mpm.body_coupling_effect import BodyMpmCoupling
from torchdlo.coupling.mpm.rod_coupling_effect import RodMpmCoupling
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.physics.effects import EFFECTS as PHYSICS
from torchdlo.scene_files import limits
from torchdlo.scene_files.older import OLDER, upgraded
from torchdlo.scene_files.schema import SceneDescription
from torchdlo.untrusted import one_line, parse_json, read_text
from torchdlo.untrusted.json_file import MOST

__all__ = ["EFFECTS", "FORMAT", "like", "parse", "plain", "read", "save", "text"]

EFFECTS = PHYSICS | COUPLING | {e.name: e for e in (RodMpmCoupling, BodyMpmCoupling)}
FORMAT = "torchdlo scene 2"
"""What the entry "format" of a file that is written says; files of version 1 are read, too."""


def save(description: SceneDescription, path: str | Path) -> None:
    """Write a description as JSON, without what has its default. Numbers read back as they were, to the last bit."""
    limits.check_ranges(description, EFFECTS)
    write_atomically(Path(path), text(description))


def text(description: SceneDescription) -> str:
    """Return what `save` writes."""
    return json.dumps({"format": FORMAT} | plain(description), indent=1, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Return a description as lists and objects, without what has its default."""
    if dataclasses.is_dataclass(value):
        fields = {f.name: (getattr(value, f.name), _default(f)) for f in dataclasses.fields(value)}
        return {name: plain(given) for name, (given, usual) in fields.items() if given != usual}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return {k: plain(v) for k, v in value.items()} if isinstance(value, dict) else value


def _default(one: dataclasses.Field) -> Any:
    return one.default if one.default_factory is dataclasses.MISSING else one.default_factory()


def read(path: str | Path) -> SceneDescription:
    """Read a scene file."""
    return parse(read_text(path, "a scene file", most=MOST), where=str(path))


def parse(content: str, *, where: str = "scene") -> SceneDescription:
    """Read the text of a scene file; `where` is what errors call it."""
    found = parse_json(content, where=where, what="a scene in JSON")
    if not isinstance(found, dict) or found.get("format") not in (FORMAT, OLDER):
        given = found.get("format") if isinstance(found, dict) else type(found).__name__
        hint = ""
        if given == "torchdlo-model":
            hint = ' It is a model file: write a scene around it, {"model": "..."} in one of its ropes.'
        raise InputError(
            f'{where}: expected an object with "format": "{FORMAT}", given {one_line(repr(given), 60)}.{hint}'
        )
    if found.pop("format") == OLDER:
        found = upgraded(found)
    description = _checked(SceneDescription, found, where, "")
    limits.check_ranges(description, EFFECTS, where)
    return description


def _wrong(where: str, place: str, expected: str, given: Any) -> InputError:
    return InputError(f"{where}: {place or 'the whole'}: expected {expected}, given {json.dumps(given)[:60]}.")


def like(name: str, known: typing.Iterable[str]) -> str:
    """Return a hint at the known name that is most like a wrong one, or the list of them."""
    known = list(known)
    near = difflib.get_close_matches(name, known, 1)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


def _checked(kind: Any, given: Any, where: str, place: str) -> Any:
    """Return plain data as a value of a type, or say where it does not fit."""
    if dataclasses.is_dataclass(kind):
        return _record(kind, given, where, place)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        if given is None and type(None) in inner:
            return None
        lists = [one for one in inner if typing.get_origin(one) is tuple and isinstance(given, list)]
        return _checked((lists or inner)[0], given, where, place)
    if origin is Literal:
        if given not in inner:
            hint = like(given, inner) if isinstance(given, str) else "give it in quotes"
            raise _wrong(where, place, f"one of {', '.join(map(repr, inner))} ({hint})", given)
        return given
    if origin is tuple:
        count = None if inner[-1] is ... else len(inner)
        if not isinstance(given, list) or (count is not None and len(given) != count):
            what = "numbers" if inner[0] in (int, float) else "entries"
            raise _wrong(where, place, f"a list of {'any length' if count is None else f'{count} {what}'}", given)
        return tuple(_checked(inner[0], v, where, f"{place}[{k}]") for k, v in enumerate(given))
    if origin is dict:
        return _numbers(given, where, place) if inner[1] is float else _effects(given, where, place)
    number = isinstance(given, (int, float)) and not isinstance(given, bool)
    if kind is float and number and math.isfinite(given):
        return float(given)
    if kind in (int, bool, str) and type(given) is kind:
        return given
    names = {float: "a finite number", int: "a whole number", bool: "true or false", str: "text in quotes"}
    raise _wrong(where, place, names[kind], given)


def _record(kind: Any, given: Any, where: str, place: str) -> Any:
    if not isinstance(given, dict):
        raise _wrong(where, place, f"an object {{...}} that describes a {kind.__name__.lower()}", given)
    hints, fields = typing.get_type_hints(kind), {f.name: f for f in dataclasses.fields(kind)}
    dot = f"{place}." if place else ""
    for name in given:
        if name not in fields:
            raise InputError(f"{where}: {dot}{name}: there is no such entry; {like(name, fields)}.")
    for name, one in fields.items():
        if name not in given and _default(one) is dataclasses.MISSING:
            raise InputError(f"{where}: {dot}{name}: is missing; expected it in every {kind.__name__.lower()}.")
    return kind(**{name: _checked(hints[name], value, where, dot + name) for name, value in given.items()})


def _numbers(given: Any, where: str, place: str) -> dict[str, float]:
    if not isinstance(given, dict):
        raise _wrong(where, place, 'an object such as {"density": 1000}', given)
    return {name: _checked(float, value, where, f"{place}.{name}") for name, value in given.items()}


def _effects(given: Any, where: str, place: str) -> dict[str, dict[str, Any]]:
    if not isinstance(given, dict):
        raise _wrong(where, place, 'an object such as {"gravity": {}}', given)
    for name, numbers in given.items():
        here = f"{place}.{name}"
        if name not in EFFECTS:
            raise InputError(f"{where}: {here}: there is no such effect; {like(name, EFFECTS)}.")
        if not isinstance(numbers, dict):
            raise _wrong(where, here, "an object with its parameters, {} for the defaults", numbers)
        params = EFFECTS[name].params
        own: Any = EFFECTS[name]
        choices = {f.name for f in dataclasses.fields(own)}
        for key, value in numbers.items():
            if key not in params and key not in choices:
                known = [*params, *sorted(choices)]
                hint = like(key, known) if known else "it has none"
                raise InputError(f"{where}: {here}.{key}: there is no such parameter; {hint}.")
            if key in params:
                size = params[key].size
                kind: Any = float if size == 1 else tuple.__class_getitem__((float,) * size)
                _checked(kind, value, where, f"{here}.{key}")
            else:
                _checked(typing.get_type_hints(EFFECTS[name])[key], value, where, f"{here}.{key}")
    return given
