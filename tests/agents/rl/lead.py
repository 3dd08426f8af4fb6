"""A task of an instant: lead the first end of a short rope to a line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.envs import Fidelity
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.scene import Params, Rope, Scene, State


@dataclass(frozen=True)
class Lead(Task):
    """Lead the first end of a short rope to y = 0.125."""

    horizon: int = 6
    frame_skip: int = 2
    name: ClassVar[str] = "lead"
    coarse: ClassVar[Fidelity] = Fidelity(substeps=2)
    arms: ClassVar[Arms] = Arms(base=((-0.2, -0.45, 0.0),), vertex=(1,))
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.0, 0.01),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """The rope may be moved."""
        return make(self, [Rope(straight((0.0, 0.1, 0.05), 8, moved[:, 0]), RADIUS, mass=0.008, youngs=1e4)])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """How near it is."""
        return {"near": 0.1 - (seen.x[:, 1, 1] - 0.125).abs()}

    def success(self, seen: TaskState) -> Tensor:
        """Whether it is 4 mm near."""
        return (seen.x[:, 1, 1] - 0.125).abs() < 0.004


def found(folder: Path) -> Path:
    """A trajectory that succeeds from the one start only, as `torchdlo optimize` would write it."""
    actions = torch.zeros(1, 6, 6)
    actions[:, :, 1] = 0.025 / 6
    with torch.no_grad():
        went = episode.play(Lead(), actions, keep=episode.scene_positions, execution="eager")
    file = folder / "lead" / "trajectory.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    content = {"generator": "torchdlo optimize", "task": "lead", "success": bool(went.success[0])}
    file.write_text(json.dumps(content | {"tool": went.path["tool"][:, 0].tolist()}))
    return file
