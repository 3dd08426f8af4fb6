"""What to play in a task: the scripted demonstration, nothing, or a trajectory that was found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.trajopt.search_result import load_actions
from torchdlo.agents.trajopt.task_problem import TaskProblem, trajectory_problem
from torchdlo.envs import RopeMaterial, Task, find
from torchdlo.envs.core import episode
from torchdlo.errors import InputError
from torchdlo.physics.execution import Execution

__all__ = ["Script", "script"]


@dataclass(frozen=True, eq=False)
class Script:
    """An episode of one scene, and its actions."""

    task: Task
    episode: episode.Episode
    actions: Tensor
    """Shape (T, A)."""


def script(
    name: str,
    trajectory: Path | None = None,
    rope: RopeMaterial | None = None,
    *,
    no_op: bool = False,
    reset_seed: int | None = None,
    execution: Execution | None = None,
) -> Script:
    """Return what to play.

    Args:
        name: of the task.
        trajectory: a file that `torchdlo optimize` wrote, played with the precision, the kind of steps, the grasps, the
            reward and the fidelity with which it was found, so that every bit of it comes back; the scripted
            demonstration if not given.
        rope: see `torchdlo.envs.make`; a trajectory that was found for another one shows how well it carries over.
        no_op: do nothing.
        reset_seed: seed of a start with noise; without it, the nominal start.
        execution: how steps run, if no trajectory decides.

    Raises:
        InputError: The trajectory is none, is one of another task, needs a rope, or there is no scripted demonstration.
    """
    task = find(name, rope)
    if trajectory is None:
        chosen = TaskProblem(task, execution=execution or episode.quick_execution(task))
    else:
        chosen = trajectory_problem(trajectory, task, rope)
    task = chosen.task
    seeded = torch.Generator().manual_seed(reset_seed or 0)
    start: dict[str, Any] = {"generator": seeded, "variation": reset_seed is not None}
    made = episode.prepare(task, 1, like=chosen.like, execution=chosen.execution, **start)
    if trajectory is not None:
        return Script(task, made, chosen.full(load_actions(trajectory, chosen)))
    if no_op:
        return Script(task, made, chosen.like.new_zeros(task.horizon, task.width))
    way = task.demonstration() if reset_seed is None else task.demonstration(made.start.state)[0]
    if not bool((way != 0).any()):
        raise InputError(f"{name}: has no scripted demonstration; give a --trajectory, or --no-op.")
    return Script(task, made, way.to(chosen.like))
