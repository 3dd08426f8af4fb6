"""What is said once of scenes that can be made and may not be what was meant."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdlo import notices
from torchdlo.physics.integrators.rod_step import Settings


def mention(settings: Settings, bodies: bool, joined: bool, pos: Tensor) -> None:
    """Say what goes through each other because no effect keeps it apart, and whose contact is found badly.

    Args:
        settings: ropes, effects and steps of the scene.
        bodies: whether it has bodies.
        joined: whether ropes are joined to them, or to each other.
        pos: vertices at the start (..., n, 3) [m]; the first scene is looked at.
    """
    names, topology = {e.name for e in settings.effects}, settings.topology
    if joined:
        mention_sweeps(settings, bodies)
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
