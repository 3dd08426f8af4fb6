"""Rods: their state and parameters, what acts on them, and how they step; see `torchdlo.scene` for its use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchdlo import lazy

if TYPE_CHECKING:
    from torchdlo.physics.effects.base import Effect, PredictedMotion
    from torchdlo.physics.execution.replay import rollout
    from torchdlo.physics.rod.assembly import Rope
    from torchdlo.physics.rod.kinematics import Material, RodParams, RodState, View
    from torchdlo.physics.rod.topology import Topology

# Modules here import each other through this package, so that it cannot import them first.
__getattr__, __dir__ = lazy.attach(
    __name__,
    {
        "Effect": "torchdlo.physics.effects.base",
        "Material": "torchdlo.physics.rod.kinematics",
        "PredictedMotion": "torchdlo.physics.effects.base",
        "RodParams": "torchdlo.physics.rod.kinematics",
        "RodState": "torchdlo.physics.rod.kinematics",
        "Rope": "torchdlo.physics.rod.assembly",
        "Topology": "torchdlo.physics.rod.topology",
        "View": "torchdlo.physics.rod.kinematics",
        "rollout": "torchdlo.physics.execution.replay",
    },
)

__all__ = ["Effect", "Material", "PredictedMotion", "RodParams", "RodState", "Rope", "Topology", "View", "rollout"]
