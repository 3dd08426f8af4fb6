"""A part of a task, or a task with another reward: the same scene, judged by expressions, from where hands are now.

`continue_from` makes a task of its own of what is left to do: it begins with the state, the joints and the notes that
another episode left, and hands that are to hold something else open and travel there first. Physics and failures are
those of the task.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from torchdlo.coupling.common.pose import Pose
from torchdlo.envs.core import scene_names
from torchdlo.envs.core.episode import Episode, EpisodeState, finish
from torchdlo.envs.core.stages import Stage
from torchdlo.envs.core.task import Task, TaskState
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.reward_language import Reward
from torchdlo.scene import Params, Scene, State

__all__ = ["SubTask", "continue_from", "opening", "task_success", "with_reward"]

_SAME = ("name", "arms", "floor", "max_translation", "max_rotation", "stretch", "travel", "anchored")
"""What a part has from its task."""


@dataclass(frozen=True, eq=False)
class SubTask(Task):
    """A part of a task. `continue_from` and `with_reward` make it."""

    inner: Task = None  # type: ignore[assignment]
    """The task, with what hands hold here."""
    before: EpisodeState | None = None
    """The world of one scene from which it goes on; None: it begins as the task does."""
    reward: Reward | None = None
    """What it is judged by; as the task if not given."""
    kept: tuple[int | None, ...] = ()
    """What hands hold from before."""

    def __post_init__(self) -> None:
        for name in _SAME:
            object.__setattr__(self, name, getattr(self.inner, name))
        object.__setattr__(self, "combine", "sum" if self.reward else self.inner.combine)
        object.__setattr__(self, "forfeits", self.reward is not None or self.inner.forfeits)
        still = ((0.0, 0.0),) * len(self.inner.reset_noise)
        object.__setattr__(self, "reset_noise", self.inner.reset_noise if self.before is None else still)
        stages = self.inner.stages
        if self.before is not None and self.kept != self.inner.grasps:
            stages = (Stage(0, self.kept), Stage(self.travel, cast(Any, self.inner.grasps)))
        object.__setattr__(self, "stages", stages)
        object.__setattr__(self, "grasps", self.inner.grasps)
        if self.reward is not None:
            self._check(self.reward)

    @property
    def travels(self) -> int:
        """Actions at the start in which hands go to what they hold next."""
        return self.stages[1].first if self.before is not None and len(self.stages) > 1 else 0

    @functools.cached_property
    def identity(self) -> dict[str, Any]:
        """What results depend on beside the task's name, as plain data: reward, and a hash of where it begins."""
        found: dict[str, Any] = {} if self.reward is None else {"reward": self.reward.plain()}
        if self.before is not None:
            digest = hashlib.sha256()
            for leaf in tree.leaves(self.before):
                digest.update(leaf.detach().cpu().contiguous().numpy().tobytes())
            found["part"] = {"from": digest.hexdigest(), "kept": list(self.kept), "horizon": self.horizon}
        return found

    @functools.cached_property
    def layout(self) -> scene_names.Layout:
        """What there is in the scene."""
        return scene_names.layout(self.inner.start(1)[0])

    def _check(self, reward: Reward) -> None:
        """Refuse expressions that this scene has no values for, with a scene as it is at the start."""
        here, seen = opening(self)
        values = scene_names.named_values(self.inner, here, seen)
        reward.evaluate(values)
        reward.succeeded(values)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene, in the state that was left."""
        scene, params, fresh = self.inner.build(moved)
        if self.before is None:
            return scene, params, fresh

        def carried(new: Tensor, old: Tensor) -> Tensor:
            return torch.empty_like(new).copy_(old.to(new).expand_as(new))

        # What holds exert has as many rows as there are vertices to hold.
        old = tree.replace(self.before.state, reaction=fresh.reaction)
        return scene, params, tree.map(carried, fresh, old)

    def carried(self) -> EpisodeState | None:
        """Return the world from which it goes on."""
        return self.before

    def _values(self, seen: TaskState, names: frozenset[str]) -> dict[str, Tensor]:
        return scene_names.named_values(self.inner, self.layout, seen, names)

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return the terms of the reward."""
        if self.reward is None:
            return self.inner.rewards(seen)
        names = frozenset().union(*(term.names for _, term in self.reward.terms))
        return self.reward.evaluate(self._values(seen, names))

    def success(self, seen: TaskState) -> Tensor:
        """Return where the condition holds; that of the task if there is none."""
        if self.reward is None or self.reward.success is None:
            return self.inner.success(seen)
        return cast(Tensor, self.reward.succeeded(self._values(seen, self.reward.success.names)))

    def auxiliary_loss(self, seen: TaskState) -> dict[str, Tensor]:
        """Return nothing unless the reward is the task's."""
        return self.inner.auxiliary_loss(seen) if self.reward is None else {}

    def terminal_cost(self, seen: TaskState) -> Tensor:
        """Return nothing unless the reward is the task's."""
        return self.inner.terminal_cost(seen) if self.reward is None else super().terminal_cost(seen)

    def note(self, seen: TaskState) -> dict[str, Tensor]:
        """Return what the task remembers."""
        return self.inner.note(seen)

    def failed(self, seen: TaskState) -> Tensor:
        """Return where the task has failed."""
        return self.inner.failed(seen)

    def measures(self, seen: TaskState) -> dict[str, Tensor]:
        """Return those of the task."""
        return self.inner.measures(seen)

    def measured(self) -> dict[str, str]:
        """Return those of the task."""
        return self.inner.measured()

    def stage_waypoints(self) -> Sequence[Sequence[Sequence[tuple[float, float, float]]]]:
        """Return the demonstration of the task, none if it goes on from somewhere."""
        return self.inner.stage_waypoints() if self.before is None else [()] * len(self.schedule.stages)


def opening(task: Task, state: State | None = None) -> tuple[scene_names.Layout, TaskState]:
    """Return what there is in the scene of a task, and what is seen of it before the first action.

    Hands stand where they take hold; no inverse kinematics is done for it.

    Args:
        task: the task.
        state: of one scene, that of the usual start if not given.
    """
    scene, _, usual = task.start(1, like=torch.zeros((), dtype=torch.float64))
    here, before = scene_names.layout(scene), task.carried()
    if before is not None:
        return here, before.seen(task.arms.count)
    state = usual if state is None else state
    pos = state.rods.pos[:, list(task.arms.vertex)]
    seen = TaskState(
        state, Pose(pos, pos.new_tensor(task.arms.quats).expand(1, -1, -1)), torch.ones_like(pos[..., :1]), {}
    )
    return here, tree.replace(seen, notes=task.note(seen))


def with_reward(task: Task, reward: Reward) -> SubTask:
    """Return a task with another reward, and another condition of success if the reward has one."""
    return SubTask(**_fields(task), inner=task, reward=reward)


def _fields(task: Task) -> dict[str, Any]:
    names = ("horizon", "frame_skip", "settle_steps", "release", "rope", "fidelity")
    return {name: getattr(task, name) for name in names}


def continue_from(
    task: Task,
    world: EpisodeState,
    grasps: Sequence[int | None],
    *,
    holds: Sequence[int | None],
    horizon: int,
    reward: Reward | None = None,
) -> SubTask:
    """Return what is left of a task as a task of its own.

    Hands that are to hold what they do not hold yet open and travel there in the first `Task.travel` actions, which are
    added to the horizon.

    Args:
        task: the task, as `envs.find` returns it.
        world: where an episode of one scene is.
        grasps: what each hand is to hold, None for one that is to be open.
        holds: what each hand holds in that world; see `SubTask.inner.grasps` of the part that led there.
        horizon: actions after the hands have travelled.
        reward: what it is judged by, and its success.
    """
    if len(world.failed) != 1 or bool(world.failed[0]):
        raise InputError(f"{task.name}: a part can go on from one scene that has not failed, and from no other.")
    firm = world.seen(task.arms.count).closed[0, :, 0] > 0
    kept = tuple(h if h == g and bool(f) else None for h, g, f in zip(holds, grasps, firm, strict=True))
    inner = dataclasses.replace(task, grasps=tuple(grasps))
    scene, _, state = inner.start(1, like=world.state.rods.pos)
    usual = tree.replace(world, state=state).seen(task.arms.count)
    before = tree.detach(
        tree.replace(world, notes={**world.notes, "rest": inner.rest(usual, scene.topology)}, grasp=world.grasp)
    )
    fields = _fields(task) | {"settle_steps": 0, "release": 0}
    moves = task.travel if kept != tuple(grasps) and any(g is not None for g in grasps) else 0
    fields["horizon"] = horizon + moves
    return SubTask(**fields, inner=inner, before=before, reward=reward, kept=kept)


def task_success(episode: Episode, world: EpisodeState, task: Task) -> tuple[Tensor, EpisodeState]:
    """Return where the task itself is done, bool, shape (B,), and the world in which that was judged.

    Args:
        episode: of the last part.
        world: its end.
        task: the task.
    """
    last = dataclasses.replace(episode, task=dataclasses.replace(episode.task, release=task.release))
    world = finish(last, world)
    return task.success(world.seen(task.arms.count)) & ~world.failed, world
