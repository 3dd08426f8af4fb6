"""What effects look up once per step and read in its substeps, and what they may have missed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import rod, tree
from torchdlo.physics.effect import Effect, Values, altered


def survey(scene: Any, params: Any, state: Any, start: Any, control: Any) -> Any:
    """Return the parameters with what effects look up once per step among their numbers: which edges can touch.

    Args:
        scene: static choices, see `scene.Scene`.
        params: the rods' parameters before effects alter them, and the effects' numbers.
        state: the scene when the step begins.
        start: where held parts are then.
        control: where held parts are at the end of the step.
    """
    with torch.no_grad():
        carried = (control.pos - start.pos) * control.grip.get("vertices", 1.0)
        leaves = tree.leaves((params, state.rods, carried))
        batch = torch.broadcast_shapes(*(x.shape[:-2] for x in leaves))
        pos, vel = (x.expand(*batch, *x.shape[-2:]) for x in (state.rods.pos, state.rods.vel))
        there = tree.replace(state.rods, pos=pos, vel=vel)
        changed = altered(scene.effects, scene.topology, params.rods, params.effects)
        view = rod.view(scene.topology, changed, there, scene.dt)
        carried = carried.expand(*batch, -1, -1)
        found = {e.name: e.survey(view, carried) for e in scene.effects if e.reacts}
    return tree.replace(params, effects=params.effects | {n: params.effects[n] | given for n, given in found.items()})


def missed(effects: Iterable[Effect], pos: Tensor, values: dict[str, Values], before: Tensor) -> Tensor:
    """Return what was missed so far, shape (..., 1, 2).

    Args:
        effects: what acts on the rods.
        pos: vertex positions after a substep [m], shape (..., V, 3).
        values: the effects' numbers with what they looked up.
        before: what was missed before.
    """
    for e in effects:
        if e.reacts:
            before = torch.maximum(before, e.shortfall(pos, values[e.name]))
    return before


def explain(missed: Tensor) -> str:
    """Return what went wrong and how to mend it, "" if nothing did."""
    room, beyond = (float(x) for x in missed.reshape(-1, 2).amax(0))
    if room > 0:
        return (
            f"contact had no room for {room:.0f} pairs of edges, edges or nodes; give a larger `room` to RodContact, "
            "RodMatter or BodyMatter, whichever has one"
        )
    if beyond > 0:
        return (
            f"vertices went {1e3 * beyond:.2g} mm further within a step than contact looked; give RodContact a larger "
            "`burst`, or shorten dt"
        )
    return ""
