"""Where to put a camera, and how to move the grippers: what films from there would tell of the rope's parameters.

A motion is simulated once with each parameter varied; a camera's readings of it are linear in small changes, of the
parameters as of its own pose, focal length and clock. What those nuisances can take up under their priors is lost
(Schur complement of the information), and what is left of several cameras adds up. Places are ranked by the geometric
mean of the standard deviations that are left, which is the criterion D of optimal design (Pukelsheim 1993,
doi:10.1137/1.9780898719109).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import torch

from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis.budget import model_options
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace
from torchdlo.sysid.estimation.observation import INDEPENDENT, PER_CAMERA, SURE, FilmView, nuisances, seen_by
from torchdlo.sysid.estimation.result import result_json, versions
from torchdlo.sysid.experiment_design import excitation_motions
from torchdlo.sysid.experiment_design.design import motion_text
from torchdlo.sysid.experiment_design.excitation_motions import ExcitationMotion
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.trivial_predictors import catenary
from torchdlo.sysid.video.filmed_problem import start_of
from torchdlo.vision.camera import NEAR, Camera, looking_at

__all__ = [
    "CameraDesign",
    "CameraPlacement",
    "camera_json",
    "camera_places",
    "camera_summary",
    "information",
    "place_cameras",
]

Callback = Callable[[str, int, int, str], None]

_AZIMUTHS, _ELEVATIONS = 8, (0.0, 35.0)
"""Directions around the rope, and angles above the level [degrees], from which it is looked at."""

_MARGIN = 1.1
"""How much farther a camera is than it has to be to see all of the motion."""

_NEAREST = 0.25
"""Least distance of a camera [m]."""

_LINE = 0.15
"""What centre lines of masks get wrong [px]."""

_UNKNOWN = math.log(10.0)
"""Standard deviation of the logarithm of what is not known: a factor of ten either way."""


@dataclass(frozen=True, eq=False)
class CameraPlacement:
    """A motion, the cameras that film it, and what they would tell."""

    motion: ExcitationMotion
    """How the grippers move."""
    moves: str
    """The same in words."""
    cameras: tuple[Camera, ...]
    """Cameras; those of the recording have their names."""
    stands: str
    """Where they are, in words."""
    deviations: dict[str, float]
    """By parameter: expected standard deviation, of the logarithm where the scale is one, else in its unit."""
    score: float
    """Geometric mean of the standard deviations in coordinates, along the principal axes [1]."""


@dataclass(frozen=True, eq=False)
class CameraDesign:
    """The film that is suggested next."""

    recording: Recording
    """The films at hand."""
    values: dict[str, float]
    """Parameters that were taken for true."""
    single: list[CameraPlacement]
    """Motions with one camera, best first, each from its best place and those of the recording's cameras."""
    added: list[CameraPlacement]
    """The best motions with the recording's cameras and one more, best first."""
    now: CameraPlacement | None
    """The best motion with the recording's cameras alone; None if they do not see it."""
    trial: Trial
    """The suggested motion, of the grippers."""
    seconds: float
    """How long it lasts."""
    duration: float
    """Time that the search took [s]."""
    notes: list[str] = field(default_factory=list)
    """Sentences that a reader should know."""

    @property
    def best(self) -> CameraPlacement:
        """Return what is suggested for one camera."""
        return self.single[0]


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
    for elevation in _ELEVATIONS:
        for azimuth in np.arange(_AZIMUTHS) * 360.0 / _AZIMUTHS:
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


def information(
    camera: Camera, sims: np.ndarray, steps: np.ndarray, step: float, free: np.ndarray
) -> np.ndarray | None:
    """Return what films of a motion tell of parameters in coordinates, shape (K, K); None where it leaves the picture.

    Args:
        camera: that films.
        sims: places of the rope [m], as it is and with each parameter varied, shape (K + 1, T, M, 3).
        steps: by how much the coordinates were varied, shape (K,).
        step: time between simulated frames [s].
        free: which of the places may be seen, shape (M,) bool.
    """
    frames = int((sims.shape[1] - 1) * step * camera.fps) + 1
    blank = np.zeros((1, frames, 1, 2))
    view = FilmView(replace(camera, start=0.0), np.ones((1, frames), bool), blank, blank, 1.0)
    size = 0.1 * nuisances([view]).units
    rows = np.concatenate([np.zeros((len(sims), PER_CAMERA)), np.diag(size)])
    ropes = torch.as_tensor(np.concatenate([sims, np.repeat(sims[:1], PER_CAMERA, 0)])[:, None])
    with torch.no_grad():
        pixel, depth, focal = (x.numpy() for x in seen_by(view, ropes, torch.as_tensor(rows), step))
    pixel, depth = pixel[:, 0], depth[0, 0]
    here = pixel[0]
    seen = (depth > NEAR) & (here >= 0).all(-1) & (here <= np.array([camera.width - 1, camera.height - 1])).all(-1)
    if not seen[:, free].all():
        return None
    tangent = np.gradient(here, axis=1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True).clip(1e-9)
    scale = depth / focal[0]
    across = (pixel[1:] - here) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    change = ((across * tangent).sum(-1) * scale)[:, :, free].reshape(len(rows) - 1, -1)
    change /= np.concatenate([steps, np.full(PER_CAMERA, 0.1)])[:, None]
    noise = SURE**2 + (_LINE * scale[:, free]) ** 2
    whole = (change * (INDEPENDENT / free.sum() / noise.ravel())) @ change.T
    count = len(steps)
    camera_part = whole[count:, count:] + np.eye(PER_CAMERA)  # their priors
    mixed = whole[:count, count:]
    return np.asarray(whole[:count, :count] - mixed @ np.linalg.solve(camera_part, mixed.T))


def place_cameras(
    recording: Recording,
    given: ModelFile,
    *,
    seconds: float = 3.0,
    scale: float = 1.0,
    callback: Callback | None = None,
) -> CameraDesign:
    """Rank motions and places of a camera by what their films are expected to tell of the parameters.

    Args:
        recording: with films, which say what grippers can do and which cameras there are.
        given: model that is taken for true, and whose parameters are to be found better.
        seconds: how long the motion may last.
        scale: by what factor it may leave the workspace, and exceed the speeds, of the recording.
        callback: told (stage, steps done, in all, message).

    Raises:
        InputError: There are no films, or no motion can be simulated.
    """
    begun, report = time.perf_counter(), callback or (lambda *_: None)
    if recording.still:
        raise InputError(f"{recording.path}: expected films, whose grippers move, found photographs.")
    if not (math.isfinite(seconds) and 1.0 <= seconds <= 60.0):
        raise InputError(f"seconds: expected 1 to 60, found {seconds:g}.")
    model = RopeModel(recording, effects=given.effects, **(model_options(recording, None) | given.options))
    rig = _rig(recording, scale)
    motions = excitation_motions.motion_menu(rig, seconds, float(np.linalg.norm(recording.gravity)))
    motions = [g for g in motions if not g.heading]
    trials = [excitation_motions.motion_trial(rig, g, seconds, f"motion_{k}") for k, g in enumerate(motions)]
    space, sims = _varied(model, given, trials, report)
    around = _Surroundings(space, model, tuple(f.camera for f in recording.train[0].films))
    single: list[CameraPlacement] = []
    added: list[CameraPlacement] = []
    now: list[CameraPlacement] = []
    for k, (motion, trial) in enumerate(zip(motions, trials, strict=True)):
        report("placing cameras", k, len(motions), motion.kind)
        moves = motion_text(motion, *excitation_motions.largest_amplitude(rig, motion, seconds))
        rope = sims[:, k, : len(trial.time)]
        if np.isfinite(rope).all():
            for whole, part in zip((single, added, now), around.placements(motion, moves, rope), strict=True):
                whole += part
    if not single:
        raise InputError(
            f"{recording.path}: the simulation fails in every motion of the menu, or none fits into a picture; try "
            "fewer --seconds or a smaller --scale."
        )
    report("placing cameras", len(motions), len(motions), "")
    single, added, now = (sorted(part, key=lambda p: p.score) for part in (single, added, now))
    return CameraDesign(
        recording,
        dict(zip(model.parameters, map(float, given.start(model)), strict=True)),
        single,
        added[:10],
        now[0] if now else None,
        _of_grippers(trials[motions.index(single[0].motion)]),
        seconds,
        time.perf_counter() - begun,
        ["Whether something stands between a camera and the rope is not known here."],
    )


def _rig(recording: Recording, scale: float) -> excitation_motions.GripperLimits:
    """Return what the grippers can do; that a rope hangs at rest is told by them alone."""
    filled = [replace(t, markers=catenary(t, recording)) for t in recording.trials("all")]
    train = len(recording.train)
    seen = replace(recording, train=tuple(filled[:train]), test=tuple(filled[train:]))
    return excitation_motions.make_rig(seen, scale)


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """What is the same for all motions."""

    space: ParameterSpace
    """The numbers to find."""
    model: RopeModel
    """The rope."""
    cameras: tuple[Camera, ...]
    """Those of the recording."""

    def placements(
        self, motion: ExcitationMotion, moves: str, rope: np.ndarray
    ) -> tuple[list[CameraPlacement], list[CameraPlacement], list[CameraPlacement]]:
        """Return what a motion tells one camera, the recording's with one more, and those alone.

        Args:
            motion: of the grippers.
            moves: the same in words.
            rope: its places as it is and with each number varied [m], shape (K + 1, T, M, 3).
        """
        free = np.ones(self.model.count, bool)
        free[self.model.gripped] = False
        table = self.model.recording.table_height
        lowest = -np.inf if table is None else table + 0.05
        steps, dt = self.space.nudges(), self.model.dt
        mine = [(c, information(c, rope, steps, dt, free)) for c in self.cameras]
        known = [(c, told) for c, told in mine if told is not None]
        own = [_judged(self.space, motion, moves, f"camera {c.name} as it stands", [(c, told)]) for c, told in known]
        new: list[CameraPlacement] = []
        more: list[CameraPlacement] = []
        for camera, where in camera_places(self.cameras[0], rope[0].reshape(-1, 3), lowest):
            told = information(camera, rope, steps, dt, free)
            if told is not None:
                new.append(_judged(self.space, motion, moves, where, [(camera, told)]))
            if told is not None and known:
                more.append(_judged(self.space, motion, moves, f"with one more {where}", [*known, (camera, told)]))
        together = [_judged(self.space, motion, moves, "the cameras as they stand", known)] if known else []
        return [*own, *sorted(new, key=lambda p: p.score)[:2]], more, together


def _varied(
    model: RopeModel, given: ModelFile, trials: Sequence[Trial], report: Callback
) -> tuple[ParameterSpace, np.ndarray]:
    """Return the numbers to find as coordinates, and motions with none and each of them varied, (K + 1, B, T, M, 3)."""
    sizes, values = given.sizes(model), given.start(model)
    columns = [k for k, name in enumerate(model.parameters) if name in sizes]
    space = ParameterSpace(
        tuple(model.parameters[k] for k in columns),
        tuple(model.params[k] for k in columns),
        tuple(sizes[model.parameters[k]] for k in columns),
    )
    raw = space.to_raw(values[columns])
    rows = np.repeat(values[None], len(columns) + 1, 0)
    rows[1:, columns] = space.to_values(raw + np.diag(space.nudges()))
    start = start_of(model, trials, ())
    out = []
    for k, row in enumerate(rows):
        report("simulating motions", k, len(rows), "")
        out.append(model.simulate(model.motion(trials), start, row[None])[0])
    report("simulating motions", len(rows), len(rows), "")
    return space, np.stack(out)


def _judged(
    space: ParameterSpace,
    motion: ExcitationMotion,
    moves: str,
    stands: str,
    told: Sequence[tuple[Camera, np.ndarray]],
) -> CameraPlacement:
    """Return what films of a motion by cameras are expected to tell, from what each tells."""
    prior = np.array([_UNKNOWN if p.scale == "log" else 3.0 for p in space.params]) ** -2.0
    spread = np.linalg.inv(np.sum([each for _, each in told], 0) + np.diag(prior))
    deviation = np.sqrt(np.diag(spread)) * space.units
    score = float(np.exp(0.5 * np.linalg.slogdet(spread)[1] / len(spread)))
    names = dict(zip(space.names, map(float, deviation), strict=True))
    return CameraPlacement(motion, moves, tuple(c for c, _ in told), stands, names, score)


def _of_grippers(trial: Trial) -> Trial:
    """Return a motion with the markers at the grippers alone, as trials beside films have them."""
    gripped = trial.gripped
    parts: dict[str, Any] = {"markers": trial.markers[:, gripped], "marker_arclength": trial.marker_arclength[gripped]}
    if trial.gripper_marker is not None:
        parts["gripper_marker"] = (np.cumsum(gripped) - 1)[np.asarray(trial.gripper_marker)]
    return replace(trial, **parts, gripped=np.ones(int(gripped.sum()), bool))


def camera_summary(design: CameraDesign) -> str:
    """Return the outcome in words."""
    best, names = design.best, ", ".join(f"{n.replace('_', ' ')} {d:.2g}" for n, d in design.best.deviations.items())
    said = f"Move the gripper so that it {best.moves}, and film it from {best.stands}: expected deviations {names}."
    if design.now is not None:
        gain = design.now.score / best.score
        said += f" From where the cameras stand, the best motion ({design.now.moves}) tells {gain:.2g} times less." * (
            gain > 1.02
        )
    if design.added:
        gain = best.score / design.added[0].score
        said += f" The cameras as they stand, {design.added[0].stands}, tell {gain:.2g} times more."
    return said


def camera_json(design: CameraDesign) -> str:
    """Return the design as JSON text."""

    def plain(placement: CameraPlacement) -> dict[str, Any]:
        return {
            "message": placement.moves,
            "motion": vars(placement.motion),
            "place": placement.stands,
            "cameras": [asdict(c) for c in placement.cameras],
            "standard_deviations": placement.deviations,
            "score": placement.score,
        }

    content = {
        "generator": "torchdlo design-experiment",
        "recording": str(design.recording.path),
        "parameters": design.values,
        "placements": [plain(p) for p in design.single],
        "with_one_more": [plain(p) for p in design.added],
        "as_it_stands": None if design.now is None else plain(design.now),
        "seconds_of_motion": design.seconds,
        "notes": design.notes,
        "file": "motion.npz",
        "seconds": design.duration,
        "versions": versions(),
    }
    return result_json(content)
