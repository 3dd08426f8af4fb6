"""What a recorded conversation comes to from varied starts, all of which are played in one batch.

    python experiments/agent_starts.py --out experiments/agent/starts.json

It plays what `torchdlo plan --recorded FILE --reset-seed SEED` plays, as long as the way-points of the steps do: each
step is played by its way-points, and no step is searched. A start of which a step does not reach its condition that way
needs a search; it is named in the column "searched", and `agent_benchmark.py plans` runs it alone. Starts, steps and
judgement are the same; numbers are rounded otherwise in a batch.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from options import Parser, count, save
from torch import Tensor

from torchdlo import envs
from torchdlo.agents.vlm.plan_schema import step_models
from torchdlo.agents.vlm.plan_waypoints import lead_through_waypoints
from torchdlo.agents.vlm.recorded import load_recorded
from torchdlo.envs.core import episode, scene_names
from torchdlo.envs.core.subtask import SubTask, task_success
from torchdlo.physics import tree
from torchdlo.reward_language import reward

ROOT = Path(__file__).resolve().parents[1]
CONVERSATIONS = ROOT / "tests" / "agents" / "conversations"
RUNS = {
    "letter_art": ("letter_art_slips_at_first.json", "letter_art.json"),
    "wiring_ring": ("wiring_ring_wrong_at_first.json", "wiring_ring.json"),
}
"""Conversations by the task that they plan."""


def parsed(arguments: list[str] | None = None) -> Any:
    """Return the options."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--out", default="", help="file that keeps rows; those that are there are not made again")
    parser.add_argument("--tasks", nargs="+", default=list(RUNS), help="tasks")
    parser.add_argument("--starts", type=count, default=10, help="varied starts, with the seeds 0, 1, ...")
    parser.flag("smoke", "one step from one start")
    return parser.parse_args(arguments)


def spoken(file: Path, hands: int, update: bool) -> list[Any]:
    """Return the steps that are carried out, in their order: the first of every answer, or those of the first plan."""
    plan, other = step_models(hands)
    said = [
        (plan if a["kind"] == "plan" else other).model_validate_json(a["text"]) for a in load_recorded(file).answers
    ]
    return [answer.steps[0] for answer in said] if update else list(said[0].steps)


def part_of(task: envs.Task, world: episode.EpisodeState, step: Any, holds: tuple[int | None, ...]) -> SubTask:
    """Return a step as a task that goes on from the worlds of all starts, see `envs.core.subtask.continue_from`."""
    grasps = tuple(step.grasps.model_dump().values())
    firm = (world.seen(task.arms.count).closed[..., 0] > 0).all(0)
    kept = tuple(h if h == g and bool(f) else None for h, g, f in zip(holds, grasps, firm, strict=True))
    inner = dataclasses.replace(task, grasps=grasps)
    scene, _, state = inner.start(len(world.failed), like=world.state.rods.pos)
    rest = inner.rest(tree.replace(world, state=state).seen(task.arms.count), scene.topology)
    before = tree.detach(tree.replace(world, notes={**world.notes, "rest": rest}))
    fields = {name: getattr(task, name) for name in ("frame_skip", "rope", "fidelity")}
    moves = task.travel if kept != grasps and any(g is not None for g in grasps) else 0
    return SubTask(**fields, horizon=step.horizon + moves, inner=inner, before=before, kept=kept)


def ways(task: envs.Task, step: Any, tools: Tensor) -> Tensor:
    """Return what leads the hands of every start from where they are (B, R, 3) through the way-points."""
    found = []
    for pos in tools:
        way = lead_through_waypoints(step, pos, task, cut=True)
        found.append(torch.zeros(step.horizon, 3 * task.arms.count) if way is None else way.float())
    return torch.stack(found)


def played(name: str, file: Path, update: bool, starts: int, most: int = 99) -> list[dict[str, Any]]:
    """Return a row for every start."""
    task, like, rows = envs.find(name), torch.zeros(()), [{} for _ in range(starts)]
    steps = spoken(file, task.arms.count, update)
    seeds = [torch.Generator().manual_seed(k) for k in range(starts)]
    moved = torch.cat([task.moved(1, like=like, generator=g, variation=True) for g in seeds])
    holds = tuple(steps[0].grasps.model_dump().values())
    world = episode.prepare_at(dataclasses.replace(task, grasps=holds), moved, execution="eager").start
    done = torch.zeros(starts, dtype=torch.bool)
    searched = torch.zeros_like(done)
    for number, step in enumerate(steps[:most], 1):
        judged, part = reward(step.reward, step.success, "reward"), part_of(task, world, step, holds)
        made = episode.prepare_at(part, torch.zeros_like(moved), execution="recorded")
        if part.travels:
            idle = like.new_zeros(starts, part.travels, task.width)
            made = dataclasses.replace(made, start=episode.play(part, idle, episode=made).world)
        actions = ways(task, step, made.start.tool.pos)
        went = episode.play(part, torch.cat([actions, torch.zeros_like(actions)], -1), episode=made)
        values = scene_names.named_values(task, scene_names.layout(made.scene), went.world.seen(task.arms.count))
        reached = judged.succeeded(values) & ~went.world.failed
        searched |= ~reached & ~done
        ended = task_success(made, went.world, task)[0] & ~done & ~searched
        for row, is_done in zip(rows, ended.tolist(), strict=True):
            row |= {"steps": number} if is_done else {}
        done, world, holds = done | ended, went.world, part.grasps or ()
        if bool(done.all()):
            break
    for k, row in enumerate(rows):
        row |= {"vary": k, "success": bool(done[k]), "searched": bool(searched[k])}
    return rows


def as_before(rows: list[dict[str, Any]], key: dict[str, Any]) -> list[dict[str, Any]] | None:
    """Return the starts of the row with updates where one without carries out the very same steps until all is done."""
    file, hands = CONVERSATIONS / key["conversation"], envs.find(key["task"]).arms.count
    same = [row for row in rows if row["conversation"] == key["conversation"] and row["update"]]
    if key["update"] or not same or not all(start["success"] for start in same[0]["starts"]):
        return None
    used = max(start["steps"] for start in same[0]["starts"])
    first, other = (spoken(file, hands, update)[:used] for update in (True, False))
    return same[0]["starts"] if first == other else None


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Make the rows, and print how many starts succeed."""
    options = parsed(arguments)
    torch.set_num_threads(1)
    kept = Path(options.out)
    rows = json.loads(kept.read_text())["rows"] if options.out and kept.exists() else []
    for name in options.tasks:
        for said in RUNS[name]:
            for update in (True, False):
                key = {"task": name, "conversation": said, "update": update}
                if any(all(row[k] == v for k, v in key.items()) for row in rows):
                    continue
                begun = time.process_time()
                with torch.no_grad():
                    found = played(
                        name, CONVERSATIONS / said, update, *((1, 1) if options.smoke else (options.starts,))
                    )
                rows.append(key | {"cpu_seconds": round(time.process_time() - begun, 1), "starts": found})
                save(options.out, {"generator": "experiments/agent_starts.py", "rows": rows})
                if options.smoke:
                    return rows
    print("task | conversation | update | successes | need a search | CPU s")
    for row in rows:
        starts = row["starts"]
        good, search = (sum(s[what] for s in starts) for what in ("success", "searched"))
        said = f"{good} of {len(starts)} | {search} | {row['cpu_seconds']}"
        print(f"{row['task']} | {row['conversation']} | {'with' if row['update'] else 'without'} | {said}")
    return rows


if __name__ == "__main__":
    sys.exit(0 if main() else 1)
