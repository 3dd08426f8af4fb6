"""What films show that the baseline lacks: doses of every effect against what it leaves over, fits, and unseen films.

The search is that of recordings with markers, on readings of films: lengths whose target is 0. Cameras, clocks and
starts in motion take up what they can before an effect may explain it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis.budget import BUDGETS, Budget
from torchdlo.sysid.diagnosis.detection_limit import limit_gap
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor, gap_rms
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.diagnosis.verdict import UNKNOWN_FLOOR, Candidate, Diagnosis, verdict_word
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.sysid.video.filmed import FILMED_STARTS, baseline
from torchdlo.sysid.video.filmed_beginnings import NEAR, chain_note, chained, further, left_out, nearer
from torchdlo.sysid.video.filmed_fit import film_gaps, fit, look, misleading_films, spread, total
from torchdlo.sysid.video.filmed_model import FilmedModel, Films, extended
from torchdlo.sysid.video.filmed_problem import add_correction, correct, without_rest
from torchdlo.sysid.video.filmed_scores import film_scores
from torchdlo.sysid.video.filmed_starts import fit_starts, restart, start_window
from torchdlo.sysid.video.fit_pool import FitPool
from torchdlo.sysid.video.footage import views_of
from torchdlo.sysid.video.overlay import overlays
from torchdlo.sysid.video.second_view import SecondView, effect_notes, second_view, second_view_json, visible

__all__ = ["diagnose_filmed"]

Callback = Callable[[str, int, int, str], None]

PAYS = 0.15
"""Share of the excess gap that an effect has to close, on the train and on the test trials."""

MORE = 2.5
"""Times the floor that have to be left for another effect to be looked for."""

SILENT = 1.3
"""Times the floor: below, there is nothing left to look for."""

MATTERS = 0.03
"""Share of the baseline's excess gap that each effect has to close, whatever the others leave."""

BLUNT = 10.0
"""Times what centre lines get wrong from which what finer simulations change is no floor, but a fit that is far off."""

_SHORT = 0.6
"""Share of the time that doses and first fits see."""

_SPINE = 0.15
"""What centre lines of masks get wrong [px], as measured on films of known motions."""

_AT_REST = ("rest_curvature", "varying_rest_curvature", "gripper_compliance")
"""What a single photograph of a rope at rest may name."""

_SAME_AT_REST = ("nonuniform_stiffness", "anisotropic_bending", "stiffening_bending", "tilted_gravity")
"""What no single photograph tells from natural curvature that varies: the moment B κ of any bending stiffness B along
the rope is also B₀ (κ - κ̄) with κ̄ = κ (1 - B / B₀), and so is that of any other load."""

_PATIENCE = 3
"""Times as many steps of the fits that lead, of ropes at rest, whose natural curvature has ten numbers."""

_SIGNS, _KEPT = (1.0, -1.0), 3
"""Directions in which doses are tried with cameras as they were calibrated, and fits that are followed further."""

_AS_GOOD = 1.1
"""Times what the best fit leaves on test trials up to which another one's numbers may be the true ones as well."""

_ROUGH, _AFRESH = 1e-2, 6
"""Share of the cost that another step of a first fit has to save, and most steps of each of those that begin afresh."""

_COMPARED = 3
"""Most steps of the fits of a baseline that leading models are compared with."""

_EXPLAINED = 2.0
"""Times the cost of the floor below which a leading model's trials keep their starts."""

_LEADERS = 3
"""Candidates that are fitted to all of the time."""

_MOST = 0.7
"""Share of what the best fit explains of train films from which a law that says more of unseen ones may be true."""

_BEHIND = 2.0
"""Times the cost of the best first fit from which another one is not followed."""


def diagnose_filmed(
    recording: Recording,
    *,
    budget: str = "fast",
    seed: int = 0,
    vertices: int | None = None,
    given: ModelFile | None = None,
    without: Sequence[str] = (),
    workers: int | None = None,
    callback: Callback | None = None,
) -> Diagnosis:
    """Name what the films of a recording show that the baseline model lacks; see `effect_search.diagnose`."""
    asked = budget, seed, vertices, given, without
    with FitPool(workers) as pool:
        return _diagnosed(recording, *asked, pool, callback or (lambda *_: None))


def _diagnosed(
    recording: Recording,
    budget: str,
    seed: int,
    vertices: int | None,
    given: ModelFile | None,
    without: Sequence[str],
    pool: FitPool,
    report: Callback,
) -> Diagnosis:
    begun = time.perf_counter()
    views, notes = views_of(recording, recording.train, report)
    unseen, said = views_of(recording, recording.test, report)
    near = np.inf if recording.still else NEAR
    own, _, best = baseline(recording, views, FILMED_STARTS, 15, seed, vertices, given, report, near)
    films = Films(own, recording.test, unseen)
    base = nearer(films, best, report) if film_gaps(own, best).max() > near else films.test(own, best)
    if given is None and not recording.still:
        base = chained(base, pool)
        report("calibrating the baseline", 1, 1, f"{1e3 * gap_rms(base.gaps('train')):.2f} mm")
    floor, level = _floor(base)
    plan, first = BUDGETS[budget], base
    shares: dict[str, float] = {}
    ties: dict[str, list[str]] = {}
    rounds: list[list[Candidate]] = []
    while len(rounds) < plan.rounds:
        # Ends of films that are left out say that something is missing, also beside what was found.
        if base.own.lasts == own.lasts and _nothing_left(base, floor, bool(shares)):
            break
        names = [n for n in effect_library.library() if n not in (*base.own.model.effects, *without)]
        names = [n for n in names if effect_library.applicable(n, recording, base.own.model.mesh)]
        if single := recording.still and len(recording.train) == 1:
            names = [n for n in names if n in _AT_REST]
        found, candidates, rivals = _round(
            base, first, names, floor, level, plan, own.lasts, f"round {len(rounds) + 1}", report, pool
        )
        rounds.append(candidates)
        if found is None:
            break
        name = found.own.model.effects[-1]
        excess = max(gap_rms(first.gaps("test")) ** 2 - floor.noise**2, 1e-12)
        shares[name] = (gap_rms(base.gaps("test")) ** 2 - gap_rms(found.gaps("test")) ** 2) / excess
        ties[name] = [*rivals, *(_SAME_AT_REST if single and "curvature" in name else ())]
        base, first = found, _as_counted(first, found)
        if not recording.still:
            first, base = further(films, first, base, given is None, report, pool)
            floor, level = _floor(base)
        base, spare = _needed(base, first, list(shares), floor, level, plan.more, report, pool)
        for name in spare:
            del shares[name], ties[name]
    notes = [*notes, *said, *left_out(base, own), *chain_note(base)]
    view = _elsewhere(base, floor, level, without, report)
    shares = _rescaled(shares, first, base, floor)
    done = _concluded(films, recording, first, base, floor, level, shares, ties, rounds, notes, seed, budget, begun)
    if view is not None:
        done.notes += effect_notes(view)
        done.limits, done.second_view = list(view.limits.values()), second_view_json(view)
    done.seconds = time.perf_counter() - begun
    return done


def _as_counted(first: FilmedModel, found: FilmedModel) -> FilmedModel:
    """Return the baseline over as much of misleading trials as another model was fitted to."""
    own = without_rest(first.own, found.own.misleading)
    if own.misleading == first.own.misleading:
        return first
    return replace(first, own=own, fit=look(own, first.fit.raw, own.offset))


def _elsewhere(
    final: FilmedModel, floor: ErrorFloor, level: float, without: Sequence[str], report: Callback
) -> SecondView | None:
    """Return from which sizes on effects are named on these films, and with one more camera."""
    gap = limit_gap(final.gaps("test"), floor.noise, level, PAYS)
    if not np.isfinite(gap):
        return None
    model = final.own.model
    names = visible(model.recording, model, (*model.effects, *without))
    stage = "looking for a second view"
    return second_view(final.own, final.fit.raw, names=names, level=gap, report=lambda k, n: report(stage, k, n, ""))


def _rescaled(shares: dict[str, float], first: FilmedModel, final: FilmedModel, floor: ErrorFloor) -> dict[str, float]:
    """Return the shares of effects so that they add up to what all of them explain of the films that count.

    Each was found when other lengths of the films may have been looked at; there they are compared to each other.
    """
    before, after = (gap_rms(m.gaps("test")) ** 2 for m in (first, final))
    explained = max(before - after, 0.0) / max(before - floor.noise**2, 1e-12)
    parts = {name: max(share, 1e-6) for name, share in shares.items()}
    return {name: explained * part / sum(parts.values()) for name, part in parts.items()}


def _floor(base: FilmedModel) -> tuple[ErrorFloor, float]:
    """Return what no effect explains: noise of centre lines, and what steps and mesh may still get wrong."""
    each = _floors(base)
    parts = (float(np.sqrt(np.mean([getattr(f, part) ** 2 for f in each]))) for part in ("step", "grid"))
    floor = ErrorFloor(each[0].noise, *parts)
    return floor, floor.total


def _floors(base: FilmedModel) -> list[ErrorFloor]:
    """Return the floor of each train trial."""
    own = base.own
    scale = np.mean([0.5 * (v.camera.fx + v.camera.fy) / own.depth(v) for v in own.spines.views])
    parts = []
    values, sims = base.values[None], own.simulate(base.values[None])
    for wrong in own.discretisation_correction.unsure if own.discretisation_correction else ():
        moved = np.concatenate([sims, sims + np.nan_to_num(wrong)[None]])
        change = own.spines.changes(moved, np.repeat(values[:, len(own.free) :], 2, 0))
        change = np.where(np.isfinite(own.spines.target), change[1] - change[0], np.nan)
        parts.append(np.sqrt(np.nanmean(change[:, :, : own.spines.priors.start] ** 2, (1, 2, 3))))
    step, grid = parts or np.zeros((2, len(own.trials)))
    return [ErrorFloor(_SPINE / float(scale), float(a), float(b)) for a, b in zip(step, grid, strict=True)]


def _nothing_left(base: FilmedModel, floor: ErrorFloor, beside: bool) -> bool:
    """Return whether the gap is so near the floor, on every train trial and on unseen films, that nothing is missing.

    Args:
        base: the model.
        floor: of all trials.
        beside: whether the model has an effect. What is left beside one, and less than finer simulations change, may
            be an error of theirs.
    """

    def small(gap: float, floor: ErrorFloor) -> bool:
        if beside:
            return gap < MORE * floor.total
        return gap < SILENT * (floor.noise if _blunt(floor.total, floor) else floor.total)

    near = all(small(*each) for each in zip(base.gaps("train"), _floors(base), strict=True))
    return near and small(gap_rms(base.gaps("test")), floor)


def _round(
    base: FilmedModel,
    first: FilmedModel,
    names: Sequence[str],
    floor: ErrorFloor,
    level: float,
    plan: Budget,
    whole: float,
    stage: str,
    report: Callback,
    pool: FitPool,
) -> tuple[FilmedModel | None, list[Candidate], list[str]]:
    """Return the model with the best effect added, if one pays, all candidates, and effects that fit as well."""
    short = base.own.lasts if base.own.lasts < whole else _SHORT * whole
    scores = film_scores(base, names, short, lambda k, n: report(f"{stage}: screening", k, n, ""), pool)
    tried = scores[: plan.candidates]
    if not tried:
        return None, [], []
    lead = tried[0].name
    tried += [s for s in scores[plan.candidates :] if effect_library.confusable(s.name, lead)]
    fits: dict[str, FilmedModel] = {}
    for k, found in pool.map(_fitted, [(base, score, plan.iterations, short) for score in tried]):
        fits[tried[k].name] = found
        report(f"{stage}: fitting", len(fits), len(tried), f"{tried[k].name} {1e3 * found.fit.cost:.3f} mm")
    leading = _leading(fits, short, pool)
    more = plan.more * (_PATIENCE if base.own.trials[0].still else 1)
    # Starts that took up what the baseline lacked are not those of a model that has it.
    enough = _EXPLAINED * levenberg_marquardt.cost_of(level)
    on = [*((fits[name], more, enough) for name in leading), (base, _COMPARED, None)]
    rival = base
    for k, found in pool.map(_fitted_on, on):
        if k == len(leading):
            rival = found
            continue
        fits[leading[k]] = found
        report(f"{stage}: fitting on", 1, 1, f"{leading[k]} {1e3 * found.fit.cost:.3f} mm")
    led = _with_special_cases(fits, leading, names, more, enough, pool)
    rival, fits = _counted(rival, fits, led)
    for name in led:
        rival = _begun_alike(rival, fits[name])
    refused = {name: _refused(rival, fits[name], first, floor, level) for name in led}
    fair = [name for name in led if refused[name] is None]
    best, rivals, reasons = None, [], {name: refused.get(name) or "fits worse" for name in fits}
    if fair:
        cost = fits[fair[0]].fit.cost
        tie = max(
            min(0.05 * (rival.fit.cost - cost), 0.5 * max(levenberg_marquardt.cost_of(level), cost)),
            1e-12,
        )
        fitted, said = ({n: _gain(rival, fits[n], split, floor) for n in fair} for split in ("train", "test"))
        close = _alike({n: (fits[n].fit.cost, fitted[n], said[n]) for n in fair}, tie)
        chosen = min(close, key=lambda n: len(fits[n].own.free))
        reasons |= dict.fromkeys(close, "as good as the best") | {chosen: "taken"}
        best, rivals = fits[chosen], [n for n in close if n != chosen]
    closed = {name: _gain(rival, fits[name], "train", floor) for name in led}
    candidates = [
        Candidate(
            s.name,
            s.share,
            closed.get(s.name),
            # Starts of unseen films take as long as a fit: what does not pay on others is not asked for them.
            _gain(rival, fits[s.name], "test", floor) if s.name == led[0] or closed.get(s.name, 0) >= PAYS else None,
            reasons.get(s.name, "its doses explain less"),
        )
        for s in scores
    ]
    return best, candidates, rivals


def _with_special_cases(
    fits: dict[str, FilmedModel],
    leading: Sequence[str],
    names: Sequence[str],
    iterations: int,
    enough: float,
    pool: FitPool,
) -> list[str]:
    """Add fits of the special cases of laws that lead, begun where those are; return what leads then, the best first.

    Air drag is wind of no speed: a law with more numbers may find the way that the true one missed.
    """
    contained = ((name, effect_library.special_case(name)[0]) for name in leading)
    pairs = [(general, special) for general, special in contained if special is not None and special in names]
    jobs = [(_specialised(fits[general], general, special), iterations, enough) for general, special in pairs]
    led = list(leading)
    for k, found in pool.map(_fitted_on, jobs) if jobs else ():
        special = pairs[k][1]
        # Others were fitted to the first seconds alone.
        if special not in led or found.fit.cost < fits[special].fit.cost:
            fits[special] = found
        led += [special] * (special not in led)
    return sorted(led, key=lambda n: fits[n].fit.cost)


def _specialised(model: FilmedModel, general: str, special: str) -> FilmedModel:
    """Return a model in which a special law takes the place of one that contains it, not yet fitted."""
    known = dict(zip(model.own.space.names, model.values, strict=True))
    numbers = {
        n.name: float(known.get(general + n.name.removeprefix(special), n.param.scalar))
        for n in effect_library.numbers(special, model.own.model.recording)
    }
    sizes = {name: abs(value) or 1.0 for name, value in numbers.items()}
    return extended(model, (special,), sizes, numbers, None, (general,))


def _needed(
    base: FilmedModel,
    first: FilmedModel,
    found: list[str],
    floor: ErrorFloor,
    level: float,
    iterations: int,
    report: Callback,
    pool: FitPool,
) -> tuple[FilmedModel, list[str]]:
    """Return the model without effects that do not pay beside those that were found after them, and their names.

    What was taken for one effect before another was known may have been the other's.
    """
    spare: list[str] = []
    enough = _EXPLAINED * levenberg_marquardt.cost_of(level)
    while len(found) - len(spare) > 1:
        older = [name for name in found[:-1] if name not in spare]
        less = pool.all(_fitted_on, [(extended(base, (), {}, {}, None, (n,)), iterations, enough) for n in older])
        rivals = [_begun_alike(rival, base) for rival in less]
        idle = [k for k, rival in enumerate(rivals) if _refused(rival, base, first, floor, level)]
        if not idle:
            break
        k = min(idle, key=lambda k: rivals[k].fit.cost)
        base = rivals[k]
        spare.append(older[k])
        report("looking back", 1, 1, f"{older[k]} does not pay beside what was found after it")
    return base, spare


def _alike(found: Mapping[str, tuple[float, float, float]], tie: float) -> list[str]:
    """Return which effects films do not tell from the one that fits best, itself among them.

    A law with more numbers fits better; one that says as much of unseen films, or more, may be the true one as well if
    it explains most of what that does.

    Args:
        found: costs on train films [m], and shares of the gap of train and of unseen films that are closed, by effect.
        tie: difference of costs that tells nothing [m].
    """
    cost, fitted, said = min(found.values())
    return [n for n, (c, own, test) in found.items() if c - cost < tie or (test >= said and own >= _MOST * fitted)]


def _gain(base: FilmedModel, other: FilmedModel, split: str, floor: ErrorFloor) -> float:
    """Return the share of the excess gap that another model closes."""
    before, after = gap_rms(base.gaps(split)) ** 2, gap_rms(other.gaps(split)) ** 2
    return float((before - after) / max(before - floor.noise**2, (0.3 * floor.noise) ** 2, 1e-12))


def _refused(rival: FilmedModel, other: FilmedModel, first: FilmedModel, floor: ErrorFloor, level: float) -> str | None:
    """Return why a model is no better than its rival, None if it is."""
    if float(np.mean(other.gaps("train") < rival.gaps("train"))) <= 0.6:
        return "helps on too few trials"
    gain = _gain(rival, other, "train", floor)
    if gain < PAYS:
        return f"closes {max(gain, 0):.0%} of the gap"
    if _gain(rival, other, "test", floor) < PAYS:
        return "does not help on the test trials"
    for split in ("train", "test"):
        before, after = (gap_rms(m.gaps(split)) ** 2 for m in (rival, other))
        enough = min(MATTERS * (gap_rms(first.gaps(split)) ** 2 - floor.noise**2), 0.8 * (before - level**2))
        if before - after <= max(level**2, enough):
            return "closes less than the floor leaves open"
    return None


def _fitted(base: FilmedModel, score: Score, iterations: int, seconds: float) -> FilmedModel:
    """Return a first fit of a model with one effect more, from the best of several doses.

    Of ropes at rest all doses are followed, with the camera as it was calibrated, too: a baseline that lacks what bends
    the rope turns the camera, and from there the way to the effect is lost.
    """
    starts = [_dosed(base, score, dose, raw) for dose, raw in score.starts]
    if base.own.trials[0].still:
        for dose, raw in score.starts:
            both = ({k: sign * v for k, v in dose.items()} for sign in _SIGNS)
            starts += [_upright(_dosed(base, score, each, raw)) for each in both]
        for keep, times in ((len(starts), 1), (_KEPT, _PATIENCE)):
            starts = [replace(s, fit=fit(s.own, s.fit.raw, times * iterations)) for s in starts[:keep]]
            starts.sort(key=lambda s: total(s.fit))
        return replace(starts[0], others=tuple(starts[1:]))
    costs = []
    target = base.own.target(seconds)[..., None]
    for start in starts:
        values = start.values[None]
        sims = start.own.simulate(values, start.own.frames(seconds))
        read = start.own.spines.read(sims, values[:, len(start.own.free) :])
        costs.append(levenberg_marquardt.costs(read, target, start.own.extent)[0])
    best = starts[int(np.argmin(costs))]
    return replace(best, fit=fit(best.own, best.fit.raw, iterations, seconds=seconds, tolerance=_ROUGH))


def _leading(fits: dict[str, FilmedModel], seconds: float, pool: FitPool) -> list[str]:
    """Return the effects whose fits to the first seconds are followed, from fresh starts where these fit better."""

    def near(names: Iterable[str]) -> list[str]:
        order = sorted(names, key=lambda n: fits[n].fit.cost)
        return [n for n in order[:_LEADERS] if not fits[n].fit.cost > _BEHIND * fits[order[0]].fit.cost]

    leading = near(fits)
    for k, found in pool.map(_afresh, [(fits[name], seconds) for name in leading]):
        fits[leading[k]] = found
    return near(leading)


def _afresh(model: FilmedModel, seconds: float) -> FilmedModel:
    """Return a better fit of a model to the first seconds: from fresh starts, over more and more of them, or as it is.

    Starts of a baseline make up for what it lacks, and small steps from there may not lead back.
    """
    if not model.own.offset.shape[1]:
        return model
    own, raw = replace(model.own, offset=model.own.fresh), model.fit.raw
    correct(own, None)
    window = min(start_window(own), seconds)
    fit_starts(own, raw, 3, seconds=0.5 * window)
    for until in (window, 0.5 * (window + seconds), seconds):
        raw = fit(own, raw, _AFRESH, seconds=until, tolerance=_ROUGH).raw
    add_correction(own, own.space.to_values(raw))
    found = replace(model, own=own, fit=look(own, raw, own.offset, seconds))
    return min(model, found, key=lambda each: total(each.fit))


def _fitted_on(model: FilmedModel, iterations: int, enough: float | None) -> FilmedModel:
    """Return a model with a better fit; the given one and its starts stay what they are.

    Trials that cost more than `enough` [m] may begin elsewhere, none if it is not given.
    """
    own = replace(model.own)
    found = fit(own, model.fit.raw, iterations)
    if enough is not None:
        found = restart(own, found, iterations, enough)
    # Starts of test trials are fitted when they are asked for, and kept where they were found.
    return replace(model, own=own, fit=found, test=own if model.test is model.own else replace(model.test))


def _begun_alike(rival: FilmedModel, other: FilmedModel) -> FilmedModel:
    """Return a model with the starts of another one of trials that it fits better with these.

    Starts are no merit of an effect.
    """
    if not rival.own.offset.shape[1]:
        return rival
    own = replace(rival.own, offset=other.own.offset.copy())
    better = fit_starts(own, rival.fit.raw, _COMPARED) < rival.fit.costs
    if not better.any():
        return rival
    own.offset = np.where(better[:, None], own.offset, rival.own.offset)
    return replace(rival, own=own, fit=fit(own, rival.fit.raw, _COMPARED))


def _counted(
    rival: FilmedModel, fits: dict[str, FilmedModel], led: Sequence[str]
) -> tuple[FilmedModel, dict[str, FilmedModel]]:
    """Return models without the rest of trials that none of them follows, their rival and those that lead fitted on."""
    lost = misleading_films([(m.own, m.fit) for m in (rival, *(fits[name] for name in led))])
    if not lost:
        return rival, fits

    def without(model: FilmedModel) -> FilmedModel:
        own = without_rest(model.own, lost)
        return replace(model, own=own, fit=fit(own, model.fit.raw, _COMPARED))

    return without(rival), fits | {name: without(fits[name]) for name in led}


def _dosed(base: FilmedModel, score: Score, dose: dict[str, float], raw: np.ndarray) -> FilmedModel:
    """Return a model with one effect more, that begins with a dose of it, not yet fitted."""
    vectors = {ParameterName.parse(name).whole for name in dose}
    numbers = effect_library.numbers(score.name, base.own.model.recording)
    used = {n.name: dose.get(n.name, n.off) for n in numbers if n.which.whole in vectors}
    return extended(base, (score.name,), {n: score.sizes.get(n, 0.0) for n in used}, used, raw)


def _upright(model: FilmedModel) -> FilmedModel:
    """Return a model that begins with cameras as they were calibrated."""
    numbers = np.arange(model.fit.raw.size) < len(model.own.free)
    return replace(model, fit=replace(model.fit, raw=np.where(numbers, model.fit.raw, 0.0)))


def _concluded(
    films: Films,
    recording: Recording,
    first: FilmedModel,
    final: FilmedModel,
    floor: ErrorFloor,
    level: float,
    shares: dict[str, float],
    ties: dict[str, list[str]],
    rounds: list[list[Candidate]],
    notes: list[str],
    seed: int,
    budget: str,
    begun: float,
) -> Diagnosis:
    before, after = first.gaps("test"), final.gaps("test")
    whole = not final.own.lasts < films.whole.lasts
    effects = list(shares)
    point, drifts = spread(final.own, final.fit)
    good = [m for m in final.others if gap_rms(m.gaps("test")) < _AS_GOOD * gap_rms(after)]
    apart = [m.fit.raw - final.fit.raw for m in good]
    drifts = np.concatenate([drifts, *(each[None] / np.sqrt(len(apart)) for each in apart)])
    predictions: dict[str, dict[str, np.ndarray]] = {"before": {}, "after": {}}
    shown = []
    for split in ("train", "test"):
        problems = [films.all_of(m, split) for m in (first, final)]
        sims = [p.simulate(m.values[None])[0] for p, m in zip(problems, (first, final), strict=True)]
        for when, each in zip(predictions, sims, strict=True):
            trials = problems[0].trials
            predictions[when] |= {t.name: s[: len(t.time)] for t, s in zip(trials, each, strict=True)}
        numbers = [m.values[len(m.own.free) :] for m in (first, final)]
        # Each is drawn by the clocks of its own, which are not the same in test films.
        each = zip(problems, sims, numbers, strict=True)
        old, new = (overlays(p, split, np.stack([s, s]), np.stack([n, n])) for p, s, n in each)
        shown += [replace(b, before=a.before) for a, b in zip(old, new, strict=True)]
    done = Diagnosis(
        _verdict(effects, gap_rms(before), gap_rms(after), floor, level if whole else np.inf),
        effects,
        {name: ties[name] for name in effects},
        shares,
        _plain(first, point=spread(first.own, first.fit)[0]),
        _plain(final, point=point),
        floor,
        before,
        after,
        rounds,
        predictions,
        final.own.model,
        drifts,
        notes=[*notes, *([_far(level, floor)] if _blunt(level, floor) else [])],
        options={"budget": budget, "seed": seed, "vertices": final.own.options["vertices"]},
    )
    done.overlays, done.misleading = shown, list(final.own.misleading)
    return done


def _blunt(level: float, floor: ErrorFloor) -> bool:
    """Return whether finer simulations change so much that this is no floor."""
    return not level < BLUNT * floor.noise


def _verdict(effects: list[str], before: float, after: float, floor: ErrorFloor, level: float) -> str:
    """Return the verdict in a word, from gaps [m]; nothing is explained down to a floor that is none."""
    return verdict_word(effects, after, np.inf if _blunt(level, floor) else level, after / before)


def _far(level: float, floor: ErrorFloor) -> str:
    """Return that nothing counts as explained."""
    if not np.isfinite(level):
        return UNKNOWN_FLOOR
    wrong, times = 1e3 * level, level / floor.noise
    return (
        f"Finer simulations of the calibrated model differ from it by {wrong:.1f} mm, {times:.0f} times what centre "
        "lines get wrong: the model is far from this rope, or its motion magnifies small errors, so nothing "
        "counts as explained. Record slower motions, or with a second camera."
    )


def _plain(model: FilmedModel, point: levenberg_marquardt.Point) -> Fitted:
    """Return a fit as those of recordings with markers are."""
    own = model.own
    return Fitted(own.model.effects, own.full(model.values[None])[0], own.space, point, tuple(own.options.items()))
