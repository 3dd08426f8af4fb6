"""What grasps and plans of agents come to, a row per task and proposer, in a file that a run goes on from.

    python experiments/agent_benchmark.py grasps --out runs/grasps.json
    python experiments/agent_benchmark.py grasps --out runs/grasps.json --endpoint http://localhost:8000/v1 --model NAME
    python experiments/agent_benchmark.py plans --conversation FILE --out runs/plans.json

`grasps` searches each task by the hybrid with the task's own grasps, those of the geometric stand-in, random ones, and,
if an endpoint is given, those of a model; by default each search begins with the best stored trajectory of the task, so
that small budgets compare. Rows are added to those that are there. `plans` carries out a recorded conversation from
varied starts, with and without updates of the plan, start by start; `agent_starts.py` plays all starts at once.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy
import torch
from options import Parser, count, save
from torch import Tensor

from torchdlo import envs
from torchdlo.agents.trajopt.presets import search_preset
from torchdlo.agents.trajopt.search import optimize
from torchdlo.agents.trajopt.stored import load_trajectory
from torchdlo.agents.trajopt.task_problem import task_problem
from torchdlo.agents.vlm.conversation import Conversation
from torchdlo.agents.vlm.decomposition import Options, carry_out
from torchdlo.agents.vlm.endpoint import Endpoint
from torchdlo.agents.vlm.geometry import Geometry
from torchdlo.agents.vlm.grasp_proposal import places_of, propose_grasps, random_grasps
from torchdlo.agents.vlm.plan_schema import MODES
from torchdlo.agents.vlm.recorded import load_recorded
from torchdlo.envs.core import episode
from torchdlo.errors import InputError

POLISHED = Path(__file__).parent / "trajopt" / "polished.json"
TASKS = ("lifting", "unknotting", "wrapping")


def parsed(arguments: list[str] | None = None) -> Any:
    """Return the options."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("what", choices=("grasps", "plans"))
    parser.add_argument("--out", default="", help="file that keeps rows; those that are there are not made again")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help="tasks whose grasps are compared")
    parser.add_argument("--episodes", type=count, default=240, help="budget of a search, or of a step of a plan")
    parser.add_argument("--population", type=count, default=24, help="trajectories per iteration")
    parser.add_argument("--method", choices=("hybrid", "cmaes"), default="hybrid")
    parser.add_argument(
        "--begin", choices=("stored", "nothing"), default="stored", help="what searches with grasps begin with"
    )
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=MODES, help="how models say grasps")
    parser.add_argument("--draws", type=count, default=3, help="random grasps per task")
    parser.add_argument("--starts", type=count, default=10, help="varied starts of plans")
    parser.add_argument("--conversation", default="", help="recorded conversation of plans")
    parser.add_argument("--task", default="wiring_ring", help="task of plans")
    parser.add_argument(
        "--updates", nargs="+", default=["with", "without"], choices=("with", "without"), help="runs of plans"
    )
    parser.add_argument("--endpoint", default="", help="server of a model that proposes grasps")
    parser.add_argument("--model", default="", help="its name")
    parser.flag("smoke", "a single task with next to no budget")
    found = parser.parse_args(arguments)
    if found.smoke:
        found.tasks, found.draws, found.starts, found.method = found.tasks[-1:], 1, 1, "cmaes"
        found.episodes = found.population = 4
    return found


def proposers(task: envs.Task, options: Any) -> dict[str, Callable[[], tuple[int | None, ...]]]:
    """Return who proposes grasps, by the name of the row."""
    found: dict[str, Callable[[], tuple[int | None, ...]]] = {"own": lambda: task.arms.vertex}
    models: list[Any] = [Geometry()]
    if options.endpoint:
        models.append(Endpoint(options.endpoint, options.model))
    for model in models:
        for mode in options.modes:
            found[f"{model.source}, {mode}"] = lambda model=model, mode=mode: asked(task, model, mode)
    for seed in range(options.draws):
        found[f"random, no model, {seed}"] = lambda seed=seed: random_grasps(places_of(task), seed).grasps
    return found


def asked(task: envs.Task, model: Any, mode: str) -> tuple[int | None, ...]:
    """Return what a model proposes on a picture."""
    from torchdlo.report.render.episode_film import stills
    from torchdlo.report.render.marks import marked_view

    made = episode.prepare(task, 1, execution="eager")
    view = marked_view(stills(made, [made.start], arms=False))
    return propose_grasps(task, mode, Conversation(model), view).grasps


def stored(name: str) -> Tensor:
    """Return the best stored trajectory of a task, shape (1, T, 3 R)."""
    found = [load_trajectory(name, "hybrid", seed) for seed in range(3)]
    best = max(found, key=lambda t: (t["success"], t["return"]))
    ways, earned = torch.as_tensor(best["actions"]), best["return"]
    if POLISHED.with_suffix(".npz").exists():
        after = json.loads(POLISHED.read_text())["tasks"].get(name, {"after": {"return": []}})["after"]["return"]
        if after and max(after) > earned:
            with numpy.load(POLISHED.with_suffix(".npz")) as arrays:
                ways = torch.as_tensor(arrays[name][after.index(max(after))])
    return ways[None, :, : 3 * envs.find(name).arms.count].double()


def searched(name: str, grasps: tuple[int | None, ...], options: Any) -> dict[str, Any]:
    """Return what a search with grasps comes to."""
    begun, own = time.process_time(), grasps == envs.find(name).arms.vertex
    chosen = task_problem(name, grasps=None if own else grasps, execution="recorded")
    given = {"episodes": options.episodes, "population": options.population}
    first = stored(name) if options.begin == "stored" else None
    found = optimize(chosen, search_preset(name, options.method, surrogate_share=0.0, **given), first=first)
    return {
        "return": float(found.outcome.returns[0]),
        "success": bool(found.outcome.success[0]),
        "cpu_seconds": round(time.process_time() - begun, 1),
    }


def planned(name: str, file: str, update: bool, vary: int, options: Any) -> dict[str, Any]:
    """Return what a plan from a start comes to; a conversation that ends too soon ends it."""
    begun = time.process_time()
    choices = {"method": options.method, "episodes": options.episodes, "population": options.population}
    talk = Conversation(load_recorded(Path(file)))
    try:
        found = carry_out(envs.find(name), talk, Options(update=update, reset_seed=vary, **choices))
    except InputError as error:
        return {"success": False, "ended": str(error), "source": talk.model.source}
    steps = [{"id": c.step["id"], "success": c.success, "episodes": c.episodes} for c in found.carried]
    return {
        "success": found.success,
        "ended": found.ended,
        "updates": found.updates,
        "episodes": sum(c.episodes for c in found.carried),
        "steps": steps,
        "source": found.source,
        "cpu_seconds": round(time.process_time() - begun, 1),
    }


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Make rows, and print them as a table."""
    options = parsed(arguments)
    torch.set_num_threads(1)
    kept = Path(options.out)
    rows = json.loads(kept.read_text()) if options.out and kept.exists() else []

    def add(key: dict[str, Any], make: Callable[[], dict[str, Any]]) -> None:
        if not any(all(row.get(k) == v for k, v in key.items()) for row in rows):
            rows.append(key | make())
            save(options.out, rows)

    budget = {"episodes": options.episodes, "population": options.population, "method": options.method}
    if options.what == "grasps":
        budget["begin"] = options.begin
        for name in options.tasks:
            for who, grasps in proposers(envs.find(name), options).items():

                def make(name: str = name, grasps: Any = grasps) -> dict[str, Any]:
                    slots = grasps()
                    # Equal grasps make equal searches.
                    same = {"task": name, "grasps": list(slots)} | budget
                    for row in rows:
                        if all(row.get(k) == v for k, v in same.items()):
                            kept = ("grasps", "return", "success", "cpu_seconds")
                            return {k: row[k] for k in kept} | {"same_as": row["proposer"]}
                    return {"grasps": list(slots)} | searched(name, slots, options)

                add({"task": name, "proposer": who} | budget, make)
    else:
        said = Path(options.conversation).name
        for update in (each == "with" for each in options.updates):
            for vary in range(options.starts):
                key = {"task": options.task, "conversation": said, "update": update, "vary": vary}
                add(key | budget, lambda u=update, v=vary: planned(options.task, options.conversation, u, v, options))
    if options.what == "grasps":
        print(table(rows))
    else:
        for row in rows:
            print(" | ".join(str(row[k]) for k in row if k not in (*budget, "steps")))
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return returns by task and proposer, and the share of what the task's own grasps earn, in Markdown."""
    tasks, whos = (list(dict.fromkeys(row[k] for row in rows)) for k in ("task", "proposer"))
    cell = {(row["task"], row["proposer"]): row for row in rows}
    if not any(who.startswith("model ") for who in whos):
        whos.append("a model of yours: --endpoint URL --model NAME")
    lines = ["| task | " + " | ".join(whos) + " |", "|---" * (1 + len(whos)) + "|"]
    for task in tasks:
        own, cells = cell.get((task, "own")), []
        for who in whos:
            row = cell.get((task, who))
            share = f", {row['return'] / own['return']:.0%}" if row and own else ""
            held = "" if row is None else ", ".join("open" if g is None else str(g) for g in row["grasps"])
            done = "" if row is None else "" if row["success"] else ", no success"
            cells.append("" if row is None else f"{row['return']:.4g}{share}{done} ({held})")
        lines.append(f"| {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(0 if main() else 1)
