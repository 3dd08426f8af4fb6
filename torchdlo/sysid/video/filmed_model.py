"""A model that was fitted to films, what its numbers say of films that were not used, and one with more effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchdlo.sysid.estimation.observation import FilmView, Spines, unfitted_clocks
from torchdlo.sysid.recordings.recording import Trial
from torchdlo.sysid.video.filmed import test_problem
from torchdlo.sysid.video.filmed_fit import Fit, film_gaps, look, time_films
from torchdlo.sysid.video.filmed_problem import FilmedProblem, add_correction, first_frames
from torchdlo.sysid.video.filmed_starts import fit_starts, follow_starts

__all__ = ["FilmedModel", "Films", "extended"]


@dataclass(eq=False)
class FilmedModel:
    """A model with its fit."""

    own: FilmedProblem
    fit: Fit
    test: FilmedProblem
    """The same of the test trials; `own` again where those do not matter."""
    others: tuple[FilmedModel, ...] = ()
    """Where other starts ended."""
    _tested: np.ndarray | None = field(init=False, default=None)

    @property
    def values(self) -> np.ndarray:
        """Numbers of rope and cameras, shape (N,)."""
        return self.own.space.to_values(self.fit.raw)

    def gaps(self, split: str) -> np.ndarray:
        """Return root mean squares of the readings of trials [m], shape (B,); infinite where a simulation failed."""
        if split == "train":
            return film_gaps(self.own, self.fit)
        if self._tested is None:
            here = self.test
            # Neither starts nor what finer simulations change are those of another model.
            add_correction(here, self.values)
            if follow_starts(here, self.fit.raw):
                add_correction(here, self.values)
                fit_starts(here, self.fit.raw, 8)
            time_films(here, self.values)
            self._tested = film_gaps(here, look(here, self.fit.raw, here.offset, worth=lambda costs: False))
        return self._tested


@dataclass(frozen=True, eq=False)
class Films:
    """All films of a recording."""

    whole: FilmedProblem
    """The problem of all of the train trials."""
    trials: tuple[Trial, ...]
    """Test trials."""
    views: list[FilmView]
    """What cameras saw of those."""

    def test(self, own: FilmedProblem, best: Fit) -> FilmedModel:
        """Return a fitted model with what its numbers say of the test films, over as long a time."""
        trials, views, seconds = self.trials, self.views, own.lasts
        if seconds < self.whole.lasts:
            trials = first_frames(trials, own.motion.markers.shape[1])
            views = [v.shortened(seconds) for v in views]
        return FilmedModel(own, best, test_problem(own, trials, views, own.space.to_values(best.raw)))

    def all_of(self, model: FilmedModel, split: str) -> FilmedProblem:
        """Return a model's problem of all of the time."""
        if not model.own.lasts < self.whole.lasts:
            return model.own if split == "train" else model.test
        if split == "train":
            return model.own.over(self.whole, self.whole.lasts)
        here, model_of = model.test, model.own.model
        pairs = zip(unfitted_clocks(self.views, here.spines.views), here.spines.views, strict=True)
        views = [replace(v, off=w.off) for v, w in pairs]
        spines = Spines(views, model_of.dt, here.extent, here.spines.free, here.spines.sure)
        start = replace(here.start, discretisation_correction=None)
        parts: dict[str, Any] = {
            "trials": self.trials,
            "motion": model_of.motion(self.trials),
            "spines": spines,
            "start": start,
        }
        return replace(here, **parts, discretisation_correction=None)


def extended(
    base: FilmedModel,
    added: Sequence[str],
    sizes: dict[str, float],
    numbers: dict[str, float],
    raw: np.ndarray | None,
    dropped: Sequence[str] = (),
) -> FilmedModel:
    """Return a model with other effects, that begins with some of their numbers, not yet fitted.

    Args:
        base: the model.
        added: effects.
        sizes: what counts as much of their numbers.
        numbers: those that are fitted.
        raw: coordinates (N,) of the model's own numbers; where they are if not given.
        dropped: effects that it does without.
    """
    effects = (*(e for e in base.own.model.effects if e not in dropped), *added)
    known = base.own.space.to_values(base.fit.raw if raw is None else base.own.space.clip(raw))
    count = len(base.own.free)
    parts = []
    for problem in (base.own,) if base.test is base.own else (base.own, base.test):
        more = problem.with_effects(effects, {k: v for k, v in sizes.items() if v}, list(numbers))
        for k, column in enumerate(problem.free):
            if (name := problem.model.parameters[column]) in more.model.parameters:
                more.fixed[more.model.parameters.index(name)] = known[k]
        for name, value in numbers.items():
            more.fixed[more.model.parameters.index(name)] = value
        parts.append(more)
    start = np.concatenate([parts[0].fixed[list(parts[0].free)], known[count:]])
    at = parts[0].space.clip(parts[0].space.to_raw(start))
    return FilmedModel(parts[0], replace(base.fit, raw=at), parts[-1])
