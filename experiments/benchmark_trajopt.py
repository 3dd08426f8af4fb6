"""Trajectory optimisation of the tasks: tasks by methods by seeds, beside published returns.

Every run keeps a journal, so that a benchmark that was stopped goes on where it was; runs that are finished are read.
An episode that is played with gradient counts as one. Returns are those of the best trajectory played alone.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from options import Parser, count, save

EXAMPLES = """examples:
  python experiments/benchmark_trajopt.py --out runs/trajopt --jobs 2
  python experiments/benchmark_trajopt.py --tasks wiring_post --methods cmaes,hybrid --seeds 5 --episodes 2000
"""

INTERRUPTED = 130
"""Exit status after Ctrl-C."""


def run(task: str, method: str, seed: int, args: Any) -> dict[str, Any]:
    """One run: read if it is finished, resumed if it was stopped."""
    from torchdlo.agents.journal import program
    from torchdlo.agents.presets import preset
    from torchdlo.agents.result import result_json, trajectory_json
    from torchdlo.agents.search import optimize
    from torchdlo.agents.tasks import problem
    from torchdlo.files import write_atomically
    from torchdlo.progress import deferred_interrupt, progress

    folder = Path(args.out) / f"{task}-{method}-{seed}"
    given = {"episodes": args.episodes or None, "population": args.population or None, "seed": seed}
    settings = preset(task, method, **given)
    # Recorded steps take seconds to make, but help only where no gradients are asked for.
    steps = {"compiled": args.compiled and method != "cmaes", "recorded": args.compiled and method == "cmaes"}
    chosen = problem(task, double=args.double, **steps)
    wanted = json.loads(json.dumps(asdict(settings) | chosen.choices))
    result = folder / "result.json"
    if result.is_file():
        found = json.loads(result.read_text())
        if found["settings"] == wanted and found["program"] == program():
            return found
    with progress() as show, deferred_interrupt(show) as callback:
        journal = folder / "journal"
        resume = (journal / "journal.json").is_file()
        found = optimize(chosen, settings, journal=journal, resume=resume, callback=callback)
    if found.interrupted:
        raise KeyboardInterrupt
    write_atomically(folder / "trajectory.json", trajectory_json(found, chosen))
    write_atomically(result, result_json(found, chosen, settings))
    return json.loads(result.read_text())


def side_by_side(args: Any) -> None:
    """Run what is not there yet, each in a process of one thread, several at a time; what they say goes to log.txt."""
    common = ["--episodes", str(args.episodes), "--population", str(args.population), "--out", args.out]
    common += ["--jobs", "1", "--quiet", *(["--double"] if args.double else []), *(["--smoke"] if args.smoke else [])]

    def one(task: str, method: str, seed: int) -> None:
        folder = Path(args.out) / f"{task}-{method}-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        words = ["--tasks", task, "--methods", method, "--first", str(seed), "--seeds", "1", *common]
        with open(folder / "log.txt", "a", encoding="utf-8") as log:
            done = subprocess.run(
                [sys.executable, __file__, *words],
                stdout=log,
                stderr=log,
                check=False,
                env={"OMP_NUM_THREADS": "1"} | dict(os.environ),
            )
        ends = {0: "done", INTERRUPTED: "interrupted"}
        print(f"{folder.name}: {ends.get(done.returncode, f'failed, see {folder}/log.txt')}", flush=True)

    with ThreadPoolExecutor(args.jobs) as pool:
        try:
            waiting = [
                pool.submit(one, task, method, args.first + k)
                for k in range(args.seeds)
                for method in args.methods
                for task in args.tasks
            ]
            for each in waiting:
                each.result()
        except KeyboardInterrupt:
            # Ctrl-C reaches the processes as well: they write down where they are.
            pool.shutdown(cancel_futures=True)
            raise


def row(task: str, method: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of the table: mean and spread over the seeds."""
    from torchdlo.agents.presets import PUBLISHED

    returns = [r["return"] for r in runs if r["return"] is not None]
    return {
        "task": task,
        "method": method,
        "seeds": len(runs),
        "return": statistics.mean(returns) if returns else None,
        "spread": statistics.stdev(returns) if len(returns) > 1 else None,
        "lowest": min(returns, default=None),
        "highest": max(returns, default=None),
        # Published returns are the largest that a search saw.
        "seen": statistics.mean(r["highest"] for r in runs),
        "published": PUBLISHED.get(task, {}).get(method),
        "success": statistics.mean(float(r["success"]) for r in runs),
        "episodes": statistics.mean(r["episodes"] for r in runs),
        "solved_after": [r["solved_after"] for r in runs],
        "seconds": statistics.mean(r["seconds"] for r in runs),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a table of Markdown."""
    lines = [
        "| task | method | seeds | return | spread | largest seen | published | success | episodes | seconds |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        cells = [
            r["task"],
            r["method"],
            str(r["seeds"]),
            *("" if r[k] is None else f"{r[k]:.2f}" for k in ("return", "spread", "seen", "published")),
            f"{r['success']:.0%}",
            f"{r['episodes']:.0f}",
            f"{r['seconds']:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def report(runs: dict[tuple[str, str], list[dict[str, Any]]], args: Any) -> None:
    """Print and write the table and the curves of what is there so far."""
    from torchdlo.files import write_atomically
    from torchdlo.report.learning import learning_png

    rows = [row(task, method, found) for (task, method), found in runs.items()]
    out, text = Path(args.out), table(rows)
    save(str(out / "benchmark.json"), {"generator": "torchdlo benchmark_trajopt", "rows": rows})
    write_atomically(out / "benchmark.md", text)
    panels: dict[str, dict[str, list[Any]]] = {}
    for (task, method), found in runs.items():
        panels.setdefault(task, {})[method] = [r["curve"] for r in found]
    write_atomically(out / "curves.png", learning_png(panels))
    print(text, end="", flush=True)


def arguments(words: list[str] | None = None) -> Any:
    """The options."""
    from torchdlo.agents.search import METHODS
    from torchdlo.envs import TASKS

    parser = Parser("benchmark_trajopt.py", description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--tasks", default=",".join(TASKS), help=f"of {', '.join(TASKS)}; default: all")
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}; default: all")
    parser.add_argument("--seeds", type=count, default=3, help="seeds per task and method; default: 3")
    parser.add_argument("--first", type=int, default=0, help="first seed; default: 0")
    parser.add_argument("--jobs", type=count, default=1, help="searches at the same time, one core each; default: 1")
    parser.add_argument("--episodes", type=int, default=0, help="budget; default: the published one of each task")
    parser.add_argument("--population", type=int, default=0, help="default: that of each method")
    parser.add_argument("--out", default="runs/trajopt", help="folder; default: runs/trajopt")
    parser.flag("double", "physics in double precision")
    parser.flag("quiet", "search only; no table")
    parser.flag("smoke", "one iteration of each method on short episodes with uncompiled steps")
    args = parser.parse_args(words)
    args.compiled = not args.smoke
    for name, known in (("tasks", TASKS), ("methods", METHODS)):
        chosen = [word for word in getattr(args, name).split(",") if word]
        wrong = [word for word in chosen if word not in known]
        if wrong or not chosen:
            parser.error(f"--{name} is {getattr(args, name)!r}; expected some of {', '.join(known)}")
        setattr(args, name, chosen)
    if args.smoke:
        args.seeds, args.episodes, args.population = 1, 4, 4
    return args


def main() -> None:
    """Run what is not there yet."""
    from torchdlo.errors import InputError

    args = arguments()
    if args.smoke:
        shorten()
    runs: dict[tuple[str, str], list[dict[str, Any]]] = {}
    try:
        if args.jobs > 1:
            side_by_side(args)
        for task in args.tasks:
            for method in args.methods:
                for seed in range(args.first, args.first + args.seeds):
                    runs.setdefault((task, method), []).append(run(task, method, seed, args))
                if not args.quiet:
                    report(runs, args)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except InputError as error:
        sys.exit(f"error: {error}")


def shorten() -> None:
    """Give every task an episode of one action of two frames."""
    from torchdlo import envs

    for name, kind in list(envs.TASKS.items()):
        short = type(kind.__name__, (kind,), {"frames": 2, "settle": 0, "release": 0})
        envs.TASKS[name] = lambda short=short: short(horizon=1)


if __name__ == "__main__":
    main()
