"""Write what README and docs claim of the benchmark from stored rows: no number there is typed.

    python experiments/hidden_effects/claims.py --store runs/hidden/findings/score.json --name mismatch --title "..."
    python experiments/hidden_effects/claims.py            # writes the tables into README.md and docs/diagnose.md
    python experiments/hidden_effects/claims.py --check    # fails if they do not stand there

Rows as `score.py` writes them lie in `stored`. Bounds are exact, one-sided, 95 % (Clopper and Pearson 1934,
doi:10.1093/biomet/26.4.404).
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import beta

sys.path.append(str(Path(__file__).resolve().parents[1]))

from options import Parser, save
from rival_table import table
from table import BINS, grid

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
Row = dict[str, Any]


@dataclass(frozen=True)
class Stored:
    """Rows of one run of the benchmark."""

    title: str
    """What a column of it is called."""
    note: str
    """What a reader should know of it."""
    rows: list[Row]
    """As of `table.judge`."""
    figures: dict[str, str]
    """What is not counted, by the names in `FIGURES`."""
    developed: bool = False
    """Whether the program was changed because of these rows: then the sentence of the README leaves them out."""


@dataclass(frozen=True)
class Measure:
    """One line of the table."""

    title: str
    """What is counted."""
    of: Callable[[Row], bool]
    """Which rows it is counted among."""
    counts: Callable[[Row], bool]
    """Which of them count."""
    bar: str = ""
    """What it should be."""
    bad: bool = False
    """Whether it should not happen."""


def _single(low: float, high: float) -> Callable[[Row], bool]:
    return lambda r: r["kind"] == "single" and low <= r["ratio"] < high


def _kind(name: str) -> Callable[[Row], bool]:
    return lambda r: r["kind"] == name


MEASURES = (
    *(
        Measure(f"hidden effect named first, gap {label} times the noise", _single(a, b), lambda r: r["right"], bar)
        for (a, b, label), bar in zip(BINS, ("", "75 %", "90 %", "95 %"), strict=True)
    ),
    Measure(
        "in a set of at most two names, all sizes",
        _kind("single"),
        lambda r: r.get("in_set") and max(map(len, r["sets"]), default=0) <= 2,
    ),
    Measure("one effect, a false name besides", _kind("single"), lambda r: bool(r.get("false")), bad=True),
    Measure("two effects at once, both named", _kind("compound"), lambda r: r["right"], "80 %"),
    Measure("two effects at once, a false name besides", _kind("compound"), lambda r: bool(r.get("false")), bad=True),
    Measure("nothing hidden, an effect named", _kind("null"), lambda r: bool(r["named"]), "1 of 60", bad=True),
    Measure("nothing hidden, `none` said", _kind("null"), lambda r: r["right"]),
    Measure("outside the library: `unknown` or `partial`", _kind("outside"), lambda r: r["right"]),
    Measure("outside the library: called explained", _kind("outside"), lambda r: r["verdict"] == "effects", bad=True),
    Measure(
        "the true effect taken out of the library: called explained",
        _kind("removed"),
        lambda r: r["verdict"] == "effects",
        "1 of 30",
        bad=True,
    ),
    Measure("wind or tilt that motions hardly tell apart: the name or a tie", _kind("tie"), lambda r: r["right"]),
)


def bound(yes: int, of: int, *, upper: bool) -> float:
    """Return the one-sided exact 95 % bound of a rate of which `yes` of `of` were seen."""
    if upper:
        return 1.0 if yes == of else float(beta.ppf(0.95, yes + 1, of - yes))
    return 0.0 if yes == 0 else float(beta.ppf(0.05, yes, of - yes + 1))


def load(folder: Path) -> list[Stored]:
    """Return all stored runs, by the names of their files."""
    found = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    return [Stored(x["title"], x["note"], x["rows"], x["figures"], x.get("developed", False)) for x in found]


def _cell(measure: Measure, rows: Sequence[Row]) -> str:
    some = [r for r in rows if measure.of(r)]
    if not some:
        return ""
    yes = sum(bool(measure.counts(r)) for r in some)
    limit = bound(yes, len(some), upper=measure.bad)
    sign = "≤" if measure.bad else "≥"
    return f"{yes} of {len(some)} ({sign} {limit:.0%})"


def rates(stored: Sequence[Stored]) -> str:
    """Return the table of rates, a column for each run."""
    lines = [["", *(s.title for s in stored), "bar"]]
    for measure in MEASURES:
        cells = [_cell(measure, s.rows) for s in stored]
        if any(cells):
            lines.append([measure.title, *cells, measure.bar])
    for name, bar in FIGURES.items():
        cells = [s.figures.get(name, "") for s in stored]
        if any(cells):
            lines.append([name, *cells, bar])
    notes = [f"*{s.title}*: {s.note}" for s in stored if s.note]
    return "\n\n".join([grid(lines), "In brackets: exact 95 % bounds of the rates. " + " ".join(notes)])


def power(stored: Sequence[Stored]) -> str:
    """Return by effect how many are named first, by the gap that they leave over the noise, of all runs together."""
    rows = [r for s in stored for r in s.rows if r["kind"] == "single"]
    names = sorted({r["truth"][0] for r in rows})
    lines = [["hidden", *(label for *_, label in BINS)]]
    for name in names:
        cells = []
        for low, high, _ in BINS:
            some = [r for r in rows if r["truth"][0] == name and low <= r["ratio"] < high]
            cells.append(f"{sum(r['right'] for r in some)} of {len(some)}" if some else "")
        lines.append([f"`{name}`", *cells])
    return grid(lines)


def nothing(stored: Sequence[Stored]) -> str:
    """Return by kind of mismatch what was said of recordings that hide nothing, of all runs together."""
    rows = [r for s in stored for r in s.rows if r["kind"] == "null"]

    def kind(row: Row) -> str:
        parts = row["case"].split("-")
        variant = parts[1] if not parts[1].isdigit() else "plain"
        return f"{variant}, {'links in MuJoCo' if parts[-1] == 'links' else 'exact rod'}"

    lines = [["nothing hidden, made as", "`none` said", "an effect named"]]
    for name in sorted({kind(r) for r in rows}):
        some = [r for r in rows if kind(r) == name]
        lines.append(
            [name, f"{sum(r['right'] for r in some)} of {len(some)}", str(sum(bool(r["named"]) for r in some))]
        )
    yes, of = sum(bool(r["named"]) for r in rows), len(rows)
    lines.append(["all", f"{sum(r['right'] for r in rows)} of {of}", f"{yes} (≤ {bound(yes, of, upper=True):.0%})"])
    return grid(lines)


def sentence(stored: Sequence[Stored]) -> str:
    """Return what the README says, in a sentence."""
    rows = [r for s in stored if not s.developed for r in s.rows]
    single, null = ([r for r in rows if r["kind"] == k] for k in ("single", "null"))
    pair, outside = ([r for r in rows if r["kind"] == k] for k in ("compound", "outside"))
    false = sum(bool(r["named"]) for r in null)
    return (
        f"Of {len(rows)} blinded recordings it named {sum(r['right'] for r in single)} of {len(single)} single effects "
        f"and both of two in {sum(r['right'] for r in pair)} of {len(pair)}; {false} of {len(null)} that hide nothing "
        f"got a name (at most {bound(false, len(null), upper=True):.0%} with 95 % confidence), and "
        f"{sum(r['verdict'] == 'effects' for r in outside)} of {len(outside)} that hide what it does not know were "
        "called explained."
    )


def rivals(_: Sequence[Stored]) -> str:
    """Return what other methods say of recordings, as `rival_methods.py` stored it."""
    return table(json.loads((ROOT / "experiments" / "rivals.json").read_text()))


FIGURES = {
    "measurement called something else": "5 %",
    "ranges that hold the truth": "85 to 95 %",
    "error of numbers, median": "0.05",
    "error of numbers, 90 %": "",
    "gap above the noise closed, median": "0.9",
    "seconds per recording, median": "180",
}
"""What is taken over from a run's summary, and what it should be."""

PARTS: dict[str, Callable[[Sequence[Stored]], str]] = {
    "rates": rates,
    "power": power,
    "nothing": nothing,
    "sentence": sentence,
    "rivals": rivals,
}
"""What can be written, by the name between the marks in a page."""

PAGES = (ROOT / "README.md", ROOT / "docs" / "diagnose.md")


def filled(page: str, stored: Sequence[Stored]) -> str:
    """Return a page with what stands between its marks written anew."""
    for name, part in PARTS.items():
        first, last = f"<!-- claims: {name} -->", f"<!-- end of claims: {name} -->"
        if first in page:
            before, rest = page.split(first, 1)
            _, found, after = rest.partition(last)
            if not found:
                raise SystemExit(f"the mark {last} is missing after {first}; put it where the generated part ends")
            margin = before[before.rfind("\n") + 1 :]
            text = part(stored)
            if name == "sentence":
                text = textwrap.fill(text, 118 - len(margin))
            page = f"{before}{first}\n{textwrap.indent(text, margin)}\n{margin}{last}{after}"
    return page


def keep(path: Path, name: str, title: str, note: str) -> None:
    """Store the rows of a run."""
    found = json.loads(path.read_text())
    figures = {k: f"{v['yes']} of {v['of']}" for k, v in found["rates"].items() if k in FIGURES}
    figures |= {k: f"{v:.3g}" for k, v in found["figures"].items() if k in FIGURES}
    content = {"title": title, "note": note, "figures": figures, "rows": found["rows"]}
    save(str(FOLDER / "stored" / f"{name}.json"), content)


def main() -> None:
    """Store rows, write the pages, or check them."""
    parser = Parser(__file__, description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--store", default="", help="score.json whose rows are to be stored first")
    for name in ("name", "title", "note"):
        parser.add_argument(f"--{name}", default="", help=f"{name} of what is stored")
    parser.flag("check", "write nothing, and fail if a page differs")
    config = parser.parse_args()
    if config.store:
        if not config.name or not config.title:
            parser.error("--store is given without --name or --title; expected all of them")
        keep(Path(config.store), config.name, config.title, config.note)
    stored, stale = load(FOLDER / "stored"), []
    for path in PAGES:
        page = path.read_text()
        new = filled(page, stored)
        if new != page:
            stale.append(path.name)
            if not config.check:
                path.write_text(new)
    if config.check and stale:
        raise SystemExit(f"{', '.join(stale)}: not as the stored rows say; run experiments/hidden_effects/claims.py")
    print(f"{len(stored)} stored runs; " + (f"written: {', '.join(stale)}" if stale else "all pages are as they say"))


if __name__ == "__main__":
    main()
