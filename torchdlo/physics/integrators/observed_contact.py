"""What contact came to within a step, for those who ask which partner exerted what."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from torch import Tensor

from torchdlo.physics.constraints import contact_penalty
from torchdlo.physics.effects.base import ContactForces

if TYPE_CHECKING:
    from torchdlo.physics.integrators.contact_step import Touching

__all__ = ["ObservedContact", "SolvedContact", "observe", "observing", "told"]


@dataclass(frozen=True)
class SolvedContact:
    """Contact that was solved together with edge lengths, from which forces of single points are found again."""

    touching: Touching
    firm: Tensor
    """Stiffness of points times `scale` [kg], shape (..., 1, V, 1)."""
    pos: Tensor
    """Positions at the end [m], shape (..., V, 3)."""
    bodies: Tensor
    """By how much contact and joints moved and turned free bodies [m, rad], shape (..., J, 6)."""

    def by_bodies(self) -> tuple[Tensor, Tensor]:
        """Return what bodies exert on ropes, at each point (..., F, V, 3) and on vertices (..., V, 3) [N]."""
        system, touch, dt = self.touching.system, self.touching.touch, self.touching.dt
        topology, linear = system.lengths.topology, contact_penalty.maps(touch)
        moved = self.pos - self.touching.origin
        felt = contact_penalty.feel(topology, touch, linear, self.firm, moved, self.bodies, dt)
        return felt.points / system.scale.unsqueeze(-3), felt.force / system.scale

    def by_ropes(self) -> Tensor:
        """Return what ropes exert on each other [N], shape (..., V, 3)."""
        return self.touching.feel_pairs(self.pos, self.firm)[0] / self.touching.system.scale + 0 * self.pos


@dataclass
class ObservedContact:
    """What is known of all substeps, one entry each."""

    pushes: list[dict[str, ContactForces]] = field(default_factory=list)
    """What effects found for themselves exerted, by their names."""
    solved: list[SolvedContact | None] = field(default_factory=list)
    """What was solved together with lengths, if anything was."""
    _last: SolvedContact | None = None

    def solve(self, found: SolvedContact) -> None:
        """Note a solution, which counts if it is the last one of its substep."""
        self._last = found

    def end(self, pushes: dict[str, ContactForces]) -> None:
        """Note what a substep came to."""
        self.pushes.append(pushes)
        self.solved.append(self._last)
        self._last = None


_observers: list[ObservedContact] = []


def observing() -> ObservedContact | None:
    """Return who asks, if anybody does. Recorded and compiled steps tell nothing."""
    return _observers[-1] if _observers else None


def told(pushes: dict[str, ContactForces], solved: str) -> None:
    """Tell who asks what a substep came to.

    Args:
        pushes: what was exerted, by the names of effects.
        solved: name of what was solved together with lengths, which is told by itself.
    """
    if (asked := observing()) is not None:
        asked.end({name: push for name, push in pushes.items() if name != solved})


@contextlib.contextmanager
def observe() -> Iterator[ObservedContact]:
    """Note what contact comes to in the steps that are taken within."""
    found = ObservedContact()
    _observers.append(found)
    try:
        yield found
    finally:
        _observers.remove(found)
