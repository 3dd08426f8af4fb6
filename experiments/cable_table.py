"""The tables of what is named on real cables, and of what was planted into them, which need nothing but their rows."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]

PLANTED = {
    "time_delay": ("delay of 20 ms", 0.02),
    "tilted_gravity": ("frame out of level by 2 degrees", 0.0349),
    "marker_offset": ("markers 8 mm beside the axis", 0.008),
    "point_mass": ("bead of 10 g", 0.01),
}
"""What a plant is in words, and the size of the number that detection limits are of, in SI units."""


def table(rows: list[Row]) -> str:
    """Return both tables as Markdown."""
    plain = {r["recording"]: r for r in rows if not r["plant"]}
    return "\n\n".join(part for part in (_cables(list(plain.values())), _plants(rows, plain)) if part)


def _cables(rows: list[Row]) -> str:
    lines = [
        "| cable | error before → after [mm] | verdict | named | p | test trials that follow to their ends |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        through, tested = r["test_trials"]
        cells = (r["recording"], _error(r), f"`{r['verdict']}`", _names(r), _chances(r), f"{through} of {tested}")
        lines.append(_line(cells))
    return "\n".join(lines) if rows else ""


def _plants(rows: list[Row], plain: dict[str, Row]) -> str:
    lines = [
        "| planted | into | detection limit beforehand | error before → after [mm] | named | p | as it should be |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for r in rows:
        if not r["plant"]:
            continue
        what, size = PLANTED[r["plant"]]
        limit = limit_of(plain.get(r["recording"]), r["plant"])
        fine = "yes" if r["named"] else "said to be too small" if limit is not None and size < limit else "**no**"
        cells = (what, r["recording"], _limit(plain.get(r["recording"]), r["plant"]), _error(r), _names(r), _chances(r))
        lines.append(_line((*cells, fine)))
    return "\n".join(lines) if len(lines) > 2 else ""


def limit_of(row: Row | None, effect: str) -> float | None:
    """Return the size from which an effect is named at the best, as was said without it; None if nothing was."""
    for each in row["detection_limits"] if row else []:
        if each["name"] == effect:
            return float("inf") if each["easiest"] is None else float(each["easiest"])
    return None


def _limit(row: Row | None, effect: str) -> str:
    for each in row["detection_limits"] if row else []:
        if each["name"] == effect:
            if each["easiest"] is None:
                return str(each["note"])
            most = "" if each["hardest"] is None else f" to {each['hardest']:.2g}"
            return f"{each['number']} {each['easiest']:.2g}{most} {each['unit']}"
    return "not said"


def _error(row: Row) -> str:
    return f"{row['test_mae_before_mm']:.1f} → {row['test_mae_after_mm']:.1f}"


def _names(row: Row) -> str:
    return ", ".join(e + "".join(f" / {t}" for t in row["ties"].get(e, [])) for e in row["effects"]) or "nothing"


def _chances(row: Row) -> str:
    return ", ".join("-" if row["p_values"].get(e) is None else f"{row['p_values'][e]:.2g}" for e in row["effects"])


def _line(cells: tuple[str, ...]) -> str:
    return f"| {' | '.join(cells)} |"
