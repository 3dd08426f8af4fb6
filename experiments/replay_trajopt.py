"""Play trajectories that were found once more, and put what they earn now beside what they earned.

Every trajectory of the archive of --out, or of its subfolders, is played alone, with the precision and the kind of
steps with which it was found. On the machine and with the versions of the search every bit comes back; what changes
with others shows how far a result rests on rounding.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from options import Parser, save

EXAMPLES = """examples:
  python experiments/replay_trajopt.py --out experiments/trajopt --json runs/replays.json
  python experiments/replay_trajopt.py --searches coiling-hybrid-0,coiling-hybrid-1
"""


def trajectories(out: Path) -> dict[str, dict[str, Any]]:
    """Return the contents of all trajectories below a folder, by the names of their searches."""
    from torchdlo.agents.trajopt.stored import NAME, read_searches

    found = {name: content for name, _, content in read_searches(out / NAME)} if (out / NAME).is_file() else {}
    loose = sorted(out.glob("*/trajectory.json"))
    return found | {file.parent.name: json.loads(file.read_text(encoding="utf-8")) for file in loose}


def replay(name: str, had: dict[str, Any], make: Callable[..., Any]) -> dict[str, Any]:
    """Play a trajectory in the problem that `make(task, **choices)` returns, and return how that went."""
    import torch

    from torchdlo.agents.trajopt.search_result import execution_of, plain_evaluation
    from torchdlo.untrusted import Entry

    choices = Entry(had["choices"], had["task"])
    # Problems that are no tasks of TorchRL have neither.
    how: dict[str, Any] = {"double": choices["double"].flag()} if "double" in choices else {}
    how |= {"execution": execution_of(choices)} if "execution" in choices or "compiled" in choices else {}
    problem = make(had["task"], **how)
    outcome, kept = problem.record(torch.as_tensor(had["actions"], dtype=torch.float64))
    now = plain_evaluation(outcome)
    row = {"search": name, "missed": kept.get("missed", "")}
    return row | {name: [had[name], now[name]] for name in ("return", "success")}


def shown(row: dict[str, Any]) -> str:
    """Return a row as a line."""
    numbers = ["no number" if value is None else f"{value:.4f}" for value in row["return"]]
    words = ["success" if ok else "no success" for ok in row["success"]]
    line = f"{row['search']:<22} {numbers[0]:>10}, {words[0]:<10}  now {numbers[1]:>10}, {words[1]:<10} {row['missed']}"
    return line.rstrip()


def main() -> None:
    """Play all that is there."""
    from torchdlo.agents.trajopt.task_problem import task_problem

    parser = Parser("replay_trajopt.py", description=__doc__, epilog=EXAMPLES)
    parser.add_argument("--out", default="experiments/trajopt", help="folder of the searches; default: %(default)s")
    parser.add_argument("--searches", default="", help="names of searches, separated by commas; default: all")
    parser.add_argument("--json", default="", help="file for the rows")
    args = parser.parse_args()
    found = trajectories(Path(args.out))
    wanted = [name for name in args.searches.split(",") if name]
    wrong = sorted(set(wanted) - set(found))
    if wrong or not found:
        sys.exit(
            f"error: {args.out}: expected the trajectories {', '.join(wrong) or 'of searches'}, found none of them."
        )
    rows, make = [], functools.cache(task_problem)
    for name, content in found.items():
        if not wanted or name in wanted:
            rows.append(replay(name, content, make))
            print(shown(rows[-1]), flush=True)
            save(args.json, {"generator": "torchdlo replay_trajopt", "rows": rows})
    before, now = (sum(row["success"][k] for row in rows) for k in (0, 1))
    print(f"{len(rows)} trajectories: {before} succeeded when they were found, {now} do now")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
