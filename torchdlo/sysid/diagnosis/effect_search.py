"""Find where a model and measurements disagree, name the effect that is missing, add it, and see the gap shrink.

The baseline is calibrated; doses of every effect of the library are held against what it leaves over; the leading ones
are fitted jointly with the baseline's numbers; the best is kept if it closes enough of the gap on every trial, and the
search goes on from there. Test trials are used at the end only: to confirm, or to refuse, what the train trials said.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.physics.effects.parameter_name import ParameterName, values_of
from torchdlo.sysid.calibration.absolute import mass_note
from torchdlo.sysid.diagnosis import baseline as baselines
from torchdlo.sysid.diagnosis import budget as plan
from torchdlo.sysid.diagnosis import clamp_models, effect_library, error_floor, gripper_forces, selection
from torchdlo.sysid.diagnosis.backward_elimination import EliminationResult, Revision
from torchdlo.sysid.diagnosis.budget import BUDGETS, Budget
from torchdlo.sysid.diagnosis.candidate_fits import extended_fits, short_frames
from torchdlo.sysid.diagnosis.detection_limit import detection_limits, limit_gap
from torchdlo.sysid.diagnosis.error_floor import gap_rms, trial_gaps
from torchdlo.sysid.diagnosis.gripper_forces import ForceErrors
from torchdlo.sysid.diagnosis.misleading_trials import MisleadingTrial, errors_by_frame, misleading_trials
from torchdlo.sysid.diagnosis.plausibility import implausible, unresolved
from torchdlo.sysid.diagnosis.score_test import Score, score_effects
from torchdlo.sysid.diagnosis.selection import PAYS
from torchdlo.sysid.diagnosis.significance import TOO_FEW, Agreement, agreement, chance
from torchdlo.sysid.diagnosis.verdict import (
    UNKNOWN_FLOOR,
    BestCandidate,
    Candidate,
    Diagnosis,
    finite_trials,
    verdict_word,
)
from torchdlo.sysid.diagnosis.workspace import CHAIN, SILENT, Callback, Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted
from torchdlo.sysid.estimation.levenberg_marquardt import interval
from torchdlo.sysid.estimation.result_cache import ResultCache
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model.model_file import ModelFile
from torchdlo.sysid.recordings import data_quality
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.sysid.recordings.wrench import check_forces, force_doubts
from torchdlo.sysid.video import fit_memory
from torchdlo.sysid.video.filmed_diagnosis import diagnose_filmed

MUCH = 0.15
"""Share of the excess gap of the test trials from which an effect that is not named is spoken of, unless by chance."""

MORE = 2.5
"""Times the floor that have to be left for another effect to be looked for: one of three times the floor leaves 3.2."""

NOTHING_LEFT = "the floor leaves nothing that could be named"
"""Why nothing is fitted where the baseline is as near the floor as it may be."""

LEADERS = 2
"""Effects that are fitted further in each round, besides those that are nearly as good."""

_NEAR = 0.1
"""Share of what the best short fit saves that makes others nearly as good."""


def diagnose(
    recording: Recording,
    *,
    budget: str = "fast",
    seed: int = 0,
    vertices: int | None = None,
    trials: int | None = None,
    workers: int | None = None,
    callback: Callback | None = None,
    journal: Path | None = None,
    resume: bool = False,
    given: ModelFile | None = None,
    without: Sequence[str] = (),
) -> Diagnosis:
    """Name what a recording shows that the baseline model lacks.

    Args:
        recording: what was measured.
        budget: "fast" or "full".
        seed: of the random starts.
        vertices: vertices of the rope; from the spacing of the markers if not given.
        trials: most train trials to use; by the budget if not given.
        workers: processes; one per core if not given.
        callback: see `Callback`.
        journal: folder that keeps what is done, so that a search which was stopped can go on.
        resume: go on from it.
        given: model to take as the baseline, with its effects, in place of many starts.
        without: effects of the library that are not looked for.
    """
    if budget not in BUDGETS:
        raise InputError(f"budget is {budget!r}; expected one of {', '.join(BUDGETS)}.")
    for name in without:
        effect_library.check_known("without", name)
    if recording.filmed:
        asked: dict[str, Any] = {
            "budget": budget,
            "seed": seed,
            "vertices": vertices,
            "given": given,
            "without": tuple(without),
        }
        most = plan.pick_trials(recording, trials or BUDGETS[budget].trials)
        with fit_memory.remembering(journal, most, asked, resume=resume):
            return diagnose_filmed(most, **asked, workers=workers, callback=callback)
    begun, report = time.perf_counter(), callback or (lambda *_: None)
    check_forces(recording)
    recording, faults = data_quality.check(recording)
    whole = len(recording.train)
    recording = plan.pick_trials(recording, trials or BUDGETS[budget].trials)
    options = plan.model_options(recording, vertices)
    if given is not None:
        options |= given.options if vertices is None else given.options | {"vertices": vertices}
    asked = {"budget": BUDGETS[budget], "seed": seed, "options": options, "first": given and given.values}
    less = {"without": ", ".join(sorted(set(without)))} if without else {}
    kept = None if journal is None else ResultCache(journal, recording, asked | less, resume=resume)
    with Pool(recording, options, workers, kept) as pool:
        search = _Search(pool, BUDGETS[budget], np.random.default_rng(seed), report, without)
        found = search.run(given)
    found.data_issues, found.options = faults, {"budget": budget, "seed": seed, "vertices": options["vertices"]} | less
    if len(recording.train) < whole:
        found.notes.append(f"{len(recording.train)} of the {whole} train trials were used, evenly picked.")
    found.seconds = time.perf_counter() - begun
    return found


class _Search:
    """One diagnosis."""

    def __init__(
        self, pool: Pool, budget: Budget, rng: np.random.Generator, report: Callback, without: Sequence[str] = ()
    ) -> None:
        self.budget, self.rng, self.report, self.excluded = budget, rng, report, without
        self.bench, self.recording = Workspace(pool), pool.recording
        """What is known by now."""
        self.baseline: Fitted | None = None
        self.force_before: ForceErrors | None = None
        """How far the baseline's forces at the grippers are off."""
        self.plain: list[Fitted] = []
        """The baseline, and what it became when it was fitted for as long as the first candidates were."""
        self._reductions: dict[Hashable, tuple[Hashable, Fitted]] = {}
        self.scores: list[Score] = []
        """Of all effects, beside the baseline."""
        self.misleading: list[MisleadingTrial] = []
        """Train trials that count up to a frame only."""
        self.small = ""
        """What was not named because it is as small as what steps do, in a sentence."""
        self.leading: BestCandidate | None = None
        """What came closest in the last round, if it was not taken."""

    @property
    def pool(self) -> Pool:
        """What simulates by now."""
        return self.bench.pool

    @property
    def revision(self) -> Revision:
        """Second looks, with what is known by now."""
        return Revision(self.bench, self.budget, self.plain, self.report, self._reductions)

    def run(self, given: ModelFile | None = None) -> Diagnosis:
        """Go through all stages."""
        count, most = self.budget.starts, self.budget.more
        if given is None:
            self.bench, base = baselines.calibrate_baseline(self.bench, count, most, self.rng, self.report)
        else:
            self.bench, base = baselines.go_on(self.bench, given, most, self.report)
        self.bench, base = gripper_forces.take_forces(self.bench, base, most, self.report)
        self.force_before = gripper_forces.force_errors(self.bench, base)
        self.baseline, self.before = base, self.bench.prediction(base, "all")
        self.plain.append(base)
        self._say_floor()
        rounds: list[list[Candidate]] = []
        found = EliminationResult()
        whole = self._excess(base)
        while len(rounds) < self.budget.rounds + (len(found.shares) < len(rounds)):
            if found.shares and gap_rms(self.bench.gaps(base, "all")) < MORE * self.bench.level:
                break
            if not (names := [n for n in self._possible() if n not in base.effects]):
                break
            best, rival, candidates, rivals = self._round(base, names, f"round {len(rounds) + 1}")
            rounds.append(candidates)
            if best is None:
                if not found.shares and (further := self._anew(rival)):
                    base, whole = further, self._excess(further)
                    if CHAIN in base.effects:
                        continue
                elif rival is not base and (found.shares or rival.options != base.options):
                    base = rival
                    self._take(base)
                break
            name, old = best.effects[-1], self._squared(base)
            found.rivals[name] = rival
            self._take(best)
            found.shares[name], found.ties[name] = (old - self._squared(best)) / whole, rivals
            self.bench, base = baselines.go_further(self.bench, best, self.budget.more, self.report)
            found.shares[name] += (self._squared(best) - self._squared(base)) / whole
            base = self.revision.exchanged(self.revision.pruned(base, found), found, self._possible())
            self._take(base)
            self._say_floor()
        base = self.revision.plainer(self.revision.pruned(base, found), found, self._possible())
        return self._conclude(base, found, rounds)

    def _take(self, model: Fitted) -> None:
        """Give all models the options of this one from now on."""
        self.bench = self.bench.with_options(dict(model.options))

    def _anew(self, base: Fitted) -> Fitted | None:
        """Return a baseline that no effect explains, fitted further, as a chain of links if that is what it then is.

        None where nothing is left to be explained, or it is known to be a chain.
        """
        if CHAIN in base.effects or gap_rms(self.bench.gaps(base, "all")) < SILENT * self.bench.level:
            return None
        self.bench, further = baselines.go_further(self.bench, base, self.budget.more, self.report)
        self.baseline, self.before = further, self.bench.prediction(further, "all")
        self.force_before = gripper_forces.force_errors(self.bench, further)
        self.plain[:] = [further]
        return further

    def _excess(self, fitted: Fitted) -> float:
        return max(self._squared(fitted) - self.bench.floor.noise**2, 1e-12)

    def _squared(self, fitted: Fitted) -> float:
        """Return the squared gap on the test trials [m^2]; all frames count the same, whatever is known of them.

        Trials that the baseline does not get through are left out, as nothing can be compared with them.
        """
        trials = self.bench.trials["test"]
        gaps, plain = (
            trial_gaps(s, trials) for s in (self.bench.prediction(fitted, "test"), self.before[-len(trials) :])
        )
        return float(gap_rms(gaps[finite_trials(plain)]) ** 2)

    def _possible(self) -> list[str]:
        mesh, names = self.pool.local.model(()).mesh, [n for n in effect_library.library() if n not in self.excluded]
        return [n for n in names if effect_library.applicable(n, self.recording, mesh)]

    def _say_floor(self) -> None:
        self.report("measuring the floor", 1, 1, f"{1e3 * self.bench.floor.total:.2f} mm")

    def _round(
        self, base: Fitted, names: Sequence[str], stage: str
    ) -> tuple[Fitted | None, Fitted, list[Candidate], list[str]]:
        """Return the model with the best effect added, if one pays, that without, all candidates, and equal ones."""
        scores = score_effects(
            self.pool,
            base,
            names,
            self.bench.starts["train"],
            lambda k, n: self.report(f"{stage}: screening", k, n, ""),
        )
        soft = [
            s
            for s in scores[self.budget.candidates :]
            if s.name == clamp_models.NAME and clamp_models.may_be_stiff(self.bench, base)
        ]
        self.scores = self.scores or scores
        if self._nothing_left(base):
            self.leading = None
            return None, base, [Candidate(s.name, s.share, None, None, NOTHING_LEFT) for s in scores], []
        fits, led, rival, worst = self._fits(base, [*scores[: self.budget.candidates], *soft], stage)
        self.bench.predict([base, rival, *fits.values()])
        if lost := self._misleading([rival, *fits.values()]):
            self.misleading += lost
            self.bench = self.bench.discount({trial.name: trial.frame for trial in lost})
            jobs = [self.bench.further(f, self.budget.more) for f in (rival, *(fits[name] for name in led))]
            rival, *again = self._fitted(jobs, f"{stage}, without {', '.join(trial.name for trial in lost)}")
            fits |= dict(zip(led, again, strict=True))
            self.bench.predict([rival, *again])
        if base is self.baseline:
            self.plain.append(rival)
        first = min(led, key=lambda name: fits[name].point.cost)
        left = gap_rms(self.bench.gaps(fits[first], "all")) > SILENT * self.bench.level
        if left and selection.tells_of_kin([self._gain(rival, fits[name], "train") for name in led]):
            # Something is left: one that does alike things may be right, however little its doses explain.
            kin = [s for s in scores if s.name not in fits and effect_library.confusable(s.name, first)]
            more, also = self._fits_of_kin(base, kin, worst, f"{stage}, effects like {first}") if kin else ({}, [])
            self.bench.predict(list(more.values()))
            fits, led = fits | more, led + also
        return self._judged(scores, fits, sorted(led, key=lambda name: fits[name].point.cost), rival)

    def _nothing_left(self, base: Fitted) -> bool:
        """Return whether the gap is so near the floor that no effect could close enough of it to be named."""
        noise, level = min(self.bench.floor.noise, error_floor.shown_noise(self.recording)), self.bench.level

        def little(split: str) -> bool:
            # Frames that count less leave less of the noise, too.
            weights = self.bench.starts[split].frame_weights
            told = 1.0 if weights is None else min(1.0, float(np.sqrt(np.mean(np.square(weights)))))
            return selection.nothing_can_matter(gap_rms(self.bench.gaps(base, split)), told * noise, level)

        return little("train") or little("test")

    def _fits(
        self, base: Fitted, scores: Sequence[Score], stage: str
    ) -> tuple[dict[str, Fitted], list[str], Fitted, float]:
        """Return fits of effects, and the names of those that lead and were fitted to whole trials.

        Also return their fair rival, which is the baseline that was fitted for as long, and a cost of short fits that
        does not close half as much as the best of them.
        """
        rivals = [self._further(base, base)]
        if clamp_models.may_be_stiff(self.bench, base):
            rivals.append(clamp_models.firm_clamp_job(base, rivals[0]))
        short, alone = self._extended(base, scores, stage, rivals)
        alone = sorted(alone, key=lambda f: f.point.cost)
        lead = self._leaders(short, alone[0])
        worst = 0.5 * (alone[0].point.cost + min(f.point.cost for f in (*short, *alone)))
        further = self._fitted([self._further(base, f) for f in (*(short[k] for k in lead), *alone)], stage)
        further, rival = further[: len(lead)], min((base, *further[len(lead) :]), key=lambda f: f.point.cost)
        fits = {s.name: f for s, f in zip(scores, short, strict=True)}
        names = [scores[k].name for k in lead]
        return fits | dict(zip(names, further, strict=True)), names, rival, worst

    def _fits_of_kin(
        self, base: Fitted, scores: Sequence[Score], worst: float, stage: str
    ) -> tuple[dict[str, Fitted], list[str]]:
        """Return fits of effects, and the names of those that were fitted to whole trials: better ones than `worst`."""
        short, _ = self._extended(base, scores, stage)
        fits = {s.name: f for s, f in zip(scores, short, strict=True)}
        names = [name for name, fitted in fits.items() if fitted.point.cost < worst]
        further = self._fitted([self._further(base, fits[name]) for name in names], stage) if names else []
        return fits | dict(zip(names, further, strict=True)), names

    def _judged(
        self, scores: Sequence[Score], fits: dict[str, Fitted], order: Sequence[str], rival: Fitted
    ) -> tuple[Fitted | None, Fitted, list[Candidate], list[str]]:
        """Return what `_round` does, from fits; those in order lead, best first."""
        refused = {name: self._refused(rival, fits[name]) for name in order}
        tests = {name: self._agreement(rival, fitted, len(scores)) for name, fitted in fits.items()}
        by_chance = chance(tests, len(scores))
        refused = {name: refused[name] or by_chance.get(name) for name in order}
        refused |= self._below_steps(fits, order, refused, rival)
        fair = [name for name in order if refused[name] is None]
        best, rivals = None, []
        reasons = {name: refused.get(name) or "fits worse" for name in fits}
        if fair:
            lead = fits[fair[0]].point.cost
            close = [n for n in order if fits[n].point.cost - lead < self.bench.tie(rival.point.cost, lead)]
            special, numbers = effect_library.special_case(fair[0])
            if special in fair and special not in close and _may_be(fits[fair[0]], numbers):
                close.append(special)
            # Of laws that fit as well, the one with the fewest numbers: others may contain it.
            first = min((n for n in fair if n in close), key=lambda n: len(fits[n].space.names))
            reasons |= dict.fromkeys(close, "as good as the best") | {first: "taken"}
            best, rivals = fits[first], [n for n in close if n != first]
        gains, held = (
            {name: self._gain(rival, fitted, split) for name, fitted in fits.items()} for split in ("train", "test")
        )
        candidates = [
            Candidate(
                s.name,
                s.share,
                gains.get(s.name),
                held.get(s.name),
                reasons.get(s.name, "its doses explain less"),
                tests.get(s.name),
            )
            for s in scores
        ]
        self.leading = self._closest(fits, candidates) if best is None else None
        return best, rival, candidates, rivals

    def _below_steps(
        self, fits: dict[str, Fitted], order: Sequence[str], refused: dict[str, str | None], rival: Fitted
    ) -> dict[str, str]:
        """Return why effects are not told from what steps of simulations do: those that are as small, and likewise
        those that explain no more than one of them does."""
        found: dict[str, str] = {}
        for name in order:
            fitted = fits[name]
            why = unresolved(fitted, name, self.pool.local.model(fitted.effects, fitted.options))
            if refused[name] is None and why is not None:
                found[name] = why
                self.small = (
                    f"A {name.replace('_', ' ')} that closes {self._gain(rival, fitted, 'test'):.0%} of the gap"
                )
                self.small += f" above noise on the test trials is not named: it {why}."
                bar = fitted.point.cost - self.bench.tie(rival.point.cost, fitted.point.cost)
                others = [n for n in order if n != name and refused[n] is None and fits[n].point.cost > bar]
                found |= dict.fromkeys(others, f"explains no more than a {name.replace('_', ' ')} as small as of steps")
        return found

    def _closest(self, fits: dict[str, Fitted], candidates: Sequence[Candidate]) -> BestCandidate | None:
        """Return the candidate that closes most of the gap on the test trials if that is much, None if it is not."""
        tests = {c.name: c.test for c in candidates if c.test is not None}
        no_chance = [c for c in candidates if c.name in tests and c.name not in chance(tests, len(candidates))]
        tested = [c for c in no_chance if (c.heldout_gain or 0.0) >= MUCH]
        if not tested:
            return None
        # Of those that close nearly as much, the one that fits better.
        most = max(c.heldout_gain or 0.0 for c in tested)
        first = min(
            (c for c in tested if (c.heldout_gain or 0.0) > most - _NEAR), key=lambda c: fits[c.name].point.cost
        )
        few = "" if tree.part(first.test).could_tell(len(candidates)) else f"; there are {TOO_FEW}"
        return self._candidate(first, fits[first.name], first.reason + few)

    def _candidate(self, candidate: Candidate, fitted: Fitted, against: str) -> BestCandidate:
        """Return a candidate that is not named, with its numbers and what speaks against it."""
        numbers = dict(zip(fitted.space.names, fitted.space.to_values(fitted.point.raw), strict=True))
        own = {key: float(value) for key, value in values_of(candidate.name, numbers).items()}
        gains = candidate.gain or 0.0, candidate.heldout_gain or 0.0
        return BestCandidate(candidate.name, own, *gains, against, tree.part(candidate.test))

    def _misleading(self, fits: Sequence[Fitted]) -> list[MisleadingTrial]:
        """Return the train trials that none of these models follows, besides those that are known already."""
        trials, weights = self.bench.trials["train"], self.bench.starts["train"].frame_weights
        errors = [errors_by_frame(self.bench.prediction(f, "train"), trials, weights) for f in fits]
        found = misleading_trials(np.array(errors), trials, self.bench.level)
        new = [trial for trial in found if trial.name not in self.bench.discounted]
        return new if len(self.bench.discounted) + len(new) <= len(trials) - 2 else []

    def _findings_only(
        self, final: Fitted, found: EliminationResult, rounds: Sequence[Sequence[Candidate]]
    ) -> tuple[Fitted, np.ndarray]:
        """Return the model without effects whose ranges hold what does nothing or cannot be, and its drifts.

        Ranges are wider here than when effects were taken: they hold what the errors of steps and mesh may do.
        """
        drifts = self._drifts(final)
        while doubts := {n: why for n in found.shares if (why := implausible(final, n, drifts)) is not None}:
            name, why = next(iter(doubts.items()))
            said = next(c for each in rounds for c in each if c.name == name)
            self.leading = self._candidate(said, final, why)
            final = self.revision.without(final, name)
            for kept in (found.shares, found.ties, found.rivals):
                kept.pop(name, None)
            drifts = self._drifts(final)
        return final, drifts

    def _drifts(self, fitted: Fitted) -> np.ndarray:
        """Return what steps, mesh and a bias of forces may do to a fit's coordinates, shape (2 or 3, K)."""
        return np.concatenate([self.bench.drift(fitted), gripper_forces.bias_drift(self.bench, fitted)])

    def _leaders(self, found: Sequence[Fitted], rival: Fitted) -> list[int]:
        """Return which of the fits to short trials are worth more work."""
        costs = [f.point.cost for f in found]
        order, lead = sorted(range(len(costs)), key=costs.__getitem__), min(costs, default=0.0)
        near = _NEAR * max(rival.point.cost - lead, 0.0)
        return [k for n, k in enumerate(order) if n < LEADERS or costs[k] - lead < near]

    def _refused(self, rival: Fitted, fitted: Fitted) -> str | None:
        """Return why a fit is no better than its rival, None if it is."""
        train, test = ((self.bench.gaps(rival, split), self.bench.gaps(fitted, split)) for split in ("train", "test"))
        enough = all(self.revision.matters(rival, fitted, split) for split in ("train", "test"))
        why = selection.refused(train, test, self.bench.floor.noise, enough)
        if why is not None:
            return why
        return implausible(fitted, fitted.effects[-1])

    def _agreement(self, less: Fitted, more: Fitted, looked_at: int) -> Agreement:
        """Return how what the last effect changes agrees with what is left over without it, on the test trials."""
        before, after = (self.bench.prediction(fitted, "test") for fitted in (less, more))
        weights = self.bench.starts["test"].frame_weights
        return agreement(before, after, self.bench.trials["test"], weights, looked_at=looked_at)

    def _gain(self, base: Fitted, fitted: Fitted, split: str) -> float:
        """Return the share of the excess gap (squared, above noise) that a fit closes."""
        return selection.gain(self.bench.gaps(base, split), self.bench.gaps(fitted, split), self.bench.floor.noise)

    def _extended(
        self, base: Fitted, scores: Sequence[Score], stage: str, others: Sequence[FitJob] = ()
    ) -> tuple[list[Fitted], list[Fitted]]:
        """Return first fits of effects, and those of other jobs."""
        return extended_fits(
            self.bench, base, scores, self.budget.iterations, lambda jobs: self._fitted(jobs, stage), others
        )

    def _further(self, base: Fitted, fitted: Fitted) -> FitJob:
        """Return the job of fitting on."""
        how = (self.budget.iterations, short_frames(self.bench)) if fitted is base else (self.budget.more,)
        return self.bench.further(fitted, *how)

    def _fitted(self, jobs: Sequence[FitJob], stage: str) -> list[Fitted]:
        """Return the results of fits in their order, and say how they go."""
        found: dict[int, Fitted] = {}
        plain = max(len(job.effects) for job in jobs) - 1
        self.report(f"{stage}: fitting", 0, len(jobs), "")
        for k, fitted in self.pool.fit(jobs):
            found[k] = fitted
            last = fitted.effects[-1] if len(fitted.effects) > plain else "no effect"
            self.report(f"{stage}: fitting", len(found), len(jobs), last)
        return [found[k] for k in range(len(jobs))]

    def _conclude(self, final: Fitted, found: EliminationResult, rounds: list[list[Candidate]]) -> Diagnosis:
        final, drifts = self._findings_only(final, found, rounds)
        effects = list(found.shares)
        trials, train = self.bench.trials, len(self.bench.trials["train"])
        simulated = {"before": self.before, "after": self.bench.prediction(final, "all")}
        before, after = (trial_gaps(sims[train:], trials["test"]) for sims in simulated.values())
        verdict = verdict_word(
            effects, gap_rms(self.bench.gaps(final, "test")), self.bench.level, gap_rms(after) / gap_rms(before)
        )
        model = self.pool.local.model(final.effects, final.options)
        rivals = {n: self._rival(final, n, found) for n in effects}
        self.bench.predict([*rivals.values(), final])
        looked_at = sum(map(len, rounds))
        tests = {name: self._agreement(rival, final, looked_at) for name, rival in rivals.items()}
        limit = limit_gap(self.bench.gaps(final, "test"), self.bench.floor.noise, self.bench.level, PAYS)
        said = [
            *baselines.baseline_notes(tree.part(self.baseline)),
            *clamp_models.clamp_notes(model, final),
            *self.bench.predictions.notes(),
            *self._force_notes(final),
            *error_floor.noise_notes(self.recording, self.bench.floor.noise),
        ]
        predictions = {
            when: {t.name: sim[: len(t.time)] for sim, t in zip(sims, trials["all"], strict=True)}
            for when, sims in simulated.items()
        }
        return Diagnosis(
            verdict,
            effects,
            {name: found.ties[name] for name in effects},
            found.shares,
            tree.part(self.baseline),
            final,
            self.bench.floor,
            before,
            after,
            rounds,
            predictions,
            model,
            drifts,
            notes=[
                *said,
                *([self.small] if self.small else []),
                *([] if np.isfinite(self.bench.level) else [UNKNOWN_FLOOR]),
            ],
            tests=tests,
            limits=detection_limits(self.scores, limit, self.recording),
            leading=self.leading if verdict in ("unknown", "partial") else None,
            misleading=self.misleading,
            forces=None if self.force_before is None else (self.force_before, self._forces(final)),
        )

    def _rival(self, final: Fitted, name: str, found: EliminationResult) -> Fitted:
        """Return the model without one of the effects that it is held against in the end."""
        known = self.revision.known_without(final, name) or found.rivals[name]
        # One that was fitted beside others than are left would show what these do, too.
        rest = {effect for effect in final.effects if effect != name}
        return known if set(known.effects) == rest else self.revision.without(final, name)

    def _forces(self, fitted: Fitted) -> ForceErrors:
        return tree.part(gripper_forces.force_errors(self.bench, fitted))

    def _force_notes(self, final: Fitted) -> list[str]:
        """Return sentences on forces at the grippers, none where a recording has none."""
        told = gripper_forces.told_mass(self.bench, final)
        return [*force_doubts(self.recording), *([] if told is None else [mass_note(told, self.recording.mass)])]


def _may_be(fitted: Fitted, numbers: Mapping[str, float]) -> bool:
    """Return whether the last effect's numbers may have these values, as far as their ranges tell."""
    low, high = interval(fitted.point, fitted.space)
    asked = {ParameterName(fitted.effects[-1], name): value for name, value in numbers.items()}
    names = [ParameterName.parse(name).whole for name in fitted.space.names]
    ranges = [(asked.get(name), a, b) for name, a, b in zip(names, low, high, strict=True)]
    return all(value is None or a <= value <= b for value, a, b in ranges)
