"""Coupling of ropes with each other, rigid bodies, grippers and particles."""

from __future__ import annotations

from torchdlo.coupling.bodies.contact_effect import BodyContact
from torchdlo.coupling.mpm.body_coupling_effect import BodyMpmCoupling
from torchdlo.coupling.mpm.rod_coupling_effect import RodMpmCoupling
from torchdlo.coupling.rod_body.finger_pads import FingerPads
from torchdlo.coupling.rod_body.rod_body_effect import RodBody
from torchdlo.coupling.rod_contact.rod_contact_effect import RodContact
from torchdlo.coupling.rod_contact.self_contact import SelfContact
from torchdlo.physics.effects.base import Effect

EFFECTS: dict[str, type[Effect]] = {
    "rod_contact": RodContact,
    "self_contact": SelfContact,
    "rod_body": RodBody,
    "body_contact": BodyContact,
    "finger_pads": FingerPads,
}

__all__ = [
    "EFFECTS",
    "BodyContact",
    "BodyMpmCoupling",
    "FingerPads",
    "RodBody",
    "RodContact",
    "RodMpmCoupling",
    "SelfContact",
]
