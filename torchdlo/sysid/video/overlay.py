"""How a simulated rope overlaps with the masks of its films, and pictures of both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from torchdlo.sysid.estimation.observation import PER_CAMERA, seen_by
from torchdlo.sysid.estimation.result import Overlay
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.vision.camera import NEAR
from torchdlo.vision.rasterizer import coverage, successors

if TYPE_CHECKING:
    from torchdlo.sysid.video.filmed_problem import Problem

__all__ = ["drawn", "overlaps", "overlays"]


def drawn(
    own: Problem, view: int, sims: np.ndarray, numbers: np.ndarray, frames: np.ndarray, radius: float
) -> np.ndarray:
    """Return the masks of a simulated trial in some pictures of a view, shares that are covered, (N, H, W) float32.

    Args:
        own: the problem.
        view: which of its views.
        sims: places of the rope [m], shape (T, M, 3).
        numbers: those of all cameras, shape (Q,).
        frames: which pictures, shape (N,).
        radius: of the rope [m].
    """
    seen = own.spines.views[view]
    camera = torch.as_tensor(numbers[None, PER_CAMERA * view : PER_CAMERA * (view + 1)], dtype=torch.float32)
    with torch.no_grad():
        place = torch.as_tensor(sims[None, None], dtype=torch.float32)
        pixel, depth, focal = seen_by(seen, place, camera, own.spines.step)
        pixel, depth = pixel[0, 0, frames], depth[0, 0, frames]
        wide = radius * focal / depth.clamp(min=NEAR)
        # Grippers hide what they hold.
        shown = (depth >= NEAR) & torch.as_tensor(own.spines.free)
        size = (seen.camera.height, seen.camera.width)
        return coverage(pixel, wide, shown, successors([pixel.shape[-2]]), size).numpy()


def overlaps(recording: Recording, own: Problem, sims: np.ndarray, numbers: np.ndarray) -> list[float]:
    """Return the intersection over union of simulated and measured masks by trial, mean over good pictures and views.

    Args:
        recording: the rope.
        own: the problem, of which the radius is taken from the masks where the rope's is not known.
        sims: places of the rope [m], shape (B, T, M, 3).
        numbers: those of all cameras, shape (Q,).
    """
    out = []
    for b in range(len(own.trials)):
        parts = []
        for k, view in enumerate(own.spines.views):
            frames = np.flatnonzero(view.good[b])
            frames = frames[:: max(1, len(frames) // 24)]
            radius = recording.radius or view.half_width * 1.2 / view.camera.fx
            measured = view.masks(b, frames)
            model = drawn(own, k, sims[b], numbers, frames, radius) > 0.5
            # How thick a mask is depends on where its colours were cut off: ropes are drawn as thick as it is.
            thick = float(np.clip(measured.sum() / max(model.sum(), 1), 0.6, 1.6))
            model = drawn(own, k, sims[b], numbers, frames, thick * radius) > 0.5
            both, either = (model & measured).sum((1, 2)), (model | measured).sum((1, 2))
            parts.append(float(np.mean(both / np.maximum(either, 1))))
        out.append(float(np.mean(parts)))
    return out


def overlays(own: Problem, split: str, sims: np.ndarray, numbers: np.ndarray) -> list[Overlay]:
    """Return some pictures of each film with the rope before and after.

    Args:
        own: the problem.
        split: train or test.
        sims: places of the rope before and after [m], shape (2, B, T, M, 3).
        numbers: those of all cameras, before and after, shape (2, Q).
    """
    out = []
    for k, view in enumerate(own.spines.views):
        with torch.no_grad():
            both = torch.as_tensor(sims, dtype=torch.float32)
            cameras = torch.as_tensor(numbers[:, PER_CAMERA * k : PER_CAMERA * (k + 1)], dtype=torch.float32)
            pixel = seen_by(view, both, cameras, own.spines.step)[0].numpy()
        for b, trial in enumerate(own.trials):
            for frame, shown in view.shown[b].items():
                title = f"{trial.name}, camera {view.camera.name}, {view.time[frame]:.2f} s"
                out.append(Overlay(title, split, shown, pixel[0, b, frame], pixel[1, b, frame]))
    return out
