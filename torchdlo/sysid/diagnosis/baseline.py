"""The calibrated baseline of a diagnosis: what is fitted before anything can be missing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchdlo.physics import tree
from torchdlo.sysid.diagnosis import clamp_models
from torchdlo.sysid.diagnosis.error_floor import gap_rms, trial_gaps
from torchdlo.sysid.diagnosis.workspace import CHAIN, SILENT, Callback, Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import RopeModel

_SPREAD = np.log([100.0, 4.0, 6.0])
"""How far random starts are from the first guess, in logarithms of the baseline's numbers."""

_STIFFER = 3.0
"""Bending stiffness in the middle of the starts over that of the first guess."""

_KEPT = 1 / 3
"""Share of the starts, the best, that are fitted."""

_BETTER = 0.9
"""Share of the cost that is left where the rope is taken for a chain, or for one that clamps hold to their ends."""

_LINKED = 1.3
"""Share of the cost up to which it may turn out to be one once an effect is known."""

_LOOK = 2
"""Iterations after which a chain has to fit better than a rope, if it is to be fitted further."""

_FIRMER = 0.95
"""Share of the cost that is left where clamps are found to do so, or a rest shape is, once an effect is known."""

_ROLLS = 6
"""Sides to which a given rest shape may be rolled where fits with it start."""

_ROUND = 0.75
"""Twisting over bending stiffness of a round rope of one material."""

_FAR = np.log(8.0)
"""How far, in logarithms, a rope may be from that before the fit is thought to have run away."""


def calibrate_baseline(
    bench: Workspace, count: int, iterations: int, rng: np.random.Generator, report: Callback
) -> tuple[Workspace, Fitted]:
    """Return the fitted baseline, straight if a given rest shape fits worse, a chain or in firm clamps if that helps.

    Also return the workspace with what was learned on the way.

    Args:
        bench: the trials.
        count: random starts.
        iterations: most iterations of the last fit.
        rng: for the starts.
        report: told how it goes.
    """
    model = bench.pool.local.model(())
    bench = bench.begin(model.guess(), ())
    names, stage = tuple(model.parameters), "calibrating the baseline"
    report(stage, 0, 4, f"{count} starts")
    frames = bench.pool.local.motion(model, "train").markers.shape[1]
    ones, link = (1.0,) * len(names), float(np.diff(model.arclength).min())
    free, sizes = (*names, f"{CHAIN}.length"), (*ones, 0.5 * link)

    def plain(values: np.ndarray, most: int, frames: int | None, **options: float) -> FitJob:
        start, keep = bench.starts["train"], math.ceil(_KEPT * len(values)) if len(values) > 1 else None
        return FitJob((), values, names, ones, most, start, frames, keep, tuple(options.items()))

    def chain(values: np.ndarray, most: int, frames: int | None) -> FitJob:
        return FitJob((CHAIN,), values, free, sizes, most, bench.starts["train"], frames)

    def fit(jobs: list[FitJob], done: int) -> list[Fitted]:
        found = bench.fit(jobs)
        report(stage, done, 4, f"{1e3 * min(f.point.cost for f in found):.2f} mm")
        return found

    values = _random(model, count, rng)
    first = fit([plain(values[k::2], 4, frames // 3) for k in range(2)], 1)
    best = min(first, key=lambda f: f.point.cost).values
    straight = _straight(bench, values, best, frames) if model.rest == "given" else None
    if straight is not None:
        bench = bench.with_options({"rest": "straight"})
        best, names, ones = straight, _names(bench, "straight"), ones[: len(straight)]
        free, sizes = (*names, free[-1]), (*ones, sizes[-1])
    bench = replace(bench, early=best)
    if straight is not None or not bench.starts["train"].at_rest.all():
        bench = bench.begin(best, ())
    # Phases of late times are right only after early ones are: the horizon grows. The order of the axes of its joints
    # gives a chain's length a sign.
    sides = [chain(np.append(best, length)[None], 4, 2 * frames // 3) for length in (link, -link)]
    firm = [plain(best[None], 5, 2 * frames // 3, clamp_fraction=1.0)] if model.mesh.clamps else []
    smooth, one, other, *held = fit([plain(best[None], 5, 2 * frames // 3), *sides, *firm], 2)
    side = min((one, other), key=lambda f: f.point.cost)
    bench = replace(bench, linked=side.point.cost < _LINKED * smooth.point.cost)
    if held and held[0].point.cost < _BETTER * min(smooth.point.cost, side.point.cost):
        bench, smooth = bench.with_options({"clamp_fraction": 1.0}), held[0]
        side = _moved(side, smooth)
    bench = bench.correct(smooth)
    better = fit([plain(smooth.values[None], iterations, None)], 3)[0]
    if side.point.cost < _BETTER * smooth.point.cost:
        bench, better = _chain_or(bench, better, [chain(side.values[None], iterations, None)])
    report(stage, 4, 4, f"{1e3 * gap_rms(bench.gaps(better, 'train')):.2f} mm")
    return bench, better


def _straight(bench: Workspace, values: np.ndarray, given: np.ndarray, frames: int) -> np.ndarray | None:
    """Return the numbers of a rope without rest shape if it fits better than with the given one, None if it does not.

    Such a rope is one whose share of the rest shape is 0, which searches that begin with the shape do not always find.
    """

    def job(values: np.ndarray, most: int, frames: int, rest: str = "straight") -> FitJob:
        names, keep = _names(bench, rest), math.ceil(_KEPT * len(values)) if len(values) > 1 else None
        start, ones = bench.starts["train"], (1.0,) * len(names)
        return FitJob((), values[:, : len(names)], names, ones, most, start, frames, keep, (("rest", rest),))

    found = bench.fit([job(values[k::2], 4, frames // 3) for k in range(2)])
    best = min(found, key=lambda f: f.point.cost).values
    longer = 2 * frames // 3
    straight, shaped = bench.fit([job(best[None], 5, longer), job(given[None], 5, longer, "given")])
    return straight.values if straight.point.cost < shaped.point.cost else None


def _names(bench: Workspace, rest: str) -> tuple[str, ...]:
    return tuple(bench.pool.local.model((), (("rest", rest),)).parameters)


def _moved(side: Fitted, smooth: Fitted) -> Fitted:
    """Return a chain with the numbers of a smooth rope."""
    return replace(side, values=np.append(smooth.values, side.values[-1]))


def _random(model: RopeModel, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return starts around the first guess, shape (count, K), the guess among them."""
    values = np.repeat(model.guess()[None], count, 0)
    spread = rng.uniform(-1, 1, (count, len(_SPREAD))) * _SPREAD
    # Twisting stiffness follows bending stiffness.
    spread[0], spread[:, 1] = 0.0, spread[:, 1] + spread[:, 0]
    spread[1:, :2] += np.log(_STIFFER)
    values[:, : len(_SPREAD)] *= np.exp(spread)
    if "rest_roll" in model.parameters:
        # A lying shape may be rolled to any side where it is held.
        values[:, model.parameters.index("rest_roll")] = np.linspace(-np.pi, np.pi, count, endpoint=False)
    return values


def go_further(bench: Workspace, base: Fitted, iterations: int, report: Callback) -> tuple[Workspace, Fitted]:
    """Return a model that took up an effect, with what the lack of that effect kept the baseline from finding.

    That is the law of a chain, a given rest shape, and a twisting stiffness that hardly shows and ran away. Also return
    the workspace for that model.
    """
    bench = _begun_anew(bench, base)
    model = bench.pool.local.model(base.effects)
    bend, twist = (model.parameters.index(f"{way}ing_stiffness") for way in ("bend", "twist"))
    values, link = base.values[None], float(np.diff(model.arclength).min())
    if abs(np.log(base.values[twist] / (_ROUND * base.values[bend]))) > _FAR:
        back = base.values.copy()
        back[twist] = _ROUND * back[bend]
        values = np.stack([base.values, back])
    stage, effects, start = "fitting all numbers again", (*base.effects, CHAIN), bench.starts["train"]
    report(stage, 0, 3, "")
    jobs = [FitJob(base.effects, values, base.space.names, tuple(base.space.units), iterations, start)]
    if clamp_models.bends_between_markers(model):
        jobs.append(clamp_models.firm_clamp_job(base, jobs[0]))
    if model.rest == "straight" and bench.recording.rest_positions is not None:
        jobs.append(_shaped(bench, base, jobs[0]))
    base, *others = bench.fit(jobs)
    better = min(others, key=lambda f: f.point.cost, default=base)
    if better.point.cost < _FIRMER * base.point.cost:
        bench, base = bench.with_options(dict(better.options)), better
    names, sizes = base.space.names, tuple(base.space.units)
    free = (*names, f"{CHAIN}.length")
    report(stage, 1, 3, f"{1e3 * gap_rms(bench.gaps(base, 'train')):.2f} mm")
    if bench.linked and CHAIN not in base.effects and gap_rms(bench.gaps(base, "train")) > SILENT * bench.level:
        rows = [np.append(base.values, length)[None] for length in (link, -link)]
        sides = [FitJob(effects, r, free, (*sizes, 0.5 * link), iterations, bench.starts["train"]) for r in rows]
        bench, base = _chain_or(bench, base, sides)
    report(stage, 2, 3, f"{1e3 * gap_rms(bench.gaps(base, 'train')):.2f} mm")
    # Corrections of another motion are wrong where motions part.
    bench = _begun_anew(bench, base)
    base = bench.fit([bench.further(base, iterations // 2)])[0]
    report(stage, 3, 3, f"{1e3 * gap_rms(bench.gaps(base, 'train')):.2f} mm")
    return bench, base


def _shaped(bench: Workspace, base: Fitted, job: FitJob) -> FitJob:
    """Return the job of fitting the model without, likewise with half of the given rest shape, rolled to any side."""
    options = (*base.options, ("rest", "given"))
    model, before = bench.pool.local.model(base.effects, options), bench.pool.local.model(base.effects)
    values = np.repeat(model.guess()[None], _ROLLS, 0)
    values[:, [model.parameters.index(n) for n in before.parameters]] = base.values
    values[:, model.parameters.index("rest_share")] = 0.5
    values[:, model.parameters.index("rest_roll")] = np.linspace(-np.pi, np.pi, _ROLLS, endpoint=False)
    free, sizes = (*job.free, "rest_share", "rest_roll"), (*job.sizes, 1.0, 1.0)
    return replace(job, values=values, free=free, sizes=sizes, keep=2, options=options)


def _begun_anew(bench: Workspace, base: Fitted) -> Workspace:
    """Begin trials as a model says, and correct simulations by what finer ones of it change."""
    if not bench.starts["train"].at_rest.all():
        bench = bench.begin(base.values, base.effects)
    return bench.correct(base)


def _chain_or(bench: Workspace, smooth: Fitted, sides: Sequence[FitJob]) -> tuple[Workspace, Fitted]:
    """Return the best fit of a chain, with what is known of its errors, if it is better, else the smooth rope as it is.

    Args:
        bench: what is known of the smooth rope.
        smooth: what was fitted.
        sides: fits of the chain.
    """
    linked = bench.use(replace(tree.part(bench.refinement), links=abs(float(sides[0].values[0, -1]))))
    frame_weights = bench.starts["train"].frame_weights

    def left(bench: Workspace, fitted: Fitted) -> float:
        return gap_rms(trial_gaps(bench.prediction(fitted, "train"), bench.trials["train"], frame_weights))

    start, most = linked.starts["train"], sides[0].iterations
    found = linked.fit([replace(side, start=start, iterations=min(_LOOK, most)) for side in sides])
    best = min(found, key=lambda f: f.point.cost)
    # Each in its own measure of what can be known. A rope that is no chain fits worse from the beginning.
    plainly = smooth.point.cost / bench.level
    if most > _LOOK and best.point.cost / linked.level < plainly:
        best = linked.fit([linked.further(best, most - _LOOK)])[0]
    # Less is known of a chain: that alone does not make it better where much more is left than can be known.
    better = best.point.cost / linked.level < _BETTER * plainly and left(linked, best) < _BETTER * left(bench, smooth)
    if better and not linked.diverged(best, bench.gaps(smooth, "all")):
        return linked, best
    return bench, smooth


def go_on(bench: Workspace, given: ModelFile, iterations: int, report: Callback) -> tuple[Workspace, Fitted]:
    """Return a given model, fitted to this recording, and the workspace for it."""
    model = given.model(bench.recording, **bench.pool.local.options)
    sizes, values = given.sizes(model), given.start(model)

    def fit(values: np.ndarray, most: int) -> Fitted:
        start = bench.starts["train"]
        return bench.fit([FitJob(given.effects, values[None], tuple(sizes), tuple(sizes.values()), most, start)])[0]

    bench = bench.begin(values, given.effects)
    found = fit(values, iterations // 2)
    bench = bench.correct(found)
    found = fit(found.values, iterations)
    report("fitting the given model", 1, 1, f"{1e3 * found.point.cost:.2f} mm")
    return bench, found


def baseline_notes(base: Fitted) -> list[str]:
    """Return sentences on the baseline that a reader should know."""
    if CHAIN not in base.effects:
        return []
    length = abs(float(base.values[base.space.names.index(f"{CHAIN}.length")]))
    return [
        f"The rope moves like a chain of links of about {1e3 * length:.0f} mm, as simulated ones may; that was taken "
        "up before any effect was considered."
    ]
