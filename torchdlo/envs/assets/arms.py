"""The arms of a task: where they stand and what they hold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torchdlo.errors import InputError

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
    grip_force: float = math.inf
    """Force of each finger [N]. A hand loses the rope where holding it along its fingers takes more than friction of
    both can exert, 2 mu times this; infinite: never."""
    mu: float = 0.5
    """Coefficient of friction between fingers and rope [1]."""

    def __post_init__(self) -> None:
        if not self.base or not _rows(self.base, 3):
            raise InputError(
                f"arms: base is {self.base!r}; expected a place (x, y, z) [m] for each arm, such as "
                "base=((0.0, -0.5, 0.0),) for one."
            )
        slots = isinstance(self.vertex, tuple) and all(isinstance(v, int) and v >= 0 for v in self.vertex)
        if not slots or len(self.vertex) != self.count:
            raise InputError(
                f"arms: vertex is {self.vertex!r}; expected a tuple of {self.count} whole numbers from 0 on, one for "
                "each arm, such as vertex=(0,) for one."
            )
        if not _rows(self.quat, 4) or len(self.quat) not in (0, self.count):
            raise InputError(
                f"arms: quat is {self.quat!r}; expected an orientation (w, x, y, z) for each of {self.count} arms, or "
                "none: leave it out for tools that point straight down."
            )

    @property
    def count(self) -> int:
        """How many arms there are."""
        return len(self.base)

    @property
    def quats(self) -> tuple[tuple[float, float, float, float], ...]:
        """Orientations of all tools at the start."""
        return self.quat or (DOWN,) * self.count


def _rows(given: Any, size: int) -> bool:
    """Return whether something is a sequence of rows of so many numbers."""
    rows = isinstance(given, Sequence) and all(isinstance(row, Sequence) and len(row) == size for row in given)
    return rows and all(isinstance(x, int | float) and math.isfinite(x) for row in given for x in row)
