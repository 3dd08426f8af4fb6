"""What an effect is: a frozen class that declares its numbers once and turns a view of the rods into loads."""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor

from torchdlo.physics.rod import RodParams, View
from torchdlo.physics.topology import Topology

Values = dict[str, Tensor]
"""Numbers of one effect by name, each (..., 1, C): shared along the rod; or its history, or its loads."""

LOADS = {
    "force": "Force on vertices [N], shape (..., V, 3).",
    "acceleration": "Acceleration of all masses [m/s^2], shape (..., 1, 3).",
    "gradient": "Derivative of an energy by the edge vectors [N], shape (..., V, 3).",
    "torque": "Torque on edges about their axis [N m], shape (..., V, 1).",
    "rate": "Rate at which all velocities decay [1/s], shape (..., 1, 1).",
    "twist_decay": "Rate at which twist rates decay [1/s], shape (..., 1, 1).",
    "stiffness": "Stiffness of vertices along the axes, for implicit steps [N/m], shape (..., V, 3).",
    "drag": "Resistance of vertices along the axes, for implicit steps [N s/m], shape (..., V, 3).",
    "hinge_stiffness": "Bending moment per turning of an edge, for implicit steps [N m], shape (..., V, 1).",
    "hinge_drag": "The same per rate of turning, for implicit steps [N m s], shape (..., V, 1).",
    "edge_stiffness": "Transverse stiffness that a pulled edge has [N/m], for implicit steps, shape (..., V, 1).",
    "twist_hessian": "Second derivatives of an energy by the twists (before, before), (before, after), (after, after) "
    "of each hinge, without their part that may be negative [N m], shape (..., V, 3).",
    "twist_geometry": "That part of (before, before) and (after, after) [N m], shape (..., V, 2).",
}
"""What an effect may return. Those "for implicit steps" say how the loads answer to motion; they change the step, not
the equations that it solves, and explicit steps leave them out unless they are drags."""


@dataclass(frozen=True)
class Param:
    """One number of an effect, declared once for simulation, identification, randomisation and diagnosis."""

    default: float | tuple[float, ...]
    """Value in a scene that says nothing else."""
    low: float
    """Least sensible value."""
    high: float
    """Greatest sensible value."""
    unit: str
    """SI unit, "1" if it has none."""
    scale: Literal["log", "linear"]
    """How it is searched: by factors or by differences."""
    off: float | None
    """Value at which the effect does nothing, None if this number does not switch it."""
    doc: str
    """What it is, in one sentence."""

    @property
    def size(self) -> int:
        """How many components it has."""
        return len(self.default) if isinstance(self.default, tuple) else 1


class Effect(ABC):
    """A force law, a constitutive law, or a property of the rods. Subclasses are frozen dataclasses and final."""

    name: ClassVar[str]
    """Name in scenes, parameter trees and findings."""
    params: ClassVar[dict[str, Param]] = {}
    """Its numbers."""
    frames: ClassVar[bool] = False
    """Whether it reads the material frames or exerts torques about the edges' axes."""

    def alter(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Return the rods' parameters as this effect changes them: rest shape, stiffness, mass."""
        return params

    def loads(self, view: View, values: Values) -> Values:
        """Return loads by name, see `LOADS`."""
        return {}

    def flow(self, view: View, values: Values) -> Tensor | None:
        """Return the change of `RodState.plastic` over the substep, shape (..., V, 2), if the effect causes one."""
        return None


def total(effects: Iterable[Effect], view: View, params: dict[str, Values]) -> Values:
    """Return the sum of the loads of several effects."""
    loads: Values = {}
    for effect in effects:
        for name, load in effect.loads(view, params.get(effect.name, {})).items():
            loads[name] = loads[name] + load if name in loads else load
    return loads
