"""Coupling of ropes with each other, rigid bodies, grippers and particles."""

from __future__ import annotations

from torchdlo.coupling.contact import RodContact
from torchdlo.physics.effect import Effect

EFFECTS: dict[str, type[Effect]] = {"rod_contact": RodContact}

__all__ = ["EFFECTS", "RodContact"]
