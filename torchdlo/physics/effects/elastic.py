"""Stretching, bending and twisting of elastic rods: energies, and loads in closed form.

Bergou et al. 2008, doi:10.1145/1360612.1360662; Bergou et al. 2010, doi:10.1145/1778765.1778853, appendix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics.effect import Effect, Values
from torchdlo.physics.numerics import cross, dot
from torchdlo.physics.rod import View


@dataclass(frozen=True)
class Stretch(Effect):
    """Axial stiffness as a force: energy EA strain^2 length / 2 per edge."""

    name: ClassVar[str] = "stretch_force"

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
    shapes, two stiffnesses, or plasticity.
    """

    name: ClassVar[str] = "bend"

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        kb = view.binormal()
        return 0.5 * view.params.material.bend / view.hinge_length * dot(kb, kb)

    def loads(self, view: View, values: Values) -> Values:
        """Return the force as a gradient by the edges."""
        rest = view.params.rest
        cosine = dot(view.before, view.tangent)
        chi = (1 + cosine).clamp(min=1e-6)
        stiffness = view.params.material.bend / view.hinge_length * rest.hinge_mask
        slope = -4 * stiffness / chi.square()  # dE/dcos of E = 2 EI/l (1 - cos)/(1 + cos)
        after = slope / view.length * (view.before - cosine * view.tangent)
        before = slope * (view.tangent - cosine * view.before)
        gradient = after + view.next(before) / view.length
        return {"gradient": gradient, "hinge_stiffness": _tangent_stiffness(stiffness, (1 - cosine) / chi)}


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
    by_twist: tuple[Tensor, Tensor, Tensor, Tensor]
    """Derivatives of (kappa1, kappa2) by the angle of the edge before, then after [1], shape (..., V, 1) each."""

    def pull_back(self, view: View, moment: Tensor) -> Values:
        """Return the loads of moments [N m], shape (..., V, 2), that work against the two curvatures."""
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
        turning = (view.next(view.state.vel) - view.state.vel) / view.length * view.params.rest.edge_mask
        spin = view.state.twist_rate
        before, b1, b2, a1, a2 = view.prev(turning), *self.by_twist
        # Scalar triple products a.(b x c) of the formulas in `pull_back`.
        swept = cross(before, view.tangent) - cross(turning, view.before)
        stretched = dot(self.mean, before + turning)
        k1 = dot(self.mean2, swept) - self.kappa[..., :1] * stretched
        k2 = -dot(self.mean1, swept) - self.kappa[..., 1:] * stretched
        return torch.cat([k1 + b1 * view.prev(spin) + a1 * spin, k2 + b2 * view.prev(spin) + a2 * spin], -1)


def curvature(view: View) -> Curvature:
    """Return the curvature of every hinge."""
    chi = (1 + dot(view.before, view.tangent)).clamp(min=1e-6)
    kb = 2 * cross(view.before, view.tangent) / chi * view.params.rest.hinge_mask
    m1, m2 = view.frames()
    m1p, m2p = view.prev(m1), view.prev(m2)
    mean1, mean2 = (m1p + m1) / chi, (m2p + m2) / chi
    kappa = torch.cat([dot(kb, mean2), -dot(kb, mean1)], -1) * chi / 2
    # dk1/dtheta = -kb.m1 / 2, dk2/dtheta = -kb.m2 / 2 for the edge that turns.
    by_twist = tuple(-0.5 * dot(kb, m) for m in (m1p, m2p, m1, m2))
    return Curvature(kappa, kb, (view.before + view.tangent) / chi, mean1, mean2, by_twist)


@dataclass(frozen=True)
class BendFrame(Effect):
    """Bending with rest curvature, two stiffnesses and plastic curvature, in the material frame."""

    name: ClassVar[str] = "bend"
    frames: ClassVar[bool] = True

    def strain(self, view: View) -> Tensor:
        """Return the elastic part of the integrated curvatures [1], shape (..., V, 2)."""
        natural = view.params.rest.curvature + view.state.plastic
        return (curvature(view).kappa - natural) * view.params.rest.hinge_mask

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        stiffness = view.params.material.bend / view.hinge_length
        return 0.5 * (stiffness * self.strain(view).square()).sum(-1, keepdim=True)

    def loads(self, view: View, values: Values) -> Values:
        """Return gradients by the edges and torques."""
        hinge = curvature(view)
        stiffness = view.params.material.bend / view.hinge_length * view.params.rest.hinge_mask
        natural = view.params.rest.curvature + view.state.plastic
        moment = stiffness * (hinge.kappa - natural)
        loads = hinge.pull_back(view, moment)
        s1, s2 = stiffness[..., :1], stiffness[..., -1:]
        f1, f2 = moment[..., :1], moment[..., 1:]
        b1, b2, a1, a2 = hinge.by_twist
        curved = dot(hinge.binormal, hinge.binormal) / 4
        return {
            **loads,
            "hinge_stiffness": _tangent_stiffness(torch.maximum(s1, s2), curved),
            "twist_hessian": torch.cat(
                [s1 * b1 * b1 + s2 * b2 * b2, s1 * b1 * a1 + s2 * b2 * a2, s1 * a1 * a1 + s2 * a2 * a2], -1
            ),
            "twist_geometry": torch.cat([f1 * b2 - f2 * b1, f1 * a2 - f2 * a1], -1),
        }


@dataclass(frozen=True)
class Twist(Effect):
    """Twisting: energy GJ (twist - rest twist)^2 / (2 l) per hinge."""

    name: ClassVar[str] = "twist"
    frames: ClassVar[bool] = True

    def strain(self, view: View) -> Tensor:
        """Return the twist across each hinge beyond its rest value [rad], shape (..., V, 1)."""
        angle = view.state.twist - view.prev(view.state.twist) + view.state.ref_twist
        return (angle - view.params.rest.twist) * view.params.rest.hinge_mask

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        return 0.5 * view.params.material.twist / view.hinge_length * self.strain(view).square()

    def loads(self, view: View, values: Values) -> Values:
        """Return gradients by the edges and torques."""
        stiffness = view.params.material.twist / view.hinge_length * view.params.rest.hinge_mask
        moment = stiffness * self.strain(view)
        # The twist of the reference frames changes with the edges by kb / (2 |e|) each (Bergou 2008, eq. 9).
        pull = 0.5 * moment * view.binormal()
        return {
            "gradient": (pull + view.next(pull)) / view.length,
            "torque": view.next(moment) - moment,
            "twist_hessian": torch.cat([stiffness, -stiffness, stiffness], -1),
        }


def _tangent_stiffness(stiffness: Tensor, squared: Tensor) -> Tensor:
    """Return the bending moment per turning, given tan^2(angle/2): it grows as the hinge closes.

    Second derivative of 2 k tan^2(angle/2); capped, for hinges that are folded flat.
    """
    s = squared.clamp(max=100.0)
    return stiffness * (1 + s) * (1 + 3 * s)
