"""Many runs of the same command, over subjects and seeds, on several cores or machines; nothing finished is lost.

A job is a whole command of `torchdlo`, which can be resumed by itself. On this machine it writes into its folder; on
another one into a temporary folder, whose files come back when it has ended.
"""

from __future__ import annotations

import functools
import io
import itertools
import json
import os
import secrets
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torchdlo.agents.distributed import executors
from torchdlo.errors import InputError
from torchdlo.journal import at_work, read_json, write_json

__all__ = ["KINDS", "Job", "Sweep", "run_sweep"]

KINDS = {
    "optimize": ("optimize",),
    "train": ("train",),
    "diagnose": ("diagnose",),
    "dataset": ("dataset", "make"),
}
"""What can be swept, and the command of each."""
PLAN, DONE, FAILED = "sweep.json", "done", "failed"
_BEGUN = ("journal", "unfinished", "*checkpoint*")
"""What a command leaves from which it goes on."""


@dataclass(frozen=True)
class Job:
    """A command with its folder."""

    name: str
    command: tuple[str, ...]
    """Arguments of `torchdlo`, without --out."""


@dataclass(frozen=True)
class Sweep:
    """What to run."""

    kind: str
    subjects: tuple[str, ...]
    """Tasks, or folders of recordings."""
    seeds: tuple[int, ...]
    options: tuple[str, ...] = ()
    """Further options of the command."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"sweep: expected one of {', '.join(KINDS)}, given {self.kind!r}.")
        if not self.subjects or not self.seeds:
            raise InputError("sweep: give one task or recording and one seed or more.")
        own = {"--out", "-o", "--seed", "--resume"} & set(self.options)
        if own:
            raise InputError(f"sweep: {', '.join(sorted(own))} belongs to the sweep; leave it out behind --.")

    @property
    def jobs(self) -> list[Job]:
        """The jobs, seed by seed."""
        from torchdlo.envs import short_name

        named = (lambda path: Path(path).resolve().name) if self.kind == "diagnose" else short_name
        names = [named(subject) for subject in self.subjects]
        if len(set(names)) < len(names):
            raise InputError(f"sweep: two of {', '.join(names)} have the same name.")
        found = []
        for seed, (name, subject) in itertools.product(self.seeds, zip(names, self.subjects, strict=True)):
            given = str(Path(subject).resolve()) if self.kind == "diagnose" else subject
            workers = ("--workers", "1") if self.kind in ("diagnose", "dataset") else ()
            command = (*KINDS[self.kind], given, "--seed", str(seed), *workers, *self.options)
            found.append(Job(f"{name}-{seed}", command))
        return found


@dataclass(frozen=True)
class _Outcome:
    code: int
    said: str
    """The last line of what it said, if it failed."""
    seconds: float
    files: bytes | None = None
    """Its folder as an archive, if it was elsewhere."""


def _command(job: Job, folder: Path) -> list[str]:
    # A data set that is finished says so itself.
    begun = any(any(folder.glob(pattern)) for pattern in (*_BEGUN, "meta/info.json"))
    resume = ["--resume"] if begun else []
    return [sys.executable, "-m", "torchdlo", *job.command, "--out", str(folder), *resume]


def _called(job: Job, folder: Path) -> _Outcome:
    begun = time.monotonic()
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        _command(job, folder),
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    executors.CHILDREN.add(process)
    try:
        _, errors = process.communicate()
    finally:
        executors.CHILDREN.discard(process)
    lines = errors.decode(errors="replace").strip().splitlines() or [""]
    said = lines[-1] if process.returncode else ""
    return _Outcome(process.returncode, said, round(time.monotonic() - begun, 1))


def _here(job: Job, root: str) -> _Outcome:
    return _called(job, Path(root) / job.name)


def _elsewhere(job: Job) -> _Outcome:
    with tempfile.TemporaryDirectory(prefix="torchdlo-") as name:
        folder = Path(name) / job.name
        went = _called(job, folder)
        if went.code:
            return went
        content = io.BytesIO()
        with tarfile.open(fileobj=content, mode="w:gz") as archive:
            archive.add(folder, arcname=".")
    return _Outcome(went.code, went.said, went.seconds, content.getvalue())


def _unpack(content: bytes, folder: Path) -> None:
    """Put a folder into its place as a whole."""
    temporary = folder.with_name(f".{secrets.token_hex(4)}-{folder.name}")
    try:
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            archive.extractall(temporary, filter="data")
        shutil.rmtree(folder, ignore_errors=True)
        os.rename(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def run_sweep(
    sweep: Sweep,
    out: Path,
    executor: executors.Executor,
    *,
    away: bool = False,
    resume: bool = False,
    callback: Callable[[str, int, int, str], None] | None = None,
) -> dict[str, Any]:
    """Run what is not done yet; return how each job ended.

    Args:
        sweep: what to run.
        out: a folder, which gets one for each job.
        executor: where.
        away: whether workers have disks of their own.
        resume: go on with a sweep that was begun there; what failed is tried again.
        callback: told (stage, jobs done, in all, message); may raise KeyboardInterrupt.
    """
    _check_plan(sweep, out, resume)
    with at_work(out, PLAN):
        return _run(sweep, out, executor, away, callback)


def _said(sweep: Sweep) -> dict[str, Any]:
    return json.loads(json.dumps({"generator": "torchdlo sweep"} | asdict(sweep)))


def _check_plan(sweep: Sweep, out: Path, resume: bool) -> None:
    """Refuse a folder in which this sweep was not begun."""
    plan = out / PLAN
    if plan.is_file():
        if not resume:
            raise InputError(f"{out}: a sweep was begun there; --resume goes on with it, or choose another --out.")
        found = read_json(plan)
        if found is None:
            raise InputError(f"{plan}: it is damaged; remove it, and the folders of another sweep, then --resume.")
        if found != _said(sweep):
            raise InputError(f"{out}: another sweep was begun there, see {plan}; choose another --out.")
    elif out.exists() and (not out.is_dir() or (any(_visible(out)) and not resume)):
        raise InputError(f"{out}: it exists already; choose another --out.")
    elif resume and out.exists():
        names = {job.name for job in sweep.jobs} | {DONE, FAILED}
        if any(p.name not in names for p in _visible(out)):
            raise InputError(f"{out}: it exists already, and holds more than this sweep; choose another --out.")


def _visible(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if not p.name.startswith(".")]


def _run(
    sweep: Sweep,
    out: Path,
    executor: executors.Executor,
    away: bool,
    callback: Callable[[str, int, int, str], None] | None,
) -> dict[str, Any]:
    jobs = sweep.jobs
    write_json(out / PLAN, _said(sweep))
    todo = [job for job in jobs if read_json(out / DONE / f"{job.name}.json") is None]
    done = len(jobs) - len(todo)
    work = _elsewhere if away else functools.partial(_here, root=str(out))
    if callback is not None:
        callback("sweep", done, len(jobs), "")
    for k, went in executor.map(work, todo):
        done += _noted(out, todo[k], went)
        if callback is not None:
            callback("sweep", done, len(jobs), f"{todo[k].name}: {'failed' if went.code else 'done'}")
    return _report(out, jobs)


def _noted(out: Path, job: Job, went: _Outcome) -> bool:
    """Write down how a job ended; return whether it did well."""
    note = {"command": list(job.command), "seconds": went.seconds, "code": went.code, "message": went.said}
    good = went.code == 0
    if good and went.files is not None:
        _unpack(went.files, out / job.name)
    write_json(out / (DONE if good else FAILED) / f"{job.name}.json", note)
    if good:
        (out / FAILED / f"{job.name}.json").unlink(missing_ok=True)
    return good


def _report(out: Path, jobs: Sequence[Job]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for job in jobs:
        for folder in (DONE, FAILED):
            note = read_json(out / folder / f"{job.name}.json")
            if note is not None:
                found[job.name] = {"done": folder == DONE, "seconds": note["seconds"], "message": note["message"]}
                break
    return found
