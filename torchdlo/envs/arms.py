"""The arms of a task: where they stand and what they hold."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["DOWN", "Arms"]

DOWN = (0.0, 1.0, 0.0, 0.0)
"""Orientation of a tool that points straight down, (w, x, y, z)."""


@dataclass(frozen=True)
class Arms:
    """The arms of a task, one entry each. They stand still; their tools start at one vertex each."""

    base: tuple[tuple[float, float, float], ...]
    """Where they stand [m]."""
    vertex: tuple[int, ...]
    """Where tools start and, in tasks without stages, what they hold: slots on the vertex axis of the scene."""
    quat: tuple[tuple[float, float, float, float], ...] = ()
    """Orientations of the tools at the start, straight down if not given."""
    squeeze: float = math.inf
    """Force of each finger [N]. A hand loses the rope where holding it along its fingers takes more than friction of
    both can exert, 2 mu times this; infinite: never."""
    mu: float = 0.5
    """Coefficient of friction between fingers and rope [1]."""

    @property
    def count(self) -> int:
        """How many arms there are."""
        return len(self.base)

    @property
    def quats(self) -> tuple[tuple[float, float, float, float], ...]:
        """Orientations of all tools at the start."""
        return self.quat or (DOWN,) * self.count
