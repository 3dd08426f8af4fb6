"""Clamps that do more than give elastically: those with play, and those that creep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import EffectKind, Param, Values
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
from torchdlo.physics.effects.gripper_compliance import CLAMP_STIFFNESS, Clamps
from torchdlo.physics.linalg.numerics import dot, safe_norm
from torchdlo.physics.rod.kinematics import View

__all__ = ["GripperDamping", "GripperPlay"]


def _matrix(stiffness: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the parts 11, 22 and 12 of a stiffness (..., V, 1, 2 or 3) as `Material.bend`."""
    first = stiffness[..., :1]
    second = first if stiffness.shape[-1] == 1 else stiffness[..., 1:2]
    return first, second, stiffness[..., 2:] if stiffness.shape[-1] == 3 else torch.zeros_like(first)


def _clamped(effect: Clamps, view: View) -> Tensor:
    """Return the stiffness of the hinges at clamps [N m], as `hinge_stiffness`; 0 elsewhere."""
    return hinge_stiffness(view) * effect.here(view.topology, view.length)


@dataclass(frozen=True)
class GripperPlay(Clamps):
    """Clamps in which the rope turns freely within an angle to every side, and beyond it against a spring.

    The play is taken off the bend b of the hinge at a clamp, which is rope and clamp in series: with the energy E of
    the hinge with the spring, E(b (1 - angle / |b|)) beyond the play, 0 within. So the moment is continuous, and for a
    rope that is equally stiff in all directions it is that of play, spring and rope in series exactly. Bending only:
    in twist the spring alone acts. There is no friction in the play.
    """

    name: ClassVar[str] = "gripper_play"
    kind: ClassVar[EffectKind] = "boundary"
    equation: ClassVar[str] = "moment at a clamp = stiffness · (turn of the rope in it - angle), 0 within the angle"
    frames: ClassVar[bool] = True
    frame_bending: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "angle": Param(0.0, 0.0, 0.3, "rad", "linear", 0.0, "Turn to every side that meets no resistance."),
        "stiffness": CLAMP_STIFFNESS,
    }
    spec = RopeEffectSpec(
        lambda s: [{"angle": 5e-3, "stiffness": 300 * s.bending_stiffness / s.rope.length}],
        strength=("angle",),
        confusable=("gripper_compliance",),
        experiments={
            "gripper_compliance": "turn a gripper slowly until the rope leaves it towards the other side: with play it "
            "swings over at once, from a spring it turns evenly",
            "stiffening_bending": "grip it at another place: play moves with the gripper",
            "tilted_gravity": "turn the grippers over: play lets the rope hang lower in both poses, a tilt to one side",
        },
        special_case=("gripper_compliance", {"angle": 0.0}),
        requires="clamps",
    )

    def loads(self, view: View, values: Values) -> Values:
        """Return what the play takes off the moment of bending, and how that answers to twist."""
        hinge = curvature(view)
        strain, stiffness = elastic_curvature(view, hinge), _clamped(self, view)
        s11, s22, s12 = _matrix(stiffness)
        size = safe_norm(strain)
        # Bends are integrated curvatures, 2 tan(angle / 2).
        play = torch.minimum(2 * torch.tan(0.5 * values["angle"]), size)
        share = play / torch.where(size > 0, size, 1.0)
        along = strain / torch.where(size > 0, size, 1.0)
        n1, n2 = along[..., :1], along[..., 1:]
        # Parts of the stiffness along the bend and across it.
        same, other = (
            s11 * n1 * n1 + 2 * s12 * n1 * n2 + s22 * n2 * n2,
            s11 * n2 * n2 - 2 * s12 * n1 * n2 + s22 * n1 * n1,
        )
        mixed = s12 * (n1 * n1 - n2 * n2) + (s22 - s11) * n1 * n2
        across = tree.cat_components([-n2, n1])
        moment = -play * (same * along + (2 - share) * mixed * across)
        # In these axes: 0 or, within the play, all of the stiffness; coupling; across.
        inside = size <= 2 * torch.tan(0.5 * values["angle"])
        a = torch.where(inside, -same, 0.0) * share
        c = -share.square() * mixed
        b = share * ((1 - share) * same - (2 - share) * other)
        gradient = tree.cat_components(
            [
                a * n1 * n1 - 2 * c * n1 * n2 + b * n2 * n2,
                a * n2 * n2 + 2 * c * n1 * n2 + b * n1 * n1,
                (a - b) * n1 * n2 + c * (n1 * n1 - n2 * n2),
            ]
        )
        return {**hinge.pull_back(view, moment), **moment_derivatives(view, hinge, moment, gradient)}


@dataclass(frozen=True)
class GripperDamping(Clamps):
    """Clamps that turn like a spring and a damper side by side: what is bent in them creeps, and loses energy.

    In series with the rope's hinge of stiffness S that is a standard linear solid: the turn t of the clamp obeys
    t + loss_time dt/dt = S (b - t) / stiffness, b the bend of both. Here stands what the moment S (b - t) has over the
    one of a spring without damper. Turns are found by the implicit rule of Euler, stable whatever the loss time, and
    of first order in the substep. A rope starts with its clamps at rest. Bending only: in twist the spring alone acts.
    """

    name: ClassVar[str] = "gripper_damping"
    kind: ClassVar[EffectKind] = "boundary"
    equation: ClassVar[str] = "moment at a clamp = stiffness · (turn of the rope in it + loss_time · d turn/dt)"
    frames: ClassVar[bool] = True
    frame_bending: ClassVar[bool] = True
    is_quasistatic: ClassVar[bool] = True
    memory: ClassVar[int] = 3
    params: ClassVar[dict[str, Param]] = {
        "stiffness": CLAMP_STIFFNESS,
        "loss_time": Param(0.05, 0.0, 10.0, "s", "linear", None, "Damping of a clamp over its stiffness."),
    }
    spec = RopeEffectSpec(
        lambda s: [
            {"stiffness": 100 * s.bending_stiffness / s.rope.length, "loss_time": loss_time}
            for loss_time in (0.02, 0.2)
        ],
        strength=("stiffness",),
        confusable=("gripper_compliance", "bending_damping"),
        experiments={
            "gripper_compliance": "bend it at a gripper and hold still: a damped clamp creeps",
            "bending_damping": "grip it at another place: what a clamp damps moves with the gripper",
        },
        special_case=("gripper_compliance", {"loss_time": 0.0}),
        requires="clamps",
    )

    def _lag(self, view: View, values: Values, strain: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return by how much the turns lag behind those at rest, (1 + h (1 - q S))^-1 h d, see `loads`, and q S b."""
        memory = view.state.memory[self.name]
        stiffness = _clamped(self, view)
        compliance = 1 / values["stiffness"] - 1 / CLAMP_STIFFNESS.high
        rate = memory[..., 2:] * values["loss_time"] / view.dt
        rest = compliance * bending_moments(stiffness, strain)
        s11, s22, s12 = _matrix(stiffness)
        # (1 + h) - h q S, inverted by cofactors; S is that of rope and spring in series, so that q S is below 1.
        m11, m22, m12 = (1 + rate * (1 - compliance * s) for s in (s11, s22, torch.zeros_like(s12)))
        m12 = -rate * compliance * s12
        inverse = tree.cat_components([m22, m11, -m12]) / (m11 * m22 - m12.square())
        return rate * bending_moments(inverse, rest - memory[..., :2]), rest, rate * inverse

    def loads(self, view: View, values: Values) -> Values:
        """Return what the damper adds to the moment of bending, and how that answers to bending and twist.

        With S of rope and spring in series, q the compliance of the spring and h = loss_time / dt, the turn is
        q S b - A h (1 + h A)^-1 d, A = 1 - q S and d = q S b - the last turn; the moment is larger by
        S h (1 + h A)^-1 d.
        """
        hinge = curvature(view)
        strain, stiffness = elastic_curvature(view, hinge), _clamped(self, view)
        lag, _, answer = self._lag(view, values, strain)
        moment = bending_moments(stiffness, lag)
        compliance = 1 / values["stiffness"] - 1 / CLAMP_STIFFNESS.high
        # q S^2 h (1 + h A)^-1: functions of the same matrix commute.
        gradient = compliance * _product(_product(stiffness, stiffness), answer)
        return {
            **hinge.pull_back(view, moment),
            **moment_derivatives(view, hinge, moment, gradient),
            "hinge_stiffness": closing_stiffness(stiffness_bound(gradient), dot(hinge.binormal, hinge.binormal) / 4),
        }

    def update_memory(self, view: View, values: Values) -> Tensor:
        """Return how far the rope is turned in the clamps, as integrated curvatures, and 1."""
        strain = elastic_curvature(view, curvature(view))
        lag, rest, _ = self._lag(view, values, strain)
        compliance = 1 / values["stiffness"] - 1 / CLAMP_STIFFNESS.high
        turn = rest - lag + compliance * bending_moments(_clamped(self, view), lag)
        return tree.cat_components([turn, torch.ones_like(turn[..., :1])])


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Return the product of two matrices that commute, as `Material.bend`, shape (..., V, 3)."""
    a11, a22, a12 = _matrix(a)
    b11, b22, b12 = _matrix(b)
    return tree.cat_components([a11 * b11 + a12 * b12, a12 * b12 + a22 * b22, a11 * b12 + a12 * b22])
