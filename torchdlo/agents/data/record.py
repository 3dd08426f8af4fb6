"""Recording demonstrations: episodes are played in batches, and each becomes the frames of a data set."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from torchdlo.agents.data import sentences
from torchdlo.agents.data.dataset_schema import JOINTS, Schema
from torchdlo.agents.data.demonstrators import Demonstrator
from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.coupling.common.pose import Pose
from torchdlo.envs import Task
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import RADIUS
from torchdlo.physics import tree
from torchdlo.physics.linalg.numerics import safe_norm
from torchdlo.physics.linalg.rotation import multiply

__all__ = [
    "EpisodeRecording",
    "EpisodeStart",
    "Noise",
    "Painter",
    "action_towards",
    "arm_state",
    "draw_starts",
    "play_batch",
    "record_attempts",
    "scene_in_time",
    "seed_of",
]

OPEN = 0.08
"""Distance of fingers that hold nothing [m]."""


class Painter(Protocol):
    """Draws what the cameras of a task see."""

    def __call__(
        self, made: episode.Episode, world: episode.EpisodeState, looks: Sequence[int], size: int
    ) -> dict[str, Tensor]:
        """Return pictures by camera, 8 bits of red, green and blue, shape (B, size, size, 3).

        Args:
            made: the episode that scenes belong to.
            world: B scenes.
            looks: for each the seed of its colours, lights, and where its cameras stand exactly.
            size: width and height [px].
        """
        ...


@dataclass(frozen=True)
class Noise:
    """Disturbance of what hands do, so that demonstrations show how to get back from mistakes."""

    size: float = 0.002
    """Standard deviation per axis [m]; 0 for none."""
    turn: float = 0.02
    """The same of turns [degrees]."""
    memory: float = 0.8
    """Correlation of one action with the next [1]."""

    def drawn(self, seed: int, horizon: int, arms: int) -> Tensor:
        """Return disturbances of ways [m] and turns [degrees], shape (horizon, arms, 6)."""
        generator = torch.Generator().manual_seed(seed)
        fresh = torch.randn(horizon, arms, 6, generator=generator, dtype=torch.float64)
        found = [fresh[0]]
        for x in fresh[1:]:
            found.append(self.memory * found[-1] + (1 - self.memory**2) ** 0.5 * x)
        return torch.stack(found) * torch.tensor([self.size] * 3 + [self.turn * bool(self.size)] * 3)


@dataclass(frozen=True)
class EpisodeStart:
    """One attempt at a task: everything random in it comes from its seed."""

    number: int
    """Which attempt it is, counted from 0."""
    seed: int
    told: str
    """The instruction."""

    def part(self, what: str) -> int:
        """Return the seed of a part of it."""
        return seed_of(self.seed, what)


def seed_of(*parts: object) -> int:
    """Return a seed that depends on all parts."""
    text = "/".join(map(str, parts))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 2


def draw_starts(
    task: Task, seed: int | str, numbers: Sequence[int], told: Sequence[str] | None = None
) -> list[EpisodeStart]:
    """Return the attempts with these numbers; `told` are instructions in turn, drawn from a seed if not given."""
    found, plain = [], (type(task).__doc__ or task.name).splitlines()[0]
    for k in numbers:
        own = seed_of(seed, task.name, k)
        text = told[k % len(told)] if told else sentences.draw_instruction(task.name, seed_of(own, "told"), plain)
        found.append(EpisodeStart(k, own, text))
    return found


@dataclass(frozen=True, eq=False)
class EpisodeRecording:
    """An episode as it is kept."""

    start: EpisodeStart
    offsets: list[list[float]]
    """How far the things that the task varies were off their places [m]."""
    success: bool
    failed: bool
    returned: float
    """Sum of the rewards [1]."""
    columns: dict[str, np.ndarray]
    """Frames by column, shape (T, D) or (T,); empty if the episode did not succeed."""
    pictures: dict[str, np.ndarray]
    """Pictures by column, shape (T, H, W, 3), 8 bits."""


@dataclass(frozen=True, eq=False)
class _Step:
    """What a batch did in one action."""

    before: episode.EpisodeState
    action: Tensor
    executed: Tensor
    target: Tensor
    """Places of tools and their orientations, shape (B, R, 7)."""
    joints: Tensor
    reward: Tensor
    success: Tensor


def arm_state(world: episode.EpisodeState) -> Tensor:
    """Return what is known of the arms, shape (B, R, 15), see `schema.STATE`."""
    closed = world.seen(world.tool.pos.shape[1]).closed
    opening = closed * 2 * RADIUS + (1 - closed) * OPEN
    return torch.cat([world.joints[..., :JOINTS], opening, world.tool.pos, world.tool.quat], -1)


def action_towards(task: Task, world: episode.EpisodeState, target: Pose, shake: Tensor | None = None) -> Tensor:
    """Return the action that leads tools towards poses, as far as they reach, shape (B, A).

    Args:
        task: the task.
        world: the scenes.
        target: poses in the world, shapes (B, R, 3) and (B, R, 4).
        shake: what is added to ways [m] and turns [degrees], shape (B, R, 6).
    """
    way = target.pos - world.target.pos
    # Small turns are twice the vector of the quaternion that leads there, in the frame of the tool.
    off = multiply(conjugate(world.target.quat), target.quat)
    turn = torch.rad2deg(2 * off[..., 1:] * off[..., :1].sign())
    if shake is not None:
        way, turn = _cut(task, way) + shake[..., :3], turn.clamp(-task.max_rotation, task.max_rotation) + shake[..., 3:]
    return torch.cat([_cut(task, way).flatten(1), turn.clamp(-task.max_rotation, task.max_rotation).flatten(1)], -1)


def _cut(task: Task, way: Tensor) -> Tensor:
    """Return ways (B, R, 3) as far as tools reach, in the same directions."""
    return way * (task.max_translation / safe_norm(way).clamp(min=task.max_translation))


def play_batch(
    made: episode.Episode,
    attempts: Sequence[EpisodeStart],
    actor: Demonstrator,
    noise: Noise,
    painter: Painter | None,
) -> tuple[list[_Step], episode.EpisodeState, Tensor]:
    """Play attempts, as many as the episode has scenes; return the steps, the end, and how starts were off [m]."""
    task, like = made.task, made.start.tool.pos
    offsets = [
        task.moved(1, like=like, generator=torch.Generator().manual_seed(start.part("start"))) for start in attempts
    ]
    moved = torch.cat(offsets)
    shakes = [noise.drawn(start.part("noise"), task.horizon, task.arms.count) for start in attempts]
    shake = torch.stack(shakes, 1).to(like)
    world = episode.begin(made, task.build(moved)[2])
    upright = world.target.quat  # no demonstration turns its tools
    memory, steps = actor.begin(made, world, [start.told for start in attempts]), []
    looks = [start.part("look") for start in attempts]
    for k in range(task.horizon):
        size = actor.sees(memory) if painter is not None else 0
        seen = painter(made, world, looks, size) if painter is not None and size else {}
        target, memory = actor.target(world, memory, seen)
        goal = Pose(target, upright)
        action, executed = action_towards(task, world, goal), action_towards(task, world, goal, shake[k])
        aim, joints = episode.follow(task, world, action)
        before, world = world, episode.act(made, world, executed)
        if k == task.horizon - 1:
            world = episode.finish(made, world)
        reward = episode.episode_reward(made, world)[1]
        success = task.success(world.seen(task.arms.count)) & ~world.failed
        pose = torch.cat([target, aim.quat], -1)
        steps.append(_Step(before, action, executed, pose, joints[..., :JOINTS], reward, success))
    return steps, world, moved


def record_attempts(
    made: episode.Episode,
    attempts: Sequence[EpisodeStart],
    actor: Demonstrator,
    schema: Schema,
    painter: Painter | None = None,
    noise: Noise | None = None,
) -> list[EpisodeRecording]:
    """Return attempts as they are kept; those without success without their frames.

    A batch is filled up with its first attempt, as steps are made for one size.
    """
    count = len(made.start.failed)
    if len(attempts) < count:
        filled = [*attempts, *[attempts[0]] * (count - len(attempts))]
        return record_attempts(made, filled, actor, schema, painter, noise)[: len(attempts)]
    with torch.no_grad():
        steps, end, moved = play_batch(made, attempts, actor, noise or Noise(), painter)
        found = []
        for k, start in enumerate(attempts):
            rewards = torch.stack([step.reward[k] for step in steps])
            success = bool(steps[-1].success[k])
            columns = _columns(schema, steps, k) if success else {}
            worlds = scene_in_time([step.before for step in steps], k)
            pictures = _pictures(made, worlds, start, schema, painter) if success and painter is not None else {}
            sums = float(rewards.double().sum())
            found.append(
                EpisodeRecording(start, moved[k].tolist(), success, bool(end.failed[k]), sums, columns, pictures)
            )
    return found


def scene_in_time(worlds: Sequence[episode.EpisodeState], k: int) -> episode.EpisodeState:
    """Return the scene k of many moments as a batch of them."""

    def row(*parts: Tensor) -> Tensor:
        # What scenes share has an axis of size 1, or none.
        return torch.cat([p[k : k + 1] if p.shape[0] > k else p[:1] for p in parts]) if parts[0].dim() else parts[0]

    return tree.map(row, *worlds)


def _wide(x: Tensor, arms: int) -> Tensor:
    """Return what is known of arms (R, D) with zeros for those that are not there."""
    return torch.cat([x, x.new_zeros(arms - len(x), x.shape[-1])])


def _action(x: Tensor, arms: int) -> Tensor:
    """Return an action (6 R,) as wide as that of a task with so many arms."""
    parts = x.unflatten(-1, (2, -1, 3))
    return torch.stack([_wide(part, arms) for part in parts]).flatten()


def _columns(schema: Schema, steps: Sequence[_Step], k: int) -> dict[str, np.ndarray]:
    arms, last = schema.arms, len(steps) - 1
    rows = {
        "observation.state": [_wide(arm_state(step.before)[k], arms).flatten() for step in steps],
        "action": [_action(step.action[k], arms) for step in steps],
        "torchdlo.executed": [_action(step.executed[k], arms) for step in steps],
        "torchdlo.target": [_wide(step.target[k], arms).flatten() for step in steps],
        "torchdlo.joint_target": [_wide(step.joints[k], arms).flatten() for step in steps],
        "next.reward": [step.reward[k] for step in steps],
        "next.success": [step.success[k] for step in steps],
    }
    found = {name: torch.stack(row).numpy() for name, row in rows.items()}
    found = {name: x.astype(bool if x.dtype == bool else np.float32) for name, x in found.items()}
    return found | {"next.done": np.arange(last + 1) == last}


def _pictures(
    made: episode.Episode, worlds: episode.EpisodeState, start: EpisodeStart, schema: Schema, painter: Painter
) -> dict[str, np.ndarray]:
    if not schema.size:
        return {}
    count = len(worlds.failed)
    drawn = painter(made, worlds, [start.part("look")] * count, schema.size)
    black = torch.zeros(count, schema.size, schema.size, 3, dtype=torch.uint8)
    return {key: drawn.get(key.rpartition(".")[2], black).numpy() for key in schema.pictures}
