"""What episodes cost: frames of 1 ms per second, summed over environments, for every task.

Measured are whole actions as `torchdlo.envs.episode.act` runs them: inverse kinematics, 20 frames of five substeps, and
the reward. With gradients, the reward of a window of actions is differentiated by them. CPU seconds are counted, as
other work on the machine may take turns with this one. Beside each row stands the figure that DLO-Lab published for an
L40S GPU, for orientation: another machine, and other code for the same scene.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from options import Parser, save

EXAMPLES = """examples:
  python experiments/bench_env.py --quick
  python experiments/bench_env.py --tasks coiling,wrapping --envs 1,10,100 --json bench_env.json
"""
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


def measure(name: str, count: int, mode: str, choices: argparse.Namespace) -> dict[str, Any]:
    """Time a task."""
    import torch

    from torchdlo.envs import episode, find

    torch.set_num_threads(1)
    task, backward = find(name), mode == "forward+backward"
    start = time.perf_counter()
    made = episode.prepare(task, count, compiled=choices.compiled, segment=1)
    action = torch.full((count, task.width), 1e-3)

    def act() -> None:
        chosen = action.clone().requires_grad_(backward)
        with torch.set_grad_enabled(backward):
            world = episode.act(made, made.start, chosen)
            reward = episode.earned(made, world)[0]
        if backward:
            torch.autograd.grad(reward.sum(), chosen)

    act()
    first, used, actions = time.perf_counter() - start, time.process_time(), 0
    while not actions or time.process_time() - used < choices.seconds:
        act()
        actions += 1
    used = time.process_time() - used
    published = PUBLISHED.get((mode, count), ())
    return {
        "task": name,
        "envs": count,
        "mode": mode,
        "frames_per_cpu_s": actions * task.frames * count / used,
        "first_call_s": first,
        "published": published[NAMES.index(name)] if published and name in NAMES else None,
    }


def shown(row: dict[str, Any]) -> str:
    """Return a row of the table."""
    beside = "" if row["published"] is None else f"{row['published']:.0f}"
    return (
        f"{row['task']:<12} {row['envs']:>5} {row['mode']:<17} {row['frames_per_cpu_s']:>10.0f} {beside:>10} "
        f"{row['first_call_s']:>8.1f}"
    )


def parsed() -> argparse.Namespace:
    """Read the options."""
    parser = Parser(__file__, description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--tasks", default="", help="names, separated by commas; all if not given")
    parser.add_argument("--envs", default="", help="environments, e.g. 1,10,50,100 (the default)")
    parser.add_argument("--seconds", type=float, default=5.0, help="CPU seconds per row, after a first action")
    parser.add_argument("--json", default="", help="file for the rows")
    parser.flag("compiled", "compile the steps, which costs up to a minute per row at first")
    parser.flag("quick", "one and ten environments, one second per row")
    parser.flag("smoke", "one task, one environment: does it run?")
    return parser.parse_args()


def main() -> None:
    """Print and keep one row per task, number of environments, and mode."""
    choices = parsed()
    from torchdlo.envs import TASKS

    names = [n for n in choices.tasks.split(",") if n] or list(TASKS)
    envs = [int(n) for n in choices.envs.split(",") if n] or [1, 10, 50, 100]
    if choices.quick:
        envs, choices.seconds = envs[:2], min(choices.seconds, 1.0)
    if choices.smoke:
        names, envs, choices.seconds = names[:1], envs[:1], 0.0
    wrong = sorted(set(names) - set(TASKS))
    if wrong:
        sys.exit(f"bench_env: there is no task {', '.join(wrong)}; known are {', '.join(TASKS)}")
    print(f"{'task':<12} {'envs':>5} {'mode':<17} {'frames/CPU s':>10} {'L40S':>8} {'first s':>8}")
    rows = []
    for name in names:
        for count in envs:
            for mode in ("forward", "forward+backward"):
                rows.append(measure(name, count, mode, choices))
                print(shown(rows[-1]), flush=True)
                save(choices.json, {"rows": rows, "compiled": choices.compiled})


if __name__ == "__main__":
    main()
