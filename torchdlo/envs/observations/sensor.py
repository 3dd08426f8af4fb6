"""Observations of environments that come from cameras: pictures, masks, depths and clouds of points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdlo.envs.core.episode import Episode, EpisodeState
from torchdlo.envs.observations.pixels import (
    CLOUD,
    CameraRig,
    PointCloud,
    camera_rig,
    render_cameras,
    rope_points,
    views,
)
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.vision.look import Look

__all__ = ["Sensor", "sensor_of"]


@dataclass(frozen=True, eq=False)
class Sensor:
    """What cameras add to the observations of an environment."""

    rig: CameraRig
    samples: int = 4
    """Per pixel, 1 or 4."""
    shadow: int = 512
    """Texels of the map of shadows along each side, 0 for none."""
    pixels: bool = True
    """Whether there are pictures: ("pixels", camera), uint8, (..., H, W, 3)."""
    masks: bool = False
    """Whether there are masks: ("masks", camera), int16, (..., H, W); numbers as in `vision.renderer`."""
    depth: bool = False
    """Whether there are depths: ("depth", camera), float32 [m], (..., H, W), infinite where nothing is."""
    points: bool | PointCloud = False
    """Whether there are points of ropes, "points", float32 [m], (..., 384, 3), or what makes them."""
    random: bool = False
    """Whether looks are drawn at every reset."""

    def shapes(self) -> dict[str, tuple[tuple[str, ...], tuple[int, ...], torch.dtype]]:
        """Return the kinds of observations: names of their cameras (none: one for all), shapes and dtypes."""
        (width, height), names = self.rig.size, tuple(c.name for c in self.rig.cameras)
        found = {
            "pixels": (names, (height, width, 3), torch.uint8),
            "masks": (names, (height, width), torch.int16),
            "depth": (names, (height, width), torch.float32),
            "points": ((), (CLOUD, 3), torch.float32),
        }
        return {kind: value for kind, value in found.items() if getattr(self, kind)}

    def observe(self, world: EpisodeState, looks: Sequence[Look]) -> dict[str, dict[str, Tensor] | Tensor]:
        """Return the observations of a batch of scenes, on the CPU and without gradients."""
        rig, points = self.rig, bool(self.points)
        given: dict[str, Any] = {"looks": looks, "samples": self.samples, "shadow": self.shadow}
        asked: dict[str, Any] = {"rgb": self.pixels, "depth": self.depth or points, "ids": self.masks or points}
        seen = render_cameras(rig, world.state, world.joints, **given, **asked)
        parts = {"pixels": seen.rgb, "masks": seen.ids, "depth": seen.depth}
        found: dict[str, dict[str, Tensor] | Tensor] = {}
        for kind in self.shapes():
            if kind != "points":
                found[kind] = {c.name: tree.part(parts[kind])[:, k] for k, c in enumerate(rig.cameras)}
                continue
            make = self.points if callable(self.points) else rope_points
            found[kind] = make(seen, views(rig, world.state, world.joints))
        return found


_CHOICES = ("size", "cameras", "samples", "shadow", "pixels", "masks", "depth", "points", "looks")


def sensor_of(episode: Episode, choices: Mapping[str, Any]) -> Sensor:
    """Return what cameras observe of an episode.

    Args:
        episode: the episode.
        choices: "size" and "cameras" of `pixels.camera_rig`, fields of `Sensor`, and "looks", "usual" or "random".
    """
    unknown = sorted(set(choices) - set(_CHOICES))
    if unknown:
        raise InputError(f"pixels: there is no choice {', '.join(unknown)}; expected some of {', '.join(_CHOICES)}.")
    looks = choices.get("looks", "usual")
    if looks not in ("usual", "random"):
        raise InputError(f"pixels: looks is {looks!r}; expected 'usual' or 'random'.")
    rig = camera_rig(episode, cameras=choices.get("cameras"), size=choices.get("size", 128))
    named = {k: v for k, v in choices.items() if k not in ("size", "cameras", "looks")}
    made = Sensor(rig, random=looks == "random", **named)
    if made.samples not in (1, 4):
        raise InputError(f"pixels: samples is {made.samples!r}; expected 1 or 4 per pixel.")
    if not made.shapes():
        raise InputError("pixels: nothing is to be seen; expected one of pixels, masks, depth or points to be true.")
    return made
