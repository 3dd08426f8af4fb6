"""A rope with known numbers that takes the place of a task's own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from torchdlo.errors import InputError
from torchdlo.field_docs import with_field_docs
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.effects.base import Effect
from torchdlo.scene import Rope

__all__ = ["RopeMaterial"]


@with_field_docs
@dataclass(frozen=True)
class RopeMaterial:
    """What a rope is made of, whatever its length: the ropes of a task become pieces of it, as thick as before.

    `torchdlo.scene_files.cable` reads one from the model file of a calibration or a diagnosis.
    """

    line_density: float
    """Mass per length [kg/m]."""
    bend: float
    """Bending stiffness [N m^2]."""
    damping: float
    """Rate at which velocities decay [1/s]."""
    effects: tuple[tuple[str, tuple[tuple[str, tuple[float, ...]], ...]], ...] = ()
    """What else acts on it: names of `physics.effects.EFFECTS`, each with its numbers by name."""
    curvature: tuple[tuple[float, float], ...] = ()
    """Natural curvature about the two material directors [1/m], at even distances from end to end; () if straight."""

    @property
    def laws(self) -> list[Effect]:
        """The effects."""
        return [EFFECTS[name]() for name, _ in self.effects]

    @property
    def values(self) -> dict[str, dict[str, list[float]]]:
        """Their numbers, and the damping."""
        return {"damping": {"rate": [self.damping]}} | {
            name: {key: list(value) for key, value in numbers} for name, numbers in self.effects
        }

    def pieces(self, ropes: Sequence[Rope]) -> list[Rope]:
        """Return ropes of the same shapes, made of this one.

        Raises:
            InputError: It cannot be so short, or closed.
        """
        return [self._piece(rope) for rope in ropes]

    def _piece(self, rope: Rope) -> Rope:
        x = rope.positions
        length = float((x[..., 1:, :] - x[..., :-1, :]).norm(dim=-1).sum(-1).amax())
        place = dict(dict(self.effects).get("point_mass", ())).get("position", (0.0,))[0]
        if place > length:
            raise InputError(
                f"rope: its point mass sits at {place:.3g} m; expected a rope of at least that length, but this task's "
                f"has {length:.3g} m. Take the effect out of the model, or choose another task."
            )
        if self.curvature and rope.closed:
            raise InputError("rope: it has a natural shape with two ends; expected a task without closed ropes.")
        made = dataclasses.replace(
            rope,
            mass=None,
            density=self.line_density / (math.pi * float(rope.radius) ** 2),
            youngs=None,
            bend=self.bend,
            bend2=None,
        )
        if not self.curvature:
            return made
        known = torch.tensor(self.curvature, dtype=x.dtype, device=x.device)
        at = torch.linspace(0, len(known) - 1, x.shape[-2], dtype=x.dtype, device=x.device)
        before = at.floor().long().clamp(max=len(known) - 2)
        share = (at - before).unsqueeze(-1)
        return dataclasses.replace(made, rest_curvature=(1 - share) * known[before] + share * known[before + 1])
