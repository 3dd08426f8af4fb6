"""Trajectory optimisation of the tasks: tasks by methods by seeds, beside published returns.

All searches of a task run at the same time and share their batches, so that their seconds are shared ones; the best
trajectories are played alone in the end, and returns are those. An episode counts once, with its gradient or without.
Every search keeps a journal, so that a benchmark that was stopped goes on where it was; finished ones are read. Those
of another version of the program or of libraries are marked with a star in the table, and run anew with --again. With
--minutes, searches end with what they found by then; without it, the same command goes on with them. With --report,
nothing is run: the table is made of all that is finished in --out.

The table says what the hybrid had seen after as many episodes as a method had, and what was published of the method;
beside the hybrid stands published CMA-ES. Seconds are those of all seeds together, on one core.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from options import Parser, count
from report_trajopt import earlier, finished, report

EXAMPLES = """examples:
  python experiments/benchmark_trajopt.py --out runs/trajopt --jobs 2
  python experiments/benchmark_trajopt.py --tasks wiring_post --methods cmaes,hybrid --seeds 5 --episodes 2000
  python experiments/benchmark_trajopt.py --report --out experiments/trajopt
"""

SHARE = {"cmaes": 0.0, "hybrid": 0.25}
"""Of which share of the trajectories gradients are wanted, if not of all."""
INTERRUPTED = 130
"""Exit status after Ctrl-C."""


@dataclass(frozen=True)
class Timed:
    """A problem of which no batch is begun any more when the time is over; what was found can still be recorded."""

    inner: Any
    over: Callable[[], bool]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def evaluate(self, actions: Any) -> Any:
        """Play actions, or end the search as Ctrl-C does."""
        if self.over():
            raise KeyboardInterrupt
        return self.inner.evaluate(actions)

    def surrogate(self) -> Any:
        """Return the surrogate task, which ends at the same time."""
        found = self.inner.surrogate()
        return None if found is None else Timed(found, self.over)


@dataclass(frozen=True)
class Case:
    """One search."""

    task: str
    method: str
    seed: int
    settings: Any
    folder: Path

    @property
    def result(self) -> Path:
        """The file that says that it is finished."""
        return self.folder / "result.json"

    def found(self, problem: Any, again: bool, ended: bool) -> dict[str, Any] | None:
        """Return its result, if it is there.

        Args:
            problem: what it is of.
            again: whether it has to be of the same program, and what is of other settings does not count.
            ended: whether one that ended early counts.

        Raises:
            InputError: It is there, but of other settings.
        """
        from torchdlo.agents.trajopt.search import SearchSettings
        from torchdlo.errors import InputError

        def resolved(settings: dict[str, Any]) -> dict[str, Any]:
            own = SearchSettings(**{f.name: settings[f.name] for f in fields(SearchSettings)})
            return settings | {name: getattr(own.plan(problem), name) for name in ("hold", "sigma", "rate", "steps")}

        if not self.result.is_file():
            return None
        found = json.loads(self.result.read_text())
        # Earlier versions had fewer settings.
        had, wanted = (
            json.loads(json.dumps(x)) for x in (asdict(SearchSettings()), asdict(self.settings) | problem.choices)
        )
        same = resolved(had | found["settings"]) == resolved(wanted)
        if not (same or again):
            raise InputError(
                f"{self.result}: what a search with other settings found is here; --again replaces it, or choose "
                "another --out."
            )
        return found if same and not (again and earlier(found)) and (ended or not found["interrupted"]) else None

    def ready(self, choices: dict[str, Any], again: bool) -> None:
        """Say so before anything runs if the journal of a stopped search is of another one; `again` removes it."""
        from torchdlo.agents.trajopt.search_journal import program_hash, remove_journal
        from torchdlo.errors import InputError

        journal = self.folder / "journal"
        if not (journal / "journal.json").is_file():
            return
        had = json.loads((journal / "journal.json").read_text())
        wanted = json.loads(json.dumps(asdict(self.settings) | choices))
        other = [name for name, value in wanted.items() if had["options"].get(name) != value]
        other += ["version"] if had["program"] != program_hash(self.task) else []
        if other and again:
            remove_journal(journal)
        elif other:
            raise InputError(
                f"{journal}: a search was stopped here whose {', '.join(other)} differ; --again begins anew, or choose "
                "another --out."
            )

    def search(self, problem: Any, callback: Any, over: Callable[[], bool]) -> None:
        """Search, resumed if it was stopped, and write what was found; nothing if there was no time for anything."""
        from torchdlo.agents.trajopt.search import optimize
        from torchdlo.agents.trajopt.search_journal import remove_journal
        from torchdlo.agents.trajopt.search_result import result_json, trajectory_json
        from torchdlo.files import write_atomically

        journal = self.folder / "journal"
        resume = (journal / "journal.json").is_file()
        timed = Timed(problem, over)
        try:
            found = optimize(timed, self.settings, journal=journal, resume=resume, callback=callback)
        except KeyboardInterrupt:
            if not over():
                raise
            print(f"{self.folder.name}: time was over before the first iteration was", file=sys.stderr)
            return
        if found.interrupted and not over():
            raise KeyboardInterrupt
        write_atomically(self.folder / "trajectory.json", trajectory_json(found, problem))
        write_atomically(self.result, result_json(found, problem, self.settings))
        if not found.interrupted:
            remove_journal(journal)


def cases(task: str, args: Any) -> list[Case]:
    """All searches of a task."""
    from torchdlo.agents.trajopt.presets import search_preset

    given = {
        "episodes": args.episodes or None,
        "population": args.population or None,
        "surrogate_share": args.surrogate_share,
    }
    seeds = range(args.first, args.first + args.seeds)
    return [
        Case(
            task,
            method,
            seed,
            search_preset(task, method, seed=seed, **given),
            Path(args.out) / f"{task}-{method}-{seed}",
        )
        for method in args.methods
        for seed in seeds
    ]


def solve(task: str, args: Any) -> list[tuple[Case, dict[str, Any]]]:
    """Run what is not there yet of a task, all at once, and return all results."""
    from torchdlo.agents.trajopt.batched_evaluation import evaluate_batched
    from torchdlo.agents.trajopt.task_problem import task_problem
    from torchdlo.cli.progress import deferred_interrupt, progress

    chosen, wanted = (
        task_problem(task, double=args.double, execution="eager" if args.smoke else "compiled"),
        cases(task, args),
    )
    left = [case for case in wanted if case.found(chosen, args.again, args.minutes is not None) is None]
    end = math.inf if args.minutes is None else time.monotonic() + 60 * args.minutes
    for case in left:
        case.ready(chosen.choices, args.again)
    said: dict[Path, tuple[int, int, str]] = {}
    with progress() as show, deferred_interrupt(show) as callback:

        def pulse() -> None:
            done, total, words = zip(*said.values(), strict=True)
            callback("optimize", sum(done), sum(total), f"{task}: {', '.join(filter(None, words))}")

        def searching(case: Case) -> Any:
            def note(_: str, done: int, total: int, words: str) -> None:
                said[case.folder] = (done, total, words)

            said[case.folder] = (0, case.settings.episodes, "")
            return lambda shared: case.search(shared, note, lambda: time.monotonic() > end)

        sizes = [min(case.settings.population, case.settings.chunk) for case in wanted]
        with_gradient = sum(int(size * SHARE.get(case.method, 1)) for size, case in zip(sizes, wanted, strict=True))
        evaluate_batched(chosen, [searching(case) for case in left], sum(sizes), pulse, with_gradient=with_gradient)
    return [(case, json.loads(case.result.read_text())) for case in wanted if case.result.is_file()]


def side_by_side(args: Any) -> None:
    """Run tasks each in a process of one thread, several at a time; what they say goes to log files."""
    common = ["--episodes", str(args.episodes), "--population", str(args.population), "--out", args.out]
    common += ["--methods", ",".join(args.methods), "--first", str(args.first), "--seeds", str(args.seeds)]
    common += ["--jobs", "1", "--quiet", *(["--double"] if args.double else []), *(["--smoke"] if args.smoke else [])]
    common += ["--again"] if args.again else []
    for name in ("surrogate_share", "minutes"):
        value = getattr(args, name)
        common += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]

    def one(task: str) -> None:
        file = Path(args.out) / f"{task}.log"
        file.parent.mkdir(parents=True, exist_ok=True)
        with open(file, "a", encoding="utf-8") as log:
            done = subprocess.run(
                [sys.executable, __file__, "--tasks", task, *common],
                stdout=log,
                stderr=log,
                check=False,
                env={"OMP_NUM_THREADS": "1"} | dict(os.environ),
            )
        ends = {0: "done", INTERRUPTED: "interrupted"}
        print(f"{task}: {ends.get(done.returncode, f'failed, see {file}')}", flush=True)

    with ThreadPoolExecutor(args.jobs) as pool:
        try:
            for each in [pool.submit(one, task) for task in args.tasks]:
                each.result()
        except KeyboardInterrupt:
            # Ctrl-C reaches the processes as well: they write down where they are.
            pool.shutdown(cancel_futures=True)
            raise


def arguments(words: list[str] | None = None) -> Any:
    """The options."""
    from torchdlo.agents.trajopt.search import METHODS
    from torchdlo.envs import TASKS

    parser = Parser("benchmark_trajopt.py", description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--tasks", default=",".join(TASKS), help=f"of {', '.join(TASKS)}; default: all")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}; default: all")
    parser.add_argument("--seeds", type=count, default=3, help="seeds per task and method; default: 3")
    parser.add_argument("--first", type=int, default=0, help="first seed; default: 0")
    parser.add_argument("--jobs", type=count, default=1, help="tasks at the same time, one core each; default: 1")
    parser.add_argument("--episodes", type=int, default=0, help="budget; default: the published one of each task")
    parser.add_argument("--population", type=int, default=0, help="default: that of each method")
    parser.add_argument(
        "--surrogate-share",
        type=float,
        help="share of the iterations that all methods play in the surrogate task; default: that of each method",
    )
    parser.add_argument("--minutes", type=float, help="time for the searches of a task; default: as long as it takes")
    parser.add_argument("--out", help="folder; default: runs/trajopt, with --smoke runs/smoke")
    parser.flag("again", "run anew what was found by another version of the program or of libraries")
    parser.flag("report", "run nothing; show what is finished in --out, whatever its settings")
    parser.flag("double", "physics in double precision")
    parser.flag("quiet", "search only; no table")
    parser.flag("smoke", "one iteration of each method on short episodes with uncompiled steps")
    args = parser.parse_args(words)
    for name, known in (("tasks", TASKS), ("methods", METHODS)):
        chosen = [word for word in getattr(args, name).split(",") if word]
        wrong = [word for word in chosen if word not in known]
        if wrong or not chosen:
            parser.error(f"--{name} is {getattr(args, name)!r}; expected some of {', '.join(known)}")
        setattr(args, name, chosen)
    if args.minutes is not None and not args.minutes > 0:
        parser.error(f"--minutes is {args.minutes:g}; expected more than 0")
    if args.smoke:
        args.seeds, args.episodes, args.population = 1, 4, 4
    args.out = args.out or ("runs/smoke" if args.smoke else "runs/trajopt")
    return args


def main() -> None:
    """Run what is not there yet."""
    from torchdlo.errors import InputError

    args = arguments()
    if args.smoke:
        shorten()
    runs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    if args.report:
        every = {(task, m): finished(task, m, Path(args.out)) for task in args.tasks for m in args.methods}
        runs = {key: found for key, found in every.items() if found}
        if not runs:
            sys.exit(f"error: {args.out}: expected finished searches of these tasks and methods, found none.")
        report(runs, Path(args.out))
        return
    try:
        if args.jobs > 1:
            side_by_side(args)
        for task in args.tasks:
            for case, found in solve(task, args):
                runs.setdefault((task, case.method), []).append(found)
            if not args.quiet:
                report(runs, Path(args.out))
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except InputError as error:
        sys.exit(f"error: {error}")


def shorten() -> None:
    """Give every task an episode of one action of two frames."""
    from torchdlo import envs

    for name, kind in list(envs.TASKS.items()):
        short = type(kind.__name__, (kind,), {"frame_skip": 2, "settle_steps": 0, "release": 0})
        envs.TASKS[name] = lambda short=short: short(horizon=1)


if __name__ == "__main__":
    main()
