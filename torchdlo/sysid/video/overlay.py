"""How a simulated rope overlaps with the masks of its films, and pictures of both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from torchdlo.sysid.estimation.observation import by_camera, seen_by
from torchdlo.sysid.estimation.result import Overlay
from torchdlo.sysid.video.footage import RANGES
from torchdlo.vision.boundary import boundary_f, wide_areas
from torchdlo.vision.camera import NEAR
from torchdlo.vision.rasterizer import coverage, successors
from torchdlo.vision.segment import left_out, load_ranges
from torchdlo.vision.spine import curve_vectors

if TYPE_CHECKING:
    from torchdlo.sysid.video.filmed_problem import FilmedProblem

__all__ = ["drawn_masks", "hidden_area", "mask_overlaps", "overlays"]

_FOLLOWED = 0.9
"""Share of what masks reach that a simulated rope has to sweep to tell what is hidden."""


def drawn_masks(
    own: FilmedProblem, view: int, sims: np.ndarray, numbers: np.ndarray, frames: np.ndarray, radius: float, trial: int
) -> np.ndarray:
    """Return the masks of a simulated trial in some pictures of a view, shares that are covered, (N, H, W) float32.

    Args:
        own: the problem.
        view: which of its views.
        sims: places of the rope [m], shape (T, M, 3).
        numbers: those of all cameras, shape (Q,).
        frames: which pictures, shape (N,).
        radius: of the rope in the middle of the masks [px].
        trial: number of the trial, whose masks say how much of the rope grippers hide.
    """
    seen = own.spines.views[view]
    camera = torch.as_tensor(by_camera(own.spines.views, numbers[None])[view], dtype=torch.float32)
    seen = seen.picked(np.array([trial]))
    with torch.no_grad():
        place = torch.as_tensor(sims[None, None], dtype=torch.float32)
        pixel, depth, _ = seen_by(seen, place, camera, own.spines.step)
        pixel, depth = pixel[0, 0, frames], depth[0, 0, frames]
        near = depth.clamp(min=NEAR)
        wide = radius * near.median() / near
        points = torch.as_tensor(seen.places[0, frames], dtype=torch.float32)
        cut, shown = _without_grippers(pixel, points, radius)
        size = (seen.camera.height, seen.camera.width)
        return coverage(cut, wide, shown & (depth >= NEAR), successors([pixel.shape[-2]]), size).numpy()


def _without_grippers(pixel: torch.Tensor, points: torch.Tensor, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a rope's pixels (N, M, 2) that begin and end where the mask does, and which of them can be seen, (N, M).

    Grippers hide a piece of rope at its ends that is the same in all pictures: where centre lines (N, S, 2) end in the
    pictures that show most of it.
    """
    last = pixel.shape[-2] - 1
    _, along = curve_vectors(pixel, points.nan_to_num(1e6))
    along = torch.where(torch.isfinite(points).all(-1), along, torch.nan)
    edge = torch.linalg.vector_norm(pixel.diff(dim=-2), dim=-1).median().clamp(min=1e-3)
    inset = radius / float(edge)
    low = float(np.nanquantile(np.nanmin(along.numpy(), 1), 0.1)) - inset
    high = float(np.nanquantile(np.nanmax(along.numpy(), 1), 0.9)) + inset
    low, high = max(low, 0.0), min(high, float(last))
    number = torch.arange(last + 1)
    first, final = int(low), int(np.ceil(high))
    cut = pixel.clone()
    cut[:, first] = torch.lerp(pixel[:, first], pixel[:, min(first + 1, last)], low - first)
    cut[:, final] = torch.lerp(pixel[:, final], pixel[:, max(final - 1, 0)], final - high)
    return cut, ((number >= first) & (number <= final)).expand(pixel.shape[:-1])


def mask_overlaps(own: FilmedProblem, sims: np.ndarray, numbers: np.ndarray) -> list[tuple[float, float]]:
    """Return how simulated and measured masks agree by trial, mean over good pictures and views.

    Args:
        own: the problem; ropes are drawn as thick as masks are, which depends on where colours were cut off.
        sims: places of the rope [m], shape (B, T, M, 3).
        numbers: those of all cameras, shape (Q,).

    Returns:
        Intersection over union, and `boundary_f`, of each trial, where nothing hides the rope.
    """
    parts: list[list[tuple[float, float]]] = [[] for _ in own.trials]
    for k, view in enumerate(own.spines.views):
        seen = ~hidden_area(own, k, sims, numbers)
        for b in range(len(own.trials)):
            frames = np.flatnonzero(view.good[b])
            frames = frames[:: max(1, len(frames) // 24)]
            measured = view.masks(b, frames) & seen
            model = (drawn_masks(own, k, sims[b], numbers, frames, view.half_width, b) > 0.5) & seen
            # How thick a mask is depends on where its colours were cut off: ropes are drawn as thick as it is.
            wide = view.half_width * np.clip(
                np.median(measured.sum((1, 2)) / np.maximum(model.sum((1, 2)), 1)), 0.6, 1.6
            )
            model = (drawn_masks(own, k, sims[b], numbers, frames, wide, b) > 0.5) & seen
            both, either = (model & measured).sum((1, 2)), (model | measured).sum((1, 2))
            edges = np.mean([boundary_f(a, c) for a, c in zip(model, measured, strict=True)])
            parts[b].append((float(np.mean(both / np.maximum(either, 1))), float(edges)))
    return [(float(share), float(edges)) for share, edges in (np.mean(each, 0) for each in parts)]


def hidden_area(own: FilmedProblem, view: int, sims: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return where something in front hides the rope in a view, shape (H, W) bool.

    Rectangles that are left out of masks, and areas that the simulated rope sweeps while no mask ever reaches into
    them. Strips that are not wider than the rope do not count: those are errors of the simulation; nor does any area if
    it does not follow the masks elsewhere.
    """
    seen = own.spines.views[view]
    swept, reached = (np.zeros((seen.camera.height, seen.camera.width), bool) for _ in range(2))
    for b in range(len(own.trials)):
        for frames in np.array_split(np.flatnonzero(seen.good[b]), 4):
            if len(frames):
                swept |= (drawn_masks(own, view, sims[b], numbers, frames, seen.half_width, b) > 0.5).any(0)
                reached |= seen.masks(b, frames).any(0)
    follows = (swept & reached).sum() >= _FOLLOWED * reached.sum()
    out = wide_areas(swept & ~reached & follows, 2 * round(seen.half_width) + 3)
    file = own.model.recording.path / RANGES
    return out | left_out(load_ranges(file), out.shape) if file.is_file() else out


def overlays(own: FilmedProblem, split: str, sims: np.ndarray, numbers: np.ndarray) -> list[Overlay]:
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
            cameras = torch.as_tensor(by_camera(own.spines.views, numbers)[k], dtype=torch.float32)
            pixel = seen_by(view, both, cameras, own.spines.step)[0].numpy()
        for b, trial in enumerate(own.trials):
            for frame, shown in view.shown[b].items():
                title = f"{trial.name}, camera {view.camera.name}, {view.time[b, frame]:.2f} s"
                out.append(Overlay(title, split, shown, pixel[0, b, frame], pixel[1, b, frame]))
    return out
