"""Coupling of ropes with each other, rigid bodies, grippers and particles."""

from __future__ import annotations

from torchdlo.coupling.body_contact import BodyContact
from torchdlo.coupling.body_matter import BodyMatter
from torchdlo.coupling.contact import RodContact
from torchdlo.coupling.pads import FingerPads
from torchdlo.coupling.rod_body import RodBody
from torchdlo.coupling.rod_matter import RodMatter
from torchdlo.physics.effect import Effect

EFFECTS: dict[str, type[Effect]] = {
    "rod_contact": RodContact,
    "rod_body": RodBody,
    "body_contact": BodyContact,
    "finger_pads": FingerPads,
}

__all__ = ["EFFECTS", "BodyContact", "BodyMatter", "FingerPads", "RodBody", "RodContact", "RodMatter"]
