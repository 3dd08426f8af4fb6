"""Scene files: a whole simulation, ropes, effects, bodies, holds and their motion, as plain data that a person writes.

A `Description` becomes a scene, its parameters, its first state and the controls of all steps by `build`, and a JSON
file by `save`. Numbers are SI, angles in radians. What a file does not say has the value that the field has here.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling import EFFECTS as COUPLING
from torchdlo.coupling.bodies import BodyTargets, Solid, turn_by
from torchdlo.coupling.grasp import Hands, carry, weld
from torchdlo.coupling.pose import Pose
from torchdlo.errors import InputError
from torchdlo.files import write_atomically
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS as PHYSICS
from torchdlo.physics.rotation import multiply

__all__ = ["Body", "Description", "Hold", "Key", "Rope", "build", "load", "parse", "read", "save", "text"]

Vector = tuple[float, float, float]
EFFECTS = PHYSICS | COUPLING
FORMAT = "torchdlo scene 1"
"""What the entry "format" of a file says."""


@dataclass(frozen=True)
class Rope:
    """A rope; fields without a comment are those of `scene.Rope`."""

    points: tuple[Vector, ...]
    """Corners of the line along which it lies [m]; its vertices, if `vertices` is not given."""
    vertices: int | None = None
    """How many vertices to place at equal distances along that line."""
    radius: float = 0.005
    mass: float | None = None
    density: float | None = None
    youngs: float | None = None
    shear: float | None = None
    bend: float | None = None
    bend2: float | None = None
    twist: float | None = None
    stretch: float | None = None
    closed: bool = False
    rest: Literal["straight", "as_placed"] = "straight"


@dataclass(frozen=True)
class Key:
    """Where something is at a time, from where it is at the start; between keys it moves by `path`."""

    time: float
    """When [s]."""
    move: Vector = (0.0, 0.0, 0.0)
    """How far it has moved [m]."""
    turn: Vector = (0.0, 0.0, 0.0)
    """By how much it has turned: axis times angle [rad]."""


@dataclass(frozen=True)
class Hold:
    """Vertices of a rope that are held together as by one tool."""

    vertices: tuple[int, ...]
    """Numbers of vertices along the rope; -1 is the last."""
    rope: int = 0
    """Number of the rope."""
    edges: tuple[int, ...] = ()
    """Edges whose twist is held, too."""
    keys: tuple[Key, ...] = ()
    """Motion about the first vertex; none if empty."""
    path: Literal["smooth", "linear"] = "smooth"
    """Whether it starts and stops at each key without a jerk."""
    release: float | None = None
    """When it is let go [s], if ever."""


@dataclass(frozen=True)
class Body:
    """A rigid body; fields without a comment are those of `coupling.bodies.Solid`."""

    shape: Literal["plane", "sphere", "box", "capsule", "cylinder", "cone", "torus", "ring"]
    size: tuple[float, ...] = ()
    pos: Vector = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    vel: Vector = (0.0, 0.0, 0.0)
    omega: Vector = (0.0, 0.0, 0.0)
    motion: Literal["free", "fixed", "kinematic"] = "free"
    density: float | None = None
    mass: float | None = None
    mu_s: float = 0.3
    mu_k: float = 0.3
    restitution: float = 0.0
    damping: float = 0.0
    name: str = ""
    keys: tuple[Key, ...] = ()
    """Motion of a kinematic body."""
    path: Literal["smooth", "linear"] = "smooth"


@dataclass(frozen=True)
class Description:
    """A simulation from its start to its end; fields without a comment are those of `scene.Scene`."""

    ropes: tuple[Rope, ...]
    effects: dict[str, dict[str, Any]]
    """Effects by name, each with the numbers and choices that differ from its defaults."""
    bodies: tuple[Body, ...] = ()
    holds: tuple[Hold, ...] = ()
    duration: float = 1.0
    """How long to simulate [s]."""
    dt: float = 1e-3
    substeps: int = 5
    integrator: Literal["explicit", "implicit"] = "explicit"
    twist: Literal["none", "dynamic", "quasistatic"] = "none"
    constrained: bool = True
    precision: Literal["float64", "float32"] = "float64"
    """Type of all numbers."""
    notes: str = field(default="")
    """Anything."""


def save(description: Description, path: str | Path) -> None:
    """Write a description as JSON, without what has its default. Numbers read back as they were, to the last bit."""
    write_atomically(Path(path), text(description))


def text(description: Description) -> str:
    """Return what `save` writes."""
    return json.dumps({"format": FORMAT} | _plain(description), indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        fields = {f.name: (getattr(value, f.name), f.default) for f in dataclasses.fields(value)}
        return {name: _plain(given) for name, (given, usual) in fields.items() if given != usual}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return {k: _plain(v) for k, v in value.items()} if isinstance(value, dict) else value


def read(path: str | Path) -> Description:
    """Read a scene file."""
    try:
        content = Path(path).read_text(encoding="utf-8")
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: expected a scene file, found none.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected JSON, found something that is not text.") from None
    return parse(content, where=str(path))


def parse(content: str, *, where: str = "scene") -> Description:
    """Read the text of a scene file; `where` is what errors call it."""
    try:
        found = json.loads(content)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{where}: line {error.lineno}, column {error.colno}: is not JSON ({error.msg}); is the file cut, or is a "
            "comma missing or too many?"
        ) from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        given = found.get("format") if isinstance(found, dict) else type(found).__name__
        raise InputError(f'{where}: expected an object with "format": "{FORMAT}", given {given!r}.')
    del found["format"]
    return _checked(Description, found, where, "")


def load(path: str | Path) -> tuple[scenes.Scene, scenes.Params, scenes.State, scenes.Control]:
    """Return the scene of a file, its parameters, its first state, and the controls of all steps."""
    description = read(path)
    try:
        return build(description)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _wrong(where: str, place: str, expected: str, given: Any) -> InputError:
    return InputError(f"{where}: {place or 'the whole'}: expected {expected}, given {json.dumps(given)[:60]}.")


def _like(name: str, known: typing.Iterable[str]) -> str:
    known = list(known)
    near = difflib.get_close_matches(name, known, 1)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


def _checked(kind: Any, given: Any, where: str, place: str) -> Any:
    """Return plain data as a value of a type, or say where it does not fit."""
    if dataclasses.is_dataclass(kind):
        return _record(kind, given, where, place)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        return None if given is None else _checked(inner[0], given, where, place)
    if origin is Literal:
        if given not in inner:
            hint = _like(given, inner) if isinstance(given, str) else "give it in quotes"
            raise _wrong(where, place, f"one of {', '.join(map(repr, inner))} ({hint})", given)
        return given
    if origin is tuple:
        count = None if inner[-1] is ... else len(inner)
        if not isinstance(given, list) or (count is not None and len(given) != count):
            raise _wrong(where, place, f"a list of {'any length' if count is None else f'{count} numbers'}", given)
        return tuple(_checked(inner[0], v, where, f"{place}[{k}]") for k, v in enumerate(given))
    if origin is dict:
        return _effects(given, where, place)
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
            raise InputError(f"{where}: {dot}{name}: there is no such entry; {_like(name, fields)}.")
    for name, one in fields.items():
        if name not in given and one.default is dataclasses.MISSING:
            raise InputError(f"{where}: {dot}{name}: is missing; expected it in every {kind.__name__.lower()}.")
    return kind(**{name: _checked(hints[name], value, where, dot + name) for name, value in given.items()})


def _effects(given: Any, where: str, place: str) -> dict[str, dict[str, Any]]:
    if not isinstance(given, dict):
        raise _wrong(where, place, 'an object such as {"gravity": {}}', given)
    for name, numbers in given.items():
        here = f"{place}.{name}"
        if name not in EFFECTS:
            raise InputError(f"{where}: {here}: there is no such effect; {_like(name, EFFECTS)}.")
        if not isinstance(numbers, dict):
            raise _wrong(where, here, "an object with its numbers, {} for the defaults", numbers)
        params = EFFECTS[name].params
        choices = {f.name for f in dataclasses.fields(EFFECTS[name])}
        for key, value in numbers.items():
            if key not in params and key not in choices:
                known = [*params, *sorted(choices)]
                hint = _like(key, known) if known else "it has none"
                raise InputError(f"{where}: {here}.{key}: there is no such number; {hint}.")
            if key in params:
                size = params[key].size
                kind = float if size == 1 else tuple[(float,) * size]
                _checked(kind, value, where, f"{here}.{key}")
    return given


def build(
    description: Description,
) -> tuple[scenes.Scene, scenes.Params, scenes.State, scenes.Control]:
    """Return the scene, its parameters, its first state, and the controls of all steps, with time as the first axis."""
    d = description
    dtype = getattr(torch, d.precision)
    ropes = [_rope(r, dtype) for r in d.ropes]
    effects, values = [], {}
    for name, given in d.effects.items():
        kind = EFFECTS[name]
        choices = {k: tuple(v) if isinstance(v, (list, tuple)) else v for k, v in given.items() if k not in kind.params}
        effects.append(kind(**choices))
        values[kind.name] = {k: v for k, v in given.items() if k in kind.params}
    bodies = [Solid(**{k: v for k, v in vars(b).items() if k not in ("keys", "path")}) for b in d.bodies]
    static = {name: getattr(d, name) for name in ("dt", "substeps", "integrator", "twist", "constrained")}
    held = {f"held_{part}": _slots(d, [r.positions.shape[-2] for r in ropes], part) for part in ("vertices", "edges")}
    made = scenes.make(ropes, effects, values, bodies=bodies, **held, **static)
    return *made, _controls(d, *made)


def _slots(d: Description, counts: list[int], part: str) -> tuple[int, ...]:
    """Return the scene's slots of held vertices or edges: ropes lie one after the other."""
    slots = []
    for k, held in enumerate(d.holds):
        if not held.vertices:
            raise InputError(f"holds[{k}].vertices: is empty; expected at least one.")
        if not 0 <= held.rope < len(counts):
            raise InputError(f"holds[{k}].rope: expected 0 to {len(counts) - 1}, given {held.rope}.")
        count = counts[held.rope] - (part == "edges" and not d.ropes[held.rope].closed)
        for number in getattr(held, part):
            if not -count <= number < count:
                raise InputError(f"holds[{k}].{part}: expected {-count} to {count - 1}, given {number}.")
            slots.append(sum(counts[: held.rope]) + number % count)
    return tuple(slots)


def _rope(rope: Rope, dtype: torch.dtype) -> scenes.Rope:
    given = {k: v for k, v in vars(rope).items() if k not in ("points", "vertices") and v is not None}
    points = torch.tensor(rope.points, dtype=torch.float64).reshape(-1, 3)
    if rope.vertices is not None:
        points = _resampled(points, rope)
    return scenes.Rope(points.to(dtype), **given)


def _resampled(points: Tensor, rope: Rope) -> Tensor:
    if len(points) < 2 or rope.vertices < 3:
        raise InputError(f"rope: {len(points)} points and {rope.vertices} vertices; expected at least 2 and 3.")
    line = torch.cat([points, points[:1]]) if rope.closed else points
    along = torch.cat([points.new_zeros(1), (line[1:] - line[:-1]).norm(dim=-1).cumsum(0)])
    count = rope.vertices + rope.closed
    at = torch.linspace(0, 1, count, dtype=points.dtype)[: rope.vertices] * along[-1]
    k = (torch.searchsorted(along, at, right=True) - 1).clamp(0, len(line) - 2)
    share = ((at - along[k]) / (along[k + 1] - along[k]).clamp(min=1e-30))[:, None]
    return line[k] + share * (line[k + 1] - line[k])


def _motion(keys: tuple[Key, ...], path: str, time: Tensor) -> Pose:
    """Return how far something has moved and turned at times (T,): shapes (T, 3) and (T, 4)."""
    keys = tuple(sorted(keys, key=lambda key: key.time))
    if not keys or keys[0].time > 0:
        keys = (Key(0.0), *keys)
    at, rows = time.new_tensor([k.time for k in keys]), time.new_tensor([(*k.move, *k.turn) for k in keys])
    k = (torch.searchsorted(at, time, right=True) - 1).clamp(0, len(keys) - 1)
    after = (k + 1).clamp(max=len(keys) - 1)
    gap = at[after] - at[k]
    share = torch.where(gap > 0, (time - at[k]) / torch.where(gap > 0, gap, 1.0), 0.0).clamp(0, 1)[:, None]
    if path == "smooth":
        # The path of least jerk (Flash and Hogan 1985, doi:10.1523/JNEUROSCI.05-07-01688.1985).
        share = share**3 * (10 - 15 * share + 6 * share**2)
    between = rows[k] + share * (rows[after] - rows[k])
    return Pose(between[:, :3], turn_by(between[:, 3:]))


def _controls(d: Description, scene: scenes.Scene, params: scenes.Params, state: scenes.State) -> scenes.Control:
    steps = max(1, round(d.duration / d.dt))
    like = state.rods.pos
    time = torch.arange(1, steps + 1, dtype=torch.float64) * d.dt
    still = scenes.hold(scene, state)
    pos, director = still.pos.expand(steps, -1, -1), still.director.expand(steps, -1, -1)
    grip: dict[str, Tensor] = {}
    if d.holds:
        owners = {part: [k for k, h in enumerate(d.holds) for _ in getattr(h, part)] for part in ("vertices", "edges")}
        hands = Hands(len(d.holds), tuple(owners["vertices"]), tuple(owners["edges"]))
        first = still.pos[[hands.vertices.index(k) for k in range(len(d.holds))]]
        unturned = like.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(d.holds), 4)
        held = weld(scene, hands, still, Pose(first, unturned), like.new_ones(len(d.holds), 1))
        moved = [tree.map(lambda x: x.to(like), _motion(h.keys, h.path, time)) for h in d.holds]
        tools = Pose(first + torch.stack([m.pos for m in moved], 1), torch.stack([m.quat for m in moved], 1))
        until = time.new_tensor([math.inf if h.release is None else h.release for h in d.holds])
        closed = (time[:, None] <= until).to(like)[..., None]
        pos, director, grip = carry(hands, tree.replace(held, closed=closed), tools)
        grip = grip if any(h.release is not None for h in d.holds) else {}
    return scenes.Control(pos, director, grip, _targets(d, still.bodies, time, like))


def _targets(d: Description, still: Any, time: Tensor, like: Tensor) -> Any:
    """Return poses of kinematic bodies, shapes (T, L, 3) and (T, L, 4)."""
    if not d.bodies:
        return ()
    moved = [_motion(b.keys, b.path, time) for b in d.bodies if b.motion == "kinematic"]
    if not moved:
        return tree.map(lambda x: x.expand(len(time), *x.shape), still)
    shift, turn = (torch.stack([getattr(m, part) for m in moved], 1).to(like) for part in ("pos", "quat"))
    return BodyTargets(still.pos + shift, multiply(turn, still.quat.expand_as(turn)))
