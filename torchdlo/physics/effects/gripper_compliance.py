"""How a rope is held: clamps that give."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.rod.kinematics import RodParams, hinge_length
from torchdlo.physics.rod.topology import Topology


def _in_series(stiffness: Tensor, other: Tensor) -> Tensor:
    """Return (S^-1 + 1/k)^-1 of stiffnesses S, (..., V, 1, 2 or 3) as `Material.bend`, and springs k, (..., V, 1)."""
    if stiffness.shape[-1] < 3:
        return stiffness / (1 + stiffness / other)
    s11, s22, s12 = stiffness[..., :1], stiffness[..., 1:2], stiffness[..., 2:]
    # S (1 + S/k)^-1 by the cofactors of a symmetric 2 x 2 matrix.
    both = (s11 * s22 - s12.square()) / other
    divisor = 1 + (s11 + s22) / other + both / other
    return tree.cat_components(torch.broadcast_tensors(s11 + both, s22 + both, s12)) / divisor


CLAMP_STIFFNESS = Param(
    1e18, 1e-3, 1e18, "N m/rad", "reciprocal", 1e18, "Stiffness of a clamp; 1e18 stands for a rigid one."
)
"""The spring of a clamp, whatever else it does."""


@dataclass(frozen=True)
class Clamps(Effect):
    """Clamps that turn like a spring, whatever else they do: what such effects have in common."""

    hinges: tuple[int, ...] = ()
    """Slots of the vertices where clamps end."""

    last: ClassVar[bool] = True

    def check(self, topology: Topology) -> None:
        """Raise a `ValueError` if the clamps are not at hinges."""
        mask = topology.hinge_mask()
        wrong = [h for h in self.hinges if not 0 <= h < topology.size or not mask[h]]
        if wrong or not self.hinges:
            here = [i for i, real in enumerate(mask) if real]
            raise ValueError(
                f"{self.name}: hinges are {list(self.hinges)}; expected one or more of {here[0]} to {here[-1]} "
                "inside the ropes, where clamps end"
            )

    def here(self, topology: Topology, like: Tensor) -> Tensor:
        """Return 1 where clamps end and 0 elsewhere, shape (V, 1), of the dtype and device of a tensor."""
        return like.new_tensor([[float(slot in self.hinges)] for slot in range(topology.size)])

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Put the springs in series with bending and twisting where clamps end."""
        length, material = hinge_length(topology, params.rest), params.material
        here, spring = self.here(topology, length) > 0, values["stiffness"] * length
        bend = torch.where(here, _in_series(material.bend, spring), material.bend)
        twist = torch.where(here, _in_series(material.twist, spring), material.twist)
        return tree.replace(params, material=tree.replace(material, bend=bend, twist=twist))


@dataclass(frozen=True)
class GripperCompliance(Clamps):
    """Clamps that turn elastically: a spring in series with bending and twisting of the hinge at each of them.

    It softens the elastic hinge, 1/total = l/B + 1/stiffness; other moments of that hinge, such as friction, are taken
    to act on the rope behind the spring.
    """

    name: ClassVar[str] = "gripper_compliance"
    kind: ClassVar[EffectKind] = "boundary"
    equation: ClassVar[str] = "moment at a clamp = stiffness · turn of the rope in it"
    params: ClassVar[dict[str, Param]] = {"stiffness": CLAMP_STIFFNESS}
    spec = RopeEffectSpec(
        lambda s: [{"stiffness": 100 * s.bending_stiffness / s.rope.length}],
        strength=("stiffness",),
        experiments={
            "nonuniform_stiffness": "grip it at another place: compliance moves with the gripper",
            "time_delay": "hold the grippers still in two poses: a delay shows in motion only",
        },
        requires="clamps",
    )
