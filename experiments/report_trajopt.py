"""The table and the curves of `benchmark_trajopt.py`: tasks by methods, beside published returns."""

from __future__ import annotations

import io
import json
import statistics
from pathlib import Path
from typing import Any

from options import save


def earlier(result: dict[str, Any]) -> bool:
    """Return whether a result is of another version of the program or of libraries."""
    from torchdlo.agents.trajopt.search_journal import program_hash

    return result["program"] != program_hash(result["task"])


def finished(task: str, method: str, out: Path) -> list[dict[str, Any]]:
    """All results of a task by a method that are there, of any settings, by seed."""
    from torchdlo.agents.trajopt.search_result import upgrade_result
    from torchdlo.agents.trajopt.stored import NAME, read_searches

    found, archive, start = {}, out / NAME, f"{task}-{method}-"
    if archive.is_file():
        found = {name: result for name, result, _ in read_searches(archive) if name.startswith(start)}
    # What was searched since the archive was written counts more.
    found |= {
        file.parent.name: upgrade_result(json.loads(file.read_text())) for file in out.glob(f"{start}*/result.json")
    }
    return sorted(found.values(), key=lambda run: run["settings"]["seed"])


def seen(runs: list[dict[str, Any]], episodes: float) -> float | None:
    """Largest return that searches had seen after so many episodes, mean over the seeds; None before the first."""
    sofar = [[p["best"] for p in run["curve"] if p["episodes"] <= episodes and p["best"] is not None] for run in runs]
    return statistics.mean(max(best) for best in sofar) if sofar and all(sofar) else None


def row(task: str, method: str, runs: list[dict[str, Any]], hybrid: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of the table: mean and spread over the seeds, and what the hybrid saw of the same task."""
    from torchdlo.agents.trajopt.presets import PUBLISHED, search_preset

    known = "cmaes" if method == "hybrid" else method
    goal, solved = PUBLISHED.get(task, {}).get(known, (None, None))
    episodes = statistics.mean(r["episodes"] for r in runs)
    returns, largest = ([r[k] for r in runs if r[k] is not None] for k in ("return", "max_return"))
    return {
        "task": task,
        "method": method,
        "seeds": len(runs),
        "return": statistics.mean(returns) if returns else None,
        "spread": statistics.stdev(returns) if len(returns) > 1 else None,
        "lowest": min(returns, default=None),
        "max_return": max(returns, default=None),
        # Published returns are the largest that a search saw.
        "seen": statistics.mean(largest) if largest else None,
        "hybrid": seen(hybrid, episodes),
        "published": goal,
        "published_success": solved,
        "published_episodes": None if goal is None else search_preset(task, known).episodes,
        "success": statistics.mean(float(r["success"]) for r in runs),
        "episodes": episodes,
        "episodes_to_success": [r["episodes_to_success"] for r in runs],
        "seconds": statistics.mean(r["seconds"] for r in runs),
        "earlier": any(earlier(r) for r in runs),
        "missed": any(r.get("missed") for r in runs),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a table of Markdown."""
    lines = [
        "| task | method | seeds | return | spread | largest | hybrid | success | episodes | seconds | published |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        beside = ""
        if r["published"] is not None:
            beside = f"{r['published']:.2f}, {r['published_success']:.0%} after {r['published_episodes']}"
        cells = [
            r["task"],
            r["method"],
            f"{r['seeds']}{'*' * r['earlier']}{'†' * r['missed']}",
            *("" if r[k] is None else f"{r[k]:.2f}" for k in ("return", "spread", "seen", "hybrid")),
            f"{r['success']:.0%}",
            f"{r['episodes']:.0f}",
            f"{r['seconds']:.0f}",
            beside,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    if any(r["earlier"] for r in rows):
        lines += ["", "\\* of another version of the program or of libraries; --again runs them anew"]
    if any(r["missed"] for r in rows):
        lines += [
            "",
            "† a best trajectory moved further within a step than contact looked, see `missed` in its result.json",
        ]
    return "\n".join(lines) + "\n"


def report(runs: dict[tuple[str, str], list[dict[str, Any]]], out: Path) -> None:
    """Print and write the table and the curves of what is there so far."""
    from PIL import Image

    from torchdlo.files import write_atomically
    from torchdlo.report.figures.learning_curve import learning_png

    rows = [row(task, method, found, runs.get((task, "hybrid"), [])) for (task, method), found in runs.items()]
    text = table(rows)
    save(str(out / "benchmark.json"), {"generator": "torchdlo benchmark_trajopt", "rows": rows})
    write_atomically(out / "benchmark.md", text)
    panels: dict[str, dict[str, list[Any]]] = {}
    for (task, method), found in runs.items():
        panels.setdefault(task, {})[method] = [r["curve"] for r in found]
    picture = io.BytesIO()
    Image.open(io.BytesIO(learning_png(panels))).save(picture, "WEBP", lossless=True, quality=100, method=6)
    write_atomically(out / "curves.webp", picture.getvalue())
    print(text, end="", flush=True)
