"""Run `torchdlo diagnose` on recordings that hide an effect, and hold its findings against the answers.

Findings that are there already are kept, and a diagnosis that was stopped goes on, so that a run may be stopped at any
time. The answers are read only after all diagnoses, but for the names of what `--removed` leaves out.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

from cases import PARTS, subset
from make import Config as Made
from make import identity
from options import Parser, count, save
from seal import kept, seal
from table import judge, markdown, summary, without_it

COMMAND = "from torchdlo.cli import main; main()"


@dataclass(frozen=True)
class Config:
    """What to score and where."""

    recordings: str = Made.out
    """Folder with the recordings."""
    answers: str = Made.answers
    """Folder with the answers."""
    out: str = "runs/hidden/findings"
    """Folder for the findings, score.json and score.md."""
    subset: str = "there"
    """Which part of the benchmark; there: all recordings that are there."""
    salt: str = Made.salt
    """As given to make.py."""
    budget: str = "fast"
    """As of `torchdlo diagnose`."""
    workers: int = 2
    """Processes of a diagnosis."""
    jobs: int = 1
    """Diagnoses at the same time."""
    timeout: float = 3600.0
    """Longest time for one diagnosis [s]."""
    removed: bool = False
    """Look for what single recordings hide in a library without it; findings go to a folder of their own."""
    ready: bool = False
    """Score only what is diagnosed already."""
    smoke: bool = False
    """Only the first recording."""


def diagnose(recording: Path, out: Path, config: Config, without: Sequence[str] = ()) -> str:
    """Diagnose one recording with a library without some effects; return why that failed, or nothing."""
    command = [sys.executable, "-c", COMMAND, "diagnose", str(recording), "--json", "-o", str(out)]
    command += ["--budget", config.budget, "--workers", str(config.workers)]
    command += [word for effect in without for word in ("--exclude-effect", effect)]
    if (out / "journal").exists():
        command.append("--resume")
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=config.timeout,
            check=False,
            env={"OMP_NUM_THREADS": "1"} | dict(os.environ),
        )
    except subprocess.TimeoutExpired:
        return f"not done within {config.timeout:g} s"
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
    return ""


def findings(out: Path) -> dict | None:
    """Return the findings in a folder, None where there are none."""
    try:
        return json.loads((out / "findings.json").read_text())
    except (OSError, json.JSONDecodeError):
        return None


def chosen(config: Config) -> list[str]:
    """Return the names of the recordings, in an order that says nothing."""
    there = sorted(p.name for p in Path(config.recordings).glob("r*") if (p / "rope.json").exists())
    if config.subset != "there":
        wanted = {identity(case, config.salt) for case in subset(config.subset)}
        missing = wanted - set(there)
        if missing:
            raise SystemExit(
                f"{config.recordings}: {len(missing)} of {len(wanted)} recordings of the subset {config.subset} are "
                f"not there; make them with: make.py --subset {config.subset} --out {config.recordings} "
                f"--answers {config.answers} --salt {config.salt}"
            )
        there = sorted(wanted)
    if not there:
        raise SystemExit(f"{config.recordings}: no recordings found; make some with make.py")
    if config.removed:
        there = [name for name in there if answer_of(config, name)["kind"] == "single"]
    return there[: 1 if config.smoke else None]


def answer_of(config: Config, name: str) -> dict:
    """Return what a recording hides."""
    return json.loads((Path(config.answers) / f"{name}.json").read_text())


def run(config: Config, names: list[str]) -> dict[str, str]:
    """Diagnose what is not diagnosed yet; return failures by name."""
    todo = [] if config.ready else [n for n in names if findings(Path(config.out) / n) is None]
    failed, begun = {}, time.perf_counter()
    with ThreadPoolExecutor(config.jobs) as pool:
        jobs = {}
        for name in todo:
            without = answer_of(config, name)["answer"] if config.removed else ()
            folders = Path(config.recordings) / name, Path(config.out) / name
            jobs[pool.submit(diagnose, *folders, config, without)] = name
        try:
            for k, job in enumerate(as_completed(jobs), 1):
                name = jobs[job]
                failed[name] = job.result()
                left = (time.perf_counter() - begun) / k * (len(todo) - k)
                print(f"{k}/{len(todo)} {name}: {failed[name] or 'done'}; {left / 60:.0f} min left", flush=True)
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            raise
    return {name: why for name, why in failed.items() if why}


def score(config: Config, names: list[str], failed: dict[str, str]) -> list[dict]:
    """Return the rows of all recordings that were diagnosed."""
    rows = []
    for name in names:
        found = findings(Path(config.out) / name)
        if found is None and name not in failed:
            continue
        answer = answer_of(config, name)
        rows.append(judge(name, without_it(answer) if config.removed else answer, found))
        rows[-1]["sealed"] = kept(Path(config.answers), Path(config.out), name)
        if found is None:
            rows[-1]["why"] = failed[name]
    return sorted(rows, key=lambda row: row["case"])


def main() -> None:
    """Diagnose, score, print and write."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    for name in ("recordings", "answers", "out", "salt"):
        parser.add_argument(f"--{name}", default=getattr(Config, name))
    parser.add_argument("--subset", default=Config.subset, choices=("there", *PARTS))
    parser.add_argument("--budget", default=Config.budget, choices=("fast", "full"))
    parser.add_argument("--workers", type=count, default=Config.workers)
    parser.add_argument("--jobs", type=count, default=Config.jobs, help="diagnoses at the same time (%(default)s)")
    parser.add_argument("--timeout", type=float, default=Config.timeout)
    parser.flag("removed", "single effects only, in a library without the one that is hidden")
    parser.flag("ready", "score only what is diagnosed already")
    parser.flag("smoke", "only the first recording")
    config = Config(**vars(parser.parse_args()))
    names = chosen(config)
    if config.removed:
        config = replace(config, out=str(Path(config.out) / "removed"))
    if not config.ready:
        print(f"answers are sealed: {seal(Path(config.answers), Path(config.out), names)}", flush=True)
    rows = score(config, names, run(config, names))
    page = markdown(rows, f"Hidden effects: {len(rows)} of {len(names)} recordings")
    machine = {"cores": os.cpu_count(), "python": platform.python_version()}
    save(str(Path(config.out) / "score.json"), {"machine": machine, **summary(rows), "rows": rows})
    (Path(config.out) / "score.md").write_text(page)
    print(page)


if __name__ == "__main__":
    main()
