"""What effects look up once per step and read in its substeps, and what they may have missed."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import altered_params
from torchdlo.physics.integrators.rod_step import yield_shares
from torchdlo.physics.linalg.numerics import safe_norm, tiny
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.kinematics import RodState
from torchdlo.physics.rod.topology import following

STRAIN = 0.05
"""By what share of its length an edge may be too short or too long before it counts; lengths are kept to 1e-5 and
better."""
YIELDING = 0.02
"""By what share of its length an edge may give way because its tension is more than its steps can hold, likewise; hits
of taut ropes leave less."""
UNSOLVED = 0.02
"""What share of the forces a step with coupled contact may leave unbalanced before it counts."""
WIDTH = 5
"""How many numbers tell what was missed: see `diagnostics`."""


def broad_phase(scene: Any, params: Any, state: Any, start: Any, control: Any) -> Any:
    """Return the parameters with what effects look up once per step among their numbers: which edges can touch.

    Args:
        scene: static choices, see `scene.Scene`.
        params: the rods' parameters before effects alter them, and the effects' numbers.
        state: the scene when the step begins.
        start: where held parts are then.
        control: where held parts are at the end of the step.
    """
    with torch.no_grad():
        carried = (control.pos - start.pos) * control.attachment_weight.get("vertices", 1.0)
        leaves = tree.leaves((params, state.rods, carried))
        batch = torch.broadcast_shapes(*(x.shape[:-2] for x in leaves))
        pos, vel = (x.expand(*batch, *x.shape[-2:]) for x in (state.rods.pos, state.rods.vel))
        there = tree.replace(state.rods, pos=pos, vel=vel)
        changed = altered_params(scene.effects, scene.topology, params.rods, params.effects)
        view = rod.view(scene.topology, changed, there, scene.dt)
        carried = carried.expand(*batch, -1, -1)
        found = {e.name: e.broad_phase(view, carried) for e in scene.effects if e.is_contact}
    return tree.replace(params, effects=params.effects | {n: params.effects[n] | given for n, given in found.items()})


def missed(scene: Any, params: Any, rods: RodState, before: Tensor, unsolved: Any = ()) -> Tensor:
    """Return what was missed so far: room, reach, what is too short and too long, unsolved steps, shape (..., 1, 5).

    Args:
        scene: static choices, see `scene.Scene`.
        params: the rods' parameters before effects alter them, and the effects' numbers with what they looked up.
        rods: the rods after a substep.
        before: what was missed before.
        unsolved: share of the forces that the substep left unbalanced, (..., 1, 1); () if it was not looked at.
    """
    contact, strained, left = before.split((2, 2, 1), -1)
    for e in scene.effects:
        if e.is_contact:
            contact = torch.maximum(contact, e.capacity_overflow(rods.pos, params.effects[e.name]))
    if scene.constrained:
        strained = torch.maximum(strained, _strained(scene, params, rods))
    if isinstance(unsolved, Tensor):
        left = torch.maximum(left, torch.where(unsolved > UNSOLVED, unsolved, 0.0).detach())
    # A state may have been given a batch in some of its parts only.
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in (contact, strained, left)))
    return torch.cat([x.expand(*batch, *x.shape[-2:]) for x in (contact, strained, left)], -1)


@torch.no_grad()
def _strained(scene: Any, params: Any, rods: RodState) -> Tensor:
    """Return by what share an edge is too short and too long, (..., 1, 2).

    That is 0 where it is by less than `STRAIN`, or `YIELDING` where its tension stands at what its steps can hold.
    """
    held, after = set(scene.prescribed_vertices), scene.topology.successor()
    # Hands that hold both ends of an edge set its length.
    solved = [m * (not {k, after[k]} <= held) for k, m in enumerate(scene.topology.edge_mask())]
    changed = altered_params(scene.effects, scene.topology, params.rods, params.effects)
    edge = rod.edge_vectors(scene.topology, rods.pos, changed.rest.edge_mask)
    wanted = changed.rest.length * (1 + rods.tension / changed.material.stretch)
    long = (safe_norm(edge) / wanted.clamp(min=tiny(wanted)) - 1) * wanted.new_tensor(solved).unsqueeze(-1)
    mass, settings = changed.material.mass, scene.settings
    cap = yield_shares(settings.coupled)[0] * changed.rest.length * torch.minimum(mass, following(scene.topology, mass))
    # No flags are put together with flags: compilers of graphs make code of that which does not compile.
    gives = ((rods.tension * settings.dt**2 >= cap) & (long > YIELDING)).to(long).amax(-2, keepdim=True)
    short, longest = (-long).amax(-2, keepdim=True), long.amax(-2, keepdim=True)
    told = (longest > STRAIN) | (gives > 0)
    return torch.cat([torch.where(short > STRAIN, short, 0.0), torch.where(told, longest, 0.0)], -1)


def explain_diagnostics(missed: Tensor) -> str:
    """Return what went wrong and how to mend it, "" if nothing did."""
    room, beyond, short, *others = (float(x) for x in missed.reshape(-1, missed.shape[-1]).amax(0))
    if room > 0:
        return (
            f"contact had no room for {room:.0f} pairs of edges, edges or nodes; give a larger `room` to RodContact, "
            "RodMpmCoupling or BodyMpmCoupling, whichever the scene has; SelfContact has a fixed one: take RodContact"
        )
    if beyond > 0:
        return (
            f"vertices went {1e3 * beyond:.2g} mm further within a step than contact looked; give RodContact a larger "
            "`burst`, or shorten dt"
        )
    if short > 0:
        return (
            f"an edge became {short:.0%} shorter than it has to be: a straight rope was pressed along its line, or "
            "jerked; lay it in a slight bend, move what holds it more slowly, or give it a finite `stretch`"
        )
    if others and others[0] > 0:
        share = f"{others[0]:.0%}" if others[0] > STRAIN else f"{others[0]:.1%}"
        return (
            f"an edge became {share} longer than it has to be: a rope was pulled beyond its length, moved too "
            "far within a step, or carries more than its steps can hold; move what holds it more slowly, take shorter "
            "substeps or integrator='implicit', or give it a finite `stretch`"
        )
    if others[1:] and others[1] > 0:
        left = f"{others[1]:.0%} of its forces unbalanced"
        # Single precision leaves rounding of positions, over the square of a substep.
        cure = "shorten dt" if missed.dtype == torch.float64 else "take substeps of a millisecond, or double precision"
        return f"a step with contact left {left}; {cure}, or take explicit steps with contact by sweeps"
    return ""
