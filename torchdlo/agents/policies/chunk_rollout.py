"""Policies in closed loop: as who acts in a data set, and judged from starts that they have not seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdlo.agents.data import sentences
from torchdlo.agents.data.record import EpisodeStart, Noise, Painter, arm_state, draw_starts, play_batch
from torchdlo.agents.policies import language
from torchdlo.agents.policies.chunk_policy import ChunkPolicy, load_policy
from torchdlo.envs import PAIRED_TASKS, TASKS, find, find_stored
from torchdlo.envs.core import episode
from torchdlo.errors import InputError

__all__ = ["CONDITIONS", "PolicyDemonstrator", "evaluate_chunk_policy"]

CONDITIONS = ("varied", "paraphrased", "swapped", "blanked")
"""How a policy is judged, always from unseen starts: with instructions of data sets; with others that mean the same;
with those of another task, when it should not succeed; and with black pictures, when it should not either."""
AGAIN = 8
"""Actions after which it looks again."""


@dataclass(frozen=True, eq=False)
class _Chunk:
    words: Tensor
    """Vectors of the instructions, shape (B, 384)."""
    targets: Tensor | None = None
    """What is to be done, shape (B, chunk, R, 3)."""
    done: int = 0
    """Actions done of it."""


@dataclass(frozen=True, eq=False)
class PolicyDemonstrator:
    """A policy as a demonstrator, see `demonstrators.Demonstrator`."""

    policy: ChunkPolicy
    encoder: str
    source: str
    blank: bool = False
    """Whether it sees black pictures."""

    @staticmethod
    def load(path: Path) -> PolicyDemonstrator:
        """Return the policy in a file."""
        policy, about = load_policy(path)
        return PolicyDemonstrator(policy, about["language"], f"policy {path.name}")

    def sees(self, memory: _Chunk) -> int:
        """Return the size of pictures if it looks before this action, else 0 [px]."""
        looks = memory.targets is None or memory.done >= min(AGAIN, self.policy.shape.chunk)
        return self.policy.shape.size * looks

    def begin(self, made: episode.Episode, world: episode.EpisodeState, told: Sequence[str]) -> _Chunk:
        """Return what it remembers: the instructions."""
        if made.task.arms.count > self.policy.shape.arms:
            raise InputError(
                f"{self.source}: it moves {self.policy.shape.arms} arm, and {made.task.name} has "
                f"{made.task.arms.count}; learn from a data set with that task."
            )
        return _Chunk(language.encode_sentences(told, self.encoder))

    def target(self, world: episode.EpisodeState, memory: _Chunk, pictures: dict[str, Tensor]) -> tuple[Tensor, _Chunk]:
        """Return where tools are to go; it looks now and then, and follows what it has decided in between."""
        if self.sees(memory):
            memory = replace(memory, targets=self._decide(world, memory.words, pictures), done=0)
        assert memory.targets is not None
        found = memory.targets[:, memory.done, : world.tool.pos.shape[1]]
        return found.to(world.tool.pos), replace(memory, done=memory.done + 1)

    def _decide(self, world: episode.EpisodeState, words: Tensor, pictures: dict[str, Tensor]) -> Tensor:
        shape, count = self.policy.shape, len(words)
        state = arm_state(world)
        wide = state.new_zeros(count, shape.arms, state.shape[-1])
        wide[:, : state.shape[1]] = state
        black = torch.zeros(count, 3, shape.size, shape.size, dtype=torch.uint8)
        shots = {name: pictures[name].movedim(-1, 1) for name in shape.cameras if name in pictures and not self.blank}
        with torch.no_grad():
            seen = {name: shots.get(name, black) for name in shape.cameras}
            return self.policy(seen, wide.flatten(1).float(), words)


def evaluate_chunk_policy(
    path: Path,
    tasks: Sequence[str],
    painter: Painter,
    *,
    episodes: int = 15,
    seed: int = 0,
    conditions: Sequence[str] = ("varied",),
    callback: Callable[[str, int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Return how often a policy succeeds from unseen starts, with unseen looks and without noise.

    Args:
        path: the policy's file.
        tasks: names of tasks; those that it has learned if empty.
        painter: draws what it sees.
        episodes: per task and condition.
        seed: of the starts; no data set has them, whatever its seed.
        conditions: some of `CONDITIONS`.
        callback: told (stage, done, in all, message).
    """
    wrong = set(conditions) - set(CONDITIONS)
    if wrong:
        raise InputError(f"conditions: expected some of {', '.join(CONDITIONS)}, given {', '.join(sorted(wrong))}.")
    actor, about = PolicyDemonstrator.load(path), load_policy(path)[1]
    names = list(tasks) or [_registered(name, path) for name in about["tasks"]]
    if not names:
        raise InputError(f"{path}: it does not say which tasks it has learned; name them.")
    # Tasks of one's own are code, which the caller may name, and a file may not.
    known = [name for name in about["tasks"] if name in tasks or name in TASKS | PAIRED_TASKS] or names
    found: dict[str, Any] = {}
    for number, name in enumerate(names):
        made = _prepared(name, episodes)
        for k, condition in enumerate(conditions):
            attempts = [
                _told(s, name, known, condition) for s in draw_starts(made.task, f"evaluate {seed}", range(episodes))
            ]
            who = replace(actor, blank=condition == "blanked")
            with torch.no_grad():
                steps, end, _ = play_batch(made, attempts, who, Noise(0.0), painter)
            returns = torch.stack([step.reward for step in steps]).sum(0)
            rows: list[dict[str, Any]] = [
                {"told": start.told, "success": bool(good), "return": float(value) if math.isfinite(value) else None}
                for start, good, value in zip(attempts, steps[-1].success, returns, strict=True)
            ]
            share = sum(row["success"] for row in rows) / episodes
            failed = int(end.failed.sum())
            found.setdefault(name, {})[condition] = {"success": share, "failed": failed, "episodes": rows}
            if callback is not None:
                done = number * len(conditions) + k + 1
                callback("evaluate", done, len(names) * len(conditions), f"{name}, {condition}: {share:.0%}")
    means = {c: sum(found[n][c]["success"] for n in names) / len(names) for c in conditions}
    return {"policy": str(path), "seed": seed, "episodes": episodes, "mean": means, "tasks": found}


def _registered(name: str, path: Path) -> str:
    find_stored(name, path)
    return name


def _prepared(name: str, count: int) -> episode.Episode:
    task = find(name)
    return episode.prepare(task, count, execution=episode.quick_execution(task))


def _told(start: EpisodeStart, name: str, known: Sequence[str], condition: str) -> EpisodeStart:
    """Return an attempt with the instruction of its condition; `known` are the tasks that the policy has learned."""
    if condition == "paraphrased":
        said = sentences.heldout_instructions(name)
    elif condition == "swapped":
        paired = find(name).counterpart
        others = [paired] if paired else [other for other in known if other != name]
        if not others:
            raise InputError(
                f"swapped: the policy has learned no other task than {name}, whose instructions could be given."
            )
        said = sentences.training_instructions(others[start.number % len(others)])
    else:
        return start
    return replace(start, told=said[start.number % len(said)])
