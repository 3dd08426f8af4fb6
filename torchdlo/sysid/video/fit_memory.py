"""What fits to films came to, written down: a diagnosis that was stopped reads there what it had done.

A fit is kept as the numbers and starts that it found, by all that it depends on. What films leave over there is looked
at once more, which costs as much as one of its steps.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchdlo.errors import InputError
from torchdlo.sysid.estimation.result_cache import ResultCache, Results

if TYPE_CHECKING:
    from torchdlo.sysid.video.filmed_problem import FilmedProblem

__all__ = ["keep", "place", "recall", "remember", "remembering", "task"]

_results: Results | None = None
"""Where this process keeps them; nowhere if not set."""


def place() -> Results | None:
    """Return where the fits of this process are kept, None if they are not."""
    return _results


def remember(results: Results | None) -> None:
    """Keep the fits of this process, or none of them, from now on."""
    global _results
    _results = results


@contextlib.contextmanager
def remembering(path: Path | None, *about: Any, **how: Any) -> Iterator[None]:
    """Keep fits in a journal as long as the block lasts, see `ResultCache`; nowhere if there is no path."""
    if path is None:
        yield
        return
    cache, before = ResultCache(path, *about, **how), place()
    remember(cache.results)
    try:
        yield
    except InputError:
        # What is refused before anything was done leaves nothing behind.
        if not cache.begun:
            cache.remove()
        raise
    finally:
        remember(before)
        cache.close()


def task(own: FilmedProblem, *asked: Any) -> tuple[Any, ...] | None:
    """Return all that a fit to a problem depends on, None where fits are not kept.

    Args:
        own: the problem.
        asked: what is to be done with it.
    """
    if _results is None:
        return None
    model, start, spines = own.model, own.start, own.spines
    seen = [
        (v.camera, v.good, v.places, v.tangents, np.asarray(v.late), v.clocks, np.asarray(v.clock), np.asarray(v.off))
        for v in spines.views
    ]
    begun = start.pos, start.vel, start.at_rest, start.discretisation_correction, own.offset, own.shapes
    numbers = own.free, own.fixed, own.sizes
    about = type(own).__name__, asked, model.effects, own.options, numbers, own.motion.markers
    return *about, begun, seen, spines.free, spines.sure


def recall(job: tuple[Any, ...] | None) -> Any:
    """Return what a fit came to, None if it is not known."""
    return None if job is None or _results is None else _results.recall(job)


def keep(job: tuple[Any, ...] | None, *found: np.ndarray) -> None:
    """Write down what a fit came to."""
    if job is not None and _results is not None:
        _results.keep(job, found)
