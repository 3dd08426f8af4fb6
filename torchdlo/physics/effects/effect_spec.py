"""What a diagnosis needs to know of an effect to find it in a recording of a rope, declared beside the effect."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

__all__ = ["RecordedRope", "RopeEffectSpec", "RopeScales"]


class RecordedRope(Protocol):
    """What a recording says of its rope."""

    @property
    def length(self) -> float:
        """Length of the rope [m]."""

    @property
    def radius(self) -> float | None:
        """Radius of the rope [m], None where not known."""

    @property
    def mass(self) -> float:
        """Mass of the rope [kg]."""

    @property
    def gravity(self) -> Iterable[float]:
        """Acceleration of gravity in the world frame [m/s^2], three components."""

    @property
    def table_height(self) -> float | None:
        """Height of the table [m], None where there is none."""

    @property
    def fluid_density(self) -> float | None:
        """Density of the liquid around the rope [kg/m^3], None in air."""


@dataclass(frozen=True)
class RopeScales:
    """How large things are in a recording, so that a perturbation can be small there."""

    rope: RecordedRope
    """The rope."""
    bending_stiffness: float
    """That of the calibrated baseline [N m^2]."""
    curvature: float
    """A large curvature of the recording [1/m]."""
    weight: float
    """Weight of the rope [N]."""
    inside: tuple[float, ...]
    """Places along the rope, as shares of its length."""
    loose: tuple[float, ...]
    """The same, with the end if nothing holds it."""


def _nothing(_: RecordedRope) -> dict[str, Any]:
    return {}


@dataclass(frozen=True, eq=False)
class RopeEffectSpec:
    """How an effect is looked for. Its numbers with their units and bounds are the effect's `params`."""

    perturbations: Callable[[RopeScales], Sequence[Mapping[str, float]]]
    """Small doses that together show what it can do: numbers that differ from their off values, with `.k` for a
    component. Doses of one number each are mixed, others exclude each other."""
    signed: bool = False
    """Whether the opposite doses are possible too."""
    strength: tuple[str, ...] = ()
    """Numbers that grow with the dose, the first says how large the effect is; empty where none does so evenly."""
    power: float = 1.0
    """Power of the first of them with which the gap grows that a lack of the effect leaves."""
    places: tuple[str, ...] = ()
    """Numbers that say where along the rope it acts."""
    fixed: tuple[str, ...] = ()
    """Numbers that are not fitted: what the recording says, or what motion hardly shows."""
    known: Callable[[RecordedRope], Mapping[str, Any]] = _nothing
    """Those of them that the recording gives."""
    limits: Callable[[RecordedRope], Mapping[str, tuple[float, float]]] = _nothing
    """Default and greatest value of numbers that depend on the rope."""
    confusable: tuple[str, ...] = ()
    """Effects that do alike things, so that small doses are hard to tell apart. Naming it on one side is enough."""
    experiments: Mapping[str, str] = field(default_factory=dict)
    """By effect: what would tell the two apart. Naming it on one side is enough."""
    special_case: tuple[str, Mapping[str, float]] | None = None
    """An effect with fewer numbers that this one contains, and the values of those that it lacks."""
    requires: Literal["table", "clamps", "fluid", "air", "rest", "near_itself"] | None = None
    """What a recording must have for it to act, or be: of a rope in air, at rest, or of one that comes near itself. One
    that requires clamps has a field `hinges` for where they end."""
