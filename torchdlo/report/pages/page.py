"""Pages that need nothing but themselves: their frame, tables and numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from torchdlo.untrusted import for_html


def page(title: str, style: str, body: str) -> str:
    """The whole page."""
    return _FRAME.format(title=for_html(title), style=style, body=body)


def table(heads: tuple[str, ...], rows: Sequence[tuple[str, ...]], *, last_is_ours: bool = False) -> str:
    """A table; its last row may be marked as ours."""
    lines = ['<div class="wide"><table><thead><tr>', *(f"<th>{for_html(h)}</th>" for h in heads)]
    lines.append("</tr></thead><tbody>")
    for index, row in enumerate(rows):
        ours = ' class="ours"' if last_is_ours and index == len(rows) - 1 else ""
        cells = "".join(f"<td>{for_html(cell)}</td>" for cell in row)
        lines.append(f"<tr{ours}>{cells}</tr>")
    return "".join(lines) + "</tbody></table></div>"


def listed(sentences: list[str]) -> str:
    """Sentences as a list, nothing for none."""
    items = "".join(f"<li>{for_html(s)}</li>" for s in sentences)
    return f"<ul>{items}</ul>" if items else ""


def number(value: Any, digits: int = 3) -> str:
    """A number with a few digits, a dash for none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}g}" if abs(value) < 10 ** (digits - 1) else f"{value:.1f}"


def percent(share: Any) -> str:
    """A share in per cent, a dash for none."""
    return "-" if share is None or not math.isfinite(share) else f"{100 * share:.0f} %"


def words(name: str) -> str:
    """A name as words."""
    return name.replace("_", " ")


_FRAME = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="generator" content="torchdlo">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>
<link rel="icon" href="data:,"><style>{style}</style></head>
<body>
{body}
</body></html>
"""

STYLE = """
:root { color-scheme: light dark; --ink: #1f2933; --soft: #5a6672; --line: #dfe4e9; --page: #ffffff; --card: #f5f7f9;
  --before: #c4472f; --after: #00798c; --floor: #8592a0; --accent: #00798c; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e9ee; --soft: #9fabb7; --line: #343d46; --page: #14181c;
  --card: #1d2329; --before: #f08a72; --after: #4cc3d3; --floor: #8592a0; --accent: #4cc3d3; } }
* { box-sizing: border-box; }
body { font: 16px/1.55 system-ui, -apple-system, "Segoe UI", sans-serif; color: var(--ink); background: var(--page);
  max-width: 1080px; margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word; }
h1 { margin: 0 0 .4rem; font-size: 1.6rem; } h2 { margin: 2.6rem 0 .6rem; font-size: 1.25rem; }
h3 { margin: 1.4rem 0 .3rem; font-size: 1rem; }
p, ul { max-width: 75ch; } li { margin: .15rem 0; }
.verdict { font-size: 1.25rem; line-height: 1.45; border-left: 4px solid var(--accent); padding-left: .9rem; }
.soft { color: var(--soft); }
img { width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .94rem; }
th, td { text-align: right; padding: .35rem .9rem; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; color: var(--soft); }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
.text th, .text td, .candidates th:nth-child(n+5), .candidates td:nth-child(n+5) { text-align: left; }
.candidates td:nth-child(n+5) { min-width: 11rem; } .candidates td:last-child { min-width: 18rem; color: var(--soft); }
summary { cursor: pointer; color: var(--soft); padding: .3rem 0; }
.ours td { font-weight: 600; color: var(--accent); }
pre { background: var(--card); padding: .8rem 1rem; overflow-x: auto; border-radius: 6px; font-size: .88rem; }
code { font-family: ui-monospace, "SF Mono", Menlo, Consolas, monospace; font-size: .92em; }
"""
