"""Simulations of many models, shared out over processes: a single one would leave cores idle."""

from __future__ import annotations

import copy
import itertools
import multiprocessing
import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, Models, Search, SimulationJob
from torchdlo.sysid.estimation.result_cache import ResultCache
from torchdlo.sysid.model import initial_state as starts
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording

Job = TypeVar("Job")

_FEW = 32
"""Scenes that are not shared out: each step costs as much as they do, however few there are."""

_MANY = 64
"""Scenes from which the time of a step goes with their number."""

_SMALL = 1000
"""Frames of scenes, less than a tenth of a second, that no worker is asked for: they need seconds to begin."""


def spread_jobs(kinds: Sequence[Hashable], parts: int) -> list[list[int]]:
    """Return indices of jobs by their kinds, those of each kind in so many groups or less."""
    alike: dict[Hashable, list[int]] = {}
    for k, kind in enumerate(kinds):
        alike.setdefault(kind, []).append(k)
    return [some for group in alike.values() for n in range(parts) if (some := group[n::parts])]


_DIED = (
    "a worker process died twice at the same work, as where memory is short: give fewer --workers if there is that "
    "option, and --resume goes on with what is done."
)


@dataclass(eq=False)
class _Task:
    """What a worker is asked for."""

    worker: int
    what: Callable[[Models, Any], Any]
    job: Any
    queue: ProcessPoolExecutor | None = None
    """Of the worker when it was asked."""
    repeated: bool = False


class Pool:
    """Worker processes that keep their models."""

    def __init__(
        self,
        recording: Recording,
        options: dict[str, Any],
        workers: int | None = None,
        journal: ResultCache | None = None,
    ) -> None:
        """Start the workers.

        Args:
            recording: what is simulated.
            options: options of every model.
            workers: how many; one per core if not given. One means this process.
            journal: keeps the results of jobs, and has those that need not be computed again.
        """
        self.workers = workers = workers or max(1, os.cpu_count() or 1)
        self.journal = journal
        self.recording, self.local = recording, Models(recording, options)
        # Named in every job, so that what was found with them is not mixed up with what others find later.
        self._chosen: dict[str, Any] = {
            name: options[name] for name in ("numerical_damping", "clamp_fraction", "rest") if name in options
        }
        self._begun_with = options
        # Each has a queue of its own: what was recorded for a model's steps is known to the process that did it.
        self._queues = [self._worker() for _ in range(workers if workers > 1 else 0)]

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        if self.journal is not None:
            self.journal.close()
        # After Ctrl-C nobody waits for fits that are still running; idle workers do not mind.
        for queue in self._queues:
            processes = list((queue._processes or {}).values())
            queue.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()

    def _worker(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, (self.recording, self._begun_with))

    def _submit(self, task: _Task) -> Future:
        """Have a task done by its worker, which is started again if it died."""
        for _ in range(2):
            task.queue = self._queues[task.worker]
            try:
                return task.queue.submit(_do, task.what, task.job)
            except BrokenProcessPool:
                self._replace(task)
        raise InputError(_DIED)

    def _replace(self, task: _Task) -> None:
        # All tasks of a worker that died come here, one after the other.
        if self._queues[task.worker] is task.queue:
            self._queues[task.worker] = self._worker()

    def _again(self, task: _Task) -> Future:
        """Repeat a task whose worker died, once."""
        self._replace(task)
        if task.repeated:
            raise InputError(_DIED)
        task.repeated = True
        return self._submit(task)

    def with_options(self, **options: Any) -> Pool:
        """Return the same workers for models with other options."""
        if options.items() <= self._chosen.items():
            return self
        other = copy.copy(self)
        other.local, other._chosen = Models(self.recording, self.local.options | options), self._chosen | options
        return other

    def _whole(self, options: tuple[tuple[str, Any], ...]) -> tuple[tuple[str, Any], ...]:
        return tuple((self._chosen | dict(options)).items())

    def simulate(self, jobs: Sequence[SimulationJob]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the index and the markers of every job as they get ready."""
        return self._new(jobs, lambda new: self._led([_once(job) for job in new]))

    def simulator(
        self, effects: Sequence[str], split: str | tuple[str, ...], options: tuple[tuple[str, Any], ...] = ()
    ) -> starts.Simulator:
        """Return a function that simulates trials with one model."""

        def simulate(start: Start, values: np.ndarray, frames: int | None = None) -> np.ndarray:
            ((_, sims),) = self.simulate([SimulationJob(tuple(effects), values, split, start, options, frames)])
            return sims

        return simulate

    def fit(self, jobs: Sequence[FitJob]) -> Iterator[tuple[int, Fitted]]:
        """Yield the index and the result of every fit as they get ready."""
        return self._new(jobs, self._fitted)

    def run(self, what: Callable[[Models, Job], Any], jobs: Sequence[Job]) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result of `what` for every job as they get ready.

        Args:
            what: a function of a module, of the models of a process and a job.
            jobs: dataclasses with `options` of models.
        """
        return self._new(jobs, partial(self._done, what))

    def _new(
        self, jobs: Sequence[Job], compute: Callable[[Sequence[Job]], Iterator[tuple[int, Any]]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield what is computed for jobs, or written down."""
        whole = [self._completed(job) for job in jobs]
        yield from compute(whole) if self.journal is None else self.journal.through(whole, compute)

    def _completed(self, job: Any) -> Any:
        return replace(job, options=self._whole(job.options))

    def _fitted(self, jobs: Sequence[FitJob]) -> Iterator[tuple[int, Fitted]]:
        groups = self.groups(jobs)
        for n, found in self._led([self.local.search([jobs[k] for k in group]) for group in groups]):
            yield from zip(groups[n], found, strict=True)

    def groups(self, jobs: Sequence[FitJob]) -> list[list[int]]:
        """Return the indices of the fits that run together: alike ones, as long as few scenes come together.

        A step of few scenes costs hardly more for more of them, but each effect of one costs in all scenes.
        """
        kinds = [(id(j.start), j.frames, self._whole(j.options), self.local.framed(j.effects)) for j in jobs]
        scenes = sum(len(j.free) + 1 for j in jobs) * len(self.recording.train)
        return spread_jobs(kinds, max(self.workers, scenes // _MANY))

    def _done(self, what: Callable[[Models, Job], Any], jobs: Sequence[Job]) -> Iterator[tuple[int, Any]]:
        if not self._queues:
            yield from ((k, what(self.local, job)) for k, job in enumerate(jobs))
            return
        waiting: dict[Future, tuple[int, _Task]] = {}
        left = enumerate(jobs)

        def next_for(worker: int) -> None:
            for k, job in itertools.islice(left, 1):
                task = _Task(worker, what, job)
                waiting[self._submit(task)] = k, task

        for worker in range(len(self._queues)):
            next_for(worker)
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                k, task = waiting.pop(future)
                try:
                    result = future.result()
                except BrokenProcessPool:
                    waiting[self._again(task)] = k, task
                    continue
                next_for(task.worker)
                yield k, result

    def _led(self, searches: Sequence[Search]) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result of every search as they get ready; all workers simulate what they ask for."""
        asked: dict[int, SimulationJob] = {}
        waiting: dict[Future, tuple[int, int, _Task]] = {}
        parts: dict[int, list[np.ndarray | None]] = {}
        left, home = set(range(len(searches))), {n: n % self.workers for n in range(len(searches))}

        def idlest(n: int) -> int:
            """Return the worker for a search: the one it had last, unless that is busy and another one is idle."""
            load = [0] * self.workers
            for *_, task in waiting.values():
                load[task.worker] += 1
            if load[home[n]] and 0 in load:
                home[n] = load.index(0)
            return home[n]

        def go_on(n: int, sims: np.ndarray | None) -> Iterator[tuple[int, Any]]:
            """Give a search what it asked for; yield its result, or have the next simulation done."""
            try:
                asked[n] = job = next(searches[n]) if sims is None else searches[n].send(sims)
                while not (count := self._parts(job, len(left))):
                    asked[n] = job = searches[n].send(self.local.simulate(job))
            except StopIteration as end:
                left.remove(n)
                yield n, end.value
                return
            parts[n] = [None] * count
            for p, worker in enumerate(range(count) if count > 1 else [idlest(n)]):
                task = _Task(worker, _simulated, (job, p, count))
                waiting[self._submit(task)] = n, p, task

        for n in range(len(searches)):
            yield from go_on(n, None)
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                n, p, task = waiting.pop(future)
                try:
                    parts[n][p] = future.result()
                except BrokenProcessPool:
                    waiting[self._again(task)] = n, p, task
                    continue
                found = [part for part in parts[n] if part is not None]
                if len(found) == len(parts[n]):
                    del parts[n]
                    sims = np.concatenate(found)
                    yield from go_on(n, sims.reshape(len(asked[n].values), -1, *sims.shape[-3:]))

    def _parts(self, job: SimulationJob, searches: int) -> int:
        """Return into how many parts a simulation is split for the workers, which others may keep busy as well.

        0 if this process had better do it.
        """
        trials = self.recording.trials(job.split)
        scenes, frames = len(job.values) * len(trials), job.frames or max(len(t.time) for t in trials)
        if not self._queues or (searches == 1 and scenes * frames < _SMALL):
            return 0
        return max(1, min(-(-self.workers // searches), scenes // _FEW))


def _once(job: SimulationJob) -> Search:
    """Ask for one simulation and return it."""
    return (yield job)


_models: Models | None = None
"""Those of a worker process."""


def begin_worker() -> None:
    """Make this process a worker: of one thread, deaf to Ctrl-C, and no longer there than the one that began it."""
    import signal
    import threading

    import torch

    torch.set_num_threads(1)
    # Ctrl-C is the parent's to handle; and when the parent is gone, nobody wants the rest.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _begin(recording: Recording, options: dict[str, Any]) -> None:
    global _models
    begin_worker()
    _models = Models(recording, options)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(what: Callable[[Models, Job], Any], job: Job) -> Any:
    return what(tree.part(_models), job)


def _simulated(models: Models, asked: tuple[SimulationJob, int, int]) -> np.ndarray:
    return models.simulate(*asked)
