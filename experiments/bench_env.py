"""What episodes cost: frames of 1 ms per second, summed over environments, for every task.

Measured are `reset` and `step` of the TorchRL environment: inverse kinematics, 20 frames of five substeps, the reward
and the observation. With gradients, the reward of an action is differentiated by it; what that takes stays in memory,
so that nothing is run again. CPU seconds are counted, as other work on the machine may take turns with this one; rates
are summed over processes of one thread each that start together and share the environments. Steps are compiled, unless
--steps says otherwise. Beside each row stands the figure that DLO-Lab published for an L40S GPU, for orientation:
another machine, and other code for the same scene. Rows that the JSON file has already are not measured again.

With --memory: peak memory of the gradient of an episode's return with respect to all its actions, ten environments that
run five frames again at once, over 200 and over 2 000 frames.

examples:
  python experiments/bench_env.py --quick
  python experiments/bench_env.py --tasks coiling,wrapping --envs 1,10,100 --json bench_env.json
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench_rod import BOTH, FORWARD, clocked, gathered, peak_mb, processes, receive, start
from options import Parser, count, save

STEPS = ("plain", "recorded", "compiled")
NAMES = ("coiling", "gathering", "lifting", "separation", "slingshot", "unknotting", "wiring_post", "wrapping")
PUBLISHED = {
    ("forward", 1): (90.85, 32.31, 50.03, 87.20, 90.08, 80.70, 90.82, 83.71),
    ("forward", 10): (873.73, 175.79, 418.94, 819.08, 829.03, 725.73, 883.78, 752.17),
    ("forward", 50): (4349.98, 365.86, 1736.94, 3372.44, 3759.83, 3192.53, 4125.65, 3327.49),
    ("forward", 100): (8566.86, 422.92, 2625.83, 4939.99, 6120.69, 5131.42, 8531.82, 5139.43),
    ("forward+backward", 1): (32.49, 8.24, 12.10, 30.29, 13.73, 28.68, 31.13, 31.17),
    ("forward+backward", 10): (344.25, 52.00, 53.37, 267.77, 106.72, 211.16, 282.10, 186.84),
    ("forward+backward", 50): (1465.67, 184.28, 153.30, 1056.34, 412.05, 709.75, 1382.38, 670.37),
    ("forward+backward", 100): (3015.49, 300.56, 245.21, 1655.18, 661.25, 1134.70, 2509.35, 1048.17),
}
"""Frames per second on one L40S, summed over environments."""
SEGMENT = 5
"""Frames that are run again at once where memory is measured."""


@dataclass(frozen=True)
class Case:
    """One row."""

    task: str
    scenes: int
    mode: str
    steps: str
    workers: int = 2
    seconds: float = 5.0
    """CPU time in each process, after two actions [s]."""


def work(case: Case, share: int, go: Any, results: Any) -> None:
    """Time a share of a case in this process: put None when ready, wait for `go`, put what was found."""
    import torch

    from torchdlo import envs

    torch.set_num_threads(1)
    backward = case.mode == BOTH
    steps = {"execution": "eager" if case.steps == "plain" else case.steps}
    choices = {"gradients": backward, "segment": None, "variation": False, **steps}

    def act(env: Any) -> None:
        start = env.reset()
        action = torch.full_like(env.action_spec.zero(), 1e-3).requires_grad_(backward)
        reward = env.step(start.set("action", action))["next", "reward"]
        if backward:
            torch.autograd.grad(reward.sum(), action)

    found: list[Any] = []
    first = clocked(lambda: (found.append(envs.make(case.task, num_envs=share, **choices)), act(found[0])))[1]
    act(found[0])
    results.put(None)
    go.wait()
    used, actions = 0.0, 0
    while not actions or used < case.seconds:
        used += clocked(lambda: act(found[0]))[0]
        actions += 1
    rate = actions * found[0].task.frame_skip * share / used
    results.put({"cpu": rate, "first_call_s": first, "peak_mb": peak_mb()})


def remember(task: str, actions: int, compiled: bool, go: Any, results: Any) -> None:
    """Put the peak memory of the gradient of a return, first calls not counted."""
    import torch

    from torchdlo import envs

    torch.set_num_threads(1)
    choices = {
        "gradients": True,
        "execution": "compiled" if compiled else "eager",
        "variation": False,
        "segment": SEGMENT,
    }
    env = envs.make(task, num_envs=10, **choices)
    stage_waypoints = [torch.full_like(env.action_spec.zero(), 1e-3).requires_grad_() for _ in range(actions)]

    def gradient(chosen: list[Any]) -> None:
        td, earned = env.reset(), 0.0
        for action in chosen:
            stepped, td = env.step_and_maybe_reset(td.set("action", action))
            earned = earned + stepped["next", "reward"].sum()
        torch.autograd.grad(earned, chosen)

    gradient(stage_waypoints[:2])
    before = peak_mb(restart=True)
    gradient(stage_waypoints)
    results.put({"frames": actions * env.task.frame_skip, "before_mb": before, "peak_mb": peak_mb()})


def memory(task: str, actions: int, compiled: bool) -> dict[str, Any]:
    """Return the memory of the gradient of a return of so many actions."""
    with processes(remember, [(task, actions, compiled)]) as (jobs, _, results):
        start(jobs)
        return {"task": task, **receive(jobs, results)}


def measure(case: Case) -> dict[str, Any]:
    """Return the row of a case."""
    found = gathered(work, case)
    row = asdict(case) | {"workers": len(found), "published": None}
    row["frames_per_cpu_s"] = sum(f["cpu"] for f in found)
    row["peak_mb"] = sum(f["peak_mb"] for f in found)
    row["first_call_s"] = max(f["first_call_s"] for f in found)
    if case.task in NAMES and (case.mode, case.scenes) in PUBLISHED:
        row["published"] = PUBLISHED[case.mode, case.scenes][NAMES.index(case.task)]
    return row


def shown(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    goal = row["published"]
    beside = "" if goal is None else f"{goal:8.0f}  {'missed' if row['frames_per_cpu_s'] < goal else 'reached'}"
    head = f"{row['task']:<12} {row['scenes']:>5} {row['mode']:<17} {row['steps']:<9}"
    return f"{head} {row['frames_per_cpu_s']:>10.0f} {beside:17} first call {row['first_call_s']:.0f} s"


def parsed() -> argparse.Namespace:
    """Read the options."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default="", help="names, separated by commas; all that are published if not given")
    parser.add_argument("--envs", default="1,10,50,100", help="environments (%(default)s)")
    parser.add_argument("--modes", default=f"{FORWARD},{BOTH}", help="of %(default)s")
    parser.add_argument("--steps", default="compiled", choices=STEPS, help="how steps are run (%(default)s)")
    parser.add_argument("--seconds", type=float, default=5.0, help="CPU seconds per row and process (%(default)s)")
    parser.add_argument("--workers", type=count, default=2, help="processes that share the environments (%(default)s)")
    parser.add_argument("--json", default="", help="file for the rows")
    parser.flag("memory", "memory instead of speed")
    parser.flag("quick", "one and ten environments without gradients, one second per row")
    parser.flag("smoke", "one task, one environment: does it run?")
    return parser.parse_args()


def names(choices: argparse.Namespace) -> list[str]:
    """Return the names of the tasks."""
    from torchdlo.envs import TASKS

    found = [n for n in choices.tasks.split(",") if n] or list(NAMES)
    wrong = sorted(set(found) - set(TASKS))
    if wrong:
        sys.exit(f"bench_env: there is no task {', '.join(wrong)}; known are {', '.join(TASKS)}")
    return found


def cases(choices: argparse.Namespace) -> list[Case]:
    """Return what is timed."""
    chosen = names(choices)
    modes = [m for m in choices.modes.split(",") if m]
    if not modes or not set(modes) <= {FORWARD, BOTH}:
        sys.exit(f"bench_env: --modes is {choices.modes!r}; expected some of {FORWARD}, {BOTH}")
    envs, seconds, steps = [int(n) for n in choices.envs.split(",") if n], choices.seconds, choices.steps
    if choices.quick:
        envs, modes, seconds = [1, 10], [FORWARD], 1.0
    if choices.smoke:
        chosen, envs, seconds, steps = chosen[:1], [1], 0.0, "plain"
    return [Case(name, n, mode, steps, choices.workers, seconds) for name in chosen for n in envs for mode in modes]


def kept(path: str) -> dict[str, Any]:
    """Return what a file has."""
    return json.loads(Path(path).read_text()) if path and Path(path).is_file() else {}


def main() -> None:
    """Print and keep one row per task, number of environments, and mode."""
    choices = parsed()
    if choices.memory:
        lengths = (1, 2) if choices.smoke else (10, 100)
        rows = [memory(name, actions, not choices.smoke) for name in names(choices) for actions in lengths]
        for row in rows:
            print(
                f"{row['task']:<12} {row['frames']:>5} frames {row['peak_mb']:6.0f} MB, {row['before_mb']:.0f} before"
            )
        save(choices.json, kept(choices.json) | {"cores": os.cpu_count(), "memory": rows})
        return
    rows = kept(choices.json).get("rows", [])
    for case in cases(choices):
        wanted = asdict(case) | {"workers": min(case.workers, case.scenes)}
        found = next((r for r in rows if all(r[name] == value for name, value in wanted.items())), None)
        if found is None:
            rows.append(found := measure(case))
            save(choices.json, kept(choices.json) | {"cores": os.cpu_count(), "rows": rows})
        print(shown(found), flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
