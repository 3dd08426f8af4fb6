"""Effects that change the rods themselves: natural curvature, stiffness along the rope, extra mass, viscous bending."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.effects.elastic import Curvature, curvature
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg.numerics import dot
from torchdlo.physics.rod.kinematics import RodParams, View, hinge_length
from torchdlo.physics.rod.topology import Topology, preceding


def arclength(params: RodParams) -> tuple[Tensor, Tensor]:
    """Return arclength of vertices [m], shape (..., V, 1), and the whole length [m], shape (..., 1, 1).

    Rods that share a scene are counted as one, end to end.
    """
    real = params.rest.length * params.rest.edge_mask
    run = torch.cumsum(real, -2)
    return run - real, run[..., -1:, :]


@dataclass(frozen=True)
class RestCurvature(Effect):
    """Natural curvature, the same all along the rope, in the material frame. Needs `BendFrame`."""

    name: ClassVar[str] = "rest_curvature"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "M = B (κ - κ̄); κ̄: the two curvatures, fixed in the rope's material"
    frame_bending: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "curvature": Param((0.0, 0.0), -30.0, 30.0, "1/m", "linear", 0.0, "Curvature about the two material directors.")
    }
    spec = RopeEffectSpec(
        lambda s: [{"curvature.0": 0.05 * s.curvature}, {"curvature.1": 0.05 * s.curvature}],
        signed=True,
        strength=("curvature",),
        confusable=("marker_offset",),
        experiments={
            "marker_offset": "roll the rope by half a turn in its grippers and repeat",
            "anisotropic_bending": "hang it by one end at rest: natural curvature shows without motion",
            "tilted_gravity": "roll the rope by half a turn in its grippers: a tilt stays, curvature turns",
            "gripper_compliance": "grip it at another place: compliance moves with the gripper",
        },
    )

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Add the curvature to the rest shape."""
        hinge = hinge_length(topology, params.rest) * params.rest.hinge_mask
        rest = tree.replace(params.rest, curvature=params.rest.curvature + hinge * values["curvature"])
        return tree.replace(params, rest=rest)


@dataclass(frozen=True)
class VaryingRestCurvature(Effect):
    """Natural curvature that varies along the rope, as of a wire that was bent by hand. Needs `BendFrame`."""

    name: ClassVar[str] = "varying_rest_curvature"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "M = B (κ - κ̄), κ̄(s) = Σ modesₖ Pₖ(2 s/L - 1); Pₖ: Legendre's polynomials"
    frame_bending: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "modes": Param(
            (0.0,) * 10, -30.0, 30.0, "1/m", "linear", 0.0, "Five about the first director, five the second."
        )
    }
    spec = RopeEffectSpec(
        lambda s: [{f"modes.{k}": 0.05 * s.curvature} for k in range(10)],
        signed=True,
        strength=("modes",),
        confusable=("rest_curvature", "nonuniform_stiffness", "gripper_compliance"),
        experiments={"nonuniform_stiffness": "lay it on a level table: what is bent there is natural curvature"},
        requires="rest",
    )

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Add the curvature to the rest shape."""
        s, length = arclength(params)
        x = 2 * s / length - 1
        modes = [torch.ones_like(x), x]
        for n in range(1, 4):
            # Bonnet's recursion.
            modes.append(((2 * n + 1) * x * modes[n] - n * modes[n - 1]) / (n + 1))
        basis = torch.cat(modes, -1)
        curvature = torch.stack([(basis * values["modes"][..., 5 * k : 5 * k + 5]).sum(-1) for k in (0, 1)], -1)
        hinge = hinge_length(topology, params.rest) * params.rest.hinge_mask
        rest = tree.replace(params.rest, curvature=params.rest.curvature + hinge * curvature)
        return tree.replace(params, rest=rest)


@dataclass(frozen=True)
class NonuniformStiffness(Effect):
    """Bending stiffness times 1 + gradient (s/L - 1/2) and times a soft or stiff spot (factor at its centre)."""

    name: ClassVar[str] = "nonuniform_stiffness"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "B(s) = B (1 + slope (s/L - ½)) exp(factor · exp(-½ ((s/L - position) / width)²))"
    params: ClassVar[dict[str, Param]] = {
        "position": Param(0.5, 0.0, 1.0, "1", "linear", None, "Centre of the spot as a fraction of the length."),
        "width": Param(0.1, 0.02, 0.5, "1", "log", None, "Half width of the spot as a fraction of the length."),
        "factor": Param(0.0, -2.5, 2.5, "1", "linear", 0.0, "Logarithm of stiffness at the spot over that elsewhere."),
        "slope": Param(0.0, -1.8, 1.8, "1", "linear", 0.0, "Relative change of stiffness from end to end."),
    }
    spec = RopeEffectSpec(
        lambda s: [*({"position": x, "factor": 0.3, "width": 0.08} for x in s.inside), {"slope": 0.3}],
        signed=True,
        strength=("factor", "slope"),
        places=("position",),
        confusable=("stiffening_bending", "anisotropic_bending", "gripper_compliance"),
    )

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Scale the bending stiffness of the hinges."""
        s, length = arclength(params)
        at = s / length
        spot = torch.exp(-0.5 * ((at - values["position"]) / values["width"]).square())
        scale = torch.exp(values["factor"] * spot) * (1 + values["slope"] * (at - 0.5))
        material = tree.replace(params.material, bend=params.material.bend * scale)
        return tree.replace(params, material=material)


@dataclass(frozen=True)
class StiffnessProfile(Effect):
    """Bending stiffness that varies along the rope in any way: logarithms of factors at 16 places, linear between."""

    name: ClassVar[str] = "stiffness_profile"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "B(s) = B exp(factors(s/L))"
    params: ClassVar[dict[str, Param]] = {
        "factors": Param((0.0,) * 16, -2.5, 2.5, "1", "linear", 0.0, "Logarithms of stiffness over the uniform one.")
    }

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Scale the bending stiffness of the hinges."""
        s, length = arclength(params)
        count = values["factors"].shape[-1]
        near = (1 - ((count - 1) * s / length - torch.arange(count).to(s)).abs()).clamp(min=0.0)
        scale = torch.exp((near * values["factors"]).sum(-1, keepdim=True))
        return tree.replace(params, material=tree.replace(params.material, bend=params.material.bend * scale))


@dataclass(frozen=True)
class PointMass(Effect):
    """An extra mass at one place, shared between the two vertices next to it; it has weight and inertia."""

    name: ClassVar[str] = "point_mass"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "rho(s) → rho(s) + mass · δ(s - position)"
    params: ClassVar[dict[str, Param]] = {
        "position": Param(0.5, 0.0, 10.0, "m", "linear", None, "Place along the rope."),
        "mass": Param(0.0, 0.0, 1.0, "kg", "linear", 0.0, "The extra mass."),
    }
    spec = RopeEffectSpec(
        lambda s: [{"position": x * s.rope.length, "mass": 0.05 * s.rope.mass} for x in s.loose],
        strength=("mass",),
        places=("position",),
        limits=lambda rope: {"position": (0.5 * rope.length, rope.length), "mass": (0.0, 2 * rope.mass)},
        confusable=("nonuniform_stiffness",),
        experiments={"nonuniform_stiffness": "bend it slowly, then swing it fast: a mass shows in fast motion"},
    )

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Add the mass to the vertices."""
        s, length = arclength(params)
        real = params.rest.length * params.rest.edge_mask
        at = torch.minimum(values["position"].clamp(min=0.0), length)
        inside = (at >= s) & (at <= s + real) & (real > 0)
        after = torch.where(inside, (at - s) / params.rest.length, 0.0)
        weight = torch.where(inside, 1 - after, 0.0) + preceding(topology, after)
        # At a vertex both neighbouring edges claim the place.
        mass = params.material.mass + values["mass"] * weight / weight.sum(-2, keepdim=True)
        return tree.replace(params, material=tree.replace(params.material, mass=mass))


@dataclass(frozen=True)
class AxialStiffness(Effect):
    """Finite axial stiffness, in series with the one that the rope has: 1/EA adds to it."""

    name: ClassVar[str] = "stretch"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "T = EA · strain"
    params: ClassVar[dict[str, Param]] = {
        "EA": Param(1e18, 1.0, 1e18, "N", "reciprocal", 1e18, "Axial stiffness; 1e18 stands for inextensible.")
    }
    spec = RopeEffectSpec(
        lambda s: [{"EA": 100 * s.weight}],
        strength=("EA",),
        experiments={"marker_offset": "pull it straight with two forces: only stretch moves the markers apart"},
    )

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Soften the edges."""
        stretch, stiffness = params.material.stretch, values["EA"]
        fixed = torch.isinf(stretch)
        soft = torch.where(fixed, 1.0, stretch)
        stretch = torch.where(fixed, stiffness, soft / (1 + soft / stiffness))
        return tree.replace(params, material=tree.replace(params.material, stretch=stretch))


@dataclass(frozen=True)
class BendingDamping(Effect):
    """Kelvin-Voigt bending: a moment proportional to the rate of curvature."""

    name: ClassVar[str] = "bending_damping"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "M = coefficient · dκ/dt"
    frames: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "coefficient": Param(0.0, 0.0, 1.0, "N m^2 s", "linear", 0.0, "Bending moment per rate of curvature.")
    }
    spec = RopeEffectSpec(
        lambda s: [{"coefficient": 3e-3 * s.bending_stiffness}],
        strength=("coefficient",),
        confusable=("internal_friction", "bending_plasticity"),
        experiments={
            "internal_friction": "bend it slowly at two speeds: friction does not depend on them",
            "time_delay": "move a gripper in steps: a delay is the same at all speeds and places",
        },
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return the moment's loads and how they answer to turning and to twists."""
        hinge = curvature(view)
        resistance = values["coefficient"] / view.hinge_length * view.params.rest.hinge_mask
        rate, twisted = _rate_and_twisted(view, hinge, resistance)
        # The integrated curvature is 2 tan(angle/2): it grows by 1 + tan^2 per turning, and so does its work.
        faster = 1 + (dot(hinge.binormal, hinge.binormal) / 4).clamp(max=100.0)
        return {
            **hinge.pull_back(view, resistance * rate),
            **twisted,
            "hinge_drag": resistance * faster.square(),
        }


def _rate_and_twisted(view: View, hinge: Curvature, resistance: Tensor) -> tuple[Tensor, Values]:
    """Return the rates of curvature [1/s], shape (..., V, 2), and what `_twisted` does."""
    if not lanes.ready(view.tangent):
        rate = hinge.rate(view)
        return rate, _twisted(view, hinge, resistance, rate)
    state, angle = view.state, view.state.twist
    own = hinge.kappa, hinge.binormal, hinge.mean, hinge.mean1, hinge.mean2, *hinge.by_twist
    edge = view.before, view.tangent, state.director, angle.cos(), angle.sin(), state.vel, state.twist_rate
    inputs = *own, *edge, view.length, view.params.rest.edge_mask, resistance
    found = lanes.apply("damp", view.topology.name, inputs, (2, 3, 1, 2), numbers=(1 / view.dt,))
    return found[0], dict(zip(("twist_hessian", "twist_skew", "twist_geometry"), found[1:], strict=True))


def _twisted(view: View, hinge: Curvature, resistance: Tensor, rate: Tensor) -> Values:
    """Return how moments in proportion to the rate of curvature answer to twists that are reached in a substep.

    With k the curvatures and a, b how they change by the angles of the edges after and before, rates change by
    a / dt + a' and b / dt + b': mixed derivatives do not depend on their order.
    """
    swept, stretched = hinge.swept(view)
    moved = 2 * swept / (1 + dot(view.before, view.tangent)).clamp(min=1e-6) - hinge.binormal * stretched
    m1, m2 = view.frames()
    spin, (b1, b2, a1, a2) = view.state.twist_rate, hinge.by_twist
    back = view.prev(spin)
    grown_b1 = -0.5 * dot(moved, view.prev(m1)) + back * b2
    grown_b2 = -0.5 * dot(moved, view.prev(m2)) - back * b1
    grown_a1 = -0.5 * dot(moved, m1) + spin * a2
    grown_a2 = -0.5 * dot(moved, m2) - spin * a1
    # What 1 / dt goes with is symmetric: it would drown the rest of what is not.
    onward, backward = b1 * grown_a1 + b2 * grown_a2, a1 * grown_b1 + a2 * grown_b2
    parts = [
        (b1 * b1 + b2 * b2) / view.dt + b1 * grown_b1 + b2 * grown_b2,
        (a1 * b1 + a2 * b2) / view.dt + 0.5 * (onward + backward),
        (a1 * a1 + a2 * a2) / view.dt + a1 * grown_a1 + a2 * grown_a2,
    ]
    f1, f2 = rate[..., :1], rate[..., 1:]
    return {
        "twist_hessian": resistance * tree.cat_components(parts),
        "twist_skew": 0.5 * resistance * (onward - backward),
        "twist_geometry": resistance * tree.cat_components([f1 * b2 - f2 * b1, f1 * a2 - f2 * a1]),
    }


@dataclass(frozen=True)
class BendingPlasticity(Effect):
    """Natural curvature flows towards the curvature while its elastic part is beyond yield. Needs `BendFrame`.

    In a time dt the excess |d| - yield shrinks by exp(-rate dt), whatever the substep; without hardening d is the
    elastic curvature k_el. Hardening is kinematic (Prager's rule: Simo and Hughes 1998, Computational Inelasticity,
    chapter 1, doi:10.1007/b98904): the centre of the elastic range moves by `hardening` times the plastic
    curvature k_p, so that d = k_el - hardening k_p. A flow by g along d lowers |d| by (1 + hardening) g; hence the full
    return is g = (|d| - yield) / (1 + hardening). It needs no memory besides k_p, and a rod that was bent one way
    yields sooner the other way (Bauschinger effect). Isotropic hardening would need the whole path of flow.
    """

    name: ClassVar[str] = "bending_plasticity"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "dκ̄/dt = rate · (|κ - κ̄| - yield_curvature) along κ - κ̄, once that is positive"
    frame_bending: ClassVar[bool] = True
    frames: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "yield_curvature": Param(1e6, 0.1, 1e6, "1/m", "log", 1e6, "Elastic curvature beyond which it flows."),
        "rate": Param(10.0, 0.01, 1e4, "1/s", "log", None, "Rate of the flow."),
        "hardening": Param(0.0, 0.0, 100.0, "1", "linear", None, "Growth of yield per plastic curvature."),
    }
    spec = RopeEffectSpec(
        # What flows beyond a yield point does not grow evenly with it: no number is its strength.
        lambda s: [
            {"yield_curvature": share * s.curvature, "rate": rate} for share in (0.3, 0.6) for rate in (0.5, 10.0)
        ],
        fixed=("hardening",),
        confusable=("internal_friction",),
        experiments={
            "internal_friction": "hold it bent for a minute and let go: plastic bends stay",
            "rest_curvature": "measure its shape before and after a strong bend: only one of them changes",
        },
    )

    def plastic_flow(self, view: View, values: Values) -> Tensor:
        """Return the change of the plastic curvature."""
        plastic, hardening = view.state.plastic, values["hardening"]
        natural = view.params.rest.curvature + plastic
        driving = (curvature(view).kappa - natural - hardening * plastic) * view.params.rest.hinge_mask
        size = driving.square().sum(-1, keepdim=True)
        limit = values["yield_curvature"] * view.hinge_length
        beyond = size > limit.square()
        share = 1 - limit / torch.where(beyond, size, 1.0).sqrt()
        fraction = -torch.expm1(-values["rate"] * view.dt) / (1 + hardening)
        return torch.where(beyond, fraction * share, 0.0) * driving
