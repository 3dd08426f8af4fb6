"""First fits of a model with one effect more."""

from __future__ import annotations

from torchdlo.sysid import clamps, library
from torchdlo.sysid.bench import Bench
from torchdlo.sysid.jobs import Fit, Fitted
from torchdlo.sysid.screen import Score

_SHORT = 0.6
"""Share of the trials that first fits see."""


def extend(bench: Bench, base: Fitted, score: Score, iterations: int, frames: int | None) -> Fit:
    """Return the job of fitting a model with one effect more, from the doses that suit best.

    Args:
        bench: the trials.
        base: the model without.
        score: of the effect.
        iterations: most iterations.
        frames: how many frames to fit; all if None.
    """
    if score.name == clamps.NAME and clamps.soft(bench, base):
        return clamps.stiff(bench, base, score, iterations, frames)
    # Numbers that no dose uses stay off, a slope where a spot fits better; but vectors are fitted whole.
    vectors = {vector(name) for name in score.dose}
    used = [n.name for n in library.numbers(score.name, bench.recording) if vector(n.name) in vectors]
    return bench.extension(base, score, used, iterations, frames)


def short(bench: Bench) -> int:
    """Return how many frames the first fits see: late ones mislead as long as early ones do not fit."""
    return max(10, int(_SHORT * bench.trials["train"][0].markers.shape[0]))


def vector(name: str) -> str:
    """Return the name of a number without that of its component."""
    return ".".join(name.split(".")[:2])
