"""What films from places of cameras tell of a rope's parameters, and how large effects have to be to show there.

A motion is simulated once with each number varied, and with small doses of effects. Readings of a camera are lengths,
as in fits: displacements across the rope in the picture, times depth over focal length. They are linear in small
changes, of numbers and doses as of the camera's own pose, focal length and clock, and of how a trial began. What those
nuisances can take up under their priors is lost (Schur complement of the information); cameras share a rope and its
start, so that what one of them cannot tell another may.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from torchdlo.sysid.diagnosis import effect_library, score_test
from torchdlo.sysid.diagnosis.detection_limit import DetectionLimit, ProbedEffect, detection_limits
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace
from torchdlo.sysid.estimation.observation import INDEPENDENT, POSE, SURE, FilmView, nuisances, over_time, seen_by
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start, TrialBatch
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.vision.camera import NEAR, Camera, looking_at

__all__ = [
    "CameraInformation",
    "ExpectedInformation",
    "MotionVariations",
    "SimulatedTrials",
    "camera_information",
    "camera_places",
    "doses_of",
    "told",
    "varied",
]

_AROUND = ((0.0, 8), (35.0, 8), (75.0, 4))
"""Angles above the level [degrees] from which a rope is looked at, and from how many directions around it."""

_MARGIN = 1.1
"""How much farther a camera is than it has to be to see all of the motion."""

_NEAREST = 0.25
"""Least distance of a camera [m]."""

LINE = 0.15
"""What centre lines of masks get wrong [px]."""

_UNKNOWN = math.log(10.0)
"""Standard deviation of the logarithm of what is not known: a factor of ten either way."""

_WIDE = 3.0
"""The same of other numbers, in what counts as much of them."""

_SHIFT = 1e-4
"""By how much the rope is moved to see how pictures of it move [m]."""


@dataclass(frozen=True, eq=False)
class MotionVariations:
    """B trials as they are simulated, and what small changes of numbers, effects and starts change of them."""

    rope: np.ndarray
    """Places of the rope [m], shape (B, T, M, 3)."""
    numbers: np.ndarray
    """What each coordinate of the K numbers changes, per unit [m], shape (K, B, T, M, 3)."""
    space: ParameterSpace
    """Those numbers."""
    step: float
    """Time between simulated frames [s]."""
    free: np.ndarray
    """Which of the places may be seen, shape (M,) bool."""
    doses: np.ndarray
    """What each of D doses of effects changes [m], shape (D, B, T, M, 3)."""
    probes: tuple[tuple[str, dict[str, float]], ...] = ()
    """Those doses: effect and numbers."""
    starts: np.ndarray = field(default_factory=lambda: np.zeros((0, 1, 1, 1, 3)))
    """What numbers of the start of each trial change, per standard deviation [m], shape (J, B, T, M, 3)."""
    frames: tuple[int, ...] = ()
    """True number of frames of each trial; all if not given."""
    _sampled: dict[float, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def count(self) -> int:
        """Numbers and doses."""
        return len(self.numbers) + len(self.doses)

    def at_pictures(self, fps: float) -> np.ndarray:
        """Return all changes at the times of pictures [m], shape (K + D + J, B, F, M, 3)."""
        if fps not in self._sampled:
            time = torch.arange(self.pictures(fps), dtype=torch.float64).expand(1, len(self.rope), -1) / fps
            parts = [p for p in (self.numbers, self.doses, self.starts) if len(p)]
            rows = [over_time(torch.as_tensor(row[None]), self.step, time)[0].numpy() for part in parts for row in part]
            # Of doses whose simulation fails nothing is said.
            self._sampled[fps] = np.nan_to_num(np.stack(rows)) if rows else np.zeros((0, *self.rope.shape))
        return self._sampled[fps]

    def picked(self, rows: np.ndarray) -> MotionVariations:
        """Return some of the trials, each over its own frames."""
        frames = tuple(self.frames[b] for b in rows) if self.frames else ()
        last = max(frames, default=self.rope.shape[1])
        parts = {n: getattr(self, n)[:, rows, :last] for n in ("numbers", "doses", "starts") if len(getattr(self, n))}
        return replace(self, rope=self.rope[rows, :last], **parts, frames=frames, _sampled={})

    @property
    def sound(self) -> np.ndarray:
        """Trials that all simulations of numbers went through, shape (B,) bool."""
        known: np.ndarray = np.isfinite(self.rope).all((1, 2, 3)) & np.isfinite(self.numbers).all((0, 2, 3, 4))
        return known

    def pictures(self, fps: float) -> int:
        """Return how many pictures a camera takes of the longest trial."""
        return int((self.rope.shape[1] - 1) * self.step * fps + 1e-9) + 1


@dataclass(frozen=True, eq=False)
class CameraInformation:
    """What the films of one camera tell."""

    camera: Camera
    """The camera."""
    matrix: np.ndarray
    """Fisher information of numbers, doses, the camera's own numbers and starts, by trial, (B, N, N)."""
    weight: float
    """That of a change by one metre of all places of a rope that is not foreshortened [1/m^2]."""
    readings: float
    """Independent readings: `INDEPENDENT` of each picture that all of a rope is in, fewer of one that shows a part."""
    whole: bool
    """Whether all of the rope is in all of the pictures."""
    pixel: float
    """Length that a pixel is worth at the rope, median [m]."""


def camera_places(own: Camera, points: np.ndarray, lowest: float) -> list[tuple[Camera, str]]:
    """Return cameras around a motion, as near as all of it is in the picture, with words for where they are.

    Args:
        own: camera whose lens and sensor they have.
        points: places of the rope [m], shape (N, 3).
        lowest: least height of a camera [m].
    """
    middle = 0.5 * (points.min(0) + points.max(0))
    size, focal = (own.width, own.height), 0.5 * (own.fx + own.fy)
    half = 0.5 * np.array(size) / focal
    found = []
    for elevation, around in _AROUND:
        for azimuth in np.arange(around) * 360.0 / around:
            a, e = np.radians([azimuth, elevation])
            away = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
            turn = np.array(looking_at("", away.tolist(), [0.0, 0.0, 0.0]).rotation)
            local = (points - middle) @ turn.T
            # A point is in the picture where |x| <= half (distance + z).
            need = float((np.abs(local[:, :2]) / half - local[:, 2:]).max())
            distance = max(_MARGIN * need, _NEAREST)
            eye = middle + distance * away
            if eye[2] < lowest:
                continue
            camera = looking_at("new", eye.tolist(), middle.tolist(), size=size, focal=focal, fps=own.fps)
            where = f"{distance:.2f} m away, {azimuth:.0f}° from x, {elevation:.0f}° above the level"
            found.append((camera, where))
    return found


def camera_information(camera: Camera, motion: MotionVariations) -> CameraInformation:
    """Return what films of a motion tell of its numbers and doses, if one of them is by this camera.

    Where the rope leaves the picture there are no readings.
    """
    trials, count = len(motion.rope), motion.pictures(camera.fps)
    blank = np.zeros((trials, count, 1, 2))
    view = FilmView(replace(camera, start=0.0), np.ones((trials, count), bool), blank, blank, 1.0)
    size = 0.1 * nuisances([view]).units
    rows = np.concatenate([np.zeros((4, len(size))), np.diag(size)])
    ropes = np.repeat(motion.rope[None], len(rows), 0)
    for axis in range(3):
        ropes[1 + axis, ..., axis] += _SHIFT
    with torch.no_grad():
        pixel, depth, focal = (
            x.numpy() for x in seen_by(view, torch.as_tensor(ropes), torch.as_tensor(rows), motion.step)
        )
    here, depth = pixel[0], depth[0]
    inside = (here >= 0).all(-1) & (here <= np.array([camera.width - 1, camera.height - 1])).all(-1)
    seen = inside & (depth > NEAR) & motion.free
    ends = np.array(motion.frames or (motion.rope.shape[1],) * trials)
    running = np.arange(count) / camera.fps <= (ends[:, None] - 1) * motion.step + 1e-9
    whole = bool(seen[running][:, motion.free].all())
    seen &= running[..., None]
    tangent = np.gradient(here, axis=2)
    along = np.linalg.norm(tangent, axis=-1)
    tangent /= along.clip(1e-9)[..., None]
    scale = np.where(seen, depth, 1.0) / focal[0]
    # What is foreshortened covers fewer pixels, and has fewer readings of its own.
    at = torch.as_tensor(view.time[None])
    shapes = over_time(torch.as_tensor(motion.rope[None]), motion.step, at)[0].numpy()
    edge = np.linalg.norm(np.gradient(shapes, axis=2), axis=-1)
    share = (along * scale / edge.clip(1e-9)).clip(max=1.0)
    normal = np.stack([tangent[..., 1], -tangent[..., 0]], -1) * scale[..., None]
    moved = ((pixel[1:] - here) * normal).sum(-1)
    across = np.moveaxis(moved[:3], 0, -1) / _SHIFT
    own = moved[3:] / 0.1
    changes = motion.at_pictures(camera.fps)
    changes = np.einsum("nbfmc,bfmc->nbfm", changes, across)
    every = np.concatenate([changes[: motion.count], own, changes[motion.count :]])
    every = np.where(seen, every, 0.0)
    noise = SURE**2 + (LINE * scale) ** 2
    weight = np.where(seen, INDEPENDENT / motion.free.sum() / noise, 0.0)
    readings = weight * share
    flat = np.moveaxis(every, 1, 0).reshape(trials, len(every), -1)
    matrix = (flat * readings.reshape(trials, 1, -1)) @ flat.transpose(0, 2, 1)
    typical = float(np.median(scale[seen])) if seen.any() else math.inf
    pictures = float(seen.sum() / motion.free.sum())
    return CameraInformation(camera, matrix, float(weight.sum()), INDEPENDENT * pictures, whole, typical)


@dataclass(frozen=True, eq=False)
class ExpectedInformation:
    """What films of one or more cameras tell together."""

    deviations: dict[str, float]
    """By number: expected standard deviation, of the logarithm where the scale is one, else in its unit."""
    score: float
    """Geometric mean of the standard deviations in coordinates, along the principal axes [1]."""
    probes: tuple[tuple[str, dict[str, float], float], ...]
    """Doses: effect, numbers, and what all readings change beyond what all numbers can take up, root mean square [m];
    not a number where that is not known."""
    noise: float
    """What readings get wrong [m]."""

    def limits(self, level: float, recording: Recording) -> dict[str, DetectionLimit]:
        """Return by effect from which size on it changes readings by so much [m]."""
        names = dict.fromkeys(name for name, *_ in self.probes)
        effects = [ProbedEffect(n, tuple((d, shown) for e, d, shown in self.probes if e == n)) for n in names]
        return {limit.name: limit for limit in detection_limits(effects, level, recording)}

    def doses(self, level: float) -> dict[str, float]:
        """Return by effect how many times as large as tried its dose has to be that shows least, to change so much."""
        found: dict[str, float] = {}
        for name, _, shown in self.probes:
            if np.isfinite(shown):
                power = effect_library.spec(name).power
                times = (level / shown) ** (1 / power) if shown > 0 else math.inf
                found[name] = max(found.get(name, 0.0), times)
        return found


def told(cameras: Sequence[CameraInformation], motion: MotionVariations) -> ExpectedInformation:
    """Return what the films of cameras tell together: nuisances take up what they can, and a rope is shared."""
    numbers, count = len(motion.numbers), motion.count
    trials, starts = len(motion.rope), len(motion.starts)
    each = POSE + 1  # a clock of all films
    own = count + each * len(cameras)
    whole = np.zeros((own + trials * starts,) * 2)
    for c, camera in enumerate(cameras):
        for b, part in enumerate(camera.matrix):
            at = np.concatenate(
                [
                    np.arange(count),
                    count + each * c + np.arange(each),
                    own + starts * b + np.arange(starts),
                ]
            )
            whole[np.ix_(at, at)] += part
    shared = np.concatenate([np.arange(numbers), np.arange(count, len(whole))])
    prior = np.ones(len(shared))
    prior[:numbers] = [(_UNKNOWN if p.scale == "log" else _WIDE) ** -2.0 for p in motion.space.params]
    known = whole[np.ix_(shared, shared)] + np.diag(prior)
    spread = np.linalg.inv(known)[:numbers, :numbers]
    mixed = whole[np.ix_(np.arange(numbers, count), shared)]
    left = np.diag(whole)[numbers:count] - np.einsum("dn,nd->d", mixed, np.linalg.solve(known, mixed.T))
    weight = sum(c.weight for c in cameras)
    shown = np.sqrt(left.clip(min=0.0) / max(weight, 1e-300))
    shown = np.where(np.isfinite(motion.doses).all((1, 2, 3, 4)), shown, np.nan)
    deviation = np.sqrt(np.diag(spread)) * motion.space.units
    score = float(np.exp(0.5 * np.linalg.slogdet(spread)[1] / numbers))
    readings = sum(c.readings for c in cameras)
    return ExpectedInformation(
        dict(zip(motion.space.names, map(float, deviation), strict=True)),
        score,
        tuple((name, dose, float(x)) for (name, dose), x in zip(motion.probes, shown, strict=True)),
        math.sqrt(readings / weight) if weight > 0 else math.inf,
    )


@dataclass(frozen=True, eq=False)
class SimulatedTrials:
    """Trials that can be simulated with other numbers, and with more effects."""

    recording: Recording
    """The rope."""
    effects: tuple[str, ...]
    """Those of the model."""
    options: Mapping[str, Any]
    """Of the model."""
    numbers: Mapping[str, float]
    """All of the model's."""
    motion: TrialBatch
    """What grippers do."""
    begin: Start
    """Where trials begin."""
    frames: int
    """How many are simulated."""

    def model(self, more: Sequence[str] = ()) -> RopeModel:
        """Return the model with more effects."""
        return RopeModel(self.recording, effects=(*self.effects, *more), **self.options)

    def run(self, rows: Sequence[Mapping[str, float]], more: Sequence[str] = ()) -> np.ndarray:
        """Return places of the rope [m] with these numbers in the place of the model's, (P, B, T, M, 3)."""
        model = self.model(more)
        known = dict(zip(model.parameters, model.guess(), strict=True)) | {
            name: value for name, value in self.numbers.items() if name in model.parameters
        }
        values = np.array([[(known | dict(row))[name] for name in model.parameters] for row in rows])
        return model.simulate(self.motion, self.begin, values, frames=self.frames)[..., : model.count, :]


def varied(run: SimulatedTrials, sizes: Mapping[str, float]) -> MotionVariations:
    """Return trials with each of the numbers varied that have a size, see `ParameterSpace`; without doses."""
    model = run.model()
    columns = [k for k, name in enumerate(model.parameters) if name in sizes]
    names = tuple(model.parameters[k] for k in columns)
    space = ParameterSpace(names, tuple(model.params[k] for k in columns), tuple(sizes[n] for n in names))
    values = np.array([run.numbers[n] for n in names])
    nudges = space.nudges()
    moved = space.to_values(space.to_raw(values) + np.diag(nudges))
    rows = [{}, *({name: float(moved[k, k])} for k, name in enumerate(names))]
    sims = run.run(rows)
    free = np.ones(model.count, bool)
    free[model.gripped] = False
    changes = (sims[1:] - sims[0]) / nudges[:, None, None, None, None]
    nothing = np.zeros((0, *sims.shape[1:]))
    ends = tuple(min(n, run.frames) for n in run.motion.frames)
    return MotionVariations(sims[0], changes, space, model.dt, free, nothing, starts=nothing, frames=ends)


def doses_of(
    run: SimulatedTrials, motion: MotionVariations, names: Sequence[str], report: Callable[[int, int], None]
) -> MotionVariations:
    """Return trials with small doses of effects as well, those that a diagnosis tries."""
    mesh = run.model().mesh
    curved = score_test.curvature_scale(motion.rope[:, :: max(1, motion.rope.shape[1] // 50)])
    doses = {n: effect_library.perturbations(n, run.recording, mesh, curved, run.numbers) for n in names}
    groups, changes, probes = score_test.groups_of(names, doses), [], []
    report(0, len(groups))
    for done, group in enumerate(groups):
        each = [(name, dict(dose.values)) for name in group for dose in doses[name]]
        sims = run.run([{}, *(numbers for _, numbers in each)], group)
        changes.append((sims[1:] - sims[0]).astype(np.float32))
        probes += each
        report(done + 1, len(groups))
    if not changes:
        return motion
    return replace(motion, doses=np.concatenate(changes), probes=tuple(probes), _sampled={})
