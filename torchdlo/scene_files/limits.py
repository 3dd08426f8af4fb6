"""What a described scene may not exceed: numbers that nature has, and work that this machine can do."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from torchdlo import work_budget
from torchdlo.errors import InputError
from torchdlo.physics.execution import Execution
from torchdlo.scene_files.schema import ParticleBlockSpec, SceneDescription

__all__ = ["check_memory", "check_ranges", "check_time", "steps_of"]

_LARGEST = 1e5
"""Lengths, positions and velocities [m, m/s], and all else that has no limit of its own."""
_LIMITS = {
    "mass": 1e6,
    "density": 1e6,
    "youngs": 1e16,
    "shear": 1e16,
    "bend": 1e12,
    "bend2": 1e12,
    "twist": 1e12,
    "stretch": 1e19,
    "radius": 1e3,
    "spacing": 1e3,
    "time": 1e9,
    "close": 1e9,
    "release": 1e9,
    "since": 1e9,
    "until": 1e9,
    "force": 1e9,
    "rest_curvature": 1e9,
    "rest_twist": 1e9,
    "initial_twist": 1e9,
    "duration": 1e9,
    "dt": 10.0,
    "scale": 1e9,
    "parameters": 1e16,
    "friction": 1e3,
    "mu_s": 1e3,
    "mu_k": 1e3,
    "damping": 1e9,
}
"""Largest numbers of entries, SI units."""
_EFFECT = 1000.0
"""Parameters of effects may be this many times their largest sensible values."""

# Measured on one core of a server of 2024, float64, without gradients: bytes after a step, and seconds of a substep.
_VERTEX_BYTES, _POINT_BYTES, _NODE_BYTES = 5000.0, 2000.0, 200.0
_SUBSTEP, _VERTEX_SECONDS = 1e-3, 8e-6
_MPM_SUBSTEP, _POINT_SECONDS = 4e-3, 6e-7
_COMPILED = 0.2
"""Share of the time that compiled steps take."""


def check_ranges(d: SceneDescription, effects: dict[str, Any], where: str = "") -> None:
    """Refuse numbers that no rope, body or motion has.

    Args:
        d: the scene.
        effects: kinds of effects by name.
        where: what begins the sentence.
    """
    start = f"{where}: " if where else ""
    if not isinstance(d, SceneDescription):
        raise InputError(f"{start}expected a SceneDescription first, given {type(d).__name__}; are arguments swapped?")
    if not d.ropes:
        raise InputError(f"{start}ropes: expected at least one rope, given none.")
    if not d.duration > 0:
        raise InputError(f"{start}duration: expected seconds above 0, given {d.duration:g}.")
    for field in dataclasses.fields(d):
        if field.name != "effects":
            _check(getattr(d, field.name), field.name, field.name, start)
    for name, given in d.effects.items():
        for key, value in given.items():
            param = effects[name].params.get(key) if name in effects else None
            usual = (0.0,) if param is None else (param.low, param.high, param.off or 0.0, *_row(param.default))
            limit = _LARGEST if param is None else _EFFECT * max(1.0, *map(abs, usual))
            for number in _row(value):
                _within(number, limit, f"effects.{name}.{key}", start)


def _row(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, (tuple, list)) else (value,)


def _check(value: Any, name: str, place: str, start: str) -> None:
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            _check(getattr(value, field.name), field.name, f"{place}.{field.name}", start)
    elif isinstance(value, (tuple, list)):
        for k, part in enumerate(value):
            _check(part, name, f"{place}[{k}]", start)
    elif isinstance(value, dict):
        for key, part in value.items():
            _check(part, name, f"{place}.{key}", start)
    elif isinstance(value, float):
        _within(value, _LIMITS.get(name, _LARGEST), place, start)


def _within(value: Any, limit: float, place: str, start: str) -> None:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and not abs(value) <= limit:
        raise InputError(
            f"{start}{place}: expected a number of at most {limit:g} in size, given {value:g}; the units are SI."
        )


def steps_of(d: SceneDescription) -> float:
    """Return how many steps a scene is run for."""
    return max(1.0, d.duration / d.dt) if d.dt > 0 else 1.0


def check_memory(d: SceneDescription, where: str = "scene", frame_stride: int | None = None) -> None:
    """Refuse a scene that does not fit into the memory of this machine, before anything of it is made.

    Args:
        d: the scene.
        where: what begins the sentence.
        frame_stride: steps per frame that is kept, None if none are.
    """
    steps, vertices, points, nodes = steps_of(d), _vertices(d), _points(d), _nodes(d)
    held = sum(len(a.vertices) + len(a.edges) for a in d.attachments)
    moved = sum(b.motion == "kinematic" for b in d.bodies) + 30 * len(d.robots)
    state = vertices * _VERTEX_BYTES + points * _POINT_BYTES + nodes * _NODE_BYTES
    commands = steps * 8.0 * (12 + 20 * held + 30 * moved)
    parts = [f"{vertices:.4g} vertices", f"{steps:.4g} steps"]
    parts += [f"{points:.4g} material points", f"{nodes:.4g} cells"] if points else []
    cure = "use fewer vertices, a shorter duration, a longer dt" + (", or a larger spacing" if points else "")
    work_budget.check(where, ", ".join(parts), memory=state + commands, cure=cure)
    if frame_stride is not None:
        each = 80.0 * vertices + 24 * held + 68 * (len(d.bodies) + moved) + 12 * points
        frames = (steps / frame_stride + 1) * each
        work, cure = f"{steps / frame_stride:.4g} frames", "keep fewer with a larger --frame-stride"
        work_budget.check(where, work, memory=2 * frames, cure=cure)


def check_time(d: SceneDescription, where: str = "scene", *, execution: Execution = "recorded") -> None:
    """Refuse a scene that would run for months, and say how long one takes that runs for more than a minute."""
    vertices, points = _vertices(d), _points(d)
    substep = _SUBSTEP + _VERTEX_SECONDS * vertices
    substep += _MPM_SUBSTEP + _POINT_SECONDS * points if points else 0.0
    steps, share = steps_of(d), _COMPILED if execution == "compiled" else 1.0
    work = f"{steps:.4g} steps of {d.substeps} substeps with {vertices:.4g} vertices"
    work += f" and {points:.4g} material points" if points else ""
    work_budget.check(
        where, work, seconds=steps * d.substeps * substep * share, cure="use fewer vertices, steps or substeps"
    )


def _vertices(d: SceneDescription) -> float:
    return float(sum(len(r.points) if r.vertices is None else r.vertices for r in d.ropes))


def _points(d: SceneDescription) -> float:
    return sum(map(_count, d.material_points))


def _count(block: ParticleBlockSpec) -> float:
    axes = {"box": 3, "ball": 1}[block.shape]
    if not block.spacing > 0 or len(block.size) != axes:
        return 0.0  # said where it is built
    sizes = [abs(s) / block.spacing for s in block.size]
    return 8.0 * math.prod(sizes) if axes == 3 else 4 / 3 * math.pi * sizes[0] ** 3


def _nodes(d: SceneDescription) -> float:
    if d.box is None or not d.box.spacing > 0 or not d.material_points:
        return 0.0
    whole = [(high - low) / d.box.spacing + 5 for low, high in zip(d.box.low, d.box.high, strict=True)]
    window = d.box.window or whole
    return math.prod(max(0.0, min(w, n)) for w, n in zip(window, whole, strict=True))
