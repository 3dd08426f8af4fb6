"""Effects between the rope and its recording: when markers are seen, and where they sit on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchdlo.physics import tree
from torchdlo.physics.effects.base import Effect, EffectKind, Param, Values
from torchdlo.physics.effects.effect_spec import RopeEffectSpec


@tree.struct
class Track:
    """What a simulation says of the markers of one recording."""

    time: Tensor
    """Time since the start, in even steps [s], shape (F,)."""
    pos: Tensor
    """Points of the axis at the markers [m], shape (..., F, M, 3)."""
    director1: Tensor
    """First material directors there [1], shape (..., F, M, 3)."""
    director2: Tensor
    """Second material directors there [1], shape (..., F, M, 3)."""
    gripped: Tensor
    """Which markers are held by a gripper, so that their motion is the input [bool], shape (M,)."""


def _at(x: Tensor, index: Tensor) -> Tensor:
    """Return x (..., F, M, 3) at frames (..., F)."""
    return torch.gather(x, -3, index[..., None, None].expand(*index.shape, *x.shape[-2:]))


def _slopes(x: Tensor) -> Tensor:
    """Return derivatives per frame of (..., F, M, 3), exact for polynomials of degree 4 (five-point formulas)."""
    ends = x.new_tensor([[-25.0, 48.0, -36.0, 16.0, -3.0], [-3.0, -10.0, 18.0, -6.0, 1.0]]) / 12
    first = torch.einsum("ij,...jmc->...imc", ends, x[..., :5, :, :])
    last = -torch.einsum("ij,...jmc->...imc", ends, x[..., -5:, :, :].flip(-3)).flip(-3)
    near, far = x[..., 3:-1, :, :] - x[..., 1:-3, :, :], x[..., 4:, :, :] - x[..., :-4, :, :]
    return torch.cat([first, (8 * near - far) / 12, last], -3)


def interpolate(x: Tensor, frame: Tensor) -> Tensor:
    """Return x (..., F, M, 3) at fractions of frames (..., F).

    Cubic Hermite interpolation: once differentiable, exact for cubics, error O(step^4); frames themselves are exact.
    Before the first and after the last frame x goes on evenly.
    """
    count = x.shape[-3]
    if count < 5:
        raise ValueError(f"track: {count} frames given; interpolation in time needs at least 5")
    batch = torch.broadcast_shapes(x.shape[:-3], frame.shape[:-1])
    x, asked = x.expand(*batch, *x.shape[-3:]), frame.expand(*batch, count)
    frame = asked.clamp(0, count - 1)
    over = (asked - frame)[..., None, None]
    index = frame.detach().floor().clamp(max=count - 2).long()
    s = (frame - index)[..., None, None]
    gradients = _slopes(x)
    start = (1 + 2 * s) * (1 - s).square() * _at(x, index) + s * (1 - s).square() * _at(gradients, index)
    end = s.square() * (3 - 2 * s) * _at(x, index + 1) - s.square() * (1 - s) * _at(gradients, index + 1)
    return start + end + over.clamp(max=0) * gradients[..., :1, :, :] + over.clamp(min=0) * gradients[..., -1:, :, :]


@dataclass(frozen=True)
class TimeDelay(Effect):
    """Free markers lag the log of the grippers: they are seen where the rope was `delay` ago.

    Before the first and after the last frame the rope is taken to move as it does at that frame.
    """

    name: ClassVar[str] = "time_delay"
    kind: ClassVar[EffectKind] = "measurement"
    equation: ClassVar[str] = "marker(t) = rope(t - delay)"
    last: ClassVar[bool] = True
    params: ClassVar[dict[str, Param]] = {
        "delay": Param(0.0, -0.2, 0.2, "s", "linear", 0.0, "Time by which the markers lag the grippers.")
    }
    spec = RopeEffectSpec(
        lambda _: [{"delay": 2e-3}],
        signed=True,
        strength=("delay",),
        experiments={"air_drag": "tap a gripper at the start and at the end: a delay is the same for both"},
    )

    def observe(self, track: Track, values: Values) -> Tensor:
        """Return earlier positions of the free markers."""
        # Counted in frames, so that no delay means exactly the frames.
        late = values["delay"][..., 0] / (track.time[1] - track.time[0])
        frame = torch.arange(track.pos.shape[-3], dtype=track.pos.dtype, device=track.pos.device) - late
        return torch.where(track.gripped[:, None], track.pos, interpolate(track.pos, frame))


@dataclass(frozen=True)
class MarkerOffset(Effect):
    """Free markers sit beside the axis, all to the same side of the rope, and turn with its material."""

    name: ClassVar[str] = "marker_offset"
    kind: ClassVar[EffectKind] = "measurement"
    equation: ClassVar[str] = "marker = axis + offset₀ d₁ + offset₁ d₂; d: directors of the rope's material"
    params: ClassVar[dict[str, Param]] = {
        "offset": Param((0.0, 0.0), -0.03, 0.03, "m", "linear", 0.0, "Offset along the two material directors.")
    }
    spec = RopeEffectSpec(
        lambda s: [{f"offset.{k}": 0.5 * (s.rope.radius or 5e-3)} for k in range(2)],
        signed=True,
        strength=("offset",),
    )

    def observe(self, track: Track, values: Values) -> Tensor:
        """Return the markers beside the axis."""
        offset = values["offset"].unsqueeze(-3)  # frames are one more axis than the rods have
        beside = offset[..., :1] * track.director1 + offset[..., 1:] * track.director2
        return torch.where(track.gripped[:, None], track.pos, track.pos + beside)
