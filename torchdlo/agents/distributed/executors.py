"""Where work is done. Everything is handed over by value, so that machines need no disk in common."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import Any, Protocol, TypeVar

from torchdlo.errors import InputError

__all__ = ["Executor", "LocalProcesses", "Serial", "make_executor"]

Item = TypeVar("Item")
Result = TypeVar("Result")


class Executor(Protocol):
    """Does work on items somewhere. Functions and items can be pickled."""

    def map(self, fn: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        """Yield the place of an item and what `fn` returned for it, as they get done, in any order.

        What failed for the sake of a worker is done again; what `fn` raises is raised here. Items that were not begun
        are dropped when the iterator is closed.
        """
        ...

    def close(self) -> None:
        """End the workers."""
        ...


class _Closing:
    """An executor as a context."""

    def close(self) -> None:
        """End the workers."""

    def __enter__(self) -> Any:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class Serial(_Closing):
    """Does the work itself, one item after the other."""

    def map(self, fn: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        """Yield results in order."""
        for k, item in enumerate(items):
            yield k, fn(item)


AGAIN = 2
"""How often an item is done again if the process that had it died."""


class LocalProcesses(_Closing):
    """Processes of this machine."""

    def __init__(self, workers: int | None = None) -> None:
        """Prepare as many workers as there are cores, or a given number."""
        self.workers = workers or len(os.sched_getaffinity(0))
        self._pool = self._fresh()

    def _fresh(self) -> ProcessPoolExecutor:
        # Forked ones would inherit locks of threads.
        return ProcessPoolExecutor(self.workers, mp_context=multiprocessing.get_context("spawn"), initializer=_prepare)

    def map(self, fn: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        """Yield results as they get done; few items are handed out in advance, so that little is lost."""
        todo, tries = list(range(len(items)))[::-1], [0] * len(items)
        running: dict[Future[Result], int] = {}
        try:
            while todo or running:
                while todo and len(running) < self.workers:
                    k = todo.pop()
                    running[self._pool.submit(fn, items[k])] = k
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    k = running.pop(future)
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        # All that were running are lost with the one that died.
                        lost = [k, *running.values()]
                        running.clear()
                        self._pool.shutdown(wait=False)
                        self._pool = self._fresh()
                        for each in lost:
                            tries[each] += 1
                            if tries[each] > AGAIN:
                                raise InputError(
                                    "a worker process died again and again, as where memory is short: give --workers "
                                    "1, and --resume goes on with what is done."
                                ) from None
                        todo += lost
                        break
                    yield k, result
        finally:
            for future in running:
                future.cancel()

    def close(self) -> None:
        """End the processes; what they are at is not waited for."""
        processes = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


CHILDREN: set[subprocess.Popen[bytes]] = set()
"""Programs that a worker has begun; they end with it."""


def _prepare() -> None:
    """Let each worker use one core, leave Ctrl-C to the process that started it, and end when that is gone."""
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: _leave())
    threading.Thread(target=_watch, args=(os.getppid(),), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    _leave()


def _leave() -> None:
    for child in CHILDREN:
        child.terminate()
    os._exit(1)


def make_executor(workers: int | None = None, address: str | None = None) -> Any:
    """Return where to work.

    Args:
        workers: processes of this machine; one per core if not given, 0 for none beside this one.
        address: of a Ray cluster, "auto" for the one that this machine belongs to, "local" for one of its own.
    """
    if address is not None:
        from torchdlo.agents.distributed.ray_executor import RayWorkers

        return RayWorkers(address, workers)
    return Serial() if workers == 0 else LocalProcesses(workers)
