"""What grasps and plans of agents come to, a row per task and proposer, in a file that a run goes on from.

    python experiments/agent_benchmark.py grasps --out runs/grasps.json
    python experiments/agent_benchmark.py grasps --out runs/grasps.json --endpoint http://localhost:8000/v1 --model NAME
    python experiments/agent_benchmark.py plans --conversation FILE --out runs/plans.json

`grasps` searches each task by the hybrid with the task's own grasps, those of the geometric stand-in and random ones in
three modes, and, if an endpoint is given, those of a model. `plans` carries out a recorded conversation from varied
starts, with and without updates of the plan.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from options import Parser, count, save

from torchdlo import envs
from torchdlo.agents.trajopt.presets import search_preset
from torchdlo.agents.trajopt.search import optimize
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
        for mode in MODES:
            found[f"{model.source}, {mode}"] = lambda model=model, mode=mode: asked(task, model, mode)
    for seed in range(options.draws):
        found[f"random, no model, {seed}"] = lambda seed=seed: random_grasps(places_of(task), seed).grasps
    return found


def asked(task: envs.Task, model: Any, mode: str) -> tuple[int | None, ...]:
    """Return what a model proposes on a picture."""
    from torchdlo.report.render.episode_film import stills
    from torchdlo.report.render.marks import marked_view

    made = episode.prepare(task, 1, compiled=False)
    view = marked_view(stills(made, [made.start], arms=False))
    return propose_grasps(task, mode, Conversation(model), view).grasps


def searched(name: str, grasps: tuple[int | None, ...], options: Any) -> dict[str, Any]:
    """Return what a search with grasps comes to."""
    own = grasps == envs.find(name).arms.vertex
    chosen = task_problem(name, grasps=None if own else grasps, compiled=False, recorded=options.method == "cmaes")
    given = {"episodes": options.episodes, "population": options.population}
    found = optimize(chosen, search_preset(name, options.method, **given))
    return {"return": float(found.outcome.returns[0]), "success": bool(found.outcome.success[0])}


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
        for name in options.tasks:
            alike: dict[tuple[int | None, ...], dict[str, Any]] = {}
            for who, grasps in proposers(envs.find(name), options).items():

                def make(name: str = name, grasps: Any = grasps, alike: dict = alike) -> dict[str, Any]:
                    slots = grasps()
                    # Equal grasps make equal searches.
                    if slots not in alike:
                        alike[slots] = searched(name, slots, options)
                    return {"grasps": list(slots)} | alike[slots]

                add({"task": name, "proposer": who} | budget, make)
    else:
        said = Path(options.conversation).name
        for update in (each == "with" for each in options.updates):
            for vary in range(options.starts):
                key = {"task": options.task, "conversation": said, "update": update, "vary": vary}
                add(key | budget, lambda u=update, v=vary: planned(options.task, options.conversation, u, v, options))
    for row in rows:
        print(" | ".join(str(row[k]) for k in row if k not in budget))
    return rows


if __name__ == "__main__":
    sys.exit(0 if main() else 1)
