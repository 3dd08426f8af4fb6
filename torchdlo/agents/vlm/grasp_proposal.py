"""Where hands are to hold ropes: asked of a model that sees a picture, snapped to vertices, checked for reach."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdlo.agents.vlm.conversation import Conversation, Question, ShownPicture, plain_text
from torchdlo.agents.vlm.plan_schema import MODES, grasps_model
from torchdlo.agents.vlm.prompts import fill_prompt
from torchdlo.envs import Task
from torchdlo.envs.core import scene_names
from torchdlo.envs.core.episode import reachable
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene import Scene, State
from torchdlo.untrusted import read_json

__all__ = [
    "GraspView",
    "Places",
    "Proposal",
    "check_grasps",
    "load_grasps",
    "offered_vertices",
    "places_of",
    "propose_grasps",
    "random_grasps",
    "reach_text",
]

APART = 0.03
"""Least distance of two hands [m]."""
CLOSE = 40.0
"""How far a place in a picture may be from a vertex [pixels]."""
LABEL = 26.0
"""Least distance of two marks in a picture [pixels]."""


class GraspView(Protocol):
    """A picture of a scene in which vertices can be found."""

    pixels: Tensor
    """Where vertices are seen, from the upper left corner [pixels], shape (V, 2)."""
    visible: Tensor
    """Which are not hidden, bool, shape (V,)."""

    def marked(self, slots: Sequence[int]) -> bytes:
        """Return the picture as PNG with numbers on these vertices."""
        ...


@dataclass(frozen=True, eq=False)
class Places:
    """The vertices of a scene, and who reaches them."""

    task: Task
    scene: Scene
    x: Tensor
    """Where vertices are [m], shape (V, 3)."""
    reach: Tensor
    """Which hands reach which vertices, bool, shape (V, R)."""
    bodies: Tensor
    """Where bodies other than planes are [m], shape (K, 3)."""

    @property
    def ropes(self) -> list[tuple[int, int]]:
        """First vertex and number of vertices of each rope."""
        counts = self.scene.topology.counts
        return [(sum(counts[:k]), count) for k, count in enumerate(counts)]

    @property
    def hands(self) -> int:
        """How many hands there are."""
        return self.task.arms.count

    def rope_of(self, slot: int) -> int:
        """Return the number of the rope that a vertex is of."""
        return next(k for k, (first, count) in enumerate(self.ropes) if first <= slot < first + count)


def places_of(task: Task, state: State | None = None) -> Places:
    """Return the vertices of a task at its start, or in another state of one scene."""
    scene, _, usual = task.start(1, like=torch.zeros((), dtype=torch.float64))
    state = usual if state is None else state
    x = state.rods.pos[0].double()
    reach = reachable(task, x)
    bodies = [k for k, body in enumerate(scene.bodies) if body.shape != "plane"]
    at = tree.part(state.bodies).pos[0, bodies].double() if bodies else x.new_zeros(0, 3)
    # Vertices that are fixed in the world are nobody's.
    fixed = sorted({*scene.prescribed_vertices} - {*task.schedule.held})
    if fixed:
        reach = reach.clone()
        reach[fixed] = False
    return Places(task, scene, x, reach, at)


@dataclass(frozen=True)
class Proposal:
    """Grasps, and how they came about."""

    task: str
    mode: str
    source: str
    """Who proposed them: a model, a recorded conversation, or none."""
    grasps: tuple[int | None, ...]
    reason: str = ""

    def json(self) -> str:
        """Return the content of a file."""
        content = {
            "generator": "torchdlo propose",
            "task": self.task,
            "mode": self.mode,
            "source": self.source,
            "grasps": list(self.grasps),
            "reason": self.reason,
        }
        return json.dumps(content, indent=1) + "\n"


def load_grasps(path: Path, task: str) -> tuple[int | None, ...]:
    """Return the grasps of a proposal's file for a task."""
    content = read_json(path, "grasps as torchdlo propose writes them", most=100_000)
    try:
        grasps, other = content["grasps"], content.get("task", task)
        if not isinstance(grasps, list) or not all(g is None or type(g) is int for g in grasps):
            raise ValueError
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f'{path}: expected grasps as torchdlo propose writes them, {{"grasps": [4, 25]}}.') from None
    if other != task:
        raise InputError(f"{path}: its grasps are for {plain_text(str(other), 40)}; give grasps for {task}.")
    return tuple(grasps)


def check_grasps(places: Places, grasps: Sequence[int | None]) -> tuple[int | None, ...]:
    """Return grasps that can be; say which cannot, and what can."""
    held = [(hand, slot) for hand, slot in enumerate(grasps) if slot is not None]
    if not held:
        raise InputError("no robot holds anything; let one hold a vertex.")
    for hand, slot in held:
        if not 0 <= slot < len(places.x):
            raise InputError(f"robot_{hand + 1} is to hold vertex {slot}; there are 0 to {len(places.x) - 1}.")
        if not bool(places.reach[slot, hand]):
            raise InputError(f"robot_{hand + 1} does not reach vertex {slot}; it reaches {_ranges(places, hand)}.")
    for k, (hand, slot) in enumerate(held):
        for other, there in held[k + 1 :]:
            apart = float((places.x[slot] - places.x[there]).norm())
            if apart < APART:
                raise InputError(
                    f"robot_{hand + 1} and robot_{other + 1} would be {100 * apart:.1f} cm apart; choose places at "
                    f"least {100 * APART:.0f} cm apart."
                )
    return tuple(grasps)


def _ranges(places: Places, hand: int) -> str:
    """Return the vertices that a hand reaches, in words."""
    slots = places.reach[:, hand].nonzero()[:, 0].tolist()
    parts: list[list[int]] = []
    for slot in slots:
        if parts and parts[-1][1] == slot - 1:
            parts[-1][1] = slot
        else:
            parts.append([slot, slot])
    return ", ".join(f"{a} to {b}" if b > a else f"{a}" for a, b in parts) or "none"


def offered_vertices(places: Places, view: GraspView) -> list[int]:
    """Return vertices that get a mark: those that are seen and that a hand reaches, not too close in the picture."""
    good = view.visible & places.reach.any(-1)
    chosen: list[int] = []
    for first, count in places.ropes:
        # Ends first: what they are good for no other vertex is.
        order = [first, first + count - 1, *range(first + 1, first + count - 1)]
        for slot in order:
            if not bool(good[slot]):
                continue
            if all(float((view.pixels[slot] - view.pixels[other]).norm()) >= LABEL for other in chosen):
                chosen.append(slot)
    return sorted(chosen)


def propose_grasps(
    task: Task, mode: str, conversation: Conversation, view: GraspView, *, places: Places | None = None
) -> Proposal:
    """Return grasps that a model proposes for the start of a task.

    Args:
        task: the task.
        mode: one of `MODES`.
        conversation: with the model.
        view: a picture of the start.
        places: the vertices; found if not given.
    """
    if mode not in MODES:
        raise InputError(f"mode is {plain_text(mode, 40)!r}; expected one of {', '.join(MODES)}.")
    places = places or places_of(task)
    marks = offered_vertices(places, view) if mode == "candidate" else []
    if mode == "candidate" and not marks:
        raise InputError(f"{task.name}: no vertex that a hand reaches can be seen; use the mode coefficient.")
    text = fill_prompt(f"grasps_{mode}", scene=_scene_text(places, mode, marks))
    question = Question(
        kind="grasps",
        system=fill_prompt("system"),
        text=text,
        pictures=(ShownPicture("the scene at its start", view.marked(marks)),),
        answer=grasps_model(mode, places.hands),
        facts=(places, mode, view, marks),
    )

    def check(answer: Any) -> Proposal:
        said = [getattr(answer.grasps, f"robot_{k + 1}") for k in range(places.hands)]
        slots = [None if s is None else _snapped(places, mode, view, marks, s) for s in said]
        return Proposal(
            task.name, mode, conversation.model.source, check_grasps(places, slots), plain_text(answer.reason)
        )

    return conversation.ask(question, check)


def _snapped(places: Places, mode: str, view: GraspView, marks: list[int], said: Any) -> int:
    """Return the vertex that was meant."""
    if mode == "candidate":
        if said not in marks:
            raise InputError(f"there is no mark {said}; the marks are {', '.join(map(str, marks))}.")
        return int(said)
    if mode == "coefficient":
        if said.rope >= len(places.ropes):
            raise InputError(f"there is no rope {said.rope}; ropes are 0 to {len(places.ropes) - 1}.")
        first, count = places.ropes[said.rope]
        closed = places.scene.topology.closed[said.rope]
        return first + (round(said.share * count) % count if closed else round(said.share * (count - 1)))
    far = (view.pixels - view.pixels.new_tensor([said.u, said.v])).norm(dim=-1)
    far = torch.where(view.visible, far, torch.inf)
    slot = int(far.argmin())
    if float(far[slot]) > CLOSE:
        raise InputError(
            f"({said.u:.0f}, {said.v:.0f}) is {float(far[slot]):.0f} pixels from the rope; choose a place on it, "
            f"such as ({float(view.pixels[slot, 0]):.0f}, {float(view.pixels[slot, 1]):.0f})."
        )
    return slot


def reach_text(places: Places) -> str:
    """Return where robots stand, what they reach, and what ropes there are."""
    task = places.task
    lines = []
    for k, base in enumerate(task.arms.base):
        lines.append(
            f"robot_{k + 1} stands at ({base[0]:.2f}, {base[1]:.2f}) and reaches vertices {_ranges(places, k)}."
        )
    for k, (first, count) in enumerate(places.ropes):
        how = "closed" if places.scene.topology.closed[k] else "open"
        lines.append(f"rope {k}: {how}, vertices {first} to {first + count - 1}.")
    return "\n".join(lines)


def _scene_text(places: Places, mode: str, marks: list[int]) -> str:
    """Return what a model is told of the scene."""
    task = places.task
    lines = [f"Task: {task.name}. {(type(task).__doc__ or '').splitlines()[0]}", reach_text(places)]
    here = scene_names.layout(places.scene)
    for (name, _, doc), pos in zip(here.bodies, places.bodies, strict=True):
        lines.append(f"{name}: {doc} at ({', '.join(f'{float(p):.3f}' for p in pos)}).")
    shown = marks or range(0, len(places.x), max(1, len(places.x) // 16))
    lines.append("Marks:" if mode == "candidate" else "Some vertices:")
    for slot in shown:
        who = " and ".join(f"robot_{k + 1}" for k in range(places.hands) if bool(places.reach[slot, k])) or "nobody"
        rope = places.rope_of(slot)
        first, count = places.ropes[rope]
        share = f", share {(slot - first) / (count - 1):.2f}" if mode == "coefficient" else ""
        at = ", ".join(f"{float(p):.3f}" for p in places.x[slot])
        lines.append(f"{slot}: rope {rope}{share}, at ({at}), reached by {who}")
    return "\n".join(lines)


def random_grasps(places: Places, seed: int) -> Proposal:
    """Return grasps that are drawn among those that can be."""
    rng = torch.Generator().manual_seed(seed)
    for _ in range(1000):
        slots: list[int | None] = []
        for hand in range(places.hands):
            good = places.reach[:, hand].nonzero()[:, 0]
            slots.append(int(good[torch.randint(len(good), (), generator=rng)]) if len(good) else None)
        try:
            return Proposal(places.task.name, "random", "random, no model", check_grasps(places, slots))
        except InputError:
            continue
    raise InputError(f"{places.task.name}: no random grasps that hands reach were found in 1000 draws.")
