"""Contact of a rope with itself as an effect that a recording may lack: off, or on at some thickness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.rod_contact.rod_contact_effect import RodContact
from torchdlo.physics import tree
from torchdlo.physics.constraints.contact_penalty import Pairs
from torchdlo.physics.effects.base import Effect, EffectKind, Param, PredictedMotion, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.rod.kinematics import View

__all__ = ["SelfContact"]

_THICKEST = 2.0
"""Most of the rope's radius at which it may meet itself."""

_PAIRS = RodContact()
"""Which parts touch, and what they exert."""


@dataclass(frozen=True)
class SelfContact(Effect):
    """A rope does not pass through itself: `RodContact` at a share of its radius, nothing at all at a share of 0.

    Parts that are nearer to each other along the rope than 2 pi radii never meet.
    """

    name: ClassVar[str] = "self_contact"
    kind: ClassVar[EffectKind] = "force"
    equation: ClassVar[str] = "parts of the rope stay 2 share r apart, and rub with mu N, mu = 0.3"
    is_contact: ClassVar[bool] = True
    engages: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "share": Param(0.0, 0.0, _THICKEST, "1", "linear", 0.0, "Thickness at which it meets itself, over its own."),
        "mu": Param(0.3, 0.0, 2.0, "1", "linear", None, "Coefficient of friction of the rope with itself."),
    }
    spec = RopeEffectSpec(
        lambda _: [{"share": 0.5}, {"share": 1.0}],
        strength=("share",),
        fixed=("mu",),
        confusable=("internal_friction", "bending_plasticity"),
        experiments={
            "internal_friction": "repeat the motion without bringing the rope near itself: the difference goes away",
            "bending_plasticity": "repeat the motion without bringing the rope near itself: the difference goes away",
        },
        requires="near_itself",
    )

    def broad_phase(self, view: View, carried: Tensor) -> Values:
        """Return the pairs that can touch within the step, see `RodContact.broad_phase`."""
        return _PAIRS.broad_phase(_thick(view, _THICKEST), carried)

    def capacity_overflow(self, pos: Tensor, values: Values) -> Tensor:
        """Return what the broad phase had no room for, see `RodContact.capacity_overflow`."""
        return _PAIRS.capacity_overflow(pos, values)

    def engage(self, view: View, motion: PredictedMotion, values: Values) -> Pairs:
        """Return the pairs of edges that may touch in an implicit substep."""
        return _PAIRS.engage(_thick(view, values["share"]), motion, _numbers(values))

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> Tensor:
        """Return the forces on vertices [N], shape (..., V, 3)."""
        return _PAIRS.solve_contact(_thick(view, values["share"]), motion, _numbers(values))


def _thick(view: View, share: Tensor | float) -> View:
    """Return the rods as thick as a share of their radius."""
    material = tree.replace(view.params.material, radius=share * view.params.material.radius)
    return tree.replace(view, params=tree.replace(view.params, material=material))


def _numbers(values: Values) -> Values:
    """Return the numbers of `RodContact`; where the rope has no thickness for itself, no pair is one."""
    on = (values["share"] > 0).to(values["real"])
    like = torch.zeros_like(values["mu"])
    return values | {"real": values["real"] * on, "mu_s": values["mu"], "mu_k": values["mu"], "restitution": like}
