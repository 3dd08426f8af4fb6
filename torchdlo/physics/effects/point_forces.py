"""Forces on single vertices: loads whose direction and size do not depend on the motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.rod.kinematics import View
from torchdlo.physics.rod.topology import Topology


@dataclass(frozen=True)
class PointForce:
    """A force on a vertex that does not change, from a time on until another."""

    vertex: int
    """The vertex, by its slot in the scene."""
    force: tuple[float, float, float]
    """Force [N]."""
    since: float = 0.0
    """When it begins [s]."""
    until: float = math.inf
    """When it ends [s]."""


@dataclass(frozen=True)
class PointForces(Effect):
    """Forces on vertices, of which each substep has the share of its time in which they act.

    Bounds of explicit steps do not know of them: a rope without stretch that they overload is reported when it is.
    """

    name: ClassVar[str] = "point_forces"
    kind: ClassVar[EffectKind] = "force"
    memory: ClassVar[int] = 1
    params: ClassVar[dict[str, Param]] = {"scale": Param(1.0, -10.0, 10.0, "1", "linear", 0.0, "Factor of all forces.")}

    forces: tuple[PointForce, ...] = ()
    """The forces; those on one vertex add up."""

    def check(self, topology: Topology) -> None:
        """Raise a `ValueError` if a force acts on no vertex, is no number, or ends before it begins."""
        for each in self.forces:
            if not 0 <= each.vertex < topology.size:
                raise ValueError(
                    f"point_forces: a force acts on vertex {each.vertex}; the scene has 0 to {topology.size - 1}"
                )
            if len(each.force) != 3 or not all(map(math.isfinite, each.force)):
                raise ValueError(f"point_forces: a force is {each.force}; expected three finite numbers [N]")
            if not each.until >= each.since:
                raise ValueError(f"point_forces: a force ends at {each.until:g} s, before it begins, {each.since:g} s")

    def loads(self, view: View, values: Values) -> Values:
        """Return the forces that act in the substep."""
        windows: dict[tuple[float, float], list[list[float]]] = {}
        for each in self.forces:
            rows = windows.setdefault((each.since, each.until), [[0.0] * 3 for _ in range(view.topology.size)])
            rows[each.vertex] = [a + b for a, b in zip(rows[each.vertex], each.force, strict=True)]
        time = view.state.memory[self.name]

        def past(moment: float) -> Tensor:
            # A substep gives velocities what acts from half a substep before its beginning to half a one after it.
            return ((time - moment) / view.dt + 0.5).clamp(0.0, 1.0)

        total = torch.zeros_like(view.state.pos)
        for (since, until), rows in windows.items():
            force = total.new_tensor(rows)
            # The first substep begins at the start, and is halved for all loads.
            force = force * past(since) if since > 0 else force
            total = total + (force * (1 - past(until)) if until < math.inf else force)
        return {"force": values["scale"] * total}

    def update_memory(self, view: View, values: Values) -> Tensor:
        """Return the time since the start [s]."""
        return view.state.memory[self.name] + view.dt
