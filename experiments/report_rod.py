"""Print what bench_rod.py found, with goals."""

from __future__ import annotations

from typing import Any

FIRST = {"cold": 60.0, "warm": 15.0}
"""Longest first call [s]."""


def verdicts(content: dict[str, Any], goals: dict[tuple[int, str], float]) -> list[tuple[str, float, float, bool]]:
    """Return what was measured, its goal, and whether more is better."""
    found = []
    plain = {"vertices": 60, "dtype": "float32", "compiled": True, "integrator": "explicit", "twist": "none"}
    done = set()
    for row in content["rows"]:
        key = row["scenes"], row["mode"]
        # The first row of its kind is the one that uses all workers.
        if key in goals and key not in done and all(row[k] == v for k, v in plain.items()):
            done.add(key)
            name = f"frames/s, {key[0]} scenes, {row['workers']} processes, {key[1]}"
            found.append((name, row["frames_per_s"], goals[key], True))
    for entry in content["first_call_s"]:
        name = f"first call, {entry['case']}, {entry['mode']}, {entry['cache']} cache [s]"
        found.append((name, entry["seconds"], FIRST[entry["cache"]], False))
    for scenes, gradient in content.get("exponent", {}).items():
        found.append((f"exponent of cost, 100 to 3000 vertices, {scenes} scenes", gradient, 1.1, False))
    if len(content["memory"]) == 2:
        short, long = (entry["peak_mb"] for entry in content["memory"])
        found.append(("peak memory of the gradient, 20,000 over 2,000 substeps", long / short, 1.2, False))
    for entry in content.get("peers", {}).get("compared", []):
        for scenes, goal in ((1, 1.0), (100, 6.0)):
            if entry[f"ratio_{scenes}"] is not None:
                bound = f"{entry['error']} <= {1e3 * entry['bound_m']:.0f} mm"
                bound += f", strain <= {entry['strain']:g}" if entry["strain"] else ""
                found.append((f"times the best other, {scenes} scenes, {bound}", entry[f"ratio_{scenes}"], goal, True))
    return found


def number(value: float | None) -> str:
    """Three digits, or a dash."""
    if value is None:
        return "-"
    return f"{value:.3g}" if value < 100 else f"{value:,.0f}"


def show(content: dict[str, Any], goals: dict[tuple[int, str], float]) -> None:
    """Print the tables."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=150)
    names = ["scenes", "vertices", "mode", "dtype", "compiled", "integrator", "twist", "workers"]
    numbers = ["frames_per_s", "frames_per_wall_s", "us_per_substep", "peak_mb", "first_call_s"]
    if content["rows"]:
        table = Table(*names, *numbers, title="Falling rope")
        for row in content["rows"]:
            table.add_row(*(str(row[n]) for n in names), *(number(row[n]) for n in numbers))
        console.print(table)
    compared = content.get("peers", {}).get("compared", [])
    if compared:
        columns = [f"{who}_{n}" for n in (1, 100) for who in ("torchdlo", "pyelastica", "mujoco", "ratio")]
        table = Table(
            "error within", "[mm]", "strain", *columns, title="Simulated seconds per CPU second, 1 and 100 scenes"
        )
        for entry in compared:
            cells = (number(entry[c]) for c in columns)
            table.add_row(entry["error"], f"{1e3 * entry['bound_m']:.0f}", number(entry["strain"]), *cells)
        console.print(table)
    table = Table("what", "measured", "goal", "", title="Goals")
    for name, value, goal, more in verdicts(content, goals):
        hit = value >= goal if more else value <= goal
        table.add_row(name, number(value), f"{goal:,g}", "met" if hit else "MISSED")
    if table.row_count:
        console.print(table)
