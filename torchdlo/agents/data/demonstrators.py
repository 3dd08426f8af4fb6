"""Who acts in demonstrations: a path that tools are led along with feedback, from a task's script or a stored search.

A demonstrator says where tools are to go next, as places in the world, and not by how much they are to move: what noise
or the arm's reach took off is then made up for, and whoever learns from it learns to do so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from torchdlo.agents.trajopt.search_result import check_scene, read_trajectory
from torchdlo.envs import Task
from torchdlo.envs.core import episode
from torchdlo.errors import InputError
from torchdlo.untrusted import one_line

__all__ = ["Demonstrator", "FollowPath", "make_demonstrator", "scripted_demonstrator", "trajectory_demonstrator"]

LAG = 0.015
"""Distance of a tool from its place on the path beyond which the path waits for it [m]."""
FADE = 20
"""Actions within which a stored path leads from a start of its own to the one it was found for."""


class Demonstrator(Protocol):
    """Who acts. It is asked before every action of a batch of episodes."""

    @property
    def source(self) -> str:
        """What it is, for the record."""
        ...

    def sees(self, memory: Any) -> int:
        """Return the width and height of the pictures that it needs for the next action [px]; 0 for none."""
        ...

    def begin(self, made: episode.Episode, world: episode.EpisodeState, told: Sequence[str]) -> Any:
        """Return what it remembers when episodes begin, in which it is told what to do."""
        ...

    def target(self, world: episode.EpisodeState, memory: Any, pictures: dict[str, Tensor]) -> tuple[Tensor, Any]:
        """Return where tools are to go [m], shape (B, R, 3), and what it remembers.

        Args:
            world: the scenes.
            memory: what it remembers.
            pictures: what cameras see, (B, H, W, 3) each in 8 bits; none if it does not see.
        """
        ...


@dataclass(frozen=True, eq=False)
class _Progress:
    path: Tensor
    """Places after every action, shape (B, T + 1, R, 3)."""
    firsts: tuple[int, ...]
    """Actions with which stages begin."""
    at: Tensor
    """How far each episode is on it, whole, shape (B,)."""
    off: Tensor
    """By how much places are shifted since the stage began [m], shape (B, R, 3)."""
    count: int


@dataclass(frozen=True)
class FollowPath:
    """Leads tools along a path in the world."""

    source: str
    stored: tuple[tuple[tuple[float, ...], ...], ...] | None = field(default=None, repr=False)
    """Places of the tools after every action [m], as T rows of R points; the task's own script if not given."""

    def sees(self, memory: _Progress) -> int:
        """Return 0: it knows its way."""
        return 0

    def begin(self, made: episode.Episode, world: episode.EpisodeState, told: Sequence[str]) -> _Progress:
        """Return the path from where tools start."""
        start = world.tool.pos[:, None]
        path = torch.cat([start, self._places(made.task, world, start)], 1)
        firsts = tuple(stage.first for stage in made.task.schedule.stages)
        none = torch.zeros(len(path), dtype=torch.long)
        return _Progress(path, firsts, none, torch.zeros_like(world.tool.pos), 0)

    def _places(self, task: Task, world: episode.EpisodeState, start: Tensor) -> Tensor:
        if self.stored is None:
            actions = task.demonstration(world.state).to(start)
            actions = actions.expand(len(start), *actions.shape[-2:])
            stage_waypoints = actions[..., : 3 * task.arms.count].unflatten(-1, (task.arms.count, 3))
            return start + stage_waypoints.cumsum(1)
        places = start.new_tensor(self.stored).expand(len(start), -1, -1, -1)
        first = task.start(1, like=start)[2].rods.pos[:, list(task.arms.vertex)]
        shift = start - first[:, None]
        if not task.anchored:
            return places + shift
        left = 1 - torch.arange(1, places.shape[1] + 1).to(start) / FADE
        return places + shift * left.clamp(min=0)[:, None, None]

    def target(
        self, world: episode.EpisodeState, memory: _Progress, pictures: dict[str, Tensor]
    ) -> tuple[Tensor, _Progress]:
        """Return the next place on the path; it waits for tools that are far behind."""
        tool, off, path = world.tool.pos, memory.off, memory.path
        last = path.shape[1] - 1
        scenes = torch.arange(len(path))
        if memory.count in memory.firsts[1:]:
            # Hands went by themselves to what they hold now.
            off = tool - path[scenes, memory.at]
        behind = (tool - off - path[scenes, memory.at]).norm(dim=-1).amax(-1) > LAG
        # What follows a schedule does not wait.
        at = memory.at + torch.where(behind, 0, 1) if len(memory.firsts) == 1 else memory.at + 1
        at = at.clamp(max=last)
        found = _Progress(path, memory.firsts, at, off, memory.count + 1)
        return path[scenes, at] + off, found


def scripted_demonstrator(task: Task) -> FollowPath:
    """Return who acts as the task's scripted demonstration."""
    if not bool((task.demonstration() != 0).any()):
        raise InputError(f"{task.name}: has no scripted demonstration; give --actor a trajectory or a policy.")
    return FollowPath("scripted demonstration")


def trajectory_demonstrator(task: Task, path: Path) -> FollowPath:
    """Return who follows a trajectory that `torchdlo optimize` found."""
    content = read_trajectory(path)
    check_scene(path)
    name = one_line(content["task"].text(), 60)
    places = torch.tensor(content["tool"].numbers(None, None, 3, most=1e6), dtype=torch.float64)
    if name != task.name or places.dim() != 3 or places.shape[1:] != (task.arms.count, 3):
        raise InputError(
            f"{path}: it is a trajectory of {name} with places {tuple(places.shape)}; expected one of {task.name} with "
            f"(actions, {task.arms.count}, 3)."
        )
    rows = tuple(tuple(tuple(point) for point in row) for row in places.tolist())
    return FollowPath(f"trajectory {path.parent.name}/{path.name}", rows)


def make_demonstrator(task: Task, actor: str) -> Demonstrator:
    """Return who acts.

    Args:
        task: the task.
        actor: "scripted", a trajectory (.json), a folder of trajectories of which the best that succeeded and is the
            task's is taken, or a policy (.pt).
    """
    if actor == "scripted":
        return scripted_demonstrator(task)
    path = Path(actor)
    if path.is_dir():
        path = _best(task, path)
    if path.suffix == ".pt":
        from torchdlo.agents.policies.chunk_rollout import PolicyDemonstrator

        return PolicyDemonstrator.load(path)
    if not path.is_file():
        raise InputError(f"--actor: there is no file {actor!r}; expected scripted, a trajectory.json or a policy.pt.")
    return trajectory_demonstrator(task, path)


def _best(task: Task, folder: Path) -> Path:
    """Return the trajectory with the largest return of those in a folder that are the task's and succeeded."""
    found = []
    for file in sorted(folder.glob("*/trajectory.json")):
        try:
            content = read_trajectory(file)
            if content["task"].text() == task.name and content["success"].flag():
                check_scene(file)
                found.append((content["return"].number(), file))
        except InputError:
            continue
    if not found:
        raise InputError(f"{folder}: holds no trajectory of {task.name} that succeeded; give another --actor.")
    return max(found)[1]
