"""What the cameras of a task see, by the renderer of `torchdlo.vision`: the one place that knows it."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.envs.core import episode
from torchdlo.envs.observations.pixels import CameraRig, camera_rig, render_cameras
from torchdlo.physics import tree
from torchdlo.vision.look import Look, draw_look

__all__ = ["TaskPainter"]


@functools.lru_cache(maxsize=4)
def _rig(made: episode.Episode, size: int) -> CameraRig:
    return camera_rig(made, size=size)


@functools.lru_cache(maxsize=256)
def _look(seed: int, jitter: float) -> Look:
    return draw_look(torch.Generator().manual_seed(seed), strength=jitter)


@dataclass(frozen=True)
class TaskPainter:
    """Draws what the cameras of a task see, with colours, lights and cameras drawn from seeds."""

    samples: int = 4
    """Per pixel, 1 or 4."""
    shadow: int = 256
    """Texels of the map of shadows along each side; 0 for no shadows."""
    jitter: float = 0.3
    """Errors of the cameras, see `look.draw_look`: deviations of 0.34 degrees, 2.4 mm and 0.6 % of the focal length."""

    def __call__(
        self, made: episode.Episode, world: episode.EpisodeState, looks: Sequence[int], size: int
    ) -> dict[str, Tensor]:
        """Return pictures by camera, see `record.Painter`; the first arm has the right wrist."""
        rig = _rig(made, size)
        quality: dict[str, Any] = {"samples": self.samples, "shadow": self.shadow}
        seen = render_cameras(
            rig, world.state, world.joints, looks=[_look(seed, self.jitter) for seed in looks], **quality
        ).rgb
        return {camera.name: tree.part(seen)[:, k] for k, camera in enumerate(rig.cameras)}
