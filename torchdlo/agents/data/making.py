"""Making a data set: attempts are played in batches, maybe by several workers, until enough have succeeded.

Everything random in an attempt comes from its number, and attempts are taken in order: which worker played what, and
how often the run was stopped and resumed, makes no difference to any byte of the set.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchdlo.agents.data import attempts, build, parquet, video_codec
from torchdlo.agents.data.dataset_schema import Schema
from torchdlo.agents.data.demonstrators import Demonstrator, make_demonstrator
from torchdlo.agents.data.reading import column_array
from torchdlo.agents.data.record import Noise, Painter, draw_starts, record_attempts
from torchdlo.agents.distributed import Executor, Serial
from torchdlo.agents.trajopt.search_journal import code_versions
from torchdlo.envs import Task, find, short_name, with_fidelity
from torchdlo.envs.core import episode
from torchdlo.errors import InputError
from torchdlo.journal import locked, read_json, write_json

__all__ = ["UNFINISHED", "DatasetPlan", "make_dataset", "report_of"]

UNFINISHED = "unfinished"
"""Folder within a set for what is under way."""
PLAN = "torchdlo-plan.json"


@dataclass(frozen=True)
class DatasetPlan:
    """What a data set is made of."""

    tasks: tuple[str, ...]
    episodes: int
    """Per task."""
    seed: int = 0
    size: int = 128
    """Width and height of pictures [px]; 0 for none."""
    codec: str = "h264"
    actor: str = "scripted"
    """Who acts, see `demonstrators.make_demonstrator`."""
    noise: float | None = None
    """See `Noise.size` [m]; what each task says (`Task.demonstration_noise`) if None."""
    fidelity: str = "published"
    """How tasks are simulated: "published", "coarse" (each task's own cheaper one), or such as "1ms/2"."""
    arms: int = 1
    """Arms that the set has room for, if not more by its tasks: sets of as many arms can be merged."""
    batch: int = 16
    """Attempts that are played at once."""
    tries: int = 8
    """Attempts per episode that is asked for, after which a task is given up."""

    def __post_init__(self) -> None:
        if not self.tasks or self.episodes < 1:
            raise InputError("a data set needs one task and one episode or more.")
        names = [short_name(name) for name in self.tasks]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise InputError(f"the task {', '.join(sorted(twice))} is named twice; folders go by the names of tasks.")
        if self.noise is not None and not 0 <= self.noise <= 0.01:
            raise InputError(f"noise: expected 0 to 0.01 m, given {self.noise:g}.")
        _ = self.schema  # says what is wrong with names, size or codec
        for name in self.tasks:
            self.task(name)

    @property
    def schema(self) -> Schema:
        """What frames are like."""
        return Schema(
            arms=max(self.arms, *(find(name).arms.count for name in self.tasks)), size=self.size, codec=self.codec
        )

    def task(self, name: str) -> Task:
        """Return a task in the fidelity of the plan."""
        return with_fidelity(find(name), self.fidelity)

    def shake(self, name: str) -> Noise:
        """Return the disturbance of the hands in a task."""
        return Noise(find(name).demonstration_noise if self.noise is None else self.noise)

    @property
    def most(self) -> int:
        """Attempts at a task at most, whole batches."""
        return -(-self.episodes * self.tries // self.batch) * self.batch


@dataclass(frozen=True)
class _Job:
    """A batch of attempts, to be played by a worker."""

    plan: DatasetPlan
    task: str
    first: int
    painter: Painter | None


@functools.lru_cache(maxsize=2)
def _prepared(found: Task, batch: int) -> episode.Episode:
    # Recorded steps take seconds to begin with; compiled ones take minutes and gain little in a batch.
    return episode.prepare(found, batch, execution=episode.quick_execution(found))


@functools.lru_cache(maxsize=8)
def _actor(task: str, actor: str) -> Demonstrator:
    return make_demonstrator(find(task), actor)


def _played(job: _Job) -> list[dict[str, bytes]]:
    """Return the files of the attempts of a batch."""
    plan, actor = job.plan, _actor(job.task, job.plan.actor)
    made = _prepared(plan.task(job.task), plan.batch)
    tries = draw_starts(made.task, plan.seed, range(job.first, job.first + plan.batch))
    recordings = record_attempts(made, tries, actor, plan.schema, job.painter, plan.shake(job.task))
    return [attempts.attempt_files(each, job.task, actor.source, plan.schema) for each in recordings]


def make_dataset(
    plan: DatasetPlan,
    out: Path,
    *,
    painter: Painter | None = None,
    executor: Executor | None = None,
    resume: bool = False,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Make a data set, and return how many attempts it took, see `report_of`.

    Args:
        plan: what is to be in it.
        out: its folder, which must not be there yet.
        painter: draws pictures; can be pickled.
        executor: where attempts are played; here if not given.
        resume: go on with what a run of the same plan has begun there.
        callback: told (stage, done, in all, message); may raise KeyboardInterrupt, and all that is finished is kept.

    Raises:
        InputError: The folder is taken, the plan is not the one that was begun, or too few attempts succeed.
    """
    if plan.size and painter is None:
        raise InputError("pictures need a painter; give one, or size 0 for a set without pictures.")
    for task in plan.tasks:
        _actor(task, plan.actor)  # says what is wrong before the work
    parquet.import_pyarrow()
    if plan.size:
        video_codec.import_pyav()
    if resume and (out / "meta/info.json").is_file() and not (out / UNFINISHED / PLAN).exists():
        shutil.rmtree(out / UNFINISHED, ignore_errors=True)
        found = read_json(out / build.PROVENANCE)
        if found is None:
            raise InputError(f"{out / build.PROVENANCE}: it is damaged or gone; choose another --out.")
        return report_of(found)
    with _begun(plan, out, resume) as folder:
        done = {task: _gather(plan, task, folder, painter, executor or Serial(), callback) for task in plan.tasks}
        return _finish(plan, out, done, callback)


@contextmanager
def _begun(plan: DatasetPlan, out: Path, resume: bool) -> Iterator[Path]:
    """Yield the folder for what is under way; no other run may have it meanwhile."""
    folder = out / UNFINISHED
    said = _said(plan)
    if (folder / PLAN).is_file():
        if not resume:
            raise InputError(f"{out}: a run was begun there; --resume goes on with it, or choose another --out.")
        # Attempts say themselves which plan they belong to, should it be damaged.
        if (read_json(folder / PLAN) or said) != said:
            raise InputError(
                f"{out}: what was begun there has other options or versions, see {folder / PLAN}; give the same, or "
                "choose another --out."
            )
    elif out.exists() and (not out.is_dir() or any(p.name != UNFINISHED for p in out.iterdir())):
        raise InputError(f"{out}: it exists already; choose another --out.")
    with locked(folder):
        write_json(folder / PLAN, said)
        attempts.remove_unfinished(folder)
        yield folder


def _said(plan: DatasetPlan) -> dict[str, Any]:
    """Return what the attempts at a plan depend on, as it is written down."""
    return json.loads(json.dumps(asdict(plan) | {"versions": code_versions()}))


def _key(plan: DatasetPlan) -> str:
    """Return a hash of it."""
    return hashlib.sha256(json.dumps(_said(plan), sort_keys=True).encode()).hexdigest()


def _gather(
    plan: DatasetPlan,
    task: str,
    folder: Path,
    painter: Painter | None,
    executor: Executor,
    callback: Callable[[str, int, int, str], None] | None,
) -> list[attempts.Attempt]:
    """Return the attempts at a task in order, up to the last that is needed; play those that are not there."""
    place = folder / short_name(task)
    known: dict[int, attempts.Attempt] = {}
    for each in sorted(place.glob("[0-9]*")):
        if (found := attempts.read_attempt(each, _key(plan))) is not None:
            known[int(each.name)] = found
        else:
            shutil.rmtree(each, ignore_errors=True)  # it is played again

    def good() -> int:
        return sum(each.success for each in known.values())

    def told() -> None:
        if callback is not None:
            callback(task, min(good(), plan.episodes), plan.episodes, f"{len(known) - good()} failed")

    while (line := _needed(known, plan.episodes)) is None:
        told()
        jobs = [_Job(plan, task, first, painter) for first in _batches(plan, known, good())]
        if not jobs:
            raise InputError(
                f"{task}: only {good()} of {len(known)} attempts succeeded, and {plan.episodes} were asked for; give "
                "less --noise, fewer --episodes, or another --actor."
            )
        for k, files in executor.map(_played, jobs):
            for number, content in enumerate(files, jobs[k].first):
                if number not in known:
                    attempts.write_attempt(place / f"{number:06d}", content, _key(plan))
                    known[number] = attempts.Attempt(place / f"{number:06d}", json.loads(content[attempts.RECORD]))
            told()
    return line


def _batches(plan: DatasetPlan, known: Container[int], good: int) -> list[int]:
    """Return the first attempts of the batches to play next: gaps, and as many more as seem to be needed."""
    firsts = range(0, plan.most, plan.batch)
    todo = [first for first in firsts if any(n not in known for n in range(first, first + plan.batch))]
    last = max((n for n in range(plan.most) if n in known), default=-1)
    gaps = [first for first in todo if first <= last]
    share = max(good, 1) / (last + 1) if last >= 0 else 1.0
    more = -(-int(max(plan.episodes - good, 0) / share) // plan.batch)
    return gaps + [first for first in todo if first > last][: max(more, 0 if gaps else 1)]


def _needed(known: dict[int, attempts.Attempt], count: int) -> list[attempts.Attempt] | None:
    """Return the attempts up to the one with which there are enough episodes, if all of them are known."""
    found: list[attempts.Attempt] = []
    good = 0
    while good < count:
        if len(found) not in known:
            return None
        found.append(known[len(found)])
        good += found[-1].success
    return found


def _finish(
    plan: DatasetPlan,
    out: Path,
    done: dict[str, list[attempts.Attempt]],
    callback: Callable[[str, int, int, str], None] | None,
) -> dict[str, Any]:
    """Build the set of finished attempts, put it into its place, and remove what is not needed any more."""
    schema, folder = plan.schema, out / UNFINISHED
    # Tasks take turns, so that any stretch of the set has something of each.
    turns = zip(*([each for each in tries if each.success] for tries in done.values()), strict=True)
    episodes = [_episode(each, schema) for turn in turns for each in turn]
    header = {
        "generator": "torchdlo dataset make",
        "versions": code_versions(),
        "plan": asdict(plan),
        "attempts": {task: len(tries) for task, tries in done.items()},
        "failures": {task: sum(not each.success for each in tries) for task, tries in done.items()},
    }
    fresh = folder / "set"
    shutil.rmtree(fresh, ignore_errors=True)

    def told(number: int, total: int) -> None:
        if callback is not None:
            callback("write", number, total, "")

    build.write_dataset(fresh, schema, episodes, header, told)
    # The description comes last: without it there is no data set.
    for name in ("data", "videos", "meta"):
        if (fresh / name).exists():
            shutil.rmtree(out / name, ignore_errors=True)
            os.rename(fresh / name, out / name)
    (folder / PLAN).unlink()
    shutil.rmtree(folder, ignore_errors=True)
    return report_of(header)


def _episode(attempt: attempts.Attempt, schema: Schema) -> build.DatasetEpisode:
    made = attempt.record
    length = made["frames"]

    def columns() -> dict[str, np.ndarray]:
        table = parquet.read_table(attempt.folder / attempts.FRAMES)
        return {name: column_array(table, name, attempt.folder) for name in table.column_names}

    clips = {key: video_codec.Clip(attempt.folder / f"{key}.mp4", 0, length) for key in schema.pictures}
    told = made["told"]
    hidden = {"histograms", "success", "failed", "frames"}
    kept = {name: value for name, value in made.items() if name not in hidden}
    counts = {key: np.array(made["histograms"][key], np.int64) for key in schema.pictures}
    return build.DatasetEpisode(told, length, columns, clips, lambda: counts, kept)


def report_of(provenance: dict[str, Any]) -> dict[str, Any]:
    """Return how many attempts each task took and how many of them failed."""
    found = provenance.get("attempts", {})
    return {task: {"attempts": n, "failed": provenance["failures"][task]} for task, n in found.items()}
