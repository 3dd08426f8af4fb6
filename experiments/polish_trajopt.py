"""Polish stored trajectories, and write what they come to.

python experiments/polish_trajopt.py --tasks lifting      # experiments/trajopt/polished.json and .npz
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from options import Parser, save

ROOT = Path(__file__).parent


def main() -> None:
    """Polish the hybrid's trajectories of tasks, three seeds each, all in one batch."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default="lifting", help="names, with commas")
    parser.add_argument("--rounds", type=int, default=3, help="how often")
    parser.add_argument("--count", type=int, default=24, help="variants of each trajectory in a round")
    parser.add_argument("--seed", type=int, default=0, help="of the variants")
    parser.add_argument("--out", default=str(ROOT / "trajopt" / "polished.json"), help="file to write")
    chosen = parser.parse_args()
    import torch

    from torchdlo.agents.trajopt.polish import polish
    from torchdlo.agents.trajopt.stored import load_trajectory
    from torchdlo.envs import find

    torch.set_num_threads(1)
    rows, arrays = {}, {}
    for name in chosen.tasks.split(","):
        task, began = find(name), time.process_time()
        stored = [load_trajectory(name, "hybrid", k) for k in range(3)]
        ways = torch.stack([torch.as_tensor(np.asarray(t["actions"])).float() for t in stored])
        actions = torch.nn.functional.pad(ways, (0, task.width - ways.shape[-1]))

        def told(stage: str, done: int, total: int, message: str, name: str = name) -> None:
            print(f"{name} {stage} {done}/{total}: {message}", file=sys.stderr, flush=True)

        found = polish(task, actions, rounds=chosen.rounds, count=chosen.count, seed=chosen.seed, callback=told)
        arrays[name] = found.actions.numpy()
        rows[name] = {
            "before": {"return": [t["return"] for t in stored], "success": [t["success"] for t in stored]},
            "after": {"return": found.returns.tolist(), "success": found.success.tolist()},
            "episodes": found.episodes,
            "cpu_seconds": round(time.process_time() - began, 1),
            "rounds": chosen.rounds,
            "count": chosen.count,
            "seed": chosen.seed,
        }
        save(chosen.out, {"generator": "experiments/polish_trajopt.py", "tasks": rows})
        np.savez_compressed(Path(chosen.out).with_suffix(".npz"), **arrays)


if __name__ == "__main__":
    main()
