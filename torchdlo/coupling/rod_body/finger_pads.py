"""Two finger pads that squeeze a rope with a given force, and hold it by Coulomb friction.

The hand is a kinematic body. Vertices between its pads go with it: across the pads without limit, for fingers are stiff
and close on the rope wherever it is; along the pads as long as that takes no more than friction of both sides can
exert, 2 mu times the force of one finger, shared by the vertices between the pads. Beyond that the rope slides and
friction stays at its limit. The hand takes the opposite force and torque.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.physics.effects.base import ContactForces, Effect, EffectKind, Param, PredictedMotion, Values
from torchdlo.physics.linalg.numerics import cross, dot, safe_norm
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.physics.rod.kinematics import View


@dataclass(frozen=True)
class FingerPads(Effect):
    """A friction grasp by a parallel gripper. Opened by a force of 0."""

    hand: int = 0
    """Number of the body that carries the pads."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the middle of the pads is in the frame of the hand, whose y axis is their normal [m]."""
    reach: tuple[float, float, float] = (0.01, 0.02, 0.01)
    """Half of the pads' length along x, of their opening along y, and of their length along z [m]."""

    name: ClassVar[str] = "finger_pads"
    kind: ClassVar[EffectKind] = "boundary"
    is_contact: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "squeeze": Param(0.0, 0.0, 100.0, "N", "linear", 0.0, "Force of each finger on the rope."),
        "mu": Param(0.5, 0.0, 2.0, "1", "linear", 0.0, "Coefficient of friction between pads and rope."),
    }

    def _between(self, view: View, at: Tensor) -> Tensor:
        """Return how much vertices are between the pads, 0 to 1 over a diameter at the rim, shape (..., V, 1)."""
        half = at.new_tensor(self.reach)
        depth = (half - at.abs()).amin(-1, keepdim=True)
        return (0.5 + 0.5 * depth / view.params.material.radius).clamp(0.0, 1.0)

    def solve_contact(self, view: View, motion: PredictedMotion, values: Values) -> ContactForces:
        """Return the forces that take vertices along [N], and their opposite on the hand."""
        hand, k = motion.bodies.state, slice(self.hand, self.hand + 1)
        pos, quat = hand.pos[..., k, :], hand.quat[..., k, :]
        lever = view.state.pos - pos
        back = conjugate(quat).expand(*lever.shape[:-1], 4)
        inside = self._between(view, rotate(back, lever) - lever.new_tensor(self.place))
        goes = motion.bodies.change[..., k, :] + cross(motion.bodies.turn[..., k, :], lever)
        answer = motion.answer.amax(-1, keepdim=True)
        free = answer > 0
        stopping = (goes - motion.change) / torch.where(free, answer, 1.0) * free
        normal = rotate(quat, quat.new_tensor([0.0, 1.0, 0.0]).expand_as(quat[..., 1:]))
        across = dot(stopping, normal) * normal
        along = stopping - across
        whole = inside.sum(-2, keepdim=True)
        share = inside / torch.where(whole > 0, whole, 1.0)
        most = 2 * values["mu"] * values["squeeze"] * share
        size = safe_norm(along)
        held = along * torch.where(size > most, most / torch.where(size > 0, size, 1.0), 1.0)
        closed = (values["squeeze"] > 0).to(inside.dtype)
        force = held + closed * inside * across
        own = force.new_tensor([[float(j == self.hand)] for j in range(hand.pos.shape[-2])])
        torque = cross(lever, force).sum(-2, keepdim=True)
        return ContactForces(force, -own * force.sum(-2, keepdim=True), -own * torque)
