"""Play tasks at several fidelities, and put returns and CPU time side by side.

A cheaper fidelity does for training where scripted demonstrations, and the stored trajectories of the hybrid search
that succeeded, succeed as at the published one, with returns within 2 %. Steps are recorded, after one that is not
timed; what is stored for a task is played in one batch.

examples:
  python experiments/fidelities.py --tasks lifting,wrapping
  python experiments/fidelities.py --stored --json stored.json
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


def actions_of(name: str, stored: bool) -> Any:
    """Return what is played of a task (B, T, A) [m, degrees]: its demonstration, or trajectories that succeeded."""
    import torch

    from torchdlo.agents.trajopt.stored import load_trajectory, read_index
    from torchdlo.agents.trajopt.task_problem import task_problem
    from torchdlo.envs import find

    if not stored:
        return find(name).demonstration().float().unsqueeze(0)
    found = [e for e in read_index() if (e["task"], e["method"], e["success"]) == (name, "hybrid", True)]
    if not found:
        return None
    kept = [torch.as_tensor(load_trajectory(name, "hybrid", e["seed"])["actions"]) for e in found]
    return task_problem(name, execution="recorded").full(torch.stack(kept))


def play(name: str, fidelity: str, actions: Any) -> dict[str, Any]:
    """Return what actions (B, T, A) earn at a fidelity, and what they take."""
    import torch

    from torchdlo.envs import find, parse_fidelity, with_fidelity
    from torchdlo.envs.core import episode
    from torchdlo.errors import InputError
    from torchdlo.scene import step_diagnostics

    task = with_fidelity(find(name), parse_fidelity(fidelity))
    row: dict[str, Any] = {"task": name, "fidelity": fidelity}
    try:
        made = episode.prepare(task, len(actions), execution="recorded")
    except InputError as error:
        return row | {"returns": [], "success": [], "failed": [], "cpu_s": math.nan, "missed": str(error)}
    with torch.no_grad():
        episode.play(task, actions[:, :1], episode=made)
        start = time.process_time()
        went = episode.play(task, actions, episode=made)
    row |= {key: getattr(went, key).tolist() for key in ("returns", "success", "failed")}
    said = step_diagnostics.explain_diagnostics(went.world.state.diagnostics)
    return row | {"cpu_s": time.process_time() - start, "missed": said}


def shown(row: dict[str, Any], first: dict[str, Any]) -> str:
    """Return a row as lines, one per episode, beside those at the first fidelity."""
    lines = []
    for k, (value, one) in enumerate(zip(row["returns"], first["returns"], strict=False)):
        off = abs(value - one) / max(abs(one), 1e-9)
        same = off <= CLOSE and row["success"][k] == first["success"][k]
        done = "failed" if row["failed"][k] else "success" if row["success"][k] else "no success"
        lines.append(f"{value:>10.3f} {done:<10}  {100 * off:6.1f} % off  {'same' if same else 'NOT the same'}")
    head = f"{row['task']:<13} {row['fidelity']:<15} {row['cpu_s']:8.1f} s CPU {row['missed']}".rstrip()
    return "\n".join([head, *lines])


def main() -> int:
    """Play what the file does not have yet, and print all of it."""
    from torchdlo.envs import TASKS

    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default=",".join(TASKS), help="names, separated by commas; default: all")
    parser.add_argument("--fidelities", default="published,2ms/1/implicit", help="separated by commas (%(default)s)")
    parser.add_argument("--json", metavar="FILE", default="", help="file that results go to, and are taken from")
    parser.flag("stored", "play trajectories of the hybrid search that succeeded, not demonstrations")
    parser.flag("smoke", "three actions of each")
    options = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    rows = json.loads(Path(options.json).read_text()) if options.json and Path(options.json).exists() else {}
    kind = "stored" if options.stored else "demonstrations"
    kept = rows.get(kind, [])
    ways = options.fidelities.split(",")
    for name in options.tasks.split(","):
        actions = actions_of(name, options.stored)
        for way in ways if actions is not None else ():
            row = next((r for r in kept if (r["task"], r["fidelity"]) == (name, way)), None)
            if row is None:
                row = play(name, way, actions[:, : 3 if options.smoke else None])
                kept.append(row)
                save(options.json, rows | {kind: kept})
            first = next(r for r in kept if (r["task"], r["fidelity"]) == (name, ways[0]))
            print(shown(row, first), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
