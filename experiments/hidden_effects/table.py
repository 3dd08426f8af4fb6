"""What findings are worth against the answers: one row per recording, rates over them, and tables to read."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from statistics import median
from typing import Any

Numbers = dict[str, float]
MEASUREMENT = ("time_delay", "marker_offset")
BINS = ((0.0, 1.8, "below 2"), (1.8, 5.5, "about 3"), (5.5, 17.0, "about 10"), (17.0, math.inf, "about 30"))
"""Ratios of gap to noise that are counted together."""


def _wind(n: Numbers) -> list[float]:
    flow = [n[f"velocity.{k}"] for k in range(2)]
    return [n["c_d"] * math.hypot(*flow, n.get("velocity.2", 0.0)) * v for v in flow]


def _ratio(n: Numbers) -> list[float]:
    # Turning by half a turn changes nothing: the direction counts twice.
    size, twice = math.log(n["ratio"]), 2 * n["direction"]
    return [size * math.cos(twice), size * math.sin(twice)]


def _pick(*names: str) -> Callable[[Numbers], list[float]]:
    return lambda n: [n[name] for name in names]


COMPARED: dict[str, Callable[[Numbers], list[float]]] = {
    "air_drag": _pick("c_d"),
    "wind": _wind,
    "tilted_gravity": _pick("angles.0", "angles.1"),
    "bending_damping": _pick("coefficient"),
    "rest_curvature": _pick("curvature.0", "curvature.1"),
    "bending_plasticity": _pick("yield_curvature"),
    "internal_friction": _pick("moment"),
    "stiffening_bending": _pick("c"),
    "nonuniform_stiffness": _pick("factor"),
    "anisotropic_bending": _ratio,
    "point_mass": _pick("mass"),
    "stretch": _pick("EA"),
    "table_friction": _pick("mu"),
    "gripper_compliance": _pick("stiffness"),
    "gripper_play": _pick("angle"),
    "gripper_damping": _pick("stiffness"),
    "fluid_forces": _pick("across", "added_mass"),
    "time_delay": _pick("delay"),
    "marker_offset": _pick("offset.0", "offset.1"),
}
"""What of an effect's numbers is compared, as a vector; of wind its push, of two stiffnesses the logarithm of their
ratio in its direction. Places and widths are not."""
COVERED = {
    "air_drag": ("c_d",),
    "tilted_gravity": ("angles.0", "angles.1"),
    "bending_damping": ("coefficient",),
    "rest_curvature": ("curvature.0", "curvature.1"),
    "bending_plasticity": ("yield_curvature",),
    "internal_friction": ("moment",),
    "stiffening_bending": ("c",),
    "nonuniform_stiffness": ("factor", "position"),
    "point_mass": ("mass", "position"),
    "stretch": ("EA",),
    "table_friction": ("mu",),
    "gripper_compliance": ("stiffness",),
    "gripper_play": ("angle",),
    "gripper_damping": ("stiffness", "loss_time"),
    "fluid_forces": ("across", "along", "added_mass"),
    "time_delay": ("delay",),
    "marker_offset": ("offset.0", "offset.1"),
}
"""Numbers whose ranges are held against the truth."""
ABSENT = ("outside", "removed")
"""Kinds of recordings that hide what is not in the library."""


def without_it(answer: dict[str, Any]) -> dict[str, Any]:
    """Return the answer for a library without what is hidden."""
    return answer | {"kind": "removed", "answer": [], "effects": {}, "measurement": []}


def judge(name: str, answer: dict[str, Any], found: dict[str, Any] | None) -> dict[str, Any]:
    """Return the row of one recording; `found` is None where the diagnosis failed."""
    row = {
        "recording": name,
        "case": answer["case"],
        "kind": answer["kind"],
        "truth": answer["answer"] or ([answer["case"].split("-")[1]] if answer["kind"] in ABSENT else []),
        "ratio": answer["ratio"],
        "measurement": bool(answer["measurement"]),
    }
    if found is None:
        return row | {"verdict": "failed", "named": [], "sets": [], "right": False, "why": "the diagnosis failed"}
    named = [e["name"] for e in found["effects"]]
    sets = [sorted({e["name"], *e["indistinguishable_from"]}) for e in found["effects"]]
    row |= {"verdict": found["verdict"], "named": named, "sets": sets, "seconds": found["seconds"]}
    row |= _compare(answer, found) | {"closed": _closed(answer, found["gap"])}
    row["false"] = [n for n, s in zip(named, sets, strict=True) if not set(s) & set(answer["answer"])]
    row["in_set"] = bool(answer["answer"]) and all(any(t in s for s in sets) for t in answer["answer"])
    row["right"], row["why"] = _right(row, answer)
    row["as_force"] = row["measurement"] and any(n not in MEASUREMENT for n in row["false"])
    return row


def _right(row: dict[str, Any], answer: dict[str, Any]) -> tuple[bool, str]:
    """Return whether a recording's answer was found, and why not."""
    verdict, named, truth = row["verdict"], row["named"], answer["answer"]
    said = f"said {verdict}" + (f": {', '.join(named)}" if named else "")
    if answer["kind"] == "null":
        return verdict == "none" and not named, said
    if answer["kind"] in ABSENT:
        return verdict in ("unknown", "partial"), said
    if answer["kind"] == "compound":
        return set(truth) <= set(named), said
    if answer["kind"] == "tie":
        # Both are right: the name alone, or the set of those that cannot be told apart.
        return bool(row["sets"]) and truth[0] in row["sets"][0], said
    return named[:1] == truth, said


def _compare(answer: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """Return relative errors of the numbers by effect, and how many ranges hold the truth, of how many."""
    errors, inside, asked = {}, 0, 0
    for effect in found["effects"]:
        name, true = effect["name"], answer["effects"].get(effect["name"])
        if true is None or name not in COMPARED:
            continue
        got = {k: v["value"] for k, v in effect["parameters"].items() if v["value"] is not None}
        a, b = COMPARED[name](dict(true)), COMPARED[name](dict.fromkeys(true, 0.0) | got)
        errors[name] = math.dist(a, b) / max(math.hypot(*a), 1e-30)
        for number in COVERED.get(name, ()):
            if number in true and number in effect["parameters"]:
                low, high = (effect["parameters"][number][k] for k in ("low", "high"))
                inside, asked = inside + (low <= true[number] <= high), asked + 1
    return {"errors": errors, "covered": [inside, asked]}


def _closed(answer: dict[str, Any], gap: dict[str, Any]) -> float | None:
    """Return the share of the gap above the noise that is closed on the test trials; None where there is hardly any."""
    before, after, floor = gap["test_rmse_before_m"], gap["test_rmse_after_m"], answer["noise_m"]
    if before < 1.3 * floor:
        return None
    return min(1.0, (before - after) / (before - floor))


def _rate(rows: list[dict[str, Any]], test: Callable[[dict[str, Any]], Any]) -> dict[str, int]:
    return {"yes": sum(bool(test(r)) for r in rows), "of": len(rows)}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the rates over all rows."""

    def kind(name: str) -> list[dict[str, Any]]:
        return [r for r in rows if r["kind"] == name]

    single, errors = kind("single"), [e for r in rows for e in r.get("errors", {}).values()]
    closed = [r["closed"] for r in rows if r["kind"] in ("single", "compound") and r.get("closed") is not None]
    covered = [r.get("covered", [0, 0]) for r in rows]
    result: dict[str, Any] = {
        "single, named first": _rate(single, lambda r: r["right"]),
        "single, in the named set": _rate(single, lambda r: r.get("in_set")),
        "single, set of at most two": _rate(
            single, lambda r: r.get("in_set") and max((len(s) for s in r["sets"]), default=0) <= 2
        ),
        "single, something false named too": _rate(single, lambda r: r.get("false")),
        "nothing missing, said so": _rate(kind("null"), lambda r: r["right"]),
        "nothing missing, an effect named": _rate(kind("null"), lambda r: r["named"]),
        "outside the library, abstained": _rate(kind("outside"), lambda r: r["right"]),
        "outside the library, called explained": _rate(kind("outside"), lambda r: r["verdict"] == "effects"),
        "taken out of the library, abstained": _rate(kind("removed"), lambda r: r["right"]),
        "taken out of the library, called explained": _rate(kind("removed"), lambda r: r["verdict"] == "effects"),
        "two at once, both named": _rate(kind("compound"), lambda r: r["right"]),
        "two at once, something false named": _rate(kind("compound"), lambda r: r.get("false")),
        "hard to tell apart, set or name right": _rate(kind("tie"), lambda r: r["right"]),
        "measurement called something else": _rate([r for r in rows if r["measurement"]], lambda r: r.get("as_force")),
        "ranges that hold the truth": {"yes": sum(c[0] for c in covered), "of": sum(c[1] for c in covered)},
        "failed": _rate(rows, lambda r: r["verdict"] == "failed"),
    }
    for low, high, label in BINS:
        some = [r for r in single if low <= r["ratio"] < high]
        result[f"single, gap {label} times the noise"] = _rate(some, lambda r: r["right"])
        result[f"single, gap {label} times the noise, in set"] = _rate(some, lambda r: r.get("in_set"))
    rates = {k: v for k, v in result.items() if v["of"]}
    figures = {
        "error of numbers, median": median(errors) if errors else None,
        "error of numbers, 90 %": sorted(errors)[math.ceil(0.9 * len(errors)) - 1] if errors else None,
        "gap above the noise closed, median": median(closed) if closed else None,
        "seconds per recording, median": median(s) if (s := [r["seconds"] for r in rows if "seconds" in r]) else None,
    }
    return {"rates": rates, "figures": {k: v for k, v in figures.items() if v is not None}}


def confusion(rows: list[dict[str, Any]]) -> list[list[str]]:
    """Return what was named first by what was hidden, with headers."""
    said = Counter((_label(r), (r["named"] or [r["verdict"]])[0]) for r in rows)
    hidden, names = sorted({k[0] for k in said}), sorted({k[1] for k in said})
    body = [[h, *(str(said[h, n]) if said[h, n] else "" for n in names)] for h in hidden]
    return [["hidden", *names], *body]


def _label(row: dict[str, Any]) -> str:
    name = " + ".join(row["truth"]) or "nothing"
    return f"({name})" if row["kind"] in ABSENT else name


def grid(lines: list[list[str]]) -> str:
    """Return lines, the first of which are headers, as a markdown table."""
    ruled = [lines[0], ["---"] * len(lines[0]), *lines[1:]]
    return "\n".join("| " + " | ".join(line) + " |" for line in ruled)


def _line(row: dict[str, Any]) -> list[str]:
    named = " + ".join("/".join(s) for s in row["sets"])
    errors = ", ".join(f"{e:.0%}" for e in row.get("errors", {}).values())
    right = "yes" if row["right"] else "no"
    return [row["recording"], row["case"], f"{row['ratio']:.1f}", row["verdict"], named, errors, right]


def markdown(rows: list[dict[str, Any]], title: str) -> str:
    """Return everything as a page to read."""
    total = summary(rows)
    rates = [[k, f"{v['yes']} of {v['of']}", f"{v['yes'] / v['of']:.0%}"] for k, v in total["rates"].items()]
    figures = [[k, f"{v:.3g}", ""] for k, v in total["figures"].items()]
    wrong = [
        [r["recording"], r["case"], f"{r['ratio']:.1f}", r["why"], ", ".join(r.get("false", []))]
        for r in rows
        if not r["right"] or (r.get("false") and r["kind"] in ("single", "compound", "tie"))
    ]
    every = [_line(r) for r in rows]
    parts = [
        f"# {title}",
        grid([["what", "count", "share"], *rates, *figures]),
        "## What was named first, by what was hidden",
        "Names in brackets are outside the library; where nothing was named, the verdict stands.",
        grid(confusion(rows)),
        "## Failures",
        grid([["recording", "case", "gap / noise", "what happened", "false names"], *wrong]) if wrong else "None.",
        "## All recordings",
        grid([["recording", "case", "gap / noise", "verdict", "named", "error of numbers", "right"], *every]),
    ]
    return "\n\n".join(parts) + "\n"
