"""What models are told: the scene with its present values, what happened so far, and the language of rewards."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from torchdlo.agents.vlm.conversation import plain_text
from torchdlo.agents.vlm.grasp_proposal import Places, reach_text
from torchdlo.envs.core import scene_names
from torchdlo.envs.core.task import Task, TaskState
from torchdlo.reward_language import FUNCTIONS

__all__ = ["language_text", "scene_text", "task_text"]


def task_text(task: Task) -> str:
    """Return what a task is, and when it is done."""
    text = sys.modules[type(task).__module__].__doc__ or type(task).__doc__ or ""
    return " ".join(text.split())


def language_text() -> str:
    """Return what expressions are made of."""
    lines = [
        "The language: one expression of numbers, names of the scene, + - * /, ** with 2, 3, 4 or 0.5, < <= > >=, and, "
        "or, not, rope[k] and rope[a:b] with whole numbers, and these functions:",
        *(f"- {name}({', '.join(_SAID[k] for k in f.takes)}): {f.doc}" for name, f in FUNCTIONS.items()),
        "Along a rope, functions work vertex by vertex: use mean, sum, min or max to make one number of it. A reward "
        "term has to give one number, success a condition. At most 4000 letters, 300 parts.",
    ]
    return "\n".join(lines)


_SAID = {"N": "number", "P": "point", "C": "condition", "A": "value"}


def scene_text(
    places: Places, seen: TaskState, carried: Sequence[dict[str, Any]], left: Sequence[dict[str, Any]]
) -> str:
    """Return the scene, names with shapes and present values, and what was done and is left to do.

    Args:
        places: the vertices as they are now.
        seen: what there is to see now.
        carried: steps that were carried out.
        left: steps of the plan that are left.
    """
    task = places.task
    lines = [f"Task {task.name}: {task_text(task)}", reach_text(places)]
    lines.append("Names with their shapes, meanings and present values:")
    rows = scene_names.names_table(task, scene_names.layout(places.scene), seen)
    lines += [f"- {r['name']} ({r['shape']}): {r['what']}; now {r['now']}" for r in rows]
    if carried:
        lines.append("Carried out so far:")
        lines += [f"- {_told(c)}" for c in carried]
    if left:
        lines.append(f"Left of the plan: {json.dumps(left)}")
    return "\n".join(lines)


def _told(carried: dict[str, Any]) -> str:
    """Return what came of a step, in words."""
    step = carried["step"]
    what = f"step {step['id']} ({plain_text(step['description'])}), grasps {json.dumps(step['grasps'])}"
    if carried["failed"]:
        return f"{what}: it failed and was taken back: {carried['failed']}"
    held = "its condition holds" if carried["success"] else f"its condition does not hold: {step['success']}"
    terms = ", ".join(f"{name} {value:.3g}" for name, value in carried["terms"].items())
    return f"{what}: {held}; terms at its end: {terms}. The task itself is not done yet."
