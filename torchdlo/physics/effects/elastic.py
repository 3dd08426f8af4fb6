"""Stretching, bending and twisting of elastic rods: energies, and loads in closed form.

Bergou et al. 2008, doi:10.1145/1360612.1360662; Bergou et al. 2010, doi:10.1145/1778765.1778853, appendix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Values
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg.numerics import cross, dot
from torchdlo.physics.rod.kinematics import View


@dataclass(frozen=True)
class Stretch(Effect):
    """Axial stiffness as a force: energy EA strain^2 length / 2 per edge."""

    name: ClassVar[str] = "stretch_force"
    kind: ClassVar[EffectKind] = "material"

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per edge [J], shape (..., V, 1)."""
        rest, p = view.params.rest, view.params.material
        strain = view.length / rest.length - 1
        return 0.5 * p.stretch * strain.square() * rest.length * rest.edge_mask

    def loads(self, view: View, values: Values) -> Values:
        """Return the force as a gradient by the edges."""
        rest, p = view.params.rest, view.params.material
        tension = p.stretch * (view.length / rest.length - 1) * rest.edge_mask
        return {"gradient": tension * view.tangent}


@dataclass(frozen=True)
class Bend(Effect):
    """Bending of a rod that is straight at rest and equally stiff in all directions.

    The energy EI |kb|^2 / (2 l) needs no material frame and does not depend on twist. Use `BendFrame` for curved rest
    shapes, stiffness that depends on direction, or plasticity.
    """

    name: ClassVar[str] = "bend"
    kind: ClassVar[EffectKind] = "material"

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        kb = view.binormal()
        return 0.5 * view.params.material.bend / view.hinge_length * dot(kb, kb)

    def loads(self, view: View, values: Values) -> Values:
        """Return the force as a gradient by the edges."""
        rest, bend = view.params.rest, view.params.material.bend
        if lanes.ready(view.tangent):
            inputs = view.before, view.tangent, view.length, view.hinge_length, bend, rest.hinge_mask
            gradient, stiffness = lanes.apply("bend", view.topology.name, inputs, (3, 1))
            return {"gradient": gradient, "hinge_stiffness": stiffness}
        cosine = dot(view.before, view.tangent)
        chi = (1 + cosine).clamp(min=1e-6)
        stiffness = bend / view.hinge_length * rest.hinge_mask
        slope = -4 * stiffness / chi.square()  # dE/dcos of E = 2 EI/l (1 - cos)/(1 + cos)
        after = slope / view.length * (view.before - cosine * view.tangent)
        before = slope * (view.tangent - cosine * view.before)
        gradient = after + view.next(before) / view.length
        return {"gradient": gradient, "hinge_stiffness": closing_stiffness(stiffness, (1 - cosine) / chi)}


@dataclass(frozen=True)
class Curvature:
    """Curvature of each hinge in the averaged material frame, and its derivatives (Bergou 2010, appendix)."""

    kappa: Tensor
    """Integrated curvatures [1], shape (..., V, 2)."""
    binormal: Tensor
    """Curvature binormal [1], shape (..., V, 3)."""
    mean: Tensor
    """(t' + t) / (1 + t'.t) [1], shape (..., V, 3)."""
    mean1: Tensor
    """(m1' + m1) / (1 + t'.t) [1], shape (..., V, 3)."""
    mean2: Tensor
    """(m2' + m2) / (1 + t'.t) [1], shape (..., V, 3)."""
    by_twist: tuple[Tensor, ...]
    """Derivatives of (kappa1, kappa2) by the angle of the edge before, then after [1], shape (..., V, 1) each."""

    def pull_back(self, view: View, moment: Tensor) -> Values:
        """Return the loads of moments [N m], shape (..., V, 2), that work against the two curvatures."""
        if lanes.ready(self.kappa):
            own = self.kappa, self.mean, self.mean1, self.mean2, *self.by_twist
            inputs = *own, view.before, view.tangent, view.length, moment
            gradient, torque = lanes.apply("pull", view.topology.name, inputs, (3, 1))
            return {"gradient": gradient, "torque": torque}
        f1, f2 = moment[..., :1], moment[..., 1:]
        # dk1/de = (-k1 t~ + t' x d2~)/|e|, dk2/de = (-k2 t~ - t' x d1~)/|e|, and with the other sign for e'.
        turned = f1 * self.mean2 - f2 * self.mean1
        along = -dot(moment, self.kappa) * self.mean
        after = along - cross(view.before, turned)
        before = along + cross(view.tangent, turned)
        b1, b2, a1, a2 = self.by_twist
        return {
            "gradient": (after + view.next(before)) / view.length,
            "torque": -(f1 * a1 + f2 * a2) - view.next(f1 * b1 + f2 * b2),
        }

    def rate(self, view: View) -> Tensor:
        """Return the rate of change of the curvatures [1/s], shape (..., V, 2)."""
        spin, (b1, b2, a1, a2) = view.state.twist_rate, self.by_twist
        # Scalar triple products a.(b x c) of the formulas in `pull_back`.
        swept, stretched = self.swept(view)
        k1 = dot(self.mean2, swept) - self.kappa[..., :1] * stretched
        k2 = -dot(self.mean1, swept) - self.kappa[..., 1:] * stretched
        return tree.cat_components([k1 + b1 * view.prev(spin) + a1 * spin, k2 + b2 * view.prev(spin) + a2 * spin])

    def swept(self, view: View) -> tuple[Tensor, Tensor]:
        """Return the rates of the cross product of the tangents (..., V, 3) and of their stretching, as edges move."""
        turning = (view.next(view.state.vel) - view.state.vel) / view.length * view.params.rest.edge_mask
        before = view.prev(turning)
        return cross(before, view.tangent) - cross(turning, view.before), dot(self.mean, before + turning)


def curvature(view: View) -> Curvature:
    """Return the curvature of every hinge."""
    if lanes.ready(view.tangent):
        angle = view.state.twist
        inputs = view.before, view.tangent, view.state.director, angle.cos(), angle.sin(), view.params.rest.hinge_mask
        found = lanes.apply("curve", view.topology.name, inputs, (2, 3, 3, 3, 3, 1, 1, 1, 1))
        kappa, kb, mean, mean1, mean2, b1, b2, a1, a2 = found
        return Curvature(kappa, kb, mean, mean1, mean2, (b1, b2, a1, a2))
    chi = (1 + dot(view.before, view.tangent)).clamp(min=1e-6)
    kb = 2 * cross(view.before, view.tangent) / chi * view.params.rest.hinge_mask
    m1, m2 = view.frames()
    m1p, m2p = view.prev(m1), view.prev(m2)
    mean1, mean2 = (m1p + m1) / chi, (m2p + m2) / chi
    kappa = tree.cat_components([dot(kb, mean2), -dot(kb, mean1)]) * chi / 2
    # dk1/dtheta = -kb.m1 / 2, dk2/dtheta = -kb.m2 / 2 for the edge that turns.
    by_twist = tuple(-0.5 * dot(kb, m) for m in (m1p, m2p, m1, m2))
    return Curvature(kappa, kb, (view.before + view.tangent) / chi, mean1, mean2, by_twist)


def elastic_curvature(view: View, hinge: Curvature) -> Tensor:
    """Return the integrated curvatures beyond the natural ones [1], shape (..., V, 2)."""
    natural = view.params.rest.curvature + view.state.plastic
    return (hinge.kappa - natural) * view.params.rest.hinge_mask


def hinge_stiffness(view: View) -> Tensor:
    """Return the bending stiffness of the hinges [N m], shape (..., V, 1, 2 or 3) as `Material.bend`."""
    return view.params.material.bend / view.hinge_length * view.params.rest.hinge_mask


def bending_moments(stiffness: Tensor, strain: Tensor) -> Tensor:
    """Return the moments of strains, both shape (..., V, 2), for a stiffness (..., V, 1, 2 or 3)."""
    if stiffness.shape[-1] < 3:
        return stiffness * strain
    return stiffness[..., :2] * strain + stiffness[..., 2:] * strain.flip(-1)


def moment_derivatives(view: View, hinge: Curvature, moment: Tensor, stiffness: Tensor) -> Values:
    """Return how moments answer to the twists: parts of `LOADS` for a stiffness (..., V, 1, 2 or 3)."""
    s1 = stiffness[..., :1]
    s2 = s1 if stiffness.shape[-1] == 1 else stiffness[..., 1:2]
    if lanes.ready(moment):
        coupling = stiffness[..., 2:] if stiffness.shape[-1] == 3 else moment.new_zeros(1, 1)
        inputs = *hinge.by_twist, moment, s1, s2, coupling
        hessian, geometry = lanes.apply("answer", view.topology.name, inputs, (3, 2))
        return {"twist_hessian": hessian, "twist_geometry": geometry}
    f1, f2 = moment[..., :1], moment[..., 1:]
    b1, b2, a1, a2 = hinge.by_twist
    parts = [s1 * b1 * b1 + s2 * b2 * b2, s1 * b1 * a1 + s2 * b2 * a2, s1 * a1 * a1 + s2 * a2 * a2]
    if stiffness.shape[-1] == 3:
        coupling = stiffness[..., 2:]
        for k, more in enumerate((2 * b1 * b2, b1 * a2 + b2 * a1, 2 * a1 * a2)):
            parts[k] = parts[k] + coupling * more
    return {
        "twist_hessian": tree.cat_components(parts),
        "twist_geometry": tree.cat_components([f1 * b2 - f2 * b1, f1 * a2 - f2 * a1]),
    }


def stiffness_bound(stiffness: Tensor) -> Tensor:
    """Return a bound on the stiffness over all directions, exact without coupling; shape (..., V, 1)."""
    if stiffness.shape[-1] == 1:
        return stiffness
    most = torch.maximum(stiffness[..., :1], stiffness[..., 1:2])
    return most + stiffness[..., 2:].abs() if stiffness.shape[-1] == 3 else most


@dataclass(frozen=True)
class BendFrame(Effect):
    """Bending with rest curvature, stiffness that depends on direction, and plastic curvature, in the material frame.

    The stiffness may be one number, one for bending towards each director, or a symmetric matrix of both.
    """

    name: ClassVar[str] = "bend"
    kind: ClassVar[EffectKind] = "material"
    frames: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        strain = elastic_curvature(view, curvature(view))
        return 0.5 * dot(bending_moments(hinge_stiffness(view), strain), strain)

    def loads(self, view: View, values: Values) -> Values:
        """Return gradients by the edges and torques."""
        hinge = curvature(view)
        stiffness = hinge_stiffness(view)
        natural = view.params.rest.curvature + view.state.plastic
        moment = bending_moments(stiffness, hinge.kappa - natural)
        curved = dot(hinge.binormal, hinge.binormal) / 4
        return {
            **hinge.pull_back(view, moment),
            **moment_derivatives(view, hinge, moment, stiffness),
            "hinge_stiffness": closing_stiffness(stiffness_bound(stiffness), curved),
        }


@dataclass(frozen=True)
class Twist(Effect):
    """Twisting: energy GJ (twist - rest twist)^2 / (2 l) per hinge."""

    name: ClassVar[str] = "twist"
    kind: ClassVar[EffectKind] = "material"
    frames: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True

    def strain(self, view: View) -> Tensor:
        """Return the twist across each hinge beyond its rest value [rad], shape (..., V, 1)."""
        angle = view.state.twist - view.prev(view.state.twist) + view.state.ref_twist
        return (angle - view.params.rest.twist) * view.params.rest.hinge_mask

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        return 0.5 * view.params.material.twist / view.hinge_length * self.strain(view).square()

    def loads(self, view: View, values: Values) -> Values:
        """Return gradients by the edges and torques."""
        if lanes.ready(view.tangent):
            rest, stiffness, now = view.params.rest, view.params.material.twist, view.state
            hinge = view.length, view.hinge_length, stiffness, rest.hinge_mask, now.twist, now.ref_twist, rest.twist
            found = lanes.apply("twist", view.topology.name, (view.before, view.tangent, *hinge), (3, 1, 3))
            return dict(zip(("gradient", "torque", "twist_hessian"), found, strict=True))
        stiffness = view.params.material.twist / view.hinge_length * view.params.rest.hinge_mask
        moment = stiffness * self.strain(view)
        # The twist of the reference frames changes with the edges by kb / (2 |e|) each (Bergou 2008, eq. 9).
        pull = 0.5 * moment * view.binormal()
        return {
            "gradient": (pull + view.next(pull)) / view.length,
            "torque": view.next(moment) - moment,
            "twist_hessian": tree.cat_components([stiffness, -stiffness, stiffness]),
        }


def closing_stiffness(stiffness: Tensor, squared: Tensor) -> Tensor:
    """Return the bending moment per turning, given tan^2(angle/2): it grows as the hinge closes.

    Second derivative of 2 k tan^2(angle/2); capped, for hinges that are folded flat.
    """
    s = squared.clamp(max=100.0)
    return stiffness * (1 + s) * (1 + 3 * s)
