"""Laws of bending beyond a uniform linear one: friction between strands, stiffening, a stiffness for each direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec
from torchdlo.physics.effects.elastic import (
    bending_moments,
    closing_stiffness,
    curvature,
    elastic_curvature,
    hinge_stiffness,
    moment_derivatives,
    stiffness_bound,
)
from torchdlo.physics.linalg.numerics import dot, safe_norm
from torchdlo.physics.rod.kinematics import RodParams, View
from torchdlo.physics.rod.topology import Topology


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """Return the symmetric part of a b^T as (11, 22, 12), shape (..., V, 3)."""
    return tree.cat_components([a * b, 0.5 * dot(a, b.flip(-1))])


@dataclass(frozen=True)
class InternalFriction(Effect):
    """Friction that does not depend on the rate of bending: the moment of Dahl's model, as a vector.

    M = moment z with dz = (dk - |dk| z) / kappa_c (Dahl 1968, A solid friction model, TOR-0158(3107-18)-1, with
    exponent 1). It starts as a stiffness moment / kappa_c, saturates at `moment`, and loses energy on every closed
    path, since z.dk = kappa_c d(|z|^2)/2 + |z|^2 |dk|. Each change of curvature is taken as straight, and on it the
    law is solved exactly: z = u + (z0 - u) exp(-|dk| / kappa_c), u the direction of dk. So substeps do not matter.
    The friction starts without moment.
    """

    name: ClassVar[str] = "internal_friction"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "M = moment · z, dz = (dκ - |dκ| z) / kappa_c"
    frames: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True
    memory: ClassVar[int] = 5
    params: ClassVar[dict[str, Param]] = {
        "moment": Param(0.0, 0.0, 0.2, "N m", "linear", 0.0, "Moment at which it saturates."),
        "kappa_c": Param(1.0, 0.01, 100.0, "1/m", "log", None, "Change of curvature over which it builds up."),
    }
    spec = RopeEffectSpec(
        lambda s: [
            {"moment": 0.1 * s.bending_stiffness * s.curvature, "kappa_c": share * s.curvature} for share in (0.03, 0.2)
        ],
        strength=("moment",),
    )

    def _change(self, view: View, values: Values, kappa: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the change of curvature since the last view over kappa_c, its size a, exp(-a), (1 - exp(-a)) / a."""
        memory = view.state.memory[self.name]
        # The last number is 0 before the first view, when no curvature is known to have changed.
        change = memory[..., 4:] * (kappa - memory[..., 2:4]) / (values["kappa_c"] * view.hinge_length)
        size = safe_norm(change)
        small = size < 1e-4
        mean = torch.where(small, 1 - 0.5 * size, -torch.expm1(-size) / torch.where(small, 1.0, size))
        return change, size, torch.exp(-size), mean

    def loads(self, view: View, values: Values) -> Values:
        """Return the moment's loads and how they answer to bending and twist."""
        hinge = curvature(view)
        change, size, decay, mean = self._change(view, values, hinge.kappa)
        before, real = view.state.memory[self.name][..., :2], view.params.rest.hinge_mask
        moment = values["moment"] * (before * decay + change * mean) * real
        # dM/dk = M' (mean 1 + w u^T), w = change dmean/da - z0 exp(-a), u = change / a.
        gradient = values["moment"] / (values["kappa_c"] * view.hinge_length) * real
        small = size < 1e-3
        safe = torch.where(small, 1.0, size)
        w = change * torch.where(small, -0.5 + size / 3, (decay - mean) / safe) - before * decay
        u = torch.where(size > 0, change / torch.where(size > 0, size, 1.0), 0.0)
        even = tree.cat_components([mean, mean, torch.zeros_like(mean)])
        started = view.state.memory[self.name][..., 4:]
        b1, b2, a1, a2 = hinge.by_twist
        odd = 0.5 * (w[..., :1] * u[..., 1:] - w[..., 1:] * u[..., :1])
        return {
            **hinge.pull_back(view, moment),
            **moment_derivatives(view, hinge, moment, gradient * started * (even + _outer(w, u))),
            "twist_skew": gradient * started * odd * (b1 * a2 - b2 * a1),
            # Turning back, friction is up to twice as stiff.
            "hinge_stiffness": closing_stiffness(
                gradient * (1 + safe_norm(before)), dot(hinge.binormal, hinge.binormal) / 4
            ),
        }

    def update_memory(self, view: View, values: Values) -> Tensor:
        """Return z, the curvature of the view, and 1."""
        kappa = curvature(view).kappa
        change, _, decay, mean = self._change(view, values, kappa)
        z = view.state.memory[self.name][..., :2] * decay + change * mean
        return tree.cat_components([z, kappa.expand_as(z), torch.ones_like(z[..., :1])])


@dataclass(frozen=True)
class StiffeningBending(Effect):
    """Bending that grows stiffer with curvature: what M = B (k + c k^3) adds to B k.

    B is the rope's own stiffness. Where it depends on direction, the energy per length is c (k.B k)(k.k) / 4.
    """

    name: ClassVar[str] = "stiffening_bending"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "M = B (κ + c κ³)"
    frames: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "c": Param(0.0, 0.0, 0.1, "m^2", "linear", 0.0, "Relative growth of the moment per squared curvature.")
    }
    spec = RopeEffectSpec(
        lambda s: [{"c": 0.2 / s.curvature**2}],
        strength=("c",),
        confusable=("anisotropic_bending", "gripper_compliance"),
        experiments={
            "nonuniform_stiffness": "repeat the motion with half its amplitude: stiffening disappears",
            "anisotropic_bending": "move it in one plane, and again after a quarter turn in its grippers",
        },
    )

    def energy(self, view: View, values: Values) -> Tensor:
        """Return the energy per hinge [J], shape (..., V, 1)."""
        strain = elastic_curvature(view, curvature(view))
        share = 0.25 * values["c"] / view.hinge_length.square()
        return share * dot(bending_moments(hinge_stiffness(view), strain), strain) * dot(strain, strain)

    def loads(self, view: View, values: Values) -> Values:
        """Return the moment's loads and how they answer to bending and twist."""
        hinge = curvature(view)
        strain, stiffness = elastic_curvature(view, hinge), hinge_stiffness(view)
        share = 0.5 * values["c"] / view.hinge_length.square()
        linear, square = bending_moments(stiffness, strain), dot(strain, strain)
        work = dot(linear, strain)
        moment = share * (square * linear + work * strain)
        s1, s2 = stiffness[..., :1], stiffness[..., 1:2] if stiffness.shape[-1] > 1 else stiffness
        coupling = stiffness[..., 2:] if stiffness.shape[-1] == 3 else torch.zeros_like(s1)
        gradient = square * tree.cat_components([s1, s2, coupling]) + 4 * _outer(linear, strain)
        gradient = share * (gradient + tree.cat_components([work, work, torch.zeros_like(work)]))
        curved = dot(hinge.binormal, hinge.binormal) / 4
        return {
            **hinge.pull_back(view, moment),
            **moment_derivatives(view, hinge, moment, gradient),
            # 3 c k^2 B along the curvature, the stiffest direction.
            "hinge_stiffness": closing_stiffness(6 * share * square * stiffness_bound(stiffness), curved),
        }


@dataclass(frozen=True)
class AnisotropicBending(Effect):
    """Two bending stiffnesses, B sqrt(ratio) and B / sqrt(ratio), at a right angle. Needs `BendFrame`.

    On a rope whose stiffness depends on direction already, B becomes Q B Q, with Q^2 the matrix of this effect alone;
    the geometric mean of the two stiffnesses stays. A ratio r at an angle a is the same as 1/r at a + pi/2.
    """

    name: ClassVar[str] = "anisotropic_bending"
    kind: ClassVar[EffectKind] = "material"
    equation: ClassVar[str] = "B₁ = B √ratio, B₂ = B / √ratio; direction: angle of the stiff one in the rope's material"
    frames: ClassVar[bool] = True
    frame_bending: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "ratio": Param(1.0, 0.05, 20.0, "1", "log", 1.0, "Stiffness towards the direction over that across it."),
        "direction": Param(
            0.0,
            -0.5 * torch.pi,
            0.5 * torch.pi,
            "rad",
            "linear",
            None,
            "Angle from the first material director to the direction towards which the rope bends least.",
            periodic=True,
        ),
    }
    spec = RopeEffectSpec(
        lambda _: [{"ratio": 1.2, "direction": 0.0}, {"ratio": 1.2, "direction": 0.25 * torch.pi}],
        signed=True,
        strength=("ratio",),
        confusable=("gripper_compliance",),
    )

    def modify_material(self, topology: Topology, params: RodParams, values: Values) -> RodParams:
        """Make the stiffness a matrix."""
        bend = params.material.bend
        b11, b22 = bend[..., :1], bend[..., 1:2] if bend.shape[-1] > 1 else bend
        b12 = bend[..., 2:] if bend.shape[-1] == 3 else torch.zeros_like(b11)
        root = values["ratio"].pow(0.25)
        mean, half = 0.5 * (root + 1 / root), 0.5 * (root - 1 / root)
        twice = 2 * values["direction"]
        q11, q22, q12 = mean + half * torch.cos(twice), mean - half * torch.cos(twice), half * torch.sin(twice)
        # Q B Q, row by row of Q B.
        r11, r12, r21, r22 = (
            q11 * b11 + q12 * b12,
            q11 * b12 + q12 * b22,
            q12 * b11 + q22 * b12,
            q12 * b12 + q22 * b22,
        )
        made = tree.cat_components([r11 * q11 + r12 * q12, r21 * q12 + r22 * q22, r11 * q12 + r12 * q22])
        return tree.replace(params, material=tree.replace(params.material, bend=made))
