"""A task of a few milliseconds and a painter that needs no renderer, for tests of data sets."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo import envs
from torchdlo.agents.data.making import DatasetPlan, make_dataset
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, straight
from torchdlo.envs.core.task import make as scene
from torchdlo.scene import Params, Rope, Scene, State


@dataclass(frozen=True)
class Short(Task):
    """Lead the first end of a short rope to the left of a place."""

    horizon: int = 4
    frame_skip: int = 1
    name: ClassVar[str] = "short"
    arms: ClassVar[Arms] = Arms(base=((-0.2, -0.45, 0.0),), vertex=(1,))
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.02, 0.01),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """The rope may be moved."""
        return scene(self, [Rope(straight((0.0, 0.1, 0.05), 6, moved[:, 0]), RADIUS, mass=0.006, youngs=1e4)])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """How far the rope is to the left."""
        return {"left": seen.x[:, 1, 1] - 0.1}

    def success(self, seen: TaskState) -> Tensor:
        """Whether it is beyond the place: starts on the right do not get there."""
        return seen.x[:, 1, 1] > 0.137

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Four centimetres to the left."""
        return [[(0.0, 0.04, 0.0)]]


@dataclass(frozen=True)
class Never(Short):
    """Never done."""

    name: ClassVar[str] = "never"

    def success(self, seen: TaskState) -> Tensor:
        """No."""
        return torch.zeros(len(seen.x), dtype=torch.bool)


@dataclass(frozen=True)
class Pair(Short):
    """Lead both ends of a short rope to the left."""

    name: ClassVar[str] = "pair"
    arms: ClassVar[Arms] = Arms(base=((-0.2, -0.45, 0.0), (0.25, -0.45, 0.0)), vertex=(1, 4))

    def waypoints(self) -> list[list[tuple[float, float, float]]]:
        """Four centimetres to the left."""
        return [[(0.0, 0.04, 0.0), (0.0, 0.04, 0.0)]]


SHORT = {kind.name: kind for kind in (Short, Never, Pair)}


@dataclass(frozen=True)
class Dots:
    """Draws a bright square where the rope's second vertex is, on a ground whose colour the look decides."""

    pause: float = 0.0
    """Time that a call takes at least [s]."""

    def __call__(
        self, made: episode.Episode, world: episode.EpisodeState, looks: Sequence[int], size: int
    ) -> dict[str, Tensor]:
        """Return pictures of all cameras."""
        time.sleep(self.pause)
        found = {}
        for name, shift in (("front", 0), ("wrist_right", 5), ("wrist_left", 9)):
            if name == "wrist_left" and made.task.arms.count < 2:
                continue
            image = torch.zeros(len(looks), size, size, 3, dtype=torch.uint8)
            for k, look in enumerate(looks):
                image[k] = look % 100
                x, y = ((world.state.rods.pos[k, 1, :2] * 100).long() + shift).tolist()
                image[k, y % (size - 4) :, x % (size - 4) :][:4, :4] = torch.tensor([250, 120, 30])
            found[name] = image
        return found


def plan(**given: object) -> DatasetPlan:
    """A small plan."""
    usual = {"tasks": ("short",), "episodes": 5, "size": 32, "batch": 4, "noise": 0.0005}
    return DatasetPlan(**(usual | given))


def main() -> None:
    """Make a set in a process of its own: OUT PAUSE EPISODES [--resume]."""
    torch.set_num_threads(1)
    envs.TASKS.update(SHORT)
    out, pause, episodes = Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
    os.umask(0o22)
    make_dataset(plan(episodes=episodes), out, painter=Dots(pause), resume="--resume" in sys.argv)


if __name__ == "__main__":
    main()
