"""Whether rods can be stepped: laws that fit them, and the longest stable substep."""

from __future__ import annotations

import torch

from torchdlo import notices
from torchdlo.physics.effects.base import Values, altered_params
from torchdlo.physics.integrators.carried_mass import Load, carried_mass
from torchdlo.physics.integrators.rod_step import Settings, yield_shares
from torchdlo.physics.rod import kinematics as rod
from torchdlo.physics.rod.kinematics import RodParams, RodState
from torchdlo.physics.rod.topology import following

NO_LOAD = Load()
"""Nothing joined to ropes."""


def check_laws(settings: Settings, rods: RodParams, values: dict[str, Values], state: RodState) -> None:
    """Raise a `ValueError` where the rods have what no effect of the scene acts on."""
    for e in settings.effects:
        e.check(settings.topology)
    rest, material = rods.rest, altered_params(settings.effects, settings.topology, rods, values).material
    kinds = {type(e).__name__ for e in settings.effects}
    if "Bend" in kinds:
        if rods.material.bend.shape[-1] == 2:
            raise ValueError("scene: a rope has bend2, which Bend leaves out; use BendFrame")
        if bool((rest.curvature != 0).any()):
            raise ValueError(
                "scene: a rope is curved at rest, which Bend leaves out; use BendFrame, or rest='straight'"
            )
        frames = sorted(type(e).__name__ for e in settings.effects if e.frame_bending)
        if frames:
            raise ValueError(
                f"scene: {frames[0]} changes the natural curvature or the stiffness by direction, which Bend leaves "
                "out; use BendFrame"
            )
    stiff = bool((material.bend.detach() != 0).any())
    if "Bend" in kinds and not stiff:
        notices.once("bend", "scene: Bend acts, but no rope has a stiffness: give Rope bend [N m^2] or youngs [Pa].")
    if stiff and "bend" not in {e.name for e in settings.effects}:
        notices.once("stiffness", "scene: a rope has a bending stiffness, but nothing bends: add Bend or BendFrame.")
    if not settings.constrained and "Stretch" not in kinds and bool(torch.isfinite(material.stretch).any()):
        raise ValueError("scene: stretch is given, but lengths are not constrained and no Stretch effect acts; add it")
    if "Stretch" in kinds and not bool(torch.isfinite(material.stretch).all()):
        raise ValueError(
            "scene: stretch is infinite, which no force can be; give EA [N], or keep constrained=True without Stretch"
        )
    if {"table", "gravity"} <= {e.name for e in settings.effects}:
        sunk = values["gravity"]["acceleration"].norm(dim=-1, keepdim=True) / values["table"]["hardness"].square()
        share = float((sunk / material.radius).detach().max())
        if share > 0.1:
            notices.once(
                "table hardness",
                f"scene: ropes rest {float(sunk.detach().max()):.2g} m deep in the table, {share:.0%} of their radius: "
                "g over its hardness squared; give Table a larger hardness, or RodBody with a plane in its place.",
            )
    if settings.constrained:
        length = rod.edge_vectors(settings.topology, state.pos.detach(), rest.edge_mask).norm(dim=-1, keepdim=True)
        strain = ((length / rest.length.detach() - 1) * rest.edge_mask).abs().max()
        if float(strain) > 0.1:
            raise ValueError(
                f"scene: a rope is placed with edges {float(strain):.0%} off their length in its rest shape; place it "
                "at its length, or use constrained=False with a Stretch effect"
            )


def _hanging(settings: Settings, rods: RodParams, values: dict[str, Values], load: Load) -> dict[str, float]:
    """Return the substep [s] up to which ropes keep their length that hang from holds, if any does."""
    gravity, topology = "gravity" in {e.name for e in settings.effects}, settings.topology
    if not (settings.constrained and settings.prescribed_vertices and gravity):
        return {}
    # Tensions above a share of l m / dt^2 are not held: edges give way, see `edge_lengths.Lengths.yielding`. As there,
    # m is the lighter end's, also if that is held.
    rest, material = rods.rest, rods.material
    lightest = torch.minimum(material.mass, following(topology, material.mass))
    carried = carried_mass(topology, settings.prescribed_vertices, material.mass, load)
    pull = values["gravity"]["acceleration"].norm(dim=-1, keepdim=True) * carried
    firm = (yield_shares(settings.coupled)[0] * rest.length * lightest / pull).sqrt()
    solved = pull.new_tensor([[k not in settings.joint_edges] for k in range(topology.size)], dtype=torch.bool)
    counts = (rest.edge_mask > 0) & (pull > 0) & solved
    return {"hanging weight": float(torch.where(counts, firm, torch.inf).amin())}


def limits(settings: Settings, rods: RodParams, values: dict[str, Values], load: Load = NO_LOAD) -> dict[str, float]:
    """Return the largest stable substep [s] by the term that limits it.

    Bending waves reach w = 4/l^2 sqrt(EI/m'), stretching waves w = 2/l sqrt(EA/m'), twist waves w = 2 sqrt(GJ/(l I));
    Stoermer-Verlet is stable for w dt < 2. Bending damping takes its force from the velocities before, and damps the
    shortest waves by r = 16 c/(m' l^4): both together are stable for (w dt)^2/4 + r dt/2 < 1. The weight of a rope that
    is held, and of the `load` that is joined to it, may pull as much as steps keep its length: T < l m / 4 dt^2.
    Implicit steps are limited by the last one only, with 10^4 in the place of 1/4.
    """
    rods = altered_params(settings.effects, settings.topology, rods, values)
    if settings.integrator == "implicit":
        return _hanging(settings, rods, values, load)
    rest, material = rods.rest, rods.material
    names = {e.name for e in settings.effects}
    real = (rest.edge_mask > 0).expand_as(rest.length)
    length = torch.where(real, rest.length, torch.inf)
    inner = (rest.hinge_mask > 0).expand_as(rest.length)
    mass = torch.where(inner, material.mass, torch.inf)
    found = {}
    if "bend" in names:
        bend = material.bend[..., :2].amax(-1, keepdim=True) + material.bend[..., 2:].abs().sum(-1, keepdim=True)
        if "internal_friction" in names:  # up to twice its first stiffness where bending turns back
            friction = values["internal_friction"]
            bend = bend + 2 * friction["moment"] / friction["kappa_c"]
        heavy = mass * length.square().clamp(max=1e6) * length
        found["bending"] = 0.5 * (heavy / bend).amin().sqrt()
        if "bending_damping" in names:
            wave, rate = 4 * bend / heavy, 8 * values["bending_damping"]["coefficient"] / heavy
            found["bending damping"] = (2 / (rate + (rate.square() + 4 * wave).sqrt())).amin()
    if "stretch_force" in names and not settings.constrained:
        found["stretching"] = (mass * length / material.stretch).amin().sqrt()
    if "twist" in names and settings.twist == "dynamic":
        found["twisting"] = (torch.where(real, material.inertia, torch.inf) * length / material.twist).amin().sqrt()
    if "table" in names:
        found["table contact"] = 2 / values["table"]["hardness"].max()
    return {name: float(value) for name, value in found.items()} | _hanging(settings, rods, values, load)
