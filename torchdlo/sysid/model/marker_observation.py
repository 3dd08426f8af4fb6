"""What markers show of a simulated rope: where they sit on it, and when they are seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.effects.measurement import Track
from torchdlo.physics.linalg import rotation
from torchdlo.physics.linalg.numerics import normalize


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers of a rope."""

    vertex: Sequence[int] | np.ndarray
    """The vertices that they are at."""
    gripped: Tensor
    """Which of them are held by a gripper [bool], shape (M,)."""
    dt: float
    """Time between frames [s]."""
    beside: bool
    """Whether they may sit beside the rope's axis, so that its directors are needed."""

    def frame(self, state: scenes.State) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions and material directors at the markers, shape (N, M, 3) each."""
        at, rods = list(self.vertex), state.rods
        pos = tree.take_vertices(rods.pos, at)
        if not self.beside:
            return pos, pos, pos
        edge = [min(v, rods.pos.shape[-2] - 2) for v in at]
        ends = [v + 1 for v in edge]
        tangent = normalize(rods.pos[:, ends] - rods.pos[:, edge])
        first = rotation.about(tangent, rods.twist[:, edge], rods.director[:, edge])
        return pos, first, torch.linalg.cross(tangent, first)

    def seen(
        self, scene: scenes.Scene, params: scenes.Params, frames: Sequence[tuple[Tensor, Tensor, Tensor]], late: bool
    ) -> Tensor:
        """Return where markers are seen, shape (N, F, M, 3).

        Args:
            scene: whose effects of measurement act.
            params: their numbers.
            frames: of `frame`, evenly in time.
            late: whether markers are seen late, too, or at once.
        """
        time = torch.arange(len(frames), dtype=torch.float64) * self.dt
        pos = torch.stack([f[0] for f in frames], 1)
        first, second = (torch.stack([f[i] for f in frames], 1) if self.beside else pos for i in (1, 2))
        track = Track(time, pos, first, second, self.gripped)
        for each in sorted(scene.effects, key=lambda e: e.last):
            if late or not each.last:
                track = tree.replace(track, pos=each.observe(track, params.effects.get(each.name, {})))
        return track.pos
