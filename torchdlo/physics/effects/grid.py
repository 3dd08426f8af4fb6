"""What a chain of links does that a rope does not: errors of the first order in the length of a link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from torchdlo.physics.effect import Effect, Param, Values
from torchdlo.physics.effects.elastic import Twist, curvature, greatest, hinge_stiffness
from torchdlo.physics.numerics import dot, safe_norm
from torchdlo.physics.rod import View


@dataclass(frozen=True)
class LinkChain(Effect):
    """The rope behaves like rigid links whose joints turn about one axis after the other.

    The angle of such a joint about the links differs from the twist by half the product of the two others, as turns do
    not commute: twist strain becomes tau - l k1 k2 / 2 per length for links of length l; the order of the axes gives
    the sign. The springs of the joints are linear in the angle instead of its tangent, which makes tight bends softer.
    Both vanish with l. A simulator of such joints shows them, a rope does not.
    """

    name: ClassVar[str] = "link_chain"
    kind: ClassVar[str] = "material"
    frames: ClassVar[bool] = True
    settles: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "length": Param(0.0, -0.1, 0.1, "m", "linear", 0.0, "Length of a link, signed by the order of the axes.")
    }

    def energy(self, view: View, values: Values) -> torch.Tensor:
        """Return what it adds to the energy per hinge [J], shape (..., V, 1)."""
        twist = Twist().strain(view)
        kappa = curvature(view).kappa
        joint = -0.5 * values["length"] / view.hinge_length * kappa[..., :1] * kappa[..., 1:]
        twisted = view.params.material.twist / view.hinge_length * (twist * joint + 0.5 * joint.square())
        # (2 atan(w |k| / 2) / w)^2 in place of |k|^2, w links per hinge: p^2 for w = 1, as |k| = 2 tan(p/2).
        links = (values["length"] / view.hinge_length).abs()
        some = links > 0
        angle = 2 * torch.atan(0.5 * links * safe_norm(kappa)) / torch.where(some, links, 1.0)
        softer = torch.where(some, dot(kappa, kappa) - angle.square(), 0.0)
        return twisted - 0.5 * greatest(hinge_stiffness(view)) * softer

    def loads(self, view: View, values: Values) -> Values:
        """Return loads and how they answer to twist."""
        hinge = curvature(view)
        stiffness = view.params.material.twist / view.hinge_length * view.params.rest.hinge_mask
        share = -0.5 * values["length"] / view.hinge_length
        k1, k2 = hinge.kappa[..., :1], hinge.kappa[..., 1:]
        joint = stiffness * share * k1 * k2
        whole = stiffness * Twist().strain(view) + joint
        # Derivative of the springs' part by k over k: atan(x) / (x (1 + x^2)) - 1, x = w |k| / 2.
        x = (0.5 * values["length"] / view.hinge_length).abs() * safe_norm(hinge.kappa)
        small = x < 1e-2
        bent_x = torch.where(small, 1.0, x)
        ratio = torch.where(small, 1 - x.square() / 3, torch.atan(bent_x) / bent_x) / (1 + x.square())
        spring = greatest(hinge_stiffness(view)) * (ratio - 1)
        bent = hinge.pull_back(view, share * whole * torch.cat([k2, k1], -1) + spring * hinge.kappa)
        pull = 0.5 * joint * view.binormal()
        b1, b2, a1, a2 = hinge.by_twist
        before, after = share * (k2 * b1 + k1 * b2), share * (k2 * a1 + k1 * a2)
        f = share * whole
        return {
            "gradient": bent["gradient"] + (pull + view.next(pull)) / view.length,
            "torque": bent["torque"] + view.next(joint) - joint,
            # k g g^T for the strain's gradient g by the twists, without Twist's own part, g = (-1, 1).
            "twist_hessian": stiffness
            * torch.cat([before.square() - 2 * before, before - after + before * after, after.square() + 2 * after], -1)
            + f * torch.cat([2 * b1 * b2, b1 * a2 + b2 * a1, 2 * a1 * a2], -1),
            "twist_geometry": f * torch.cat([k2 * b2 - k1 * b1, k2 * a2 - k1 * a1], -1),
        }
