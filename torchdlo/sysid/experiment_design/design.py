"""The next experiment: the motion of the grippers that tells apart what a recording cannot.

A menu of motions that the laboratory can do is judged by the distance that stays between rival models when each may
adapt (`contest`); the best of it is improved by an evolution strategy with one parent (Rechenberg 1973), and the
leaders are judged again by full fits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis import budget
from torchdlo.sysid.diagnosis import error_floor as floors
from torchdlo.sysid.diagnosis.effect_library import separating_experiment
from torchdlo.sysid.diagnosis.score_test import curvature_scale
from torchdlo.sysid.diagnosis.workspace import Callback, Workspace
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.result import result_json, versions
from torchdlo.sysid.estimation.result_cache import ResultCache
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.experiment_design import competing_models, excitation_motions
from torchdlo.sysid.experiment_design.excitation_motions import KINDS, ExcitationMotion, GripperLimits
from torchdlo.sysid.experiment_design.model_discrimination import ModelDiscrimination, Pair, measured_misfit, rms_size
from torchdlo.sysid.recordings import data_quality
from torchdlo.sysid.recordings.recording import Recording, Trial

__all__ = ["Design", "Option", "design_experiment", "design_json", "design_summary", "rationale"]

TRIALS = 4
"""Most train trials that rivals have to keep explaining."""

COUNT = 10
"""Motions that are tried in each step of the improvement."""

WIDTHS = (1.0, 0.5, 0.25)
"""How different they are from the best one so far, see `motions.near`."""

LEADERS = 2
"""Motions of the menu that are judged by full fits, besides the improved one."""

ITERATIONS = 3
"""Most steps of a rival's fit to what another model shows."""

LEAST_NOISE = 1e-5
"""Noise below this counts as this [m]: no camera sees finer."""


@dataclass(frozen=True, eq=False)
class Option:
    """One motion and what it would tell."""

    gesture: ExcitationMotion
    """The motion."""
    amplitude: float
    """Its amplitude, in `unit`."""
    unit: str
    """"m" or "rad"."""
    estimate: float
    """Expected separation of the worst pair to first order, in units of the marker noise; NaN where a model fails."""
    confirmed: float | None = None
    """The same after full fits; None where that was not done."""
    improved: bool = False
    """Whether it is the outcome of the improvement and not of the menu."""


@dataclass(frozen=True, eq=False)
class Design:
    """The experiment that is suggested."""

    recording: Recording
    """The trials at hand."""
    models: dict[str, Fitted]
    """The rivals by the names of their effects."""
    parameters: dict[str, list[str]]
    """Names of the numbers of each."""
    misfit: dict[str, float]
    """How far each is from the train trials, root mean square per coordinate [m]."""
    noise: float
    """Noise of the markers per coordinate [m], the unit of separations."""
    rig: GripperLimits
    """What the grippers can do."""
    seconds: float
    """How long the motion lasts."""
    present: list[Pair]
    """What is left between each pair in the trials at hand."""
    options: list[Option]
    """All motions that were tried, best first; the first one is the suggestion."""
    pairs: list[Pair]
    """What is left between each pair in the suggested motion."""
    trial: Trial
    """The suggested motion; NaN where free markers will be."""
    duration: float
    """Time that the search took [s]."""
    seed: int = 0
    """Seed of the search."""

    @property
    def separation(self) -> float:
        """Return the expected separation of the worst pair [noise]."""
        return self._worst(self.pairs)

    @property
    def reference(self) -> float:
        """Return the same of the trials at hand."""
        return self._worst(self.present)

    @property
    def needed(self) -> float:
        """Return how far apart rivals must be to be told apart [noise]: as far as the better model misses anyway."""
        return max(min(self.misfit.values()) / self.noise, 1.0)

    def _worst(self, pairs: Sequence[Pair]) -> float:
        return min(rms_size(p.left) for p in pairs) / self.noise


def design_experiment(
    recording: Recording,
    names: Sequence[str] = (),
    *,
    findings: Path | None = None,
    seconds: float = 3.0,
    scale: float = 1.0,
    mass: float = 0.0,
    vertices: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    callback: Callback | None = None,
    journal: Path | None = None,
    resume: bool = False,
) -> Design:
    """Find the motion of the grippers that tells apart effects which a recording cannot.

    Args:
        recording: what was measured.
        names: effects to tell apart; those that tie in the findings if not given.
        findings: folder of a finished diagnosis, whose model is taken.
        seconds: how long the motion may last.
        scale: by what factor it may leave the workspace, and exceed the speeds, of the recording.
        mass: known mass that can be hung on the rope [kg], 0 for none.
        vertices: vertices of the rope; from the markers or the findings if not given.
        seed: of the search.
        workers: processes; one per core if not given.
        callback: see `bench.Callback`.
        journal: folder that keeps what is done, so that a search which was stopped can go on.
        resume: go on from it.

    Raises:
        InputError: There is nothing to separate, or the findings are of another recording.
    """
    begun, report = time.perf_counter(), callback or (lambda *_: None)
    _check(recording, names, findings, seconds, scale, mass)
    recording, _ = data_quality.check(recording)
    ties, given = (None, None) if findings is None else competing_models.diagnosed(findings, recording)
    recording = budget.pick_trials(recording, TRIALS)
    options = budget.model_options(recording, vertices)
    if given is not None:
        options |= given.options if vertices is None else given.options | {"vertices": vertices}
    rig, noise = excitation_motions.make_rig(recording, scale), max(floors.marker_noise(recording), LEAST_NOISE)
    asked = {"design": list(names), "seconds": seconds, "scale": scale, "mass": mass, "seed": seed, "options": options}
    asked |= {"ties": ties, "first": given and given.values}
    kept = None if journal is None else ResultCache(journal, recording, asked, resume=resume)
    with Pool(recording, options, workers, kept) as pool:
        bench = Workspace(pool)
        names = competing_models.check_names(names, ties, bench)
        if mass and "point_mass" in (*names, *(given.effects if given else ())):
            raise InputError("mass: a known mass on the rope cannot be told from point_mass; leave out one of them.")
        bench, models = competing_models.fit_rivals(bench, names, given, seed, report)
        contest = ModelDiscrimination(bench, models, rig, seconds, noise)
        contest.prepare(report)
        options_tried = _search(contest, mass, np.random.default_rng(seed), report)
        chosen, confirmed = _confirm(contest, options_tried, report)
        return Design(
            recording,
            models,
            {n: bench.pool.local.model(m.effects).parameters for n, m in models.items()},
            measured_misfit(models, bench),
            noise,
            rig,
            seconds,
            confirmed[0],
            chosen,
            confirmed[1],
            excitation_motions.motion_trial(rig, chosen[0].gesture, seconds, "motion"),
            time.perf_counter() - begun,
            seed,
        )


def _check(
    recording: Recording, names: Sequence[str], findings: Path | None, seconds: float, scale: float, mass: float
) -> None:
    """Refuse what cannot be asked for."""
    if not names and findings is None:
        raise InputError(
            f"{recording.path}: expected the folder of a diagnosis or names of effects to tell apart, found neither; "
            "run torchdlo diagnose first, or give --effects."
        )
    if not (math.isfinite(seconds) and 1.0 <= seconds <= 60.0):
        raise InputError(f"seconds: expected 1 to 60, found {seconds:g}.")
    if not (math.isfinite(scale) and 0.01 <= scale <= 100.0):
        raise InputError(f"scale: expected a factor from 0.01 to 100, found {scale:g}.")
    if not (math.isfinite(mass) and 0.0 <= mass <= 2 * recording.mass):
        raise InputError(f"mass: expected kilograms, up to twice the rope's {recording.mass:g}, found {mass:g}.")


def _search(contest: ModelDiscrimination, mass: float, rng: np.random.Generator, report: Callback) -> list[Option]:
    """Return the motions of the menu, best first, and before them the best of them improved."""
    gravity = float(np.linalg.norm(contest.bench.recording.gravity))
    gestures = excitation_motions.motion_menu(contest.rig, contest.seconds, gravity, mass)
    found = _judged(contest, gestures, report, "the menu")
    moving = [o for o in found if o.gesture.kind != "hold" and np.isfinite(o.estimate)]
    if not moving:
        return found
    best = moving[0]
    for k, wide in enumerate(WIDTHS, 1):
        tries = excitation_motions.nearby_motions(best.gesture, rng, COUNT, wide, contest.seconds)
        leader = _judged(contest, tries, report, f"improving, step {k} of {len(WIDTHS)}", improved=True)[0]
        best = leader if leader.estimate > best.estimate else best
    return [best, *found] if best.improved else found


def _judged(
    contest: ModelDiscrimination, gestures: list[ExcitationMotion], report: Callback, stage: str, improved: bool = False
) -> list[Option]:
    found = []
    for gesture, pairs in zip(gestures, contest.judge(gestures, 0, report, stage), strict=True):
        travel = excitation_motions.largest_amplitude(contest.rig, gesture, contest.seconds)
        found.append(Option(gesture, *travel, contest.worst(pairs), None, improved))
    return sorted(found, key=_rank)


def _rank(option: Option) -> float:
    """Return a key by which the best come first."""
    value = option.estimate if option.confirmed is None else option.confirmed
    return -value if np.isfinite(value) else np.inf


def _confirm(
    contest: ModelDiscrimination, options: list[Option], report: Callback
) -> tuple[list[Option], tuple[list[Pair], list[Pair]]]:
    """Return the options, best after full fits first, and the pairs of the trials at hand and of the best."""
    lead = [o for o in options if np.isfinite(o.estimate)][: LEADERS + any(o.improved for o in options)]
    if not lead:
        raise InputError(
            f"{contest.bench.recording.path}: the simulation fails in every motion of the menu; try fewer --seconds "
            "or a smaller --scale."
        )
    present = contest.present(ITERATIONS, report, "full fits to the recording")
    pairs = contest.judge([o.gesture for o in lead], ITERATIONS, report, "full fits to the leaders")
    sizes = [contest.worst(each) for each in pairs]
    judged = [replace(o, confirmed=s) for o, s in zip(lead, sizes, strict=True)]
    best = int(np.nanargmax(sizes))
    rest = sorted((o for k, o in enumerate(judged) if k != best), key=_rank)
    return [judged[best], *rest, *(o for o in options if o not in lead)], (present, pairs[best])


def motion_text(gesture: ExcitationMotion, amplitude: float, unit: str) -> str:
    """Return a motion in words."""
    said = KINDS[gesture.kind]
    if gesture.kind != "hold":
        size = f"{1e2 * amplitude:.1f} cm" if unit == "m" else f"{np.degrees(amplitude):.0f}°"
        said += f", {size} at {gesture.frequency:.2g} Hz"
    if gesture.kind in ("swing", "ladder", "stop"):
        said += f", {np.degrees(gesture.direction) % 180:.0f}° from the x axis of the rig"
    if gesture.heading:
        said += f", rig turned by {np.degrees(gesture.heading):.0f}° about the vertical"
    return said + (f", {1e3 * gesture.mass:.3g} g on the rope" if gesture.mass else "")


def design_summary(design: Design) -> str:
    """Return the outcome in words."""
    best = design.options[0]
    names = " and ".join(n.replace("_", " ") for n in design.models)
    said = (
        f"To tell {names} apart: the gripper {motion_text(best.gesture, best.amplitude, best.unit)}. "
        f"Expected separation {design.separation:.1f} times the marker noise of {1e3 * design.noise:.2g} mm, the "
        f"recording at hand has {design.reference:.1f}"
    )
    if design.reference >= design.needed:
        return f"{said}; that would be enough already: {design.needed:.1f} are needed."
    if design.separation < design.needed:
        return (
            f"{said}; {design.needed:.1f} would be needed: no motion within the workspace and speeds of the recording "
            "is expected to tell them apart (--scale allows larger and faster ones, --tip-mass a known mass)."
        )
    return f"{said}; {design.needed:.1f} are needed."


def rationale(design: Design) -> list[str]:
    """Return why the suggested motion separates, in sentences."""
    said = [f"It {w}." for w in _more(design)]
    place = design.trial.marker_arclength
    for pair in design.pairs:
        square = np.where(np.isfinite(pair.left[0]), pair.left[0], 0.0) ** 2
        at = np.unravel_index(square.sum(-1).argmax(), square.shape[:-1])
        moved = ", ".join(_adapted(design, pair)) or "no number that moves by more than a tenth"
        truth, rival = (n.replace("_", " ") for n in (pair.truth, pair.rival))
        said.append(
            f"If {truth} is true, {rival} follows best with {moved}, and is then off by "
            f"{1e3 * rms_size(pair.left):.2g} mm, most at {1e2 * place[at[1]]:.0f} cm along the rope after "
            f"{design.trial.time[at[0]]:.1f} s."
        )
    first, second = list(design.models)[:2]
    return [*said, f"Known from the laws: {separating_experiment(first, second)}."]


def _more(design: Design) -> list[str]:
    """Return what the motion has more of than the recording, or less."""
    shown, recording = design.pairs[0].shown[0], design.recording
    free, dt = ~design.trial.gripped, float(design.trial.time[1] - design.trial.time[0])

    def speed(markers: np.ndarray) -> float:
        return float(np.nanpercentile(np.linalg.norm(np.gradient(markers[:, free], dt, axis=0), axis=-1), 95))

    def bend(markers: np.ndarray) -> float:
        return curvature_scale(markers[None, :: max(1, len(markers) // 50)])

    gesture, said = design.options[0].gesture, []
    for what, unit, much_of in (("moves the rope", "m/s", speed), ("bends it", "1/m", bend)):
        now, then = much_of(shown), max(much_of(t.markers) for t in recording.train)
        if gesture.kind != "hold" and not 1 / 1.2 < now / max(then, 1e-9) < 1.2:
            much = {("moves the rope", True): "faster", ("moves the rope", False): "more slowly"}.get(
                (what, now > then), "more" if now > then else "less"
            )
            said.append(f"{what} {much} than the recording, {now:.2g} against {then:.2g} {unit}")
    if gesture.kind == "roll":
        said.append("rolls the rope: what belongs to its material turns with it, what belongs to the room stays")
    if gesture.heading:
        turn = f"turns the rig by {np.degrees(gesture.heading):.0f}°"
        said.append(f"{turn}: what belongs to the room stays, what belongs to rope and grippers turns")
    return said


def _adapted(design: Design, pair: Pair) -> list[str]:
    """Return the numbers of a rival that move by more than a tenth, old and new."""
    before = design.models[pair.rival].values
    rows = zip(design.parameters[pair.rival], before, pair.values, strict=True)
    return [f"{n.replace('_', ' ')} {b:.3g} → {a:.3g}" for n, b, a in rows if abs(a - b) > 0.1 * max(abs(b), 1e-12)]


def design_json(design: Design) -> str:
    """Return the design as JSON text."""

    def listed(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
        return [
            {
                "truth": p.truth,
                "rival": p.rival,
                "separation": rms_size(p.left) / design.noise,
                "left_m": rms_size(p.left),
                "rival_parameters": dict(zip(design.parameters[p.rival], p.values, strict=True)),
            }
            for p in pairs
        ]

    content = {
        "generator": "torchdlo design-experiment",
        "recording": str(design.recording.path),
        "names": list(design.models),
        "noise_m": design.noise,
        "misfit_m": design.misfit,
        "needed": design.needed,
        "separation": design.separation,
        "separation_of_recording": design.reference,
        "motion": _option(design.options[0]),
        "why": rationale(design),
        "pairs": listed(design.pairs),
        "pairs_of_recording": listed(design.present),
        "motions": [_option(o) for o in design.options],
        "seconds_of_motion": design.seconds,
        "models": {
            n: {"effects": m.effects, "parameters": dict(zip(design.parameters[n], m.values, strict=True))}
            for n, m in design.models.items()
        },
        "file": "motion.npz",
        "seed": design.seed,
        "seconds": design.duration,
        "versions": versions(),
    }
    return result_json(content)


def _option(option: Option) -> dict[str, Any]:
    return {
        "message": motion_text(option.gesture, option.amplitude, option.unit),
        "separation_estimate": option.estimate,
        "separation": option.confirmed,
        f"amplitude_{option.unit}": option.amplitude,
        "improved": option.improved,
        **vars(option.gesture),
    }
