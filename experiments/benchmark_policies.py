"""Train policies on tasks by algorithms and seeds, judge them from unseen starts, and pack what was found.

    python experiments/benchmark_policies.py --algos hybrid --seeds 0,1,2      # goes on where it was stopped
    python experiments/benchmark_policies.py --pack experiments/policies.zip   # what is there, as one archive
    python experiments/benchmark_policies.py --table experiments/policies.zip  # the table of docs/policies.md

A run leaves TASK-ALGO-SEED with its policy, its log and evaluation.json: 15 unseen starts, and the one start.
The hybrid begins with the trajectories in experiments/trajopt/searches.npz; with --source scripted, it begins with the
scripted demonstrations of tasks, and runs are called TASK-scripted-SEED.
"""

from __future__ import annotations

import io
import json
import math
import statistics
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

from options import Parser, save

ROOT = Path(__file__).parent
TASKS = ("coiling", "gathering", "lifting", "separation", "slingshot", "unknotting", "wiring_post", "wrapping")
KEPT = ("policy.pt", "evaluation.json", "stages.json", "expert.json", "result.json", "student.json", "robustness.json")

JUDGED = ("evaluation.json", "stages.json", "result.json", "robustness.json")


def options() -> Any:
    """Read the options."""
    parser = Parser(__file__, description=__doc__)
    parser.add_argument("--tasks", default=",".join(TASKS), help="names, with commas")
    parser.add_argument("--algos", default="hybrid", help="ppo, sac, shac, sapo, hybrid, with commas")
    parser.add_argument("--seeds", default="0", help="seeds, with commas")
    parser.add_argument("--episodes", type=int, default=None, help="budget; default: the published one")
    parser.add_argument("--minutes", type=float, default=None, help="budget of the clock of each run")
    parser.add_argument("--fidelity", default=None, help="of training, for algorithms without stages")
    parser.add_argument("--device", default=None, help="of training, for algorithms without stages: cpu or cuda")
    parser.add_argument("--count", type=int, default=None, help="episodes at once, for algorithms without stages")
    parser.add_argument("--settings", default="{}", help="other settings of algorithms without stages, as JSON")
    parser.add_argument("--train-only", action="store_true", help="leave the judgement to a later run with --judge")
    parser.add_argument("--without", default="", help="stages of the hybrid to leave out, with commas")
    parser.add_argument("--source", default="found", choices=("found", "scripted"), help="what the hybrid begins with")
    parser.add_argument("--starts", type=int, default=15, help="episodes of each judgement")
    parser.add_argument("--reset-seed", type=int, default=1, help="seed of the starts of the judgement")
    parser.add_argument("--plan", default="{}", help="other sizes of the hybrid's stages, as JSON")
    parser.add_argument("--judge", action="store_true", help="judge policies that are there, and train none")
    parser.add_argument("--out", default="runs/policies", help="folder of the runs")
    parser.add_argument("--pack", default="", help="write an archive of what is in --out, and end")
    parser.add_argument("--table", default="", help="print the table of an archive, and end")
    return parser.parse_args()


def scripted(name: str, folder: Path) -> Path:
    """Write the tools' path of a scripted demonstration as a trajectory."""
    import torch

    from torchdlo.envs import find
    from torchdlo.envs.core import episode

    file = folder / f"{name}-scripted" / "trajectory.json"
    if not file.exists():
        task = find(name)
        with torch.no_grad():
            actions = task.demonstration().float()[None]
            went = episode.play(task, actions, keep=episode.scene_positions, execution="recorded")
        content = {"generator": "torchdlo optimize", "task": name, "success": bool(went.success[0])}
        save(str(file), content | {"tool": went.path["tool"][:, 0].tolist()})
    return file


def run(name: str, algo: str, seed: int, chosen: Any) -> None:
    """Train one policy and judge it; what is done is not done again."""
    from torchdlo.agents.policies import load_policy
    from torchdlo.agents.rl.evaluate import evaluate_policies
    from torchdlo.agents.rl.hybrid_stages import STAGES, plan_of, train_hybrid
    from torchdlo.agents.rl.results import prepare_training, train_json, train_result
    from torchdlo.agents.rl.settings import training_preset
    from torchdlo.agents.rl.training import train
    from torchdlo.agents.trajopt.stored import ARCHIVE, unpack_searches
    from torchdlo.envs import find

    label = "scripted" if algo == "hybrid" and chosen.source == "scripted" else algo
    folder, task, began = Path(chosen.out) / f"{name}-{label}-{seed}", find(name), time.process_time()

    def told(stage: str, done: int, total: int, message: str) -> None:
        print(f"{time.process_time() - began:7.0f} CPU s  {folder.name} {stage} {done}/{total} {message}", flush=True)

    # A run that was killed has a policy, too, but no result.
    finished = folder / ("policy.pt" if algo == "hybrid" else "result.json")
    if (folder / "evaluation.json").exists() or (chosen.judge and not finished.exists()):
        return
    given = {"seed": seed, "minutes": chosen.minutes, "device": chosen.device}
    if chosen.judge:
        pass
    elif algo == "hybrid":
        searches = Path(chosen.out) / "searches"
        if not searches.exists():
            unpack_searches(ARCHIVE, searches)
        files = [searches / f"{name}-hybrid-{k}" / "trajectory.json" for k in range(3)]
        if label == "scripted":
            files = [scripted(name, Path(chosen.out))]
        # The path is searched once for all seeds: policies differ in what is learned.
        first = folder.with_name(f"{name}-{label}-0") / "expert.json"
        expert = first if seed and first.exists() else None
        stages = [s for s in STAGES if s not in chosen.without.split(",")]
        plan = plan_of(name, **json.loads(chosen.plan))
        choices = {"folder": folder, "plan": plan, "stages": stages, "expert": expert}
        choices |= {"resume": True, "callback": told}
        train_hybrid(task, files, training_preset(name, algo, **given), **choices)
    else:
        given |= {"episodes": chosen.episodes, "fidelity": chosen.fidelity, "count": chosen.count}
        settings = training_preset(name, algo, **given, **json.loads(chosen.settings))
        # Compiling takes half a minute, and halves the time of a step.
        trainer, played = prepare_training(task, settings, execution="compiled")
        resume = (folder / "checkpoint.pt").exists()
        found = train(trainer, played, settings, folder=folder, resume=resume, callback=told)
        (folder / "result.json").write_text(train_json(train_result(task, settings, found)))
    if chosen.train_only and not chosen.judge:
        return
    results, _ = evaluate_policies([load_policy(folder)], task, starts=chosen.starts, seed=chosen.reset_seed)
    results |= {"generator": "torchdlo evaluate", "algorithm": label, "seed": seed}
    save(str(folder / "evaluation.json"), results)
    told("judged", 1, 1, f"success {results['varied']['success']:.0%} from unseen starts")


def rounded(policy: Path) -> bytes:
    """Return the file of a policy with matrices of half precision, which are read as others are."""
    import torch

    content = torch.load(policy, map_location="cpu", weights_only=True)
    state = {k: x.half() if x.dim() > 1 and x.dtype == torch.float32 else x for k, x in content["state"].items()}
    torch.save(content | {"state": state}, written := io.BytesIO())
    return written.getvalue()


def pack(out: Path, file: Path) -> None:
    """Write what is to be kept of all finished runs to one archive, weights in half precision."""
    from torchdlo.files import replace_atomically

    with replace_atomically(file) as scratch, zipfile.ZipFile(scratch, "w") as archive:
        for folder in sorted(p.parent for p in out.glob("*/evaluation.json")):
            # What each seed came to, and the weights of the first if they ever succeed.
            judged = json.loads((folder / "evaluation.json").read_text())
            useful = judged.get("varied", {"success": 1.0})["success"] > 0
            for name in KEPT if folder.name.endswith("-0") and useful else JUDGED:
                if (folder / name).exists():
                    found = rounded(folder / name) if name == "policy.pt" else (folder / name).read_bytes()
                    archive.writestr(zipfile.ZipInfo(f"{folder.name}/{name}"), found, zipfile.ZIP_DEFLATED, 9)


def rows(file: Path) -> list[dict[str, Any]]:
    """Return a row for each task and algorithm of an archive: means over the seeds."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    with zipfile.ZipFile(file) as archive:
        names = set(archive.namelist())
        for name in sorted(names):
            folder, _, last = name.partition("/")
            if last != "evaluation.json":
                continue
            found = json.loads(archive.read(name))
            if "varied" not in found:
                continue  # a policy of clouds
            spent = {}
            for other in ("stages.json", "result.json"):
                if f"{folder}/{other}" in names:
                    spent[other] = json.loads(archive.read(f"{folder}/{other}"))
            groups.setdefault((found["task"], found["algorithm"]), []).append(found | {"spent": spent})
    return [_row(task, algo, runs) for (task, algo), runs in groups.items()]


def _episodes(run: dict[str, Any]) -> int:
    stages = run["spent"].get("stages.json")
    if stages:
        return sum(stages[s]["episodes"] for s in ("robust", "clone", "tune") if s in stages)
    return run["spent"]["result.json"]["episodes"]


def _minutes(run: dict[str, Any]) -> float:
    """Return the CPU minutes of a run, NaN where they were not kept."""
    stages = run["spent"].get("stages.json")
    if stages:
        return sum(stages[s].get("cpu_seconds", math.nan) for s in ("robust", "clone", "tune") if s in stages) / 60
    return run["spent"]["result.json"].get("cpu_seconds", math.nan) / 60


def _row(task: str, algo: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    from torchdlo.agents.rl.evaluate import wilson_interval
    from torchdlo.agents.rl.settings import PUBLISHED

    count = sum(r["varied"]["episodes"] for r in runs)
    hits = round(sum(r["varied"]["success"] * r["varied"]["episodes"] for r in runs))
    return {
        "task": task,
        "algorithm": algo,
        "seeds": len(runs),
        "starts": ", ".join(sorted({str(r.get("reset_seed", 0)) for r in runs})),
        "success": hits / count,
        "interval": wilson_interval(hits, count),
        "return": statistics.mean(r["varied"]["return"] for r in runs),
        "one_success": statistics.mean(r["one"]["success"] for r in runs),
        "one_return": statistics.mean(r["one"]["return"] for r in runs),
        "episodes": max(_episodes(r) for r in runs),
        "minutes": max(_minutes(r) for r in runs),
        "published": PUBLISHED.get(task, {}).get(algo),
    }


def table(found: list[dict[str, Any]]) -> str:
    """Return rows as a table of Markdown."""
    lines = [
        "| task | algorithm | seeds | starts | success, unseen starts | 95 % | return | one start | return | episodes "
        "| CPU min | published |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in sorted(found, key=lambda r: (r["algorithm"], r["task"])):
        low, high = r["interval"]
        known = "" if r["published"] is None else f"{r['published'][0]:.2f}, {r['published'][1]:.0%}"
        cells = [
            r["task"],
            r["algorithm"],
            str(r["seeds"]),
            r["starts"],
            f"{r['success']:.0%}",
            f"{low:.0%} to {high:.0%}",
        ]
        cells += [f"{r['return']:.2f}", f"{r['one_success']:.0%}", f"{r['one_return']:.2f}", str(r["episodes"])]
        cells += ["" if math.isnan(r["minutes"]) else f"{r['minutes']:.0f}", known]
        lines.append(f"| {' | '.join(cells)} |")
    for algo in sorted({r["algorithm"] for r in found}):
        own = [r["success"] for r in found if r["algorithm"] == algo]
        lines.append(
            f"\n{algo}: mean success from unseen starts over {len(own)} task{'s' * (len(own) != 1)} "
            f"{statistics.mean(own):.0%}."
        )
    return "\n".join(lines) + "\n"


def clouds(file: Path) -> str:
    """Return the table of policies that see clouds of points, by cameras; nothing if an archive has none."""
    lines = []
    with zipfile.ZipFile(file) as archive:
        for name in sorted(n for n in archive.namelist() if n.endswith("/evaluation.json")):
            found = json.loads(archive.read(name))
            if "conditions" not in found:
                continue
            spent = json.loads(archive.read(name.replace("evaluation", "student")))
            for camera, row in found["conditions"].items():
                low, high = row["interval"]
                cells = [
                    found["task"],
                    camera,
                    f"{row['success']:.0%} of {row['episodes']}",
                    f"{low:.0%} to {high:.0%}",
                ]
                lines.append(f"| {' | '.join([*cells, str(spent['episodes'])])} |")
    head = ["| task | camera | success, unseen starts | 95 % | episodes |", "|---|---|---|---|---|"]
    return "\n".join([*head, *lines]) + "\n" if lines else ""


def robustness(file: Path) -> str:
    """Return the tables of success under perturbations; nothing if an archive has none."""
    from torchdlo.agents.rl.robustness import table as markdown

    tables = []
    with zipfile.ZipFile(file) as archive:
        for name in sorted(n for n in archive.namelist() if n.endswith("/robustness.json")):
            found = json.loads(archive.read(name))
            tables.append(f"{found['task']}, {found['starts']} unseen starts:\n\n{markdown(found)}\n")
    return "\n".join(tables)


def main() -> None:
    """Run what is asked for."""
    chosen = options()
    if chosen.table:
        file = Path(chosen.table)
        sys.stdout.write("\n".join(part for part in (table(rows(file)), clouds(file), robustness(file)) if part))
        return
    if chosen.pack:
        pack(Path(chosen.out), Path(chosen.pack))
        return
    import torch

    torch.set_num_threads(1)
    for seed in chosen.seeds.split(","):
        for algo in chosen.algos.split(","):
            for name in chosen.tasks.split(","):
                run(name, algo, int(seed), chosen)


if __name__ == "__main__":
    main()
