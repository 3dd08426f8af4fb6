"""Where to put a camera, and how to move the grippers: what films from there would tell of the rope.

Places of a camera are compared for the motion that was recorded (`second_view`), and for the motions of a menu. Those
are ranked by the geometric mean of the standard deviations of the parameters, which is the criterion D of optimal
design (Pukelsheim 1993, doi:10.1137/1.9780898719109), or by how large named effects have to be to show.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.budget import model_options
from torchdlo.sysid.estimation.observation import FilmView
from torchdlo.sysid.estimation.result import result_json, versions
from torchdlo.sysid.experiment_design import excitation_motions
from torchdlo.sysid.experiment_design.design import motion_text
from torchdlo.sysid.experiment_design.excitation_motions import ExcitationMotion
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.trivial_predictors import catenary
from torchdlo.sysid.video.filmed_problem import filmed_problem, first_frames, start_of
from torchdlo.sysid.video.second_view import (
    SecondView,
    effect_notes,
    number_notes,
    second_view,
    second_view_json,
    visible,
)
from torchdlo.sysid.video.view_information import (
    CameraInformation,
    ExpectedInformation,
    MotionVariations,
    SimulatedTrials,
    camera_information,
    camera_places,
    doses_of,
    told,
    varied,
)
from torchdlo.vision.camera import Camera, looking_at

__all__ = [
    "CameraDesign",
    "CameraPlacement",
    "camera_json",
    "camera_summary",
    "nominal_camera",
    "place_cameras",
    "recorded_notes",
]

Callback = Callable[[str, int, int, str], None]

_TRIALS = 3
"""Most recorded trials for whose motion places are compared."""

_SECONDS = 3.0
"""Most seconds of each, of which `second_view` looks at the first 60 %."""


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
    """Geometric mean of the standard deviations in coordinates, along the principal axes [1]; where effects are named,
    times as large as tried that the dose has to be which shows least."""


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
    recorded: SecondView | None = None
    """Places of one more camera for the motion that was recorded; None if from none all of the rope is seen."""
    effects: tuple[str, ...] = ()
    """Named effects by which motions and places are ranked; none if by parameters."""
    notes: list[str] = field(default_factory=list)
    """Sentences that a reader should know."""

    @property
    def best(self) -> CameraPlacement:
        """Return what is suggested for one camera."""
        return self.single[0]


def nominal_camera() -> Camera:
    """Return a camera of 640 x 480 pixels that sees 56 degrees, at 30 pictures a second."""
    return looking_at("nominal", [0.0, -1.0, 0.0], [0.0, 0.0, 0.0], focal=600.0)


def place_cameras(
    recording: Recording,
    given: ModelFile,
    *,
    seconds: float = 3.0,
    scale: float = 1.0,
    effects: Sequence[str] = (),
    cameras: Sequence[Camera] = (),
    lens: Camera | None = None,
    callback: Callback | None = None,
) -> CameraDesign:
    """Rank motions and places of a camera by what their films are expected to tell.

    Args:
        recording: which says what grippers can do, and if it has films, which cameras there are.
        given: model that is taken for true, and whose parameters are to be found better.
        seconds: how long the motion may last.
        scale: by what factor it may leave the workspace, and exceed the speeds, of the recording.
        effects: by which places and motions are ranked; the parameters, and all effects for the recorded motion, if
            not given.
        cameras: at hand, of a recording without films.
        lens: camera like which the new one is; the first one at hand if not given, or a nominal one.
        callback: told (stage, steps done, in all, message).

    Raises:
        InputError: The recording is of a rope at rest, or no motion can be simulated.
    """
    begun, report = time.perf_counter(), callback or (lambda *_: None)
    if recording.still:
        raise InputError(f"{recording.path}: expected trials in which grippers move, found photographs.")
    if not (math.isfinite(seconds) and 1.0 <= seconds <= 60.0):
        raise InputError(f"seconds: expected 1 to 60, found {seconds:g}.")
    model = RopeModel(recording, effects=given.effects, **(model_options(recording, None) | given.options))
    for name in effects:
        effect_library.check_known("--effects", name)
        if name in given.effects or not effect_library.applicable(name, recording, model.mesh):
            raise InputError(
                f"--effects {name}: expected effects that can act in {recording.path} and that the model lacks."
            )
    at_hand = [f.camera for f in recording.train[0].films] if recording.filmed else cameras
    own = tuple(replace(camera, start=0.0, starts={}) for camera in at_hand)  # those of another recording
    like = lens or (own[0] if own else nominal_camera())
    recorded = _recorded(recording, given, model, effects, own, like, report)
    rig = _rig(recording, scale)
    motions = excitation_motions.motion_menu(rig, seconds, float(np.linalg.norm(recording.gravity)))
    motions = [g for g in motions if not g.heading]
    trials = [excitation_motions.motion_trial(rig, g, seconds, f"motion_{k}") for k, g in enumerate(motions)]
    menu = _simulation(recording, given, model, trials, seconds)
    varying = varied(menu, given.sizes(model))
    if effects:
        varying = doses_of(menu, varying, effects, lambda k, n: report("simulating motions", k, n, ""))
    around = _Surroundings(model, own, like, tuple(effects))
    single: list[CameraPlacement] = []
    added: list[CameraPlacement] = []
    now: list[CameraPlacement] = []
    for k, motion in enumerate(motions):
        report("placing cameras", k, len(motions), motion.kind)
        moves = motion_text(motion, *excitation_motions.largest_amplitude(rig, motion, seconds))
        rope = varying.picked(np.array([k]))
        if rope.sound.all():
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
        recorded,
        tuple(effects),
        ["Whether something stands between a camera and the rope is not known here."],
    )


def _recorded(
    recording: Recording,
    given: ModelFile,
    model: RopeModel,
    effects: Sequence[str],
    cameras: Sequence[Camera],
    like: Camera,
    report: Callback,
) -> SecondView | None:
    """Return places of one more camera for the recorded motion: the first 60 % of at most 3 s of each trial."""
    count = len(recording.train)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _TRIALS)).round().astype(int))
    trials = [replace(t, markers=catenary(t, recording)) for t in (recording.train[k] for k in chosen)]
    trials = [first_frames([t], math.ceil(_SECONDS / model.dt) + 1)[0] for t in trials]
    # Where films begin in motion is fitted, too; pictures are not looked at.
    longest = max(float(t.time[-1] - t.time[0]) for t in trials)
    blank = np.zeros((len(trials), int(longest * like.fps) + 1, 1, 2))
    views = [FilmView(c, np.ones(blank.shape[:2], bool), blank, blank, 1.0) for c in cameras or (like,)]
    own = filmed_problem(
        recording,
        trials,
        views,
        effects=given.effects,
        values=given.start(model),
        fitted=tuple(given.sizes(model)),
        options=model_options(recording, None) | given.options,
    )
    values = np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))])
    names = list(effects) or visible(recording, model, given.effects)
    return second_view(
        own,
        own.space.to_raw(values),
        names=names,
        ranked=effects,
        cameras=cameras,
        lens=like,
        report=lambda k, n: report("trying effects in the recorded motion", k, n, ""),
    )


def _simulation(
    recording: Recording, given: ModelFile, model: RopeModel, trials: Sequence[Trial], seconds: float
) -> SimulatedTrials:
    """Return trials with the model that is taken for true, begun at rest where grippers are."""
    count = max(3, math.ceil(seconds / model.dt) + 1)
    cut = first_frames(trials, count)
    alone = [replace(t, markers=catenary(t, recording)) for t in cut]
    numbers = dict(zip(model.parameters, map(float, given.start(model)), strict=True))
    options = model_options(recording, None) | given.options
    motion = model.motion(cut)
    frames = min(count, motion.markers.shape[1])
    return SimulatedTrials(recording, given.effects, options, numbers, motion, start_of(model, alone, ()), frames)


def _rig(recording: Recording, scale: float) -> excitation_motions.GripperLimits:
    """Return what the grippers can do; that a rope hangs at rest is told by them alone."""
    filled = [replace(t, markers=catenary(t, recording)) for t in recording.trials("all")]
    train = len(recording.train)
    seen = replace(recording, train=tuple(filled[:train]), test=tuple(filled[train:]))
    return excitation_motions.make_rig(seen, scale)


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """What is the same for all motions."""

    model: RopeModel
    """The rope."""
    cameras: tuple[Camera, ...]
    """Those at hand."""
    like: Camera
    """What a new one is like."""
    effects: tuple[str, ...]
    """Those that rank; none if parameters do."""

    def placements(
        self, motion: ExcitationMotion, moves: str, rope: MotionVariations
    ) -> tuple[list[CameraPlacement], list[CameraPlacement], list[CameraPlacement]]:
        """Return what a motion tells one camera, those at hand with one more, and those alone.

        Args:
            motion: of the grippers.
            moves: the same in words.
            rope: its places, as they are and varied.
        """
        table = self.model.recording.table_height
        lowest = -np.inf if table is None else table + 0.05
        known = [each for c in self.cameras if (each := camera_information(c, rope)).whole]

        def judged(stands: str, films: Sequence[CameraInformation]) -> CameraPlacement:
            found = told(films, rope)
            score = self.score(found)
            return CameraPlacement(motion, moves, tuple(f.camera for f in films), stands, found.deviations, score)

        own = [judged(f"camera {each.camera.name} as it stands", [each]) for each in known]
        new: list[CameraPlacement] = []
        more: list[CameraPlacement] = []
        for camera, where in camera_places(self.like, rope.rope.reshape(-1, 3), lowest):
            each = camera_information(camera, rope)
            if each.whole:
                new.append(judged(where, [each]))
                if known:
                    more.append(judged(f"with one more {where}", [*known, each]))
        together = [judged("the cameras as they stand", known)] if known else []
        return [*own, *sorted(new, key=lambda p: p.score)[:2]], more, together

    def score(self, found: ExpectedInformation) -> float:
        """Return what ranks: the parameters' mean deviation, or the dose of the worst of named effects.

        Infinite where a simulation of a named effect failed: what it shows is not known.
        """
        if not self.effects:
            return found.score
        doses = found.doses(found.noise)
        known = all(math.isfinite(shown) for _, _, shown in found.probes)
        return max(doses[n] for n in self.effects) if known and doses.keys() >= set(self.effects) else math.inf


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
    shows = f"expected deviations {names}"
    if design.effects:
        wanted = ", ".join(n.replace("_", " ") for n in design.effects)
        if not math.isfinite(design.best.score):
            return f"No motion can be recommended: simulations with {wanted} failed in all that were tried."
        shows = f"{wanted} shows best"
    said = f"Move the gripper so that it {best.moves}, and film it from {best.stands}: {shows}."
    if design.now is not None:
        gain = design.now.score / best.score
        said += f" From where the cameras stand, the best motion ({design.now.moves}) tells {gain:.2g} times less." * (
            gain > 1.02
        )
    if design.added:
        gain = best.score / design.added[0].score
        said += f" The cameras as they stand, {design.added[0].stands}, tell {gain:.2g} times more." * (gain > 1.02)
    return said


def recorded_notes(design: CameraDesign) -> list[str]:
    """Return what one more camera would add to the recorded motion, in words."""
    view = design.recorded
    if view is None:
        return ["From no place is all of the recorded motion in the picture."]
    if view.now is None:
        return [
            f"Of places for a first camera, with the recorded motion, {view.best.where} shows the worst effect best."
        ]
    return [*effect_notes(view), *(n for n in number_notes(view) if n.startswith("One more"))]


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
        "effects": list(design.effects),
        "recorded_motion": None if design.recorded is None else second_view_json(design.recorded),
        "recorded_notes": recorded_notes(design),
        "seconds_of_motion": design.seconds,
        "notes": design.notes,
        "file": "motion.npz",
        "seconds": design.duration,
        "versions": versions(),
    }
    return result_json(content)
