"""What expressions can name in the scene of a task: ropes, tools, bodies, and what the task measures.

Shapes are (B,) for a number of each scene, (B, 3) for a point and (B, N, 3) for a rope of N vertices.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchdlo.envs.core import curve_geometry
from torchdlo.physics import tree

if TYPE_CHECKING:
    from torchdlo.envs.core.task import Task, TaskState
    from torchdlo.scene import Scene

__all__ = ["Layout", "layout", "named_values", "names_table"]

_KINDS = {"torus": "ring", "ring": "ring", "cylinder": "post"}
"""What bodies are called by their shapes, if not by a name of their own."""


@dataclass(frozen=True)
class Layout:
    """What there is in a scene: static."""

    counts: tuple[int, ...]
    """Vertices of the ropes."""
    bodies: tuple[tuple[str, int, str], ...]
    """Names of bodies, their numbers in the scene, and what they are."""
    material_points: bool


def layout(scene: Scene) -> Layout:
    """Return what there is in a scene."""
    bodies: list[tuple[str, int, str]] = []
    for k, body in enumerate(scene.bodies):
        if body.shape == "plane":
            continue
        own = body.name if body.name not in ("", f"{body.shape} {k}") else ""
        kind = _KINDS.get(body.shape, "body") if not own else ""
        # A named ring is a ring; everything else with a name is a body.
        name = re.sub(r"\W+", "_", own.lower()).strip("_")
        if name and not re.fullmatch(r"(ring|post)_\d+", name):
            name = f"body_{name}"
        if not name:
            name = f"{kind}_{sum(n.startswith(f'{kind}_') for n, _, _ in bodies)}"
        moves = "fixed" if body.motion == "fixed" else "free"
        bodies.append((name, k, f"middle of the {moves} {body.shape}{f' {own!r}' if own else ''} [m]"))
    return Layout(tuple(scene.topology.counts), tuple(bodies), bool(scene.material_points))


def _rope(rows: slice) -> Callable[[TaskState], Tensor]:
    return lambda seen: seen.x[:, rows]


def _length(rows: slice) -> Callable[[TaskState], Tensor]:
    return lambda seen: curve_geometry.length(seen.x[:, rows])


def _tool(k: int) -> Callable[[TaskState], Tensor]:
    return lambda seen: seen.tool.pos[:, k]


def _grip(k: int) -> Callable[[TaskState], Tensor]:
    return lambda seen: seen.closed[:, k, 0]


def _body(k: int) -> Callable[[TaskState], Tensor]:
    return lambda seen: tree.part(seen.state.bodies).pos[:, k]


def _matter(seen: TaskState) -> Tensor:
    return tree.part(seen.state.material_points).pos.mean(-2)


def _makers(task: Task, here: Layout) -> dict[str, tuple[str, Callable[[TaskState], Tensor]]]:
    """Return what each name is, and how it is had, without measures of the task."""
    found: dict[str, tuple[str, Callable[[TaskState], Tensor]]] = {}
    first = 0
    for k, count in enumerate(here.counts):
        end = "" if len(here.counts) == 1 else f"_{k}"
        rows = slice(first, first + count)
        found[f"rope{end}"] = (f"vertices 0 to {count - 1} of the rope [m]", _rope(rows))
        found[f"length{end}"] = (
            "length along the vertices [m]",
            _length(rows),
        )
        first += count
    for k in range(task.arms.count):
        found[f"tool_{k}"] = ("where the tool of the hand is [m]", _tool(k))
        found[f"holds_{k}"] = ("1 if the hand holds a rope, else 0", _grip(k))
    for name, k, doc in here.bodies:
        found[name] = (doc, _body(k))
    if here.material_points:
        found["body_mpm_coupling"] = ("middle of the matter [m]", _matter)
    found["time"] = (
        "time since the start of the task [s]",
        lambda seen: seen.state.time.expand(len(seen.x), 1, 1)[:, 0, 0],
    )
    return found


def named_values(task: Task, here: Layout, seen: TaskState, wanted: Collection[str] | None = None) -> dict[str, Tensor]:
    """Return what names stand for, "time" first; all of them unless some are wanted.

    Args:
        task: the task.
        here: the layout of its scene.
        seen: what is to be named.
        wanted: names; those that are not there are left out.
    """
    makers, own = _makers(task, here), task.measured()
    names = [*makers, *(n for n in own if n not in makers)]
    asked = [n for n in names if wanted is None or n in wanted]
    measures = task.measures(seen) if any(n in own for n in asked) else {}
    found = {n: measures[n] if n in own else makers[n][1](seen) for n in ["time", *asked]}
    return {n: x.to(seen.x.dtype) if not x.is_floating_point() else x for n, x in found.items()}


def names_table(task: Task, here: Layout, seen: TaskState) -> list[dict[str, str]]:
    """Return what a scene offers: name, shape, what it is, and its present value in the first scene."""
    docs = {name: doc for name, (doc, _) in _makers(task, here).items()} | task.measured()
    rows = []
    for name, value in named_values(task, here, seen).items():
        shape = "number" if value.dim() == 1 else "point" if value.dim() == 2 else f"{value.shape[1]} points"
        rows.append({"name": name, "shape": shape, "what": docs[name], "now": _said(value[0])})
    return rows


def _said(value: Tensor) -> str:
    """Return a value in millimetre digits; of a rope its ends and some vertices between."""
    if value.dim() == 0:
        return f"{float(value):.3f}"
    if value.dim() == 1:
        return "(" + ", ".join(f"{float(x):.3f}" for x in value) + ")"
    count = len(value)
    some = sorted({*torch.linspace(0, count - 1, min(count, 9)).round().long().tolist()})
    return "; ".join(f"[{k}] {_said(value[k])}" for k in some)
