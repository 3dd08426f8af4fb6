"""What is measured of a simulated rope, as lengths: markers themselves, or what films show of it.

An observation reads simulated places of the rope and numbers of its own that need no simulation, and says what the
readings should be. A reading is a length in metres whatever it comes from, so that knees, floors and intervals mean the
same for all of them. A film's readings are distances in the picture between the centre line of a mask and the projected
rope, both ways, times depth over focal length, with target 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchdlo.physics.effects.base import Param
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace
from torchdlo.vision.camera import NEAR, Camera, Lens, lens, project
from torchdlo.vision.spine import curve_vectors

__all__ = [
    "FilmView",
    "MarkerObservation",
    "Observation",
    "Spines",
    "by_camera",
    "nuisances",
    "over_time",
    "own_clocks",
    "unfitted_clocks",
]


Pairs = tuple[Tensor, Tensor]
"""Edges of the rope that points of a centre line belong to, and points that places of the rope belong to."""


class Observation(Protocol):
    """Something that is measured of the rope."""

    target: np.ndarray
    """What readings should be [m], NaN where nothing was measured; shape (B, F, R, C)."""
    extent: float
    """How far what is measured moves [m]."""
    nuisances: ParameterSpace
    """Numbers of its own, which need no simulation: a camera's pose for instance."""

    def read(self, sims: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return readings [m], shape (P, B, F, R, C).

        Args:
            sims: simulated places of the rope [m], shape (P, B, T, M, 3).
            numbers: values of the nuisances, shape (P, Q).
        """
        ...


@dataclass(frozen=True, eq=False)
class MarkerObservation:
    """Markers: what is simulated is what is measured."""

    target: np.ndarray
    """Measured markers [m], NaN where not seen, shape (B, F, M, 3)."""
    extent: float
    """Largest range of a coordinate [m]."""
    nuisances: ParameterSpace = field(default_factory=lambda: ParameterSpace((), (), ()))
    """None."""

    def read(self, sims: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return the simulated markers."""
        del numbers
        return sims


@dataclass(frozen=True, eq=False)
class FilmView:
    """What one camera saw of all trials."""

    camera: Camera
    """The camera as given."""
    good: np.ndarray
    """Frames that can be trusted, shape (B, F) bool."""
    places: np.ndarray
    """Points of the masks' centre lines [px], NaN where there are fewer, shape (B, F, S, 2)."""
    tangents: np.ndarray
    """Unit tangents there, shape (B, F, S, 2)."""
    half_width: float
    """Usual half width of the rope in the masks [px]."""
    packed: tuple[np.ndarray, ...] = ()
    """By trial: masks, eight pixels a byte, shape (F, H W / 8) uint8."""
    shown: tuple[dict[int, np.ndarray], ...] = ()
    """By trial: some pictures by their frames, grey, (H, W) uint8 each."""
    late: np.ndarray | float = 0.0
    """By how much films began later than the camera's `start` [s], shape (B,)."""
    clocks: tuple[str, ...] = ("",)
    """Names of clocks that are fitted: one of all films, or, of films that were begun by hand, one of each."""
    clock: np.ndarray | int = 0
    """Which of these each film has, -1 for none of them, shape (B,)."""
    off: np.ndarray | float = 0.0
    """What clocks of films are off that are not fitted with the rope [s], shape (B,)."""

    def masks(self, trial: int, frames: np.ndarray) -> np.ndarray:
        """Return the masks of frames (N,) of a trial, shape (N, H, W) bool."""
        height, width = self.camera.height, self.camera.width
        bits = np.unpackbits(self.packed[trial][frames], axis=1, count=height * width)
        return bits.reshape(len(frames), height, width).astype(bool)

    def picked(self, rows: np.ndarray) -> FilmView:
        """Return what was seen of these trials, in their order, repeated as given."""
        packed, shown = (tuple(part[b] for b in rows) if part else () for part in (self.packed, self.shown))
        names = ("good", "places", "tangents", "late", "clock", "off")
        own: dict[str, Any] = {n: x[rows] for n in names if np.ndim(x := getattr(self, n))}
        return replace(self, packed=packed, shown=shown, **own)

    def shortened(self, seconds: float) -> FilmView:
        """Return what was seen in the first seconds."""
        inside = self.time <= seconds
        count = max(1, int(inside.sum(1).max()))
        good, places, tangents = self.good[:, :count], self.places[:, :count], self.tangents[:, :count]
        if not inside[:, :count].all():
            # Of cameras that began earlier than others what is too late has no centre line.
            places = np.where(inside[:, :count, None, None], places, np.nan)
        return replace(self, good=good, places=places, tangents=tangents)

    @property
    def first(self) -> np.ndarray:
        """When the first pictures that count were taken [s], shape (B,); infinite where none was."""
        return np.where(self.good, self.time, np.inf).min(1)

    @property
    def time(self) -> np.ndarray:
        """Middles of exposures, as clocks have them that are not off [s], shape (B, F)."""
        trials, frames = self.good.shape
        begun = self.camera.start + self.late + self.off + np.zeros(trials)
        return begun[:, None] + np.arange(frames) / self.camera.fps

    @property
    def numbers(self) -> int:
        """How many numbers of the camera are fitted: pose, focal length and clocks."""
        return POSE + len(self.clocks)


_PRIORS = (
    *((f"turn_{axis}", np.radians(1.0), "rad") for axis in "xyz"),
    *((f"shift_{axis}", 1e-2, "m") for axis in "xyz"),
    ("zoom", 1e-2, "1"),
)
"""Numbers of a camera, and how far calibrations are usually off: standard deviations."""


def nuisances(views: Sequence[FilmView]) -> ParameterSpace:
    """Return pose, focal length and clocks of every camera as coordinates, in units of how far off they may be."""
    names, params, sizes = [], [], []
    for view in views:
        clocks = [(f"clock.{name}" if name else "clock", half_a_picture(view), "s") for name in view.clocks]
        for name, size, unit in (*_PRIORS, *clocks):
            names.append(f"camera_{view.camera.name}.{name}")
            params.append(Param(0.0, -5 * size, 5 * size, unit, "linear", None, "off what the calibration says"))
            sizes.append(size)
    return ParameterSpace(tuple(names), tuple(params), tuple(sizes))


POSE = len(_PRIORS)
"""Numbers of a camera before those of its clocks."""


def half_a_picture(view: FilmView) -> float:
    """Return how far clocks are usually off [s]: when in the time of a picture a film was begun."""
    return 0.5 / view.camera.fps


def own_clocks(names: Sequence[str]) -> dict[str, Any]:
    """Return clocks of a view of trials with these names, each film having its own."""
    return {"clocks": tuple(names), "clock": np.arange(len(names))}


def unfitted_clocks(views: Sequence[FilmView], fitted: Sequence[FilmView]) -> list[FilmView]:
    """Return views of trials that are judged by numbers of others.

    A clock that all films have is theirs, too; clocks of single films say nothing of theirs.
    """
    pairs = zip(views, fitted, strict=True)
    return [replace(v, clocks=w.clocks, clock=0 if w.clocks == ("",) else -1) for v, w in pairs]


_Numbers = TypeVar("_Numbers", np.ndarray, Tensor)


def by_camera(views: Sequence[FilmView], numbers: _Numbers) -> list[_Numbers]:
    """Return the numbers of each camera, of those of all of them, shape (..., Q)."""
    ends = np.cumsum([v.numbers for v in views])
    return [numbers[..., end - v.numbers : end] for v, end in zip(views, ends, strict=True)]


def over_time(sims: Tensor, step: float, time: Tensor) -> Tensor:
    """Return positions (P, B, T, M, 3), evenly in time by `step` [s], at times (P, B, F), cubic; (P, B, F, M, 3)."""
    last = sims.shape[2] - 1
    at = (time / step).clamp(0.0, last)
    first = at.floor().clamp(max=last - 1)
    x = (at - first)[..., None, None]
    index = first.long()
    sets, trials = (torch.arange(n) for n in sims.shape[:2])
    rows, columns = sets[:, None, None], trials[:, None]
    a, b, c, d = (sims[rows, columns, (index + k).clamp(0, last)] for k in (-1, 0, 1, 2))
    # Catmull and Rom's spline.
    return b + 0.5 * x * (c - a + x * (2 * a - 5 * b + 4 * c - d + x * (3 * (b - c) + d - a)))


def seen_by(view: FilmView, sims: Tensor, numbers: Tensor, step: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return pixels (P, B, F, M, 2), depths (P, B, F, M) [m], and focal lengths (P,) [px], of a rope in a view.

    Args:
        view: the camera and its clock.
        sims: positions [m], shape (P, B, T, M, 3).
        numbers: those of the camera, shape (P, 7 + C) for C clocks.
        step: time between simulated frames [s].
    """
    none = numbers.new_zeros(len(numbers), 1)
    clocks = torch.cat([numbers[:, POSE:], none], 1)[:, np.full(len(view.good), view.clock)]
    time = torch.as_tensor(view.time, dtype=sims.dtype) + clocks[..., None]
    points = over_time(sims, step, time)
    given = lens([view.camera], sims.dtype)
    given = Lens(*(x.expand(len(sims), *x.shape[1:]) for x in vars(given).values()))
    moved = given.moved(numbers[:, :3], numbers[:, 3:6], numbers[:, 6])
    pixel, depth = project(moved, points.flatten(1, 3))
    focal = 0.5 * (moved.intrinsics[:, 0, 0] + moved.intrinsics[:, 1, 1])
    return pixel.reshape(*points.shape[:-1], 2), depth.reshape(points.shape[:-1]), focal


_ALONG = 12.0
"""Distance along the centre line from which places of the rope count less that it does not reach [px]."""

_COPIES = 16
"""How often a prior is read, so that each reading of it stays small."""

_TOGETHER = 1_000_000
"""Numbers of motions that are read at once: fewer calls, and what they make stays small."""

SURE = 5e-4
"""What independent readings get wrong [m], against which priors are weighed."""

INDEPENDENT = 2.0
"""Readings of a picture that tell something of their own."""


class _Filmed:
    """What observations of films have in common: views, priors, and the target 0."""

    def __init__(self, views: Sequence[FilmView], step: float, extent: float, sure: float) -> None:
        self.views, self.step, self.extent, self.sure = tuple(views), step, extent, sure
        self.nuisances = nuisances(views)
        self.target: np.ndarray = np.empty(0)
        self.times: np.ndarray = np.empty(0)
        """When readings are taken [s], of priors 0, shape (B, F, R)."""
        self.priors, self._copies = slice(0, 0), _COPIES

    def _finish(self, shape: tuple[int, ...], known: list[np.ndarray]) -> None:
        """Set the target: 0 where something was measured, and one reading of the priors per trial."""
        trials, frames = shape
        target = np.concatenate([np.where(k, 0.0, np.nan) for k in known], 2)
        count = np.isfinite(target).sum((1, 2, 3))
        pictures = sum(v.good.sum(1) for v in self.views)
        # A squared reading counts one of `count`; a trial tells as much as `INDEPENDENT` readings per picture.
        share = count / np.maximum(INDEPENDENT * pictures * trials, 1)
        self.priors = slice(target.shape[2], None)
        # Copies lie in as many frames as there are: readings are kept for all frames.
        self._copies = -(-_COPIES // min(frames, _COPIES))
        rows = -(-_COPIES // self._copies)
        self._weight = self.sure * np.sqrt(share / (self._copies * rows))
        prior = np.full((trials, frames, self._copies * len(self.nuisances.names), 1), np.nan)
        prior[:, :rows] = 0.0
        self.target = np.concatenate([target, prior], 2)
        taken = np.zeros(self.target.shape[:3])
        ends = np.cumsum([k.shape[2] for k in known])
        for view, last, each in zip(self.views, ends, known, strict=True):
            time = view.time
            taken[:, : time.shape[1], last - each.shape[2] : last] = time[..., None]
        self.times = taken

    def _priors(self, numbers: np.ndarray, frames: int) -> np.ndarray:
        """Return readings of the priors, shape (P, B, F, R, 1)."""
        own = np.tile(numbers / self.nuisances.units, self._copies)
        out = self._weight[None, :, None] * own[:, None]
        return np.broadcast_to(out[:, :, None, :, None], (*out.shape[:2], frames, out.shape[2], 1))

    def read(self, sims: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return readings [m], see `Observation`."""
        out = []
        for row, own in zip(sims, numbers, strict=True):  # one at a time: they are large
            parts = []
            for k, (view, camera) in enumerate(zip(self.views, self._cameras(own[None]), strict=True)):
                with torch.no_grad():
                    parts.append(self._view(k, view, torch.as_tensor(row[None], dtype=torch.float32), camera))
            frames = self.target.shape[1]
            short = [np.pad(p, ((0, 0), (0, 0), (0, frames - p.shape[2]), (0, 0), (0, 0))) for p in parts]
            out.append(np.concatenate([*short, self._priors(own[None], frames)], 3)[0])
        return np.stack(out)

    def _cameras(self, numbers: np.ndarray) -> list[Tensor]:
        return [torch.as_tensor(own, dtype=torch.float32) for own in by_camera(self.views, numbers)]

    def _view(self, k: int, view: FilmView, sims: Tensor, numbers: Tensor) -> np.ndarray:
        raise NotImplementedError


class Spines(_Filmed):
    """Distances between centre lines and the projected rope, both ways."""

    def __init__(
        self, views: Sequence[FilmView], step: float, extent: float, free: np.ndarray, sure: float = SURE
    ) -> None:
        """Prepare.

        Args:
            views: what cameras saw.
            step: time between simulated frames [s].
            extent: how far the rope moves [m].
            free: which of the simulated places may be visible, shape (M,) bool.
            sure: what independent readings get wrong [m].
        """
        super().__init__(views, step, extent, sure)
        self.free, self.count_free = free, int(free.sum())
        self._free = torch.as_tensor(free)
        frames = max(v.good.shape[1] for v in views)
        known = []
        for view in views:
            seen = np.isfinite(view.places) & view.good[:, :, None, None]
            rope = np.broadcast_to(
                (view.good & np.isfinite(view.places).any((2, 3)))[:, :, None, None], (*view.good.shape, free.sum(), 1)
            )
            each = np.concatenate([seen.reshape(*seen.shape[:2], -1, 1), rope], 2)
            known.append(np.pad(each, ((0, 0), (0, frames - each.shape[1]), (0, 0), (0, 0))))
        self._finish((len(views[0].good), frames), known)

    def _view(self, k: int, view: FilmView, sims: Tensor, numbers: Tensor) -> np.ndarray:
        return self._pairs(view, sims, numbers)[0]

    def paired(self, sims: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, list[Pairs]]:
        """Return readings of one motion, as `read` does, shape (1, B, F, R, 1), and which points belong together.

        Args:
            sims: simulated places of the rope [m], shape (1, B, T, M, 3).
            numbers: those of the cameras, shape (1, Q).
        """
        found = self._all_views(sims, numbers, [None] * len(self.views))
        return found[0], found[1]

    def beside(self, pairs: Sequence[Pairs], sims: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return readings of motions near one whose points were paired, shape (P, B, F, R, 1).

        Which points belong together is kept: differences are those of finite differences, at a tenth of the time.
        """
        out = np.empty((len(sims), *self.target.shape))
        step = max(1, _TOGETHER // max(1, sims[0].size)) if len(sims) else 1
        for k in range(0, len(sims), step):
            part = slice(k, k + step)
            out[part] = self._all_views(sims[part], numbers[part], pairs)[0]
        return out

    def changes(self, sims: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return readings of several motions near the first one, as `read` does, shape (P, B, F, R, 1)."""
        first, pairs = self.paired(sims[:1], numbers[:1])
        return np.concatenate([first, self.beside(pairs, sims[1:], numbers[1:])])

    def _all_views(
        self, sims: np.ndarray, numbers: np.ndarray, pairs: Sequence[Pairs | None]
    ) -> tuple[np.ndarray, list[Pairs]]:
        rope, parts, used = torch.as_tensor(sims, dtype=torch.float32), [], []
        for k, (view, own) in enumerate(zip(self.views, self._cameras(numbers), strict=True)):
            with torch.no_grad():
                each, found = self._pairs(view, rope, own, pairs[k])
            gap = self.target.shape[1] - each.shape[2]
            parts.append(np.pad(each, ((0, 0), (0, 0), (0, gap), (0, 0), (0, 0))))
            used.append(found)
        return np.concatenate([*parts, self._priors(numbers, self.target.shape[1])], 3), used

    def _pairs(
        self, view: FilmView, sims: Tensor, numbers: Tensor, pairs: Pairs | None = None
    ) -> tuple[np.ndarray, Pairs]:
        """Return readings (P, B, F, R, 1) of a view, and which edges and points belong together, or use given ones."""
        pixel, depth, focal = seen_by(view, sims, numbers, self.step)
        scale = depth.clamp(min=NEAR).mean(-1, keepdim=True) / focal.reshape(-1, 1, 1, 1)
        places = torch.as_tensor(view.places, dtype=sims.dtype).nan_to_num(1e6)[None]
        if pairs is None:
            away, along = curve_vectors(pixel, places)
            # A trial whose simulation failed has no places; the others go on.
            edge = along.nan_to_num(0.0).floor().long().clamp(0, pixel.shape[-2] - 2)
        else:
            edge = pairs[0].expand(len(sims), *pairs[0].shape[1:])
            away = _to_edges(pixel, places, edge)
        away = torch.where(torch.as_tensor(np.isfinite(view.places))[None], away, 0.0) * scale[..., None]
        rope = pixel[..., self._free, :]
        if pairs is None:
            spots, exact = places.expand(*rope.shape[:3], *places.shape[-2:]), "donot_use_mm_for_euclid_dist"
            best = torch.cdist(rope, spots, compute_mode=exact).argmin(-1)[..., None]
        else:
            best = pairs[1].expand(len(sims), *pairs[1].shape[1:])
        both = best.expand(*best.shape[:-1], 2)
        gap = rope - torch.gather(places.expand(*both.shape[:3], *places.shape[-2:]), -2, both)
        tangents = torch.as_tensor(view.tangents, dtype=sims.dtype).nan_to_num(0.0)[None]
        along = torch.gather(tangents.expand(*both.shape[:3], *tangents.shape[-2:]), -2, both)
        lengthways = (gap * along).sum(-1)
        across = gap[..., 0] * along[..., 1] - gap[..., 1] * along[..., 0]
        across = (across / (1 + (lengthways / _ALONG) ** 2)).clamp(-1e5, 1e5) * scale
        out = torch.cat([away.flatten(-2), across], -1)[..., None]
        return out.numpy().astype(np.float64), (edge, best)


def _to_edges(curve: Tensor, places: Tensor, edge: Tensor) -> Tensor:
    """Return vectors (..., S, 2) from places (..., S, 2) to the nearest points of given edges (..., S) of a curve."""
    both = edge[..., None].expand(*edge.shape, 2)
    a, b = (torch.gather(curve, -2, both + k) for k in (0, 1))
    d, off = b - a, places - a
    t = ((off * d).sum(-1) / d.square().sum(-1).clamp(min=1e-18)).clamp(0.0, 1.0)
    return t[..., None] * d - off
