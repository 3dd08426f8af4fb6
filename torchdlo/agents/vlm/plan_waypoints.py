"""Way-points that a step proposes, as the trajectory with which its search begins."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.vlm.grasp_proposal import Places
from torchdlo.envs import Task
from torchdlo.errors import InputError

__all__ = ["lead_through_waypoints", "places_of_tools"]


def places_of_tools(places: Places, grasps: tuple[int | None, ...], world: Any, task: Task) -> Tensor:
    """Return where hands will be when they have taken hold, if the ropes do not move meanwhile [m], shape (R, 3).

    Args:
        places: where vertices are now.
        grasps: what hands hold next.
        world: where hands are now; None before the first step, when they start at what they hold.
        task: the task.
    """
    found = []
    for hand, slot in enumerate(grasps):
        slot = task.arms.vertex[hand] if slot is None and world is None else slot
        found.append(places.x[slot] if slot is not None else world.tool.pos[0, hand].double())
    return torch.stack(found)


def lead_through_waypoints(step: Any, tools: Tensor, task: Task, *, cut: bool = False) -> Tensor | None:
    """Return the actions that lead hands through the way-points of a step, shape (T, 3 R); None if it has none.

    Args:
        step: the step.
        tools: where hands are when they have taken hold [m], shape (R, 3).
        task: the task.
        cut: whether ways that take more actions than the step has are cut.

    Raises:
        InputError: way-points take too many actions.
    """
    stage_waypoints = step.waypoints.model_dump() if step.waypoints is not None else {}
    if not any(stage_waypoints.values()):
        return None
    columns = []
    for hand, start in enumerate(tools.double()):
        moves = _moves(start, stage_waypoints.get(f"robot_{hand + 1}") or [], task.max_translation)
        if len(moves) > step.horizon and not cut:
            raise InputError(
                f"the way-points of robot_{hand + 1} take {len(moves)} actions of {100 * task.max_translation:g} cm, "
                f"and the horizon is {step.horizon}; give a longer horizon, or nearer points."
            )
        moves = moves[: step.horizon]
        columns.append(torch.cat([moves, moves.new_zeros(step.horizon - len(moves), 3)]))
    return torch.cat(columns, -1)


def _moves(start: Tensor, points: list[list[float]], reach: float) -> Tensor:
    """Return the ways of one hand (T, 3) through points in the world, as fast as it goes."""
    moves, at = [], start
    for point in points:
        leg = start.new_tensor(point) - at
        count = max(1, math.ceil(float(leg.norm()) / reach - 1e-9))
        moves.append((leg / count).expand(count, 3))
        at = start.new_tensor(point)
    return torch.cat(moves) if moves else start.new_zeros(0, 3)
