"""Way-points that a step proposes, as the trajectory with which its search begins."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.vlm.grasp_proposal import Places
from torchdlo.envs import Task
from torchdlo.errors import InputError

__all__ = ["lead_through_waypoints"]


def lead_through_waypoints(
    step: Any,
    places: Places,
    grasps: tuple[int | None, ...],
    world: Any,
    task: Task,
    *,
    travels: int = 0,
) -> Tensor | None:
    """Return the actions that lead hands through the way-points of a step, shape (T, 3 R); None if it has none.

    Args:
        step: the step.
        places: where vertices are now.
        grasps: what hands hold in it.
        world: where hands are now; None before the first step, when they start at what they hold.
        task: the task.
        travels: actions before, in which hands go to what they hold.
    """
    stage_waypoints = step.waypoints.model_dump() if step.waypoints is not None else {}
    if not any(stage_waypoints.values()):
        return None
    columns = []
    for hand in range(task.arms.count):
        points = stage_waypoints.get(f"robot_{hand + 1}") or []
        slot = grasps[hand]
        slot = task.arms.vertex[hand] if slot is None and world is None else slot
        start = places.x[slot] if slot is not None else world.tool.pos[0, hand].double()
        columns.append(_column(start, points, step.horizon, task.max_translation, hand))
    return torch.cat([torch.zeros(travels, 3 * task.arms.count, dtype=torch.float64), torch.cat(columns, -1)])


def _column(start: Tensor, points: list[list[float]], horizon: int, reach: float, hand: int) -> Tensor:
    """Return the ways of one hand (T, 3) through points in the world, as fast as it goes, and then none."""
    moves, at = [], start
    for point in points:
        leg = start.new_tensor(point) - at
        count = max(1, math.ceil(float(leg.norm()) / reach - 1e-9))
        moves.append((leg / count).expand(count, 3))
        at = start.new_tensor(point)
    need = sum(len(m) for m in moves)
    if need > horizon:
        raise InputError(
            f"the way-points of robot_{hand + 1} take {need} actions of {100 * reach:g} cm, and the horizon is "
            f"{horizon}; give a longer horizon, or nearer points."
        )
    return torch.cat([*moves, start.new_zeros(horizon - need, 3)])
