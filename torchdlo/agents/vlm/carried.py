"""What plans are carried out with, and what came of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

from torch import Tensor

from torchdlo.agents.vlm.conversation import ShownPicture
from torchdlo.envs.core import episode
from torchdlo.physics.execution import Execution

__all__ = ["Carried", "Options", "Result", "WorldPainter"]


class WorldPainter(Protocol):
    """What draws pictures of worlds."""

    def now(self, made: episode.Episode, world: episode.EpisodeState) -> bytes:
        """Return the scene with numbers on the vertices, as PNG."""
        ...

    def stills(self, made: episode.Episode, worlds: Sequence[episode.EpisodeState]) -> bytes:
        """Return moments of a step side by side, as PNG."""
        ...


@dataclass(frozen=True)
class Options:
    """How plans are carried out."""

    update: bool = True
    """Whether the model is asked again after every step."""
    steps: int = 8
    """Most steps that are carried out and not taken back."""
    patience: int = 3
    """Updates without progress after which a run ends."""
    method: str = "hybrid"
    episodes: int = 240
    """Budget of a step."""
    population: int = 24
    seed: int = 0
    reset_seed: int | None = None
    """Seed of a start that differs from the usual one."""
    enough: bool = True
    """Whether a search ends with the first trajectory that reaches the success of its step."""
    execution: Execution = "recorded"
    """How steps of the scene run."""


@dataclass(frozen=True, eq=False)
class Carried:
    """What came of a step."""

    step: dict[str, Any]
    """As the model gave it."""
    success: bool
    """Whether its own condition held at its end."""
    failed: str
    """Why it was taken back, "" if it was not."""
    returns: float | None
    terms: dict[str, float]
    """Terms of its reward at its end."""
    episodes: int
    seconds: float
    task_success: bool
    """Whether the task's own condition holds now."""
    actions: Tensor | None = None
    """What was played, shape (T, 3 R)."""
    pictures: tuple[ShownPicture, ...] = ()

    def plain(self) -> dict[str, Any]:
        """Return it as plain data, without what was played."""
        kept = ("step", "success", "failed", "returns", "terms", "episodes", "seconds", "task_success")
        return {name: getattr(self, name) for name in kept} | {"pictures": [p.digest[:16] for p in self.pictures]}


@dataclass(frozen=True, eq=False)
class Result:
    """What came of a run."""

    task: str
    source: str
    success: bool
    """Whether the task's own condition holds at the end."""
    ended: str
    """Why it ended, a sentence."""
    plans: list[dict[str, Any]]
    """The first plan and every update, as they were given."""
    carried: list[Carried]
    updates: int
    calls: int
    tokens: int
    seconds: float
    world: episode.EpisodeState | None = field(repr=False)
    """What it ended in; None if no step was carried out."""

    def json(self, options: Options) -> str:
        """Return the content of a file."""
        content = {
            "generator": "torchdlo plan",
            "task": self.task,
            "source": self.source,
            "success": self.success,
            "ended": self.ended,
            "updates": self.updates,
            "calls": self.calls,
            "tokens": self.tokens,
            "seconds": round(self.seconds, 3),
            "episodes": sum(c.episodes for c in self.carried),
            "options": asdict(options),
            "plans": self.plans,
            "steps": [c.plain() for c in self.carried],
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"
