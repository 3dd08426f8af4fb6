"""A stand-in for a model: grasps from the geometry of a scene alone. What comes of it is labelled as such.

It knows nothing of a task's name. What a rope lies in and beside says what is likely to be done with it: crossings are
undone from the end that is next to them, free bodies are taken up by a pair of hands on either side of them, loops are
opened towards what they are to go round, and an end is led through or round what is fixed.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from torchdlo.agents.vlm.conversation import Question, Reply
from torchdlo.agents.vlm.grasp_proposal import APART, GraspView, Places
from torchdlo.agents.vlm.plan_schema import HORIZON
from torchdlo.envs.core import curve_geometry, scene_names
from torchdlo.errors import InputError

__all__ = ["Geometry", "geometric_grasps"]

END = 2
"""How far from its end a rope is held [vertices]: fingers have room, and the end stays free to be led."""
MARGIN = 0.1
"""Share of a rope that hangs out on either side of a pair of hands."""


class Geometry:
    """What answers in a model's place."""

    source = "geometry, no model"
    remote = False

    def reply(self, question: Question, messages: list[dict[str, Any]], digest: str) -> Reply:
        """Return an answer from the facts."""
        del digest
        if len(messages) > 2:
            raise InputError(f"geometry, no model: its answer for {question.kind} will not do, and it has no other.")
        if question.kind == "grasps":
            return Reply(json.dumps(_grasps(*question.facts)))
        task = question.facts[0].task
        if len(task.stages) > 1:
            raise InputError(
                f"geometry, no model: {task.name} takes several grasps one after the other, and geometry alone plans "
                "one; use --endpoint or --recorded."
            )
        return Reply(json.dumps({"steps": [_step(*question.facts)]}))

    def skip(self, count: int) -> None:
        """Do nothing."""


def _grasps(places: Places, mode: str, view: GraspView, marks: Sequence[int]) -> dict[str, Any]:
    """Return an answer in the form of a mode."""
    slots = geometric_grasps(places)
    said: dict[str, Any] = {}
    for k, slot in enumerate(slots):
        if slot is None:
            said[f"robot_{k + 1}"] = None
        elif mode == "candidate":
            good = [m for m in marks if bool(places.reach[m, k]) and places.rope_of(m) == places.rope_of(slot)]
            taken = [m for m in said.values() if m is not None]
            free = [m for m in good if all(float((places.x[m] - places.x[t]).norm()) >= APART for t in taken)]
            if not free:
                raise InputError(f"geometry, no model: no mark is left for robot_{k + 1}.")
            said[f"robot_{k + 1}"] = min(free, key=lambda m: float((places.x[m] - places.x[slot]).norm()))
        elif mode == "coefficient":
            rope = places.rope_of(slot)
            first, count = places.ropes[rope]
            whole = count if places.scene.topology.closed[rope] else count - 1
            said[f"robot_{k + 1}"] = {"rope": rope, "share": (slot - first) / whole}
        else:
            u, v = view.pixels[slot].tolist()
            said[f"robot_{k + 1}"] = {"u": max(0.0, u), "v": max(0.0, v)}
    return {"grasps": said, "reason": "geometry of the scene"}


def geometric_grasps(places: Places) -> tuple[int | None, ...]:
    """Return the vertex for each hand."""
    fixed = sorted({*places.scene.prescribed_vertices} - {*places.task.schedule.held})
    kinds = [body for body in places.scene.bodies if body.shape != "plane"]
    first, count = places.ropes[0]
    if fixed:
        return _deal(places, [_farthest(places, fixed)])
    if len(places.ropes) > 1:
        return _one_each(places)
    if bool(places.scene.topology.closed[0]) and len(kinds):
        return _deal(places, _opened(places))
    crossed = curve_geometry.crossing_places(places.x[first : first + count])
    if len(crossed) >= 4 and places.hands > 1:
        return _deal(places, _untied(crossed, count))
    if any(body.motion == "free" for body in kinds) and places.hands > 1:
        return _deal(places, _pair(places, count))
    return _deal(places, [_lead(places, count)])


def _deal(places: Places, slots: Sequence[int]) -> tuple[int | None, ...]:
    """Return which hand takes which vertex: hands that reach them, with the shortest ways from their bases."""
    base = places.x.new_tensor(places.task.arms.base)
    best, found = math.inf, None
    for hands in itertools.permutations(range(places.hands), min(len(slots), places.hands)):
        pairs = list(zip(hands, slots, strict=False))
        far = sum(float((places.x[s] - base[h]).norm()) for h, s in pairs)
        far += sum(10.0 for h, s in pairs if not bool(places.reach[s, h]))
        if far < best:
            best, found = far, pairs
    given: list[int | None] = [None] * places.hands
    for hand, slot in found or []:
        given[hand] = _near(places, slot, hand)
    return tuple(given)


def _near(places: Places, slot: int, hand: int) -> int:
    """Return the vertex of the same rope, nearest along it, that a hand reaches."""
    first, count = places.ropes[places.rope_of(slot)]
    good = [s for s in range(first, first + count) if bool(places.reach[s, hand])]
    if not good:
        raise InputError(f"geometry, no model: robot_{hand + 1} reaches no vertex of the rope.")
    return min(good, key=lambda s: abs(s - slot))


def _untied(crossed: torch.Tensor, count: int) -> list[int]:
    """Return the end with the shorter tail, and the strand at the last crossing as seen from there."""
    before, after = float(crossed[0]), count - 1 - float(crossed[-1])
    if before <= after:
        return [END, min(count - 1 - END, round(float(crossed[-1])))]
    return [count - 1 - END, max(END, round(float(crossed[0])))]


def _pair(places: Places, count: int) -> list[int]:
    """Return the widest pair of vertices about the middle of the bodies that two hands reach."""
    middle = places.bodies.mean(0)
    about = float((places.x - middle).norm(dim=-1).argmin())
    # The nearest place lies between vertices as often as on one.
    first, last = MARGIN * (count - 1), (1 - MARGIN) * (count - 1)
    lever = min(about - first, last - about)
    if lever < 0.25 * count:
        return [math.ceil(first), math.floor(last)]
    return [math.ceil(about - lever), math.floor(about + lever)]


def _opened(places: Places) -> list[int]:
    """Return vertices of a loop on the side of the bodies, as far apart as the bodies stand."""
    flat, bodies = places.x[:, :2], places.bodies[:, :2]
    centre = flat.mean(0)
    ahead = bodies.mean(0) - centre
    ahead = ahead / ahead.norm().clamp(min=1e-9)
    side = torch.stack([-ahead[1], ahead[0]])
    wide = (bodies - centre) @ side
    found = []
    for sign in (1.0, -1.0):
        want = (sign * wide).max()
        off = (sign * ((flat - centre) @ side) - want).abs() + 10.0 * (((flat - centre) @ ahead) <= 0)
        found.append(int(off.argmin()))
    return found


def _lead(places: Places, count: int) -> int:
    """Return a vertex behind the end that is next to a body, or to a hand if there is none."""
    aims = places.bodies if len(places.bodies) else places.x.new_tensor(places.task.arms.base)
    near = [
        (not bool(places.reach[k].any()), float((places.x[k] - aims).norm(dim=-1).min()), k)
        for k in (END, count - 1 - END)
    ]
    return min(near)[2]


def _farthest(places: Places, fixed: Sequence[int]) -> int:
    """Return the vertex that is farthest along the rope from all that are fixed: it has the longest lever."""
    return max(range(len(places.x)), key=lambda s: (min(abs(s - f) for f in fixed), bool(places.reach[s].any())))


def _one_each(places: Places) -> tuple[int | None, ...]:
    """Return for each hand the end of a rope of its own, farthest from the other ropes."""
    ends = []
    for first, count in places.ropes:
        own = places.x[first : first + count]
        others = torch.cat([places.x[:first], places.x[first + count :]])
        apart = (own[[END, count - 1 - END], None] - others).norm(dim=-1).amin(-1)
        ends.append(first + (END if float(apart[0]) >= float(apart[1]) else count - 1 - END))
    return _deal(places, ends[: places.hands])


def _step(places: Places, values: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    """Return one step for the whole of a task, from what there is to name in its scene."""
    terms, success = _aim(places, values)
    grasps = {f"robot_{k + 1}": slot for k, slot in enumerate(geometric_grasps(places))}
    return {
        "id": 1,
        "description": "all at once, from the geometry of the scene",
        "grasps": grasps,
        "waypoints": None,
        "reward": terms,
        "reward_description": "what is likely to be wanted in such a scene",
        "success": success,
        "horizon": min(HORIZON, places.task.horizon),
    }


def _aim(places: Places, values: Mapping[str, torch.Tensor]) -> tuple[dict[str, str], str]:
    """Return terms of a reward, and a condition."""
    free = [n for n, k, _ in scene_names.layout(places.scene).bodies if places.scene.bodies[k].motion == "free"]
    wound = sorted(n for n in values if n.startswith("winding_"))
    goals = sorted(n for n in values if n == "goal" or n.startswith("goal_"))
    if "crossing_number" in values:
        return {"open": "exp(-crossing_number)"}, "crossings < 0.5"
    if wound:
        posts = [n.replace("winding", "post") for n in wound]
        terms = {f"round_{k}": f"-(abs({n}) - 1) ** 2" for k, n in enumerate(wound)}
        terms |= {f"near_{k}": f"-nearest(rope, {p})" for k, p in enumerate(posts)}
        return terms, " and ".join(f"abs({n}) > 0.5" for n in wound)
    if free:
        now = {n: float(values[n][0, 2]) for n in free}
        terms = {f"up_{k}": f"5 * z({n})" for k, n in enumerate(free)}
        terms |= {f"near_{k}": f"-nearest(rope, {n})" for k, n in enumerate(free)}
        return terms, " and ".join(f"z({n}) > {now[n] + 0.05:.3f}" for n in free)
    if goals and values[goals[0]].dim() == 3:
        ropes = ["rope"] if len(goals) == 1 else [n.replace("goal", "rope") for n in goals]
        terms = {f"goal_{k}": f"-chamfer({r}, {g})" for k, (r, g) in enumerate(zip(ropes, goals, strict=True))}
        return terms, " and ".join(f"chamfer({r}, {g}) < 0.03" for r, g in zip(ropes, goals, strict=True))
    if goals:
        return {"lead": f"-dist(rope[0], {goals[0]})"}, f"dist(rope[0], {goals[0]}) < 0.03"
    if len(places.ropes) > 1:
        return {"apart": "mean(nearest(rope_0, rope_1))"}, "min(nearest(rope_0, rope_1)) > 0.05"
    body = next(n for n in values if n.startswith(("body_", "ring_", "post_")))
    return {"near": f"-mean(dist(rope, {body}))"}, f"max(dist(rope, {body})) < 0.1"
