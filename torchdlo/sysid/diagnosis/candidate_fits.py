"""First fits of a model with one effect more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from torchdlo.physics.effects.parameter_name import ParameterName
from torchdlo.sysid.diagnosis import clamp_models, effect_library
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted

_SHORT = 0.6
"""Share of the trials that first fits see."""


def extension_jobs(bench: Workspace, base: Fitted, score: Score, iterations: int, frames: int | None) -> list[FitJob]:
    """Return the jobs of fitting a model with one effect more, from the doses that suit best.

    Args:
        bench: the trials.
        base: the model without.
        score: of the effect.
        iterations: most iterations.
        frames: how many frames to fit; all if None.
    """
    if score.name == clamp_models.NAME and clamp_models.bends_between_markers(
        bench.pool.local.model(base.effects, base.options)
    ):
        return [clamp_models.stiff_clamp_job(bench, base, score, iterations, frames)]
    # Numbers that no dose uses stay off, a gradient where a spot fits better; but vectors are fitted whole.
    kinds: dict[frozenset[ParameterName], list] = {}
    for start in score.starts:
        kinds.setdefault(frozenset(ParameterName.parse(name).whole for name in start[0]), []).append(start)
    jobs = []
    for vectors, starts in kinds.items():
        used = [n.name for n in effect_library.numbers(score.name, bench.recording) if n.which.whole in vectors]
        jobs.append(bench.extension(base, replace(score, starts=tuple(starts)), used, iterations, frames))
    return jobs


def extended_fits(
    bench: Workspace,
    base: Fitted,
    scores: Sequence[Score],
    iterations: int,
    fit: Callable[[Sequence[FitJob]], Sequence[Fitted]],
    others: Sequence[FitJob] = (),
) -> tuple[list[Fitted], list[Fitted]]:
    """Return the best short fit of each of several effects, and those of other jobs.

    Args:
        bench: the trials.
        base: the model without.
        scores: of the effects.
        iterations: most iterations.
        fit: does jobs.
        others: what to do besides.
    """
    jobs = [extension_jobs(bench, base, score, iterations, short_frames(bench)) for score in scores]
    found = list(fit([*(job for alike in jobs for job in alike), *others]))
    best = [min((found.pop(0) for _ in alike), key=lambda f: f.point.cost) for alike in jobs]
    return best, found


def short_frames(bench: Workspace) -> int:
    """Return how many frames the first fits see: late ones mislead as long as early ones do not fit."""
    return max(10, int(_SHORT * bench.trials["train"][0].markers.shape[0]))
