"""What is said once of scenes that can be made and may not be what was meant."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo import notices
from torchdlo.coupling.bodies.dynamics import BodyParams
from torchdlo.physics.effects.base import Values
from torchdlo.physics.integrators.rod_step import Settings

RESOLVED = 1e-3
"""Substep from which on contact that is solved together with lengths keeps restitution [s]."""


def rebounds(bodies: BodyParams | tuple[()], numbers: dict[str, Values]) -> bool:
    """Return whether something rebounds: a body, or ropes from each other.

    Args:
        bodies: numbers of the bodies, () if there are none.
        numbers: those of effects, by effect and name.
    """
    among = numbers.get("rod_contact", {}).get("restitution")
    return any(x is not None and bool((x > 0).any()) for x in (bodies.restitution if bodies else None, among))


def mention(settings: Settings, bodies: bool, joined: bool, bounces: bool, pos: Tensor) -> None:
    """Say what goes through each other because no effect keeps it apart, and whose contact is found badly.

    Args:
        settings: ropes, effects and steps of the scene.
        bodies: whether it has bodies.
        joined: whether ropes are joined to them, or to each other.
        bounces: whether there is restitution.
        pos: vertices at the start (..., n, 3) [m]; the first scene is looked at.
    """
    names, topology = {e.name for e in settings.effects}, settings.topology
    if joined:
        mention_sweeps(settings, bodies)
    if bounces and settings.coupled and settings.dt < RESOLVED:
        notices.once(
            "restitution",
            "scene: contact that is solved together with edge lengths brakes what comes near, within some substeps if "
            f"these are as short as {1e3 * settings.dt:.2g} ms: ropes rebound with less than their restitution. Give "
            "contact='sweeps', or substeps of 1 ms or more.",
        )
    if bodies and not names & {"rod_body", "finger_pads"}:
        notices.once("rod_body", "scene: ropes go through its bodies; add RodBody if they are to touch.")
    if "rod_contact" in names or len(topology.counts) < 2:
        return
    first = pos.detach().reshape(-1, *pos.shape[-2:])[0]
    ropes = [first[start : start + count] for start, count in zip(topology.starts, topology.counts, strict=True)]
    low, high = torch.stack([x.amin(0) for x in ropes]), torch.stack([x.amax(0) for x in ropes])
    length = torch.stack([(x[1:] - x[:-1]).norm(dim=-1).sum() for x in ropes])
    apart = torch.maximum(low[:, None] - high, low - high[:, None]).clamp(min=0.0).norm(dim=-1)
    near = (apart < 0.5 * torch.minimum(length[:, None], length)).triu(1)
    if bool(near.any()):
        one, other = near.nonzero()[0].tolist()
        notices.once(
            "rod_contact",
            f"scene: ropes {one} and {other} go through each other; add RodContact if they are to touch.",
        )


def mention_sweeps(settings: Settings, bodies: bool) -> None:
    """Say that ropes that carry something among bodies are not best found by sweeps, if they are."""
    names = {e.name for e in settings.effects}
    if bodies and settings.integrator == "explicit" and settings.constrained and not settings.coupled:
        if any(e.engages for e in settings.effects) and "rod_mpm_coupling" not in names:
            notices.once(
                "sweeps",
                "scene: a rope carries something among bodies; where it hangs over one, its tension rings in explicit "
                "steps that find contact by sweeps, and friction is wrong. Give contact='coupled' in double "
                "precision (or integrator='implicit').",
            )
