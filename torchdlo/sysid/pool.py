"""Simulations of many models, shared out over processes: a single one would leave cores idle."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from torchdlo.sysid import fit, library
from torchdlo.sysid import start as starts
from torchdlo.sysid.fit import Point, Space
from torchdlo.sysid.journal import Journal
from torchdlo.sysid.model import RopeModel
from torchdlo.sysid.motion import Motion, Start
from torchdlo.sysid.recording import Recording

Job = TypeVar("Job")


@dataclass(frozen=True, eq=False)
class Simulation:
    """Parameter sets to simulate."""

    effects: tuple[str, ...]
    """Effects of the model."""
    values: np.ndarray
    """Parameter sets in the order of the model's numbers, shape (P, K)."""
    split: str | tuple[str, ...] = "train"
    """Trials: "train", "test", "all", or their names."""
    start: Start | None = None
    """Where the trials begin; read off them if not given."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of `RopeModel` that differ from those of the pool."""
    frames: int | None = None
    """How many frames to simulate; all if not given."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Numbers to fit to the train trials."""

    effects: tuple[str, ...]
    """Effects of the model."""
    values: np.ndarray
    """Where to start, in the order of the model's numbers, shape (S, K)."""
    free: tuple[str, ...]
    """Numbers to fit; the others stay as they are in the first start."""
    sizes: tuple[float, ...]
    """What counts as much of each of them, see `Space`."""
    iterations: int
    """Most iterations."""
    start: Start | None = None
    """Where the trials begin; read off them if not given."""
    frames: int | None = None
    """How many frames to fit; all if not given."""
    keep: int | None = None
    """With how many of the starts, the best, to go on; all if not given."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of `RopeModel` that differ from those of the pool."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit found."""

    effects: tuple[str, ...]
    """Effects of the model."""
    values: np.ndarray
    """Best numbers, in the order of the model's, shape (K,)."""
    space: Space
    """The numbers that were fitted."""
    point: Point
    """Their coordinates, with costs and slopes."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of `RopeModel` that differ from those of the pool."""


_Search = Generator[np.ndarray, np.ndarray, Fitted]
"""Yields parameter sets (P, K) of its model, takes their simulations (P, B, F, M, 3)."""

_Asking = Generator[Simulation, np.ndarray, Any]
"""Yields simulations, takes their markers."""

_FEW = 16
"""Scenes that are not shared out: each step costs as much as they do, however few there are."""

_MANY = 64
"""Scenes from which the time of a step goes with their number."""

_SMALL = 5000
"""Frames of scenes, some tenths of a second, that no worker is asked for: they need seconds to begin."""


class Models:
    """Models of one process by their effects and options."""

    def __init__(self, recording: Recording, options: dict[str, Any]) -> None:
        self.recording, self.options = recording, options
        self._models: dict[Any, RopeModel] = {}
        self._motions: dict[Any, Motion] = {}

    def model(self, effects: Sequence[str], options: tuple[tuple[str, Any], ...] = ()) -> RopeModel:
        """Return the model with these effects."""
        key = (tuple(effects), options)
        if key not in self._models:
            self._models[key] = RopeModel(self.recording, effects=effects, **(self.options | dict(options)))
        return self._models[key]

    def motion(self, model: RopeModel, split: str | tuple[str, ...]) -> Motion:
        """Return the motion of the trials of a split."""
        key = (split, model.substeps, len(model.arclength))
        if key not in self._motions:
            self._motions[key] = model.motion(self.recording.trials(split))
        return self._motions[key]

    def simulate(self, job: Simulation, part: int = 0, parts: int = 1) -> np.ndarray:
        """Return markers [m], shape (P, B, F, M, 3); of one of several parts, those of its P B / parts scenes."""
        model = self.model(job.effects, job.options)
        start = job.start or starts.begin(model, self.recording.trials(job.split))
        motion = self.motion(model, job.split)
        if parts == 1:
            return model.simulate(motion, start, job.values, frames=job.frames)
        rows = np.array_split(np.arange(len(job.values) * len(motion.names)), parts)[part]
        return model.scenes(motion, start, job.values, rows, frames=job.frames)

    def search(self, jobs: Sequence[Fit]) -> _Asking:
        """Ask for what several fits with the same start, frames and options need, together; return their results."""
        effects, options = tuple(dict.fromkeys(e for job in jobs for e in job.effects)), jobs[0].options
        model = self.model(effects, options)
        measured = self.motion(model, "train").markers[:, : jobs[0].frames]
        start = jobs[0].start or starts.begin(model, self.recording.train)
        trust = 1.0 if start.trust is None else start.trust[:, : jobs[0].frames, None, None]
        searches, places = [], []
        for job in jobs:
            own = self.model(job.effects, options)
            columns = [own.parameters.index(name) for name in job.free]
            space = Space(job.free, tuple(own.params[k] for k in columns), job.sizes)
            searches.append(_search(job, space, columns, measured, trust))
            places.append(self._places(model, job.effects))
        found: dict[int, Fitted] = {}
        asked = {k: next(search) for k, search in enumerate(searches)}
        while asked:
            rows = [_filled(model.guess(), places[k], values) for k, values in asked.items()]
            sims = yield Simulation(effects, np.concatenate(rows), "train", start, options, jobs[0].frames)
            ends = np.cumsum([len(r) for r in rows])[:-1]
            for k, sim in zip(list(asked), np.split(sims, ends), strict=True):
                try:
                    asked[k] = searches[k].send(sim)
                except StopIteration as end:
                    found[k] = replace(end.value, options=options)
                    del asked[k]
        return tuple(found[k] for k in range(len(jobs)))

    def framed(self, effects: Sequence[str]) -> bool:
        """Return whether twists have to be searched for in a model with these effects, which takes longer."""
        laws = [library.instance(e, self.model(()).mesh) for e in effects]
        return any(law.frame_bending or law.settles for law in laws)

    def joined(self, fits: Sequence[Fitted], split: str, start: Start) -> Simulation:
        """Return one job that simulates several fits with the same options, by a model that has the effects of all."""
        model = self.model(tuple(dict.fromkeys(e for f in fits for e in f.effects)))
        rows = [_filled(model.guess(), self._places(model, f.effects), f.values[None]) for f in fits]
        return Simulation(model.effects, np.concatenate(rows), split, start, fits[0].options)

    def _places(self, model: RopeModel, effects: Sequence[str]) -> list[int]:
        """Return where the numbers of a model with some of the effects are among those of a model with all."""
        return [model.parameters.index(name) for name in self.model(effects).parameters]


def _filled(guess: np.ndarray, places: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Return values of some numbers (P, K) among all; the others do nothing."""
    full = np.repeat(guess[None], len(values), 0)
    full[:, places] = values
    return full


def _search(job: Fit, space: Space, columns: Sequence[int], measured: np.ndarray, trust: np.ndarray | float) -> _Search:
    """Fit: yield parameter sets (P, K) of the job's model, take their simulations, return the best.

    Markers (..., B, F, M, 3), measured and simulated, are multiplied by what they are trusted, (B, F, 1, 1).
    """
    measured = trust * measured

    def full(values: np.ndarray) -> np.ndarray:
        return _filled(job.values[0], columns, values)

    raws = space.clip(space.to_raw(job.values[:, columns]))
    if job.keep is not None:
        costs = fit.costs(trust * (yield full(space.to_values(raws))), measured)
        raws = raws[np.argsort(costs)[: job.keep]]
    look = fit.Look(space, raws)
    climb = fit.Climb(space, look.points(trust * (yield full(look.values)), measured))
    for _ in range(job.iterations):
        tries = climb.tries()
        if not len(tries):
            break
        look = fit.Look(space, tries)
        climb.take(look.points(trust * (yield full(look.values)), measured))
    best = min(climb.points, key=lambda p: p.cost)
    return Fitted(job.effects, full(space.to_values(best.raw)[None])[0], space, best)


def spread(kinds: Sequence[Hashable], parts: int) -> list[list[int]]:
    """Return indices of jobs by their kinds, those of each kind in so many groups or less."""
    alike: dict[Hashable, list[int]] = {}
    for k, kind in enumerate(kinds):
        alike.setdefault(kind, []).append(k)
    return [some for group in alike.values() for n in range(parts) if (some := group[n::parts])]


class Pool:
    """Worker processes that keep their models."""

    def __init__(
        self,
        recording: Recording,
        options: dict[str, Any],
        workers: int | None = None,
        journal: Journal | None = None,
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
        self._chosen = {name: options[name] for name in ("ahead", "grip") if name in options}
        self._pool = None
        if workers > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(workers, context, _begin, (recording, options))

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is None:
            return
        # After Ctrl-C nobody waits for fits that are still running; idle workers do not mind.
        workers = list((self._pool._processes or {}).values())
        self._pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.terminate()

    def choose(self, **options: Any) -> None:
        """Give all models other options from now on."""
        if not options.items() <= self._chosen.items():
            self.local = Models(self.recording, self.local.options | options)
            self._chosen |= options

    def _whole(self, options: tuple[tuple[str, Any], ...]) -> tuple[tuple[str, Any], ...]:
        return tuple((self._chosen | dict(options)).items())

    def simulate(self, jobs: Sequence[Simulation]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the index and the markers of every job as they get ready."""
        return self._new(jobs, lambda new: self._led([_once(job) for job in new]))

    def simulator(
        self, effects: Sequence[str], split: str | tuple[str, ...], options: tuple[tuple[str, Any], ...] = ()
    ) -> starts.Simulator:
        """Return a function that simulates trials with one model."""

        def simulate(start: Start, values: np.ndarray, frames: int | None = None) -> np.ndarray:
            ((_, sims),) = self.simulate([Simulation(tuple(effects), values, split, start, options, frames)])
            return sims

        return simulate

    def fit(self, jobs: Sequence[Fit]) -> Iterator[tuple[int, Fitted]]:
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
        jobs = [replace(job, options=self._whole(job.options)) for job in jobs]
        yield from compute(jobs) if self.journal is None else self.journal.through(jobs, compute)

    def _fitted(self, jobs: Sequence[Fit]) -> Iterator[tuple[int, Fitted]]:
        groups = self.groups(jobs)
        for n, found in self._led([self.local.search([jobs[k] for k in group]) for group in groups]):
            yield from zip(groups[n], found, strict=True)

    def groups(self, jobs: Sequence[Fit]) -> list[list[int]]:
        """Return the indices of the fits that run together: alike ones, as long as few scenes come together.

        A step of few scenes costs hardly more for more of them, but each effect of one costs in all scenes.
        """
        kinds = [(id(j.start), j.frames, self._whole(j.options), self.local.framed(j.effects)) for j in jobs]
        scenes = sum(len(j.free) + 1 for j in jobs) * len(self.recording.train)
        return spread(kinds, max(self.workers, scenes // _MANY))

    def _done(self, what: Callable[[Models, Job], Any], jobs: Sequence[Job]) -> Iterator[tuple[int, Any]]:
        if self._pool is None:
            yield from ((k, what(self.local, job)) for k, job in enumerate(jobs))
            return
        waiting = {self._pool.submit(_do, what, job): k for k, job in enumerate(jobs)}
        for future in as_completed(waiting):
            yield waiting[future], future.result()

    def _led(self, searches: Sequence[_Asking]) -> Iterator[tuple[int, Any]]:
        """Yield the index and the result of every search as they get ready; all workers simulate what they ask for."""
        asked: dict[int, Simulation] = {}
        waiting: dict[Future, tuple[int, int]] = {}
        parts: dict[int, list[np.ndarray | None]] = {}
        left = set(range(len(searches)))

        def go_on(n: int, sims: np.ndarray | None) -> Iterator[tuple[int, Any]]:
            """Give a search what it asked for; yield its result, or have the next simulation done."""
            try:
                asked[n] = job = searches[n].send(sims)
                while not (count := self._parts(job, len(left))):
                    asked[n] = job = searches[n].send(self.local.simulate(job))
            except StopIteration as end:
                left.remove(n)
                yield n, end.value
                return
            parts[n] = [None] * count
            waiting.update({self._pool.submit(_do, _simulated, (job, p, count)): (n, p) for p in range(count)})

        for n in range(len(searches)):
            yield from go_on(n, None)
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                n, p = waiting.pop(future)
                parts[n][p] = future.result()
                if all(part is not None for part in parts[n]):
                    sims = np.concatenate(parts.pop(n))
                    yield from go_on(n, sims.reshape(len(asked[n].values), -1, *sims.shape[-3:]))

    def _parts(self, job: Simulation, searches: int) -> int:
        """Return into how many parts a simulation is split for the workers, which others may keep busy as well.

        0 if this process had better do it.
        """
        trials = self.recording.trials(job.split)
        scenes, frames = len(job.values) * len(trials), job.frames or max(len(t.time) for t in trials)
        if self._pool is None or scenes * frames < _SMALL:
            return 0
        return max(1, min(-(-self.workers // searches), scenes // _FEW))


def _once(job: Simulation) -> _Asking:
    """Ask for one simulation and return it."""
    return (yield job)


_models: Models | None = None
"""Those of a worker process."""


def _begin(recording: Recording, options: dict[str, Any]) -> None:
    import signal
    import threading

    import torch

    global _models
    torch.set_num_threads(1)
    # Ctrl-C is the parent's to handle; and when the parent is gone, nobody wants the rest.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _models = Models(recording, options)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(what: Callable[[Models, Job], Any], job: Job) -> Any:
    return what(_models, job)


def _simulated(models: Models, asked: tuple[Simulation, int, int]) -> np.ndarray:
    return models.simulate(*asked)
