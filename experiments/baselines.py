"""What tasks are worth: returns and successes of doing nothing, of random actions, and of the scripted demonstrations.

Every task is played from its one start and from starts that vary as they do in training. Random actions are drawn
evenly within their limits. Beside returns of doing nothing stand those that DLO-Lab's figures amount to.

examples:
  python experiments/baselines.py --tasks coiling,wrapping
  python experiments/baselines.py --starts 10 --json baselines.json
"""

from __future__ import annotations

import json
import statistics
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from options import Parser, count, save

NOTHING = {"coiling": 7.0, "gathering": 39.5, "lifting": 249.0, "slingshot": 6.90, "wrapping": 73.5}
"""Published returns of doing nothing."""


def measure(name: str, starts: int, seed: int, horizon: int | None) -> dict[str, Any]:
    """Return the row of a task: one batch of all episodes."""
    import torch

    from torchdlo.envs import find
    from torchdlo.envs.core import episode

    task, rng = find(name), torch.Generator().manual_seed(seed)
    away = 2 * torch.rand(starts, len(task.reset_noise), 2, generator=rng, dtype=torch.float64) - 1
    away = torch.nn.functional.pad(away * torch.tensor(task.reset_noise, dtype=torch.float64), (0, 1)).float()
    # From the one start: nothing and the scripted demonstration; from all others: nothing, random actions and the
    # scripted demonstration.
    moved = torch.cat([torch.zeros(2, *away.shape[1:]), away, away, away])
    base = episode.prepare(task, len(moved), execution="recorded" if horizon is None else "eager")
    _, params, state = task.build(moved)
    base = replace(base, params=params)
    base = replace(base, start=episode.begin(base, state))
    hand = task.demonstration(state)[:, :horizon]
    random = 2 * torch.rand(starts, hand.shape[1], task.width, generator=rng, dtype=torch.float64) - 1
    actions = torch.zeros_like(hand)
    actions[1], actions[2 + 2 * starts :] = hand[1], hand[2 + 2 * starts :]
    actions[2 + starts : 2 + 2 * starts] = random * torch.tensor(task.limit)
    with torch.no_grad():
        went = episode.play(task, actions.float(), episode=base)
    row: dict[str, Any] = {"task": name, "starts": starts, "published": NOTHING.get(name)}
    row |= {"nothing": float(went.returns[0]), "hand": float(went.returns[1])}
    row |= {"nothing_done": int(went.success[0]), "hand_done": int(went.success[1])}
    for k, what in enumerate(("nothing", "random", "hand")):
        part = slice(2 + k * starts, 2 + (k + 1) * starts)
        row[f"{what}_varied"] = went.returns[part].tolist()
        row[f"{what}_varied_done"] = int(went.success[part].sum())
        row[f"{what}_varied_failed"] = int(went.failed[part].sum())
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table of Markdown."""
    heads = ("task", "doing nothing", "published", "scripted", "of starts", *("nothing", "random", "scripted") * 2)
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for r in rows:
        means = [f"{statistics.mean(r[f'{w}_varied']):.1f}" for w in ("nothing", "random", "hand")]
        done = [f"{r[f'{w}_varied_done']}" for w in ("nothing", "random", "hand")]
        published = "" if r["published"] is None else f"{r['published']:g}"
        cells = [r["task"], f"{r['nothing']:.2f}", published, f"{r['hand']:.2f}", str(r["starts"]), *means, *done]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure what the file does not have yet, and print all of it."""
    from torchdlo.envs import TASKS

    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default=",".join(TASKS), help="names, separated by commas; default: all")
    parser.add_argument("--starts", type=count, default=10, help="starts that vary (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of starts and of random actions (%(default)s)")
    parser.add_argument("--json", default="", help="file for the rows; those that it has are not measured again")
    parser.flag("smoke", "one action from two starts")
    choices = parser.parse_args()
    wrong = sorted(set(choices.tasks.split(",")) - set(TASKS))
    if wrong:
        sys.exit(f"baselines: there is no task {', '.join(wrong)}; known are {', '.join(TASKS)}")
    if choices.smoke:
        choices.starts = 2
    file = Path(choices.json)
    rows = json.loads(file.read_text())["rows"] if choices.json and file.is_file() else []
    for name in choices.tasks.split(","):
        if not any((r["task"], r["starts"], r["seed"]) == (name, choices.starts, choices.seed) for r in rows):
            found = measure(name, choices.starts, choices.seed, 1 if choices.smoke else None)
            rows.append(found | {"seed": choices.seed})
            save(choices.json, {"generator": "torchdlo baselines", "rows": rows})
            print(f"{name}: nothing {found['nothing']:.2f}, scripted {found['hand']:.2f}", file=sys.stderr, flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
