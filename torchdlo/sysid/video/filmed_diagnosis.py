"""What films show that the baseline lacks: doses of every effect against what it leaves over, fits, and unseen films.

The search is that of recordings with markers, on readings of films: lengths whose target is 0. Cameras, clocks and
starts in motion take up what they can before an effect may explain it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import effect_library, score_test
from torchdlo.sysid.diagnosis.budget import BUDGETS, Budget
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor, gap_rms
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.diagnosis.verdict import UNKNOWN_FLOOR, Candidate, Diagnosis, verdict_word
from torchdlo.sysid.diagnosis.workspace import CHAIN
from torchdlo.sysid.estimation import levenberg_marquardt
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.observation import FilmView, Spines
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.model.rope_model import MAX_SUBSTEP
from torchdlo.sysid.recordings.recording import Recording, Trial
from torchdlo.sysid.video.filmed import FILMED_STARTS, baseline, require_simulated, sharper, test_problem
from torchdlo.sysid.video.filmed_fit import Fit, film_gaps, fit, look, spread, total
from torchdlo.sysid.video.filmed_problem import FilmedProblem, add_correction, correct, first_frames
from torchdlo.sysid.video.filmed_starts import fit_starts
from torchdlo.sysid.video.footage import views_of
from torchdlo.sysid.video.overlay import overlays

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

NEAR = 5e-3
"""Gap [m] from which a baseline is not near its films: only the beginnings of trials are then looked at."""

_SHARES = (0.6, 0.35, 0.2)
"""Shares of the time that are tried for these."""

_LONGER = 1.5
"""Times as much of the films that a model with a new effect is fitted to at once."""

_FOLLOW = 6
"""Most steps of each such fit."""

_BETTER = 0.9
"""Share of the cost that is left where the rope is taken for a chain."""

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

_LEADERS = 3
"""Candidates that are fitted to all of the time."""

_BEHIND = 2.0
"""Times the cost of the best first fit from which another one is not followed."""


@dataclass(eq=False)
class _Model:
    """A model with its fit."""

    own: FilmedProblem
    fit: Fit
    test: FilmedProblem
    """The same of the test trials."""
    others: tuple[_Model, ...] = ()
    """Where other starts ended."""
    _tested: np.ndarray | None = field(init=False, default=None)

    @property
    def values(self) -> np.ndarray:
        """Numbers of rope and cameras, shape (N,)."""
        return self.own.space.to_values(self.fit.raw)

    def gaps(self, split: str) -> np.ndarray:
        """Return root mean squares of the readings of trials [m], shape (B,)."""
        if split == "train":
            return film_gaps(self.own, self.fit)
        if self._tested is None:
            here = self.test
            if here.offset.shape[1]:
                fit_starts(here, self.fit.raw, 3)
            read = here.spines.read(here.simulate(self.values[None]), self.values[None, len(here.free) :])[0]
            residual = np.where(np.isfinite(here.spines.target), read, np.nan)[:, :, : here.spines.priors.start, 0]
            self._tested = np.sqrt(np.nanmean(residual**2, (1, 2)))
        return self._tested


def diagnose_filmed(
    recording: Recording,
    *,
    budget: str = "fast",
    seed: int = 0,
    vertices: int | None = None,
    given: ModelFile | None = None,
    without: Sequence[str] = (),
    callback: Callback | None = None,
) -> Diagnosis:
    """Name what the films of a recording show that the baseline model lacks; see `diagnosis.search.diagnose`."""
    begun, report = time.perf_counter(), callback or (lambda *_: None)
    views, notes = views_of(recording, recording.train, report)
    near = np.inf if recording.still else NEAR
    own, _, best = baseline(recording, views, FILMED_STARTS, 15, seed, vertices, given, report, near)
    unseen, said = views_of(recording, recording.test, report)
    films = _Films(own, recording.test, unseen)
    base = _nearer(films, best, report) if film_gaps(own, best).max() > near else films.test(own, best)
    if given is None and not recording.still:
        base = _chained(base)
        report("calibrating the baseline", 1, 1, f"{1e3 * gap_rms(base.gaps('train')):.2f} mm")
    floor, level = _floor(base)
    plan, first = BUDGETS[budget], base
    shares: dict[str, float] = {}
    ties: dict[str, list[str]] = {}
    rounds: list[list[Candidate]] = []
    while len(rounds) < plan.rounds:
        # What is left beside an effect, and less than finer simulations change, may be an error of theirs.
        bar = floor.noise if _blunt(level, floor) and not shares else level
        # Ends of films that are left out say that something is missing, also beside what was found.
        if (
            base.own.lasts == own.lasts
            and gap_rms(np.concatenate([base.gaps("train"), base.gaps("test")])) < (MORE if shares else SILENT) * bar
        ):
            break
        names = [n for n in effect_library.library() if n not in (*base.own.model.effects, *without)]
        names = [n for n in names if effect_library.applicable(n, recording, base.own.model.mesh)]
        if single := recording.still and len(recording.train) == 1:
            names = [n for n in names if n in _AT_REST]
        found, candidates, rivals = _round(
            base, first, names, floor, level, plan, own.lasts, f"round {len(rounds) + 1}", report
        )
        rounds.append(candidates)
        if found is None:
            break
        name = found.own.model.effects[-1]
        excess = max(gap_rms(first.gaps("test")) ** 2 - floor.noise**2, 1e-12)
        shares[name] = (gap_rms(base.gaps("test")) ** 2 - gap_rms(found.gaps("test")) ** 2) / excess
        ties[name] = [*rivals, *(_SAME_AT_REST if single and "curvature" in name else ())]
        base = found
        if not recording.still:
            first, base = _further(films, first, base, given is None, report)
            floor, level = _floor(base)
    notes = [*notes, *said, *_left_out(base, own), *_chain_note(base)]
    shares = _rescaled(shares, first, base, floor)
    return _concluded(films, recording, first, base, floor, level, shares, ties, rounds, notes, seed, budget, begun)


def _rescaled(shares: dict[str, float], first: _Model, final: _Model, floor: ErrorFloor) -> dict[str, float]:
    """Return the shares of effects so that they add up to what all of them explain of the films that count.

    Each was found when other lengths of the films may have been looked at; there they are compared to each other.
    """
    before, after = (gap_rms(m.gaps("test")) ** 2 for m in (first, final))
    explained = max(before - after, 0.0) / max(before - floor.noise**2, 1e-12)
    parts = {name: max(share, 1e-6) for name, share in shares.items()}
    return {name: explained * part / sum(parts.values()) for name, part in parts.items()}


@dataclass(frozen=True, eq=False)
class _Films:
    """All films of a recording."""

    whole: FilmedProblem
    """The problem of all of the train trials."""
    trials: tuple[Trial, ...]
    """Test trials."""
    views: list[FilmView]
    """What cameras saw of those."""

    def test(self, own: FilmedProblem, best: Fit) -> _Model:
        """Return a fitted model with what its numbers say of the test films, over as long a time."""
        trials, views, seconds = self.trials, self.views, own.lasts
        if seconds < self.whole.lasts:
            trials = first_frames(trials, own.motion.markers.shape[1])
            views = [v.shortened(seconds) for v in views]
        return _Model(own, best, test_problem(own, trials, views, own.space.to_values(best.raw)))

    def all_of(self, model: _Model, split: str) -> FilmedProblem:
        """Return a model's problem of all of the time."""
        if not model.own.lasts < self.whole.lasts:
            return model.own if split == "train" else model.test
        if split == "train":
            return model.own.over(self.whole, self.whole.lasts)
        here, model_of = model.test, model.own.model
        spines = Spines(self.views, model_of.dt, here.extent, here.spines.free, here.spines.sure)
        start = replace(here.start, discretisation_correction=None)
        parts: dict[str, Any] = {
            "trials": self.trials,
            "motion": model_of.motion(self.trials),
            "spines": spines,
            "start": start,
        }
        return replace(here, **parts, discretisation_correction=None)


def _nearer(films: _Films, best: Fit, report: Callback) -> _Model:
    """Return the baseline of as much of the films' beginnings as it can stay near to.

    Over longer times the answer to what is missing is so large that nothing leads back to it: other numbers have gone
    far off to follow at all, and small doses of the right effect do not help them.
    """
    whole, raw = films.whole, best.raw
    coarse = whole.with_options(substep=MAX_SUBSTEP)
    for share in _SHARES:
        own = coarse.over(whole, share * whole.lasts)
        found = fit(own, raw, _FOLLOW)
        coarse.offset = own.offset
        report("fitting the beginnings", 1, 1, f"{own.lasts:.2f} s: {1e3 * gap_rms(film_gaps(own, found)):.2f} mm")
        if film_gaps(own, found).max() < NEAR:
            break
        raw = found.raw
    require_simulated(whole.model.recording, found)
    found = sharper(own, found.raw, _FOLLOW)
    return films.test(own, found)


def _further(films: _Films, first: _Model, found: _Model, chains: bool, report: Callback) -> tuple[_Model, _Model]:
    """Return the baseline and the model that took up an effect, over as much of the films as that stays near to.

    What the lack of the effect hid is looked for, too, unless `chains` is false: whether the rope is a chain of links.
    The baseline then becomes one as well: what links explain is no merit of the effect.
    """
    whole, begun_with = films.whole, found.own.lasts
    chain = not chains or CHAIN in found.own.model.effects
    if not chain:
        found = _chained(found)
        chain = CHAIN in found.own.model.effects
    while found.own.lasts < whole.lasts:
        own = found.own.over(whole, min(_LONGER * found.own.lasts, whole.lasts))
        best = fit(own, found.fit.raw, _FOLLOW)
        report("fitting longer", 1, 1, f"{own.lasts:.2f} s: {1e3 * gap_rms(film_gaps(own, best)):.2f} mm")
        if not chain:
            other = _chained(_Model(own, best, found.test))
            chain = CHAIN in other.own.model.effects
            own, best = other.own, other.fit
        if not film_gaps(own, best).max() < NEAR:
            break
        found = replace(found, own=own, fit=best)
    if found.own.lasts == begun_with:
        return _alike(first, found), found
    add_correction(found.own, found.values)
    found = films.test(found.own, fit(found.own, found.fit.raw, _FOLLOW))
    plain = first.own.over(whole, found.own.lasts)
    # Both are compared to films with what finer simulations change.
    add_correction(plain, first.values)
    return _alike(films.test(plain, fit(plain, first.fit.raw, _FOLLOW)), found), found


def _alike(first: _Model, found: _Model) -> _Model:
    """Return the baseline as a chain of links if the model is one, unless films fit worse to that."""
    length = _links(found)
    if length is None or _links(first) is not None:
        return first
    chain = _linked(first, length)
    chain = replace(chain, fit=fit(chain.own, chain.fit.raw, _FOLLOW))
    return chain if chain.fit.cost < first.fit.cost else first


def _links(model: _Model) -> float | None:
    """Return the length of a chain's links [m], with the sign of their number; None of a rope."""
    own = model.own
    if CHAIN not in own.model.effects:
        return None
    return float(own.full(model.values[None])[0, own.model.parameters.index(f"{CHAIN}.length")])


def _chain_note(final: _Model) -> list[str]:
    """Return that the rope was taken for a chain of links."""
    length = _links(final)
    if length is None:
        return []
    return [
        f"The rope moves like a chain of links of about {1e3 * abs(length):.0f} mm, as simulated ones may; what that "
        "explains is not counted as an effect."
    ]


def _left_out(final: _Model, whole: FilmedProblem) -> list[str]:
    """Return that films were not compared to their ends."""
    if not final.own.lasts < whole.lasts:
        return []
    begun = f"Only the first {final.own.lasts:.2f} s of each trial count"
    if not final.gaps("train").max() < NEAR:
        return [f"{begun}, and even over these no model stayed within {1e3 * NEAR:.0f} mm of the films."]
    return [f"{begun}: over longer times no model stayed within {1e3 * NEAR:.0f} mm of the films."]


def _chained(plain: _Model) -> _Model:
    """Return the model as a chain of links, if films fit to that much better."""
    link = float(np.diff(plain.own.model.arclength).min())
    sides = []
    for length in (link, -link):
        chain = _linked(plain, length)
        sides.append(replace(chain, fit=fit(chain.own, chain.fit.raw, 2)))
    best = min(sides, key=lambda s: s.fit.cost)
    if not best.fit.cost < plain.fit.cost:
        return plain
    best = replace(best, fit=fit(best.own, best.fit.raw, 6))
    return best if best.fit.cost < _BETTER * plain.fit.cost else plain


def _linked(plain: _Model, length: float) -> _Model:
    """Return the model as a chain of links of this length [m], not yet fitted."""
    link = float(np.diff(plain.own.model.arclength).min())
    chain = _extended(plain, (CHAIN,), {f"{CHAIN}.length": 0.5 * link}, {f"{CHAIN}.length": length}, None)
    for problem in (chain.own, chain.test):
        if (known := problem.discretisation_correction) is not None:
            # A mesh with edges as long as the links is not wrong.
            correct(problem, replace(known, links=abs(length)))
    return chain


def _extended(
    base: _Model,
    added: Sequence[str],
    sizes: dict[str, float],
    numbers: dict[str, float],
    raw: np.ndarray | None,
) -> _Model:
    """Return a model with more effects, that begins with some of their numbers, not yet fitted.

    Args:
        base: the model.
        added: effects.
        sizes: what counts as much of their numbers.
        numbers: those that are fitted.
        raw: coordinates (N,) of the model's own numbers; where they are if not given.
    """
    effects = (*base.own.model.effects, *added)
    known = base.own.space.to_values(base.fit.raw if raw is None else base.own.space.clip(raw))
    count = len(base.own.free)
    parts = []
    for problem in (base.own, base.test):
        more = problem.with_effects(effects, {k: v for k, v in sizes.items() if v}, list(numbers))
        for k, column in enumerate(problem.free):
            more.fixed[more.model.parameters.index(problem.model.parameters[column])] = known[k]
        for name, value in numbers.items():
            more.fixed[more.model.parameters.index(name)] = value
        parts.append(more)
    start = np.concatenate([parts[0].fixed[list(parts[0].free)], known[count:]])
    at = parts[0].space.clip(parts[0].space.to_raw(start))
    return _Model(parts[0], replace(base.fit, raw=at), parts[1])


def _floor(base: _Model) -> tuple[ErrorFloor, float]:
    """Return what no effect explains: noise of centre lines, and what steps and mesh may still get wrong."""
    own = base.own
    scale = np.mean([0.5 * (v.camera.fx + v.camera.fy) / own.depth(v) for v in own.spines.views])
    parts = []
    values, sims = base.values[None], own.simulate(base.values[None])
    for wrong in own.discretisation_correction.unsure if own.discretisation_correction else ():
        moved = np.concatenate([sims, sims + np.nan_to_num(wrong)[None]])
        change = own.spines.changes(moved, np.repeat(values[:, len(own.free) :], 2, 0))
        change = np.where(np.isfinite(own.spines.target), change[1] - change[0], np.nan)
        parts.append(float(np.sqrt(np.nanmean(change[:, :, : own.spines.priors.start] ** 2))))
    floor = ErrorFloor(_SPINE / float(scale), *parts)
    return floor, floor.total


def _round(
    base: _Model,
    first: _Model,
    names: Sequence[str],
    floor: ErrorFloor,
    level: float,
    plan: Budget,
    whole: float,
    stage: str,
    report: Callback,
) -> tuple[_Model | None, list[Candidate], list[str]]:
    """Return the model with the best effect added, if one pays, all candidates, and effects that fit as well."""
    short = base.own.lasts if base.own.lasts < whole else _SHORT * whole
    scores = _scores(base, names, short, lambda k, n: report(f"{stage}: screening", k, n, ""))
    tried = scores[: plan.candidates]
    if not tried:
        return None, [], []
    lead = tried[0].name
    tried += [s for s in scores[plan.candidates :] if effect_library.confusable(s.name, lead)]
    fits: dict[str, _Model] = {}
    for k, score in enumerate(tried):
        fits[score.name] = _fitted(base, score, plan.iterations, short)
        report(f"{stage}: fitting", k + 1, len(tried), f"{score.name} {1e3 * fits[score.name].fit.cost:.3f} mm")
    order = sorted(fits, key=lambda n: fits[n].fit.cost)
    leading = [n for n in order[:_LEADERS] if not fits[n].fit.cost > _BEHIND * fits[order[0]].fit.cost]
    for name in leading:
        one = fits[name]
        more = plan.more * (_PATIENCE if base.own.trials[0].still else 1)
        fits[name] = replace(one, fit=fit(one.own, one.fit.raw, more))
        report(f"{stage}: fitting on", 1, 1, f"{name} {1e3 * fits[name].fit.cost:.3f} mm")
    rival = replace(base, fit=fit(base.own, base.fit.raw, 3))
    led = sorted(leading, key=lambda n: fits[n].fit.cost)
    refused = {name: _refused(rival, fits[name], first, floor, level) for name in led}
    fair = [name for name in led if refused[name] is None]
    best, rivals, reasons = None, [], {name: refused.get(name) or "fits worse" for name in fits}
    if fair:
        cost = fits[fair[0]].fit.cost
        tie = max(
            min(0.05 * (rival.fit.cost - cost), 0.5 * max(levenberg_marquardt.cost_of(level), cost)),
            1e-12,
        )
        close = [n for n in fair if fits[n].fit.cost - cost < tie]
        chosen = min(close, key=lambda n: len(fits[n].own.free))
        reasons |= dict.fromkeys(close, "as good as the best") | {chosen: "taken"}
        best, rivals = fits[chosen], [n for n in close if n != chosen]
    candidates = [
        Candidate(
            s.name,
            s.share,
            _gain(rival, fits[s.name], "train", floor) if s.name in led else None,
            _gain(rival, fits[s.name], "test", floor) if s.name in led else None,
            reasons.get(s.name, "its doses explain less"),
        )
        for s in scores
    ]
    return best, candidates, rivals


def _gain(base: _Model, other: _Model, split: str, floor: ErrorFloor) -> float:
    """Return the share of the excess gap that another model closes."""
    before, after = gap_rms(base.gaps(split)) ** 2, gap_rms(other.gaps(split)) ** 2
    return float((before - after) / max(before - floor.noise**2, (0.3 * floor.noise) ** 2, 1e-12))


def _refused(rival: _Model, other: _Model, first: _Model, floor: ErrorFloor, level: float) -> str | None:
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


def _fitted(base: _Model, score: Score, iterations: int, seconds: float) -> _Model:
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
    return replace(best, fit=fit(best.own, best.fit.raw, iterations, seconds=seconds))


def _dosed(base: _Model, score: Score, dose: dict[str, float], raw: np.ndarray) -> _Model:
    """Return a model with one effect more, that begins with a dose of it, not yet fitted."""
    vectors = {ParameterName.parse(name).whole for name in dose}
    numbers = effect_library.numbers(score.name, base.own.model.recording)
    used = {n.name: dose.get(n.name, n.off) for n in numbers if n.which.whole in vectors}
    return _extended(base, (score.name,), {n: score.sizes.get(n, 0.0) for n in used}, used, raw)


def _upright(model: _Model) -> _Model:
    """Return a model that begins with cameras as they were calibrated."""
    numbers = np.arange(model.fit.raw.size) < len(model.own.free)
    return replace(model, fit=replace(model.fit, raw=np.where(numbers, model.fit.raw, 0.0)))


def _tangents(own: FilmedProblem, here: Fit, seen: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return what numbers, cameras and starts can change of weighted readings, (R + N, N), their priors below."""
    count, moving = here.raw.size, here.offset.shape[1]
    columns = [(here.jacobian[:, k] * weight)[seen] for k in range(count)]
    for b in range(len(seen)):
        only = np.zeros_like(weight)
        only[b] = weight[b]
        columns += [] if own.start.at_rest[b] else [(here.jacobian[:, count + k] * only)[seen] for k in range(moving)]
    jacobian = np.stack(columns, 1).astype(float)
    priors = np.zeros((jacobian.shape[1], jacobian.shape[1]))
    per_trial = float(seen.sum()) / len(seen)
    priors[range(count, len(priors)), range(count, len(priors))] = np.sqrt(own.prior.mean() * per_trial)
    return np.concatenate([jacobian, priors])


def _scores(base: _Model, names: Sequence[str], seconds: float, report: Callable[[int, int], None]) -> list[Score]:
    """Return the scores of effects, best first: what their doses explain beyond what all other numbers can.

    Args:
        base: the model.
        names: effects to try.
        seconds: over which films are compared.
        report: told how many groups are done, and in all.
    """
    own, values = base.own, base.values
    here = look(own, base.fit.raw, own.offset, seconds)
    known = dict(zip(own.model.parameters, own.full(values[None])[0], strict=True))
    sims = own.simulate(values[None])
    step = max(1, sims.shape[2] // 50)
    curved = score_test.curvature_scale(sims[0][:, ::step])
    doses = {n: effect_library.perturbations(n, own.model.recording, own.model.mesh, curved, known) for n in names}
    groups = score_test._groups(names, doses)
    seen = np.isfinite(here.residual)
    weight = np.where(seen, 1 / (np.nan_to_num(here.residual) ** 2 + levenberg_marquardt.KNEE**2) ** 0.25, 0.0)
    left, count = -(np.nan_to_num(here.residual) * weight)[seen], here.raw.size
    q, r = np.linalg.qr(_tangents(own, here, seen, weight))
    pad = np.zeros(len(q) - len(left))
    left = np.concatenate([left, pad])
    left = left - q @ (q.T @ left)
    scores = []
    report(0, len(groups))
    for done, group in enumerate(groups):
        more = own.with_effects((*own.model.effects, *group), {}, [])
        more.fixed[:] = [known.get(n, f) for n, f in zip(more.model.parameters, more.fixed, strict=True)]
        rows = [more.fixed.copy()]
        owner = []
        for name in group:
            for probe in doses[name]:
                rows.append(more.fixed.copy())
                owner.append(name)
                for key, value in probe.values.items():
                    rows[-1][more.model.parameters.index(key)] = value
        every = replace(more, free=tuple(range(len(more.fixed))))
        cameras = np.repeat(values[None, len(own.free) :], len(rows), 0)
        offsets = np.repeat(own.offset[None], len(rows), 0)
        given = np.concatenate([np.stack(rows), cameras], 1)
        moved = every.simulate(given, own.frames(seconds), offsets)
        read = own.spines.changes(moved, cameras)[..., 0]
        for name in group:
            picked = [k + 1 for k, o in enumerate(owner) if o == name]
            change = np.stack(
                [np.concatenate([np.nan_to_num((read[k] - read[0]) * weight)[seen], pad]) for k in picked], 1
            )
            absorbed = q.T @ change
            mixtures = score_test._mixtures(doses[name], change - q @ absorbed, left)
            starts = []
            for found in mixtures[: score_test._PLACES]:
                back = np.linalg.lstsq(r, absorbed @ found.amounts, rcond=1e-6)[0][:count]
                for share in score_test._ON_THE_WAY:
                    raw = here.raw - np.clip(share * back, -1.0, 1.0)
                    starts.append((score_test._mixture(name, doses[name], share * found.amounts), raw))
            best, sizes = mixtures[0], score_test._sizes(name, doses[name])
            scores.append(Score(name, best.share, starts[0][0], tuple(starts), sizes, best.direction))
        report(done + 1, len(groups))
    return sorted(scores, key=lambda s: -s.share)


def _concluded(
    films: _Films,
    recording: Recording,
    first: _Model,
    final: _Model,
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
        shown += overlays(problems[0], split, np.stack(sims), np.stack(numbers))
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
    done.overlays, done.seconds = shown, time.perf_counter() - begun
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


def _plain(model: _Model, point: levenberg_marquardt.Point) -> Fitted:
    """Return a fit as those of recordings with markers are."""
    own = model.own
    return Fitted(own.model.effects, own.full(model.values[None])[0], own.space, point, tuple(own.options.items()))
