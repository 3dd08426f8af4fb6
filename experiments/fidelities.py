"""Play the scripted demonstrations of tasks at several fidelities, and put returns and CPU time side by side.

A cheaper fidelity does for training where a demonstration succeeds as at the published one, with a return within 2 %.
Steps are recorded, of one episode, after one step that is not timed.

examples:
  python experiments/fidelities.py --tasks lifting,wrapping
  python experiments/fidelities.py --fidelities published,1ms/2,2ms/1/implicit --json fidelities.json
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

from options import Parser, save

CLOSE = 0.02
"""Difference of returns, over the published one, up to which they count as the same."""


def play(name: str, fidelity: str, most: int | None) -> dict[str, Any]:
    """Return what a demonstration earns at a fidelity, and what it takes; `most` actions of it, if given."""
    import torch

    from torchdlo.envs import find, parse_fidelity, with_fidelity
    from torchdlo.envs.core import episode
    from torchdlo.errors import InputError
    from torchdlo.scene import step_diagnostics

    task = with_fidelity(find(name), parse_fidelity(fidelity))
    row: dict[str, Any] = {"task": name, "fidelity": fidelity}
    try:
        made = episode.prepare(task, 1, execution="recorded")
    except InputError as error:
        return row | {"return": math.nan, "success": False, "failed": True, "cpu_s": math.nan, "missed": str(error)}
    actions = task.demonstration()[:most].float().unsqueeze(0)
    with torch.no_grad():
        episode.play(task, actions[:, :1], episode=made)
        start = time.process_time()
        went = episode.play(task, actions, episode=made)
    row |= {"return": float(went.returns[0]), "success": bool(went.success[0])}
    said = step_diagnostics.explain_diagnostics(went.world.state.diagnostics)
    return row | {"failed": bool(went.failed[0]), "cpu_s": time.process_time() - start, "missed": said}


def shown(row: dict[str, Any], first: dict[str, Any]) -> str:
    """Return a row as a line, beside the one at the first fidelity."""
    off = abs(row["return"] - first["return"]) / max(abs(first["return"]), 1e-9)
    same = off <= CLOSE and row["success"] == first["success"]
    done = "failed" if row["failed"] else "success" if row["success"] else "no success"
    line = f"{row['task']:<13} {row['fidelity']:<15} {row['return']:>10.3f} {done:<10} {row['cpu_s']:8.1f} s CPU"
    return f"{line}  {100 * off:6.1f} % off  {'same' if same else 'NOT the same'} {row['missed']}".rstrip()


def main() -> int:
    """Play what the file does not have yet, and print all of it."""
    from torchdlo.envs import TASKS

    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default=",".join(TASKS), help="names, separated by commas; default: all")
    parser.add_argument("--fidelities", default="published,2ms/1/implicit", help="separated by commas (%(default)s)")
    parser.add_argument("--json", metavar="FILE", default="", help="file that results go to, and are taken from")
    parser.flag("smoke", "three actions of each")
    options = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    rows = json.loads(Path(options.json).read_text()) if options.json and Path(options.json).exists() else []
    ways = options.fidelities.split(",")
    for name in options.tasks.split(","):
        for way in ways:
            row = next((r for r in rows if (r["task"], r["fidelity"]) == (name, way)), None)
            if row is None:
                row = play(name, way, 3 if options.smoke else None)
                rows.append(row)
                save(options.json, rows)
            first = next(r for r in rows if (r["task"], r["fidelity"]) == (name, ways[0]))
            print(shown(row, first), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
