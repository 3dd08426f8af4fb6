"""What a chain of rigid links does that a rope does not: errors of the first and second order in a link's length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.elastic import Twist, curvature, hinge_stiffness, stiffness_bound
from torchdlo.physics.kernels import lanes
from torchdlo.physics.linalg.numerics import dot
from torchdlo.physics.rod.kinematics import View


@dataclass(frozen=True)
class LinkChain(Effect):
    """The rope behaves like rigid links whose joints turn about one axis after the other, with a spring on each.

    A joint turns by x about the link, then by y and z across it (with negative length in the opposite order). The three
    angles of such a joint are not the strains of a rope: to leading order x is the twist less half the product of the
    two bending angles, as turns do not commute, and springs that are linear in angles are softer than a rope's. Links
    have mass along their length, not at their ends, and so less inertia against turning. All of it vanishes with the
    length. A simulator of such joints shows it, a rope does not.
    """

    name: ClassVar[str] = "link_chain"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "rigid links of this length; joints turn about one axis after the other"
    frames: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "length": Param(0.0, -0.1, 0.1, "m", "linear", 0.0, "Length of a link, signed by the order of the axes.")
    }

    def energy(self, view: View, values: Values) -> torch.Tensor:
        """Return what it adds to the energy per hinge [J], shape (..., V, 1)."""
        return _Joint(view, values).energy()

    def loads(self, view: View, values: Values) -> Values:
        """Return loads and how they answer to twist, the latter to leading order."""
        joint = _Joint(view, values)
        hinge, rest = joint.hinge, view.params.rest
        by_kappa, moment, hessian, geometry = joint.answers()
        bent, pull = hinge.pull_back(view, by_kappa), 0.5 * moment * hinge.binormal
        line = view.params.material.mass.sum(-2, keepdim=True) / (rest.length * rest.edge_mask).sum(-2, keepdim=True)
        # Rods instead of masses at their ends: m l^2 / 12 in place of m l^2 / 4.
        length = values["length"].abs().minimum(rest.length)
        return {
            "turning_inertia": -line * length.square() / (6 * rest.length) * rest.edge_mask,
            "gradient": bent["gradient"] + (pull + view.next(pull)) / view.length,
            "torque": bent["torque"] + view.next(moment) - moment,
            "twist_hessian": hessian,
            "twist_geometry": geometry,
        }


class _Joint:
    """The angles of the joints, from the quaternion (c, s, p, q) of the turn from one link to the next.

    Not of unit length: c and s belong to half the twist, p and q are half the curvatures about the axes across, which
    are -d2 and d1 of a hinge.
    """

    def __init__(self, view: View, values: Values) -> None:
        self.view, self.fast = view, lanes.ready(view.tangent)
        self.hinge, self.twist = curvature(view), Twist().strain(view)
        self.bending = stiffness_bound(hinge_stiffness(view))
        self.twisting = view.params.material.twist / view.hinge_length * view.params.rest.hinge_mask
        links = values["length"] / view.hinge_length
        self.links, self.some = links, links.abs() > 1e-4
        self.w = torch.where(self.some, links, 1.0)
        kappa, turn = self.hinge.kappa, self.w * self.twist
        self.c, self.s = torch.cos(0.5 * turn), torch.sin(0.5 * turn)
        if self.fast:
            self.own = kappa, self.twist, self.c, self.s, self.w
            *parts, self.sine = lanes.apply("joint", view.topology.name, self.own, (1, 1, 1, 1, 1))
            self.x, self.z, self.y = torch.atan2(*parts[:2]), torch.atan2(*parts[2:]), torch.asin(self.sine)
            return
        self.p, self.q = -0.5 * self.w * kappa[..., :1], -0.5 * self.w * kappa[..., 1:]
        p, q, c, s = self.p, self.q, self.c, self.s
        self.norm = 1 + p.square() + q.square()
        self.x_of = 2 * (c * s - p * q), c.square() - s.square() + q.square() - p.square()
        self.y_of = 2 * (s * q + c * p)
        self.z_of = 2 * (c * q - s * p), 1 - p.square() - q.square()
        self.x, self.z = torch.atan2(*self.x_of), torch.atan2(*self.z_of)
        # Short of a right angle, where the first and the third axis fall together.
        self.sine = (self.y_of / self.norm).clamp(-0.99, 0.99)
        self.y = torch.asin(self.sine)

    def energy(self) -> torch.Tensor:
        """Return the energy of its springs less that of a rope [J], shape (..., V, 1)."""
        kappa = self.hinge.kappa
        bent = (self.y.square() + self.z.square()) / self.w.square() - dot(kappa, kappa)
        twisted = self.x.square() / self.w.square() - self.twist.square()
        return torch.where(self.some, 0.5 * self.bending * bent + 0.5 * self.twisting * twisted, 0.0)

    def answers(self) -> tuple[torch.Tensor, ...]:
        """Return derivatives of the energy by curvatures and by twist, and how they answer to the twists.

        The latter to leading order: `twist_hessian` and `twist_geometry` of `LOADS`.
        """
        hinge = self.hinge
        if self.fast:
            some, angles = self.some.to(self.x.dtype), (self.x, self.y, self.z)
            inputs = *self.own, self.bending, self.twisting, some, self.links, *hinge.by_twist, *angles
            return tuple(lanes.apply("spring", self.view.topology.name, inputs, (2, 1, 3, 2)))
        by_kappa, moment = self.gradients()
        stiffness, share = self.twisting, -0.5 * self.links
        k1, k2 = hinge.kappa[..., :1], hinge.kappa[..., 1:]
        b1, b2, a1, a2 = hinge.by_twist
        before, after = share * (k2 * b1 + k1 * b2), share * (k2 * a1 + k1 * a2)
        f = share * (stiffness * self.twist + moment)
        # k g g^T for the strain's gradient g by the twists, without Twist's own part, g = (-1, 1).
        direct = before.square() - 2 * before, before - after + before * after, after.square() + 2 * after
        crossed = 2 * b1 * b2, b1 * a2 + b2 * a1, 2 * a1 * a2
        hessian = stiffness * tree.cat_components(direct) + f * tree.cat_components(crossed)
        return by_kappa, moment, hessian, f * tree.cat_components([k2 * b2 - k1 * b1, k2 * a2 - k1 * a1])

    def gradients(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the derivatives of the energy by curvatures (..., V, 2) and by twist (..., V, 1)."""
        p, q, c, s = self.p, self.q, self.c, self.s
        nx, dx = self.x_of
        nz, dz = self.z_of
        ex = self.twisting * self.x / (nx.square() + dx.square())
        ez = self.bending * self.z / (nz.square() + dz.square())
        ey = self.bending * self.y / (self.norm * (1 - self.sine.square()).sqrt())
        by_p = ex * (-2 * q * dx + 2 * p * nx) + ez * (-2 * s * dz + 2 * p * nz) + ey * (2 * c - 2 * p * self.sine)
        by_q = ex * (-2 * p * dx - 2 * q * nx) + ez * (2 * c * dz + 2 * q * nz) + ey * (2 * s - 2 * q * self.sine)
        cosine, sine = c.square() - s.square(), 2 * c * s
        by_t = ex * (cosine * dx + sine * nx) - 0.5 * ez * self.y_of * dz + 0.5 * ey * nz
        kappa = self.hinge.kappa
        by_kappa = -tree.cat_components([by_p, by_q]) / (2 * self.w) - self.bending * kappa
        by_twist = by_t / self.w - self.twisting * self.twist
        return torch.where(self.some, by_kappa, 0.0), torch.where(self.some, by_twist, 0.0)
