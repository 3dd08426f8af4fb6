"""Calibration: the numbers of the baseline model with which it predicts the train trials best."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.sysid.calibration import refinement
from torchdlo.sysid.calibration.absolute import fit_absolute, mass_note
from torchdlo.sysid.diagnosis.error_floor import marker_noise
from torchdlo.sysid.estimation import evaluation, levenberg_marquardt
from torchdlo.sysid.estimation.checkpoint import Checkpoint
from torchdlo.sysid.estimation.jobs import FitJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.result import Calibration
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model import initial_state as starts_of
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start, TrialBatch
from torchdlo.sysid.recordings.metrics import average, mean_absolute_error
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.recordings.wrench import check_forces, force_doubts
from torchdlo.sysid.video import fit_memory
from torchdlo.sysid.video.filmed import FILMED_STARTS, METHODS, calibrate_filmed

Callback = Callable[[str, int, int, str], None]
"""Called with stage, steps done, steps in all, and a word on how it goes."""

_SCOUTS = 6
"""Train trials that the many starts are tried on."""

_LOOKS = 6
"""Iterations that the best starts get on those."""


@dataclass(eq=False)
class _Job:
    """One fit of one variant of the model."""

    pool: Pool
    options: tuple[tuple[str, Any], ...]
    model: RopeModel
    space: ParameterSpace
    motion: TrialBatch
    start: Start
    first: np.ndarray
    values: np.ndarray
    given: bool = False
    point: Point | None = None
    scouted: np.ndarray | None = None
    """Coordinates of the best start so far."""
    drifts: np.ndarray | None = None
    """What all trials get wrong in the same way, in coordinates, see `levenberg_marquardt.interval`."""
    weighed: bool = False
    """Whether forces told the mass."""

    @property
    def columns(self) -> list[int]:
        """Return where the numbers that are fitted stand among those of the model."""
        return [self.model.parameters.index(name) for name in self.space.names]

    @property
    def cost(self) -> float:
        """Return the cost of the best point [m]; infinite before there is one."""
        return np.inf if self.point is None else self.point.cost

    def simulator(self, trials: Sequence[Trial]) -> starts_of.Simulator:
        """Return what simulates trials, on all cores."""
        return self.pool.simulator(self.model.effects, tuple(t.name for t in trials), self.options)

    def full(self, values: np.ndarray) -> np.ndarray:
        """Return all numbers of the model for fitted ones, both (..., K)."""
        out = np.broadcast_to(self.first, (*values.shape[:-1], len(self.first))).copy()
        out[..., self.columns] = values
        return out


def calibrate(
    recording: Recording,
    *,
    starts: int = 48,
    iterations: int = 20,
    seed: int = 0,
    vertices: int | None = None,
    rest: str = "auto",
    checkpoint: Path | None = None,
    resume: bool = False,
    given: ModelFile | None = None,
    refined: bool = True,
    workers: int | None = 1,
    method: str = "auto",
    callback: Callback | None = None,
) -> Calibration:
    """Fit the baseline model to the train trials and judge it on the test trials.

    Where forces at the grippers were measured, they tell the mass, too, and with it stiffnesses by themselves.
    Stiffnesses and damping rate (and, with a given rest shape, how much of it is real and how it lies in the first
    clamp) are fitted from several starts in one batch on a few trials, and from the best of them on all. Initial
    velocities are estimated for each trial from its first 0.1 s.

    Args:
        recording: what was measured.
        starts: number of starts.
        iterations: most iterations of each of the two stages.
        seed: of the random starts.
        vertices: vertices of the simulated rope; about two per marker if not given.
        rest: rest shape "straight", "given" (`rest_positions` of the recording), or "auto", whichever of the two
            predicts the train trials better.
        checkpoint: file that keeps the best so far; of films the folder of a journal.
        resume: go on from it.
        given: model to start from in place of many starts, with its effects; it says what the rest shape is.
        refined: whether to fit on with a finer mesh, and to find out what steps and mesh do to the numbers.
        workers: processes, one per core if None. More than one begin by importing the program's main module: a script
            that asks for them has to guard what it does by `if __name__ == "__main__":`.
        method: of films: "gradient" to fit the stiffness along the rope by the gradient of masks; see
            `calibrate_filmed`.
        callback: see `Callback`; it may raise KeyboardInterrupt, which ends the fit with the best so far.

    Raises:
        InputError: the recording cannot be calibrated with these options.
    """
    if method not in METHODS or (method == "gradient" and not recording.filmed):
        raise InputError(
            f"{recording.path}: method: expected {', '.join(METHODS)}, and gradient for films only, found {method!r}."
        )
    if recording.filmed:
        if rest == "given":
            raise InputError(f"{recording.path}: expected no --rest given for films.")
        options: dict[str, Any] = {"seed": seed, "vertices": vertices, "given": given, "method": method}
        options |= {"starts": min(starts, FILMED_STARTS), "iterations": iterations}
        with fit_memory.remembering(checkpoint, recording, options, resume=resume, command="calibrate"):
            return calibrate_filmed(recording, **options, callback=callback)
    begun = time.perf_counter()
    check_forces(recording)
    if rest not in ("auto", "straight", "given"):
        raise InputError(f"rest is {rest!r}; expected auto, straight or given.")
    report = callback or (lambda stage, done, total, message: None)
    if given is not None and rest not in ("auto", given.options["rest"]):
        raise InputError(f"rest is {rest!r}; expected auto or {given.options['rest']}, as {given.path} has it.")
    rest = rest if given is None else given.options["rest"]
    kinds = [rest] if rest != "auto" else ["straight"] + (["given"] if recording.rest_positions is not None else [])
    asked: dict[str, Any] = {"starts": starts, "seed": seed, "vertices": vertices, "rest": rest}
    if given is not None:
        asked |= {"values": given.values, "options": given.options}
    memory = Checkpoint(checkpoint, recording, asked, resume)
    best: _Job | None = None
    before: dict[str, np.ndarray] | None = None
    interrupted = False
    with Pool(recording, {"vertices": vertices} if given is None else given.options, workers) as pool:
        try:
            for kind in kinds:
                job = _job(pool, kind, vertices, given)
                best = best or job
                for improved in _fit(job, starts, iterations, np.random.default_rng(seed), memory, report):
                    if best.point is None or best is improved or improved.cost < best.cost:
                        best = improved
            before = _before(tree.part(best))
            best = _refined(tree.part(best), iterations, vertices, report) if refined else best
            best = _weighed(tree.part(best), iterations, report)
        except KeyboardInterrupt:
            if best is None or (best.point is None and not _settled(best)):
                raise
            interrupted = True
        return _judge(tree.part(best), before, seed, interrupted, begun, report)


def _job(pool: Pool, rest: str, vertices: int | None, given: ModelFile | None) -> _Job:
    recording = pool.recording
    trials = _usable(recording)
    if given is None:
        options: dict[str, Any] = {"rest": rest}
        model = pool.local.model((), tuple(options.items()))
        space, values = ParameterSpace(tuple(model.parameters), tuple(model.params)), model.guess()
    else:
        options = {} if vertices is None else {"vertices": vertices}
        model = given.model(recording, **options)
        sizes, values = given.sizes(model), given.start(model)
        params = tuple(p for name, p in zip(model.parameters, model.params, strict=True) if name in sizes)
        space = ParameterSpace(tuple(sizes), params, tuple(sizes.values()))
    start, motion = starts_of.begin(model, trials), model.motion(trials)
    return _Job(pool, tuple(options.items()), model, space, motion, start, values, values, given is not None)


def _usable(recording: Recording) -> list[Trial]:
    """Return the train trials that are not suspect from start to end."""
    free = ~recording.train[0].gripped
    usable = [t for t in recording.train if np.isfinite(t.markers[~t.suspect][:, free]).any()]
    if not usable:
        raise InputError(
            f"{recording.path}: every frame of every train trial is marked suspect; expected some to fit on."
        )
    return usable


def _fit(
    job: _Job,
    starts: int,
    iterations: int,
    rng: np.random.Generator,
    memory: Checkpoint,
    report: Callback,
) -> Iterator[_Job]:
    """Yield the job each time it got better."""
    name = f"{job.model.rest} rest shape"
    kept = memory.recall(job.model.rest)
    if kept or job.given:
        raw = job.space.to_raw(np.array(kept or job.first)[job.columns])
    else:
        raw = _scout(job, starts, rng, memory, report, name)
    stage = f"fitting {len(job.motion.names)} trials, {name}"
    report(stage, 0, iterations + 1, "")
    simulate, points = _begin(job, raw, memory.once)
    if not np.isfinite(points[0].cost):
        raise InputError(
            f"{job.pool.recording.path}: the simulation failed on the train trials from every start; check length, "
            "mass and marker_arclength, or use fewer vertices."
        )
    job.point, job.values = points[0], job.full(job.space.to_values(points[0].raw))
    yield job
    report(stage, 1, iterations + 1, f"{1e3 * job.point.cost:.2f} mm")
    climbing = _climb(job, "fit", simulate, job.motion.markers, points, iterations, memory)
    for done, (point,) in enumerate(climbing):
        job.point, job.values = point, job.full(job.space.to_values(point.raw))
        memory.keep(job.model.rest, job.values)
        yield job
        report(stage, done + 2, iterations + 1, f"{1e3 * point.cost:.2f} mm")
    report(stage, iterations + 1, iterations + 1, f"{1e3 * job.point.cost:.2f} mm")


Once = Callable[[str, str, Callable[[], Any]], Any]
"""Called with a variant, the name of a step and what computes it; see `Checkpoint.once`."""


def _begin(job: _Job, raw: np.ndarray, once: Once) -> tuple[levenberg_marquardt.Simulate, list[Point]]:
    """Return what simulates all trials, and the point at some coordinates; sets where the trials begin."""
    run, values = job.simulator(_usable(job.pool.recording)), job.full(job.space.to_values(raw))
    start = job.start
    job.start = once(job.model.rest, "start", lambda: starts_of.refine(job.model, job.motion, start, values, run))

    def simulate(values: np.ndarray) -> np.ndarray:
        return run(job.start, job.full(values), None)

    def points() -> list[Point]:
        return levenberg_marquardt.evaluate(simulate, job.motion.markers, job.space, raw[None])

    return simulate, once(job.model.rest, "points", points)


def _settled(job: _Job) -> bool:
    """Let a job that was stopped while starts were tried have the best of them; return whether there is one."""
    if job.scouted is None:
        return False
    _, (point,) = _begin(job, job.scouted, lambda rest, step, compute: compute())
    if not np.isfinite(point.cost):
        return False
    job.point, job.values = point, job.full(job.space.to_values(point.raw))
    return True


def _climb(
    job: _Job,
    name: str,
    simulate: levenberg_marquardt.Simulate,
    measured: np.ndarray,
    points: Sequence[Point],
    iterations: int,
    memory: Checkpoint,
) -> Iterator[list[Point]]:
    """Yield points as `levenberg_marquardt.improve_points` does; what is found is written down."""
    climb = levenberg_marquardt.Climb(job.space, points)
    for k in range(iterations):
        tries = climb.tries()
        if not len(tries):
            return
        look = partial(levenberg_marquardt.evaluate, simulate, measured, job.space, tries)
        climb.take(memory.once(job.model.rest, f"{name} {k}", look))
        yield list(climb.points)


def _scout(
    job: _Job, starts: int, rng: np.random.Generator, memory: Checkpoint, report: Callback, name: str
) -> np.ndarray:
    """Return coordinates to start the fit from: many starts on a few trials, fewer and fewer over longer times.

    In its first second a rope has not forgotten where it began and the cost has few local minima; over a long horizon
    small errors of phase make many.
    """
    trials = _usable(job.pool.recording)
    scouts = [trials[i] for i in _pick(len(trials), _SCOUTS)]
    motion, first, run = job.model.motion(scouts), starts_of.begin(job.model, scouts), job.simulator(scouts)
    once = partial(memory.once, job.model.rest)
    begin = once("scouts' start", lambda: starts_of.refine(job.model, motion, first, job.values, run))
    stage, total = f"trying {starts} starts, {name}", 2 + _LOOKS

    def over(share: float) -> tuple[levenberg_marquardt.Simulate, np.ndarray]:
        frames = min(max(10, round(share * motion.markers.shape[1])), motion.markers.shape[1])
        return lambda values: run(begin, values, frames), motion.markers[:, :frames]

    def costs(share: float, raws: np.ndarray) -> np.ndarray:
        simulate, measured = over(share)
        return levenberg_marquardt.costs(simulate(job.space.to_values(raws)), measured)

    raws = _spread(job, starts, rng)
    report(stage, 0, total, "")
    for look, (share, keep) in enumerate(((0.3, max(2, starts // 3)), (1.0, max(2, starts // 8)))):
        found = once(f"costs {look}", partial(costs, share, raws))
        raws = raws[np.argsort(found, kind="stable")[:keep]]
        job.scouted = raws[0]
        report(stage, look + 1, total, f"{1e3 * found.min():.2f} mm over {share:.0%} of the time")
    simulate, measured = over(1.0)
    points = once("scouts", partial(levenberg_marquardt.evaluate, simulate, measured, job.space, raws))
    for look, points in enumerate(  # noqa: B020
        _climb(job, "scouts", simulate, measured, points, _LOOKS, memory)
    ):
        job.scouted = min(points, key=lambda p: p.cost).raw
        report(stage, look + 3, total, f"{1e3 * min(p.cost for p in points):.2f} mm")
    report(stage, total, total, "")
    return min(points, key=lambda p: p.cost).raw


def _refined(job: _Job, iterations: int, vertices: int | None, report: Callback) -> _Job:
    """Return the job on a finer mesh, corrected, or as it was where that predicts the train trials worse.

    A mesh that was asked for stays, with numbers that suit it; it then is only found out how wrong they may be.
    """
    pool, trials = job.pool, job.pool.recording.train
    if len(_usable(pool.recording)) < len(trials):
        return job
    finer = {} if job.given or vertices is not None else refinement.finer_options(pool.recording)
    sizes = tuple(job.space.units) if job.space.sizes else (1.0,) * len(job.columns)
    options = tuple((dict(job.options) | finer).items())
    names = job.space.names
    first = FitJob(job.model.effects, job.values[None], names, sizes, iterations, options=options)
    clamps = _CLAMPS if finer and job.model.mesh.clamps else ()
    try:
        found = refinement.refine(pool, first, clamps, iterations, vertices is None, report)
    except InputError:
        # Not every rope can be simulated on a finer mesh.
        return job
    fitted = found.fitted
    if not found.corrected:
        return replace(job, drifts=found.drifts)
    model = found.pool.local.model(fitted.effects)
    better = replace(job, pool=found.pool, options=(), model=model, space=fitted.space, motion=model.motion(trials))
    better.values, better.point, better.drifts = fitted.values, fitted.point, found.drifts
    errors = []
    for each in (job, better):
        predicted = evaluation.predict(each.model, trials, each.values, each.simulator(trials))
        errors.append(average(mean_absolute_error, [predicted[t.name] for t in trials], trials))
    # Exact numbers predict as well with their mesh, up to what noise tells; else those that suit a coarse one count.
    if errors[1] <= errors[0] + 0.5 * marker_noise(pool.recording):
        return better
    apart = job.space.to_raw(fitted.values[job.columns]) - tree.part(job.point).raw
    scale = found.drifts * fitted.space.units / job.space.units
    return replace(job, drifts=np.concatenate([scale, apart[None]]))


def _weighed(job: _Job, iterations: int, report: Callback) -> _Job:
    """Return the job with a mass that forces at the grippers tell, or as it was where none were measured."""
    recording, trials = job.pool.recording, _usable(job.pool.recording)
    if recording.wrench is None or all(t.wrench is None for t in trials):
        return job
    model = job.model
    options = dict(job.pool.local.options) | dict(job.options)
    start = starts_of.refine(model, job.motion, starts_of.begin(model, trials), job.values, job.simulator(trials))

    def said(done: int, total: int, message: str) -> None:
        report("fitting forces", done, total, message)

    before = (job.values, job.space, job.drifts)
    model, found = fit_absolute(recording, trials, options, model.effects, before, start, min(iterations, 8), said)
    better = replace(job, options=(*job.options, ("forces", True)), model=model, values=found.values)
    better.space, better.point, better.drifts, better.weighed = found.space, found.point, found.drifts, True
    return better


def _pick(count: int, wanted: int) -> list[int]:
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, wanted))})


_CLAMPS = (1.0, 0.0)
"""Where clamps may hold the rope, see `Mesh.clamp_shares`."""

_REACH = {"bending_stiffness": np.log(40.0), "twisting_stiffness": np.log(4.0), "damping_rate": np.log(10.0)}
"""How far starts go either way of the guess; the twisting stiffness relative to the bending stiffness."""


def _spread(job: _Job, starts: int, rng: np.random.Generator) -> np.ndarray:
    """Return starts (S, K) spread around the guess, evenly in every coordinate; the first is the guess itself."""
    raws = np.repeat(job.space.to_raw(job.values)[None], starts, 0)
    for k, (name, param) in enumerate(zip(job.space.names, job.space.params, strict=True)):
        # A Latin hypercube: one start in each of `starts` slices of a coordinate, in a random order.
        share = (rng.permutation(starts) + rng.uniform(size=starts)) / starts - 0.5
        raws[1:, k] += (2 * _REACH[name] if name in _REACH else 1.0 if param.periodic else 0.4) * share[1:]
    bend, twist = (job.space.names.index(name) for name in ("bending_stiffness", "twisting_stiffness"))
    raws[1:, twist] += raws[1:, bend] - raws[0, bend]
    return job.space.clip(raws)


def _before(job: _Job) -> dict[str, np.ndarray]:
    """Predict all trials with the numbers that a job began with."""
    trials = job.pool.recording.trials("all")
    return evaluation.predict(job.model, trials, job.first, job.simulator(trials))


def _judge(
    job: _Job, before: dict[str, np.ndarray] | None, seed: int, interrupted: bool, begun: float, report: Callback
) -> Calibration:
    """Predict all trials before and after, and compare."""
    recording = job.pool.recording
    trials = recording.trials("all")
    simulate = job.simulator(trials)
    report("predicting all trials", 0, 2, "")
    before = before or _before(job)
    report("predicting all trials", 1, 2, "")
    after = evaluation.predict(job.model, trials, job.values, simulate)
    report("predicting all trials", 2, 2, "")
    ends = levenberg_marquardt.interval(tree.part(job.point), job.space, job.drifts)
    least, most = (np.array([getattr(p, end) for p in job.space.params]) for end in ("low", "high"))
    turns = np.array([p.periodic for p in job.space.params])
    low, high = (np.where(turns, end, np.clip(end, least, most)) for end in ends)
    errors: dict[str, Any] = evaluation.errors(recording, after)
    return Calibration(
        parameters={
            name: {"value": float(v), "low": float(min(a, b)), "high": float(max(a, b)), "unit": param.unit}
            for name, param, v, a, b in zip(
                job.space.names, job.space.params, job.values[job.columns], low, high, strict=True
            )
        },
        **errors,
        before=evaluation.errors(recording, before),
        baselines=evaluation.trivial_errors(recording),
        per_trial=evaluation.by_trial(recording, before, after),
        seconds=time.perf_counter() - begun,
        model=model_file.content(job.model, job.values),
        predictions=after,
        predictions_before=before,
        seed=seed,
        interrupted=interrupted,
        notes=_notes(recording, job, low, high),
    )


_VAGUE = 5.0
"""Upper over lower end of a range from which a number counts as unknown."""

_RANGES = (
    "Ranges are 90 % intervals: nine of ten hold the true number of a rope that is like the model. They take in how "
    "far the train trials pull apart (jackknife), noise, and what steps, mesh, the place where clamps begin to hold, "
    "and shear may do."
)
_NARROW = "Ranges say how far the train trials pull apart (jackknife), not what all of them get wrong alike."


def _notes(recording: Recording, job: _Job, low: np.ndarray, high: np.ndarray) -> list[str]:
    notes = [f"Rest shape: {job.model.rest}."]
    if job.model.effects:
        notes.append(f"Effects of the given model: {', '.join(e.replace('_', ' ') for e in job.model.effects)}.")
    if job.weighed:
        notes.append(mass_note(float(job.values[job.model.parameters.index("mass")]), recording.mass))
    else:
        notes.append("No forces were measured: stiffnesses are as right as the mass in rope.json, in proportion.")
    notes += force_doubts(recording)
    notes.append(_RANGES if job.drifts is not None else _NARROW)
    logs = [p.scale == "log" for p in job.space.params]
    for name in (n for n, a, b, log in zip(job.space.names, low, high, logs, strict=True) if log and b > _VAGUE * a):
        notes.append(f"The recording says little of the {name.replace('_', ' ')}: see its range.")
    unused = sorted({t.name for t in recording.train} - set(job.motion.names))
    if unused:
        notes.append(f"Not fitted because every frame is marked suspect: {', '.join(unused)}.")
    if not job.model.measured_twist() and job.model.clamps:
        notes.append("The grippers' rotation about the rope was not measured; it is taken to start without twist.")
    return notes
