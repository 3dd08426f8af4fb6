"""Fits to films that do not wait for each other, shared out over processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from torchdlo.errors import InputError
from torchdlo.sysid.estimation.result_cache import Results
from torchdlo.sysid.estimation.worker_pool import begin_worker
from torchdlo.sysid.video import fit_memory

__all__ = ["FitPool"]


class FitPool:
    """Processes that are started when there is work for more than one."""

    def __init__(self, workers: int | None = None) -> None:
        """Start nothing yet.

        Args:
            workers: how many; one per core if not given. One means this process.
        """
        self.workers = workers or max(1, os.cpu_count() or 1)
        self._processes: ProcessPoolExecutor | None = None

    def __enter__(self) -> FitPool:
        return self

    def __exit__(self, *_: object) -> None:
        # After Ctrl-C nobody waits for fits that are still running; idle workers do not mind.
        if self._processes is not None:
            running = list((self._processes._processes or {}).values())
            self._processes.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()

    def map(self, what: Callable[..., Any], jobs: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result of `what` for every job as they get ready.

        Args:
            what: a function of a module, which leaves its arguments as they are: here they are shared, in other
                processes copies.
            jobs: its arguments.
        """
        if self.workers == 1 or len(jobs) == 1:
            yield from ((k, what(*job)) for k, job in enumerate(jobs))
            return
        if self._processes is None:
            context = multiprocessing.get_context("spawn")
            self._processes = ProcessPoolExecutor(self.workers, context, _begin, (fit_memory.place(),))
        try:
            waiting: dict[Future, int] = {self._processes.submit(what, *job): k for k, job in enumerate(jobs)}
            while waiting:
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future.result()
        except BrokenProcessPool:
            raise InputError("a worker process died, as where memory is short: give fewer --workers.") from None

    def all(self, what: Callable[..., Any], jobs: Sequence[tuple]) -> list[Any]:
        """Return the results of `what` for every job, in their order."""
        return [found for _, found in sorted(self.map(what, jobs), key=lambda pair: pair[0])]


def _begin(results: Results | None) -> None:
    begin_worker()
    fit_memory.remember(results)
