"""Effects that were found earlier, looked at again when another one has been added: leave them out, or exchange them.

What is added first has to make up for everything that is missing. Once the rest is known, it may be needless, a law
with fewer numbers may do, or another effect may fit better (stepwise search with exchanges: Pudil et al. 1994,
doi:10.1016/0167-8655(94)90127-9).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace

from torchdlo.sysid.diagnosis import effect_library, selection
from torchdlo.sysid.diagnosis.budget import Budget
from torchdlo.sysid.diagnosis.candidate_fits import extended_fits
from torchdlo.sysid.diagnosis.error_floor import gap_rms
from torchdlo.sysid.diagnosis.score_test import score_effects
from torchdlo.sysid.diagnosis.workspace import SILENT, Callback, Workspace
from torchdlo.sysid.estimation.jobs import Fitted

_TRIED = 2
"""Effects that are tried in the place of another, besides those that do alike things."""

_EXCHANGES = 3
"""Most exchanges after an effect was added."""


@dataclass
class EliminationResult:
    """Effects in the order in which they were found."""

    shares: dict[str, float] = field(default_factory=dict)
    """By effect: share of the gap above the floor that it closed on the test trials."""
    ties: dict[str, list[str]] = field(default_factory=dict)
    """By effect: others that the data cannot tell from it."""
    rivals: dict[str, Fitted] = field(default_factory=dict)
    """By effect: the model without it that it was held against."""

    def exchange(self, old: str, new: str, *, alike: bool) -> None:
        """Put another effect in the place of one, which it is `alike` if the data cannot tell them apart."""
        also = [n for n in (*self.ties.get(old, []), old) if n != new] if alike else []
        self.shares = {new if n == old else n: share for n, share in self.shares.items()}
        self.ties = {new if n == old else n: names for n, names in self.ties.items()} | {new: also}
        self.rivals = {new if n == old else n: rival for n, rival in self.rivals.items()}

    def leave_out(self, name: str) -> None:
        """Forget an effect that the last one makes needless; the last one takes over its share."""
        del self.ties[name]
        self.rivals.pop(name, None)
        share = self.shares.pop(name)
        self.shares[[*self.shares][-1]] += share


@dataclass(frozen=True, eq=False)
class Revision:
    """Second looks at the effects of a search."""

    bench: Workspace
    """What is known."""
    budget: Budget
    """How much work to do."""
    plain: Sequence[Fitted]
    """The baseline, and what it became when it was fitted for longer."""
    report: Callback
    """Told how it goes."""
    reductions: dict[Hashable, tuple[Hashable, Fitted]] = field(default_factory=dict)
    """A cache of models without one of their effects, with where trials began, and counted up to, in their fits."""

    def matters(self, less: Fitted, more: Fitted, split: str) -> bool:
        """Return whether a model's gap is smaller by more than the floor, and by a share of the baseline's.

        What takes away nearly all that the others leave matters, however small that is beside the baseline's gap.
        """
        # A baseline may go astray on a trial: then what it became when it was fitted further tells what a share is.
        plain, (before, after) = ([self.bench.gaps(f, split) for f in fits] for fits in (self.plain, (less, more)))
        gaps = selection.compared(plain, before, after)
        return selection.matters(*gaps, self.bench.floor.noise, self.bench.level)

    def pruned(self, fitted: Fitted, found: EliminationResult) -> Fitted:
        """Return the model without the effects that the last one, or other numbers, have made needless."""
        for name in [*found.shares][:-1]:
            less = self.without(fitted, name)
            if not self.matters(less, fitted, "train"):
                fitted = less
                found.leave_out(name)
        return fitted

    def plainer(self, fitted: Fitted, found: EliminationResult, possible: Sequence[str]) -> Fitted:
        """Return the model with possible special laws in the place of general ones, where they fit as well.

        What one effect alone cannot explain bends a law with more numbers than it needs; with the others it may do
        without them.
        """
        for general in [*found.shares]:
            special, _ = effect_library.special_case(general)
            if special is None or special in fitted.effects or special not in possible:
                continue
            less = self.bench.fit([self.bench.exchange(fitted, general, special, self.budget.more)])[0]
            self.report(f"{special} in the place of {general}", 1, 1, f"{1e3 * less.point.cost:.2f} mm")
            if less.point.cost - fitted.point.cost < self._tie(fitted):
                fitted = less
                found.exchange(general, special, alike=True)
        return fitted

    def exchanged(self, fitted: Fitted, found: EliminationResult, possible: Sequence[str]) -> Fitted:
        """Return the model with other effects in the place of some, where they fit better beside the rest.

        Its options may be others than those of the workspace. Where nothing is left to be explained, and of one effect
        alone, which was held against all others just now, there is nothing to look for.
        """
        look, waiting, count = self, [*found.shares][:-1], 0
        while waiting and count < _EXCHANGES and gap_rms(self.bench.gaps(fitted, "all")) > SILENT * self.bench.level:
            old = waiting.pop(0)
            best = look._instead(fitted, old, [n for n in possible if n not in fitted.effects])
            if not self._better(best, fitted) or self._astray(best, fitted):
                continue
            new, count = best.effects[-1], count + 1
            alike = fitted.point.cost - best.point.cost < self._tie(fitted)
            fitted = best
            look = replace(look, bench=look.bench.with_options(dict(best.options)))
            found.exchange(old, new, alike=alike)
            waiting = [n for n in found.shares if n != new]
        return fitted

    def _tie(self, fitted: Fitted) -> float:
        """Return the difference in cost up to which models are not told apart from one [m]."""
        return self.bench.tie(self.plain[-1].point.cost, fitted.point.cost)

    def _better(self, other: Fitted, fitted: Fitted) -> bool:
        """Return whether another model fits better, or as well with fewer numbers."""
        fewer = len(other.space.names) < len(fitted.space.names)
        bar = fitted.point.cost + (1 if fewer else -1) * self._tie(fitted)
        return other.point.cost < bar

    def _astray(self, other: Fitted, fitted: Fitted) -> bool:
        return self.bench.diverged(other, self.bench.gaps(fitted, "all"))

    def without(self, fitted: Fitted, name: str) -> Fitted:
        """Return the model without one of its effects; what was asked for before is not fitted again."""
        here, key = (self.bench.start, *self.bench.discounted.items()), _key(fitted, name)
        at, kept = self.reductions.get(key, (None, None))
        if kept is None or at != here:
            less = self.bench.fit([self.bench.reduction(fitted, name, self.plain[0], 2 * self.budget.more)])[0]
            self.report(f"without {name}", 1, 1, f"{1e3 * less.point.cost:.2f} mm")
            self.reductions[key] = here, less
            return less
        return kept

    def known_without(self, fitted: Fitted, name: str) -> Fitted | None:
        """Return the model without one of its effects if it was fitted before, None if it was not."""
        return self.reductions.get(_key(fitted, name), (None, None))[1]

    def _instead(self, fitted: Fitted, old: str, names: Sequence[str]) -> Fitted:
        """Return the best model with one of several effects in the place of another."""
        less, stage = self.without(fitted, old), f"in the place of {old}"
        scores = score_effects(self.bench.pool, less, names, self.bench.starts["train"], lambda *_: None)
        tried = [*scores[:_TRIED], *(s for s in scores[_TRIED:] if effect_library.confusable(s.name, old))]
        first, more = self.budget.iterations, self.budget.more
        fits, _ = extended_fits(self.bench, less, tried, first, self.bench.fit)
        lead = sorted(fits, key=lambda f: f.point.cost)[:_TRIED]
        best = min(self.bench.fit([self.bench.further(f, more) for f in lead]), key=lambda f: f.point.cost)
        self.report(f"{stage}: {best.effects[-1]}", 1, 1, f"{1e3 * best.point.cost:.2f} mm")
        return best


def _key(fitted: Fitted, name: str) -> Hashable:
    return fitted.effects, fitted.options, fitted.values.tobytes(), name
