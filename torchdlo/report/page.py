"""Pages that need nothing but themselves: their frame, tables and numbers."""

from __future__ import annotations

import html
import math
from typing import Any


def page(title: str, style: str, body: str) -> str:
    """The whole page."""
    return _FRAME.format(title=title, style=style, body=body)


def table(heads: tuple[str, ...], rows: list[tuple[str, ...]], *, last_is_ours: bool = False) -> str:
    """A table; its last row may be marked as ours."""
    lines = ["<table><thead><tr>", *(f"<th>{html.escape(h)}</th>" for h in heads)]
    lines.append("</tr></thead><tbody>")
    for index, row in enumerate(rows):
        ours = ' class="ours"' if last_is_ours and index == len(rows) - 1 else ""
        cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in row)
        lines.append(f"<tr{ours}>{cells}</tr>")
    return "".join(lines) + "</tbody></table>"


def number(value: Any, digits: int = 3) -> str:
    """A number with a few digits, a dash for none."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.{digits}g}" if abs(value) < 10 ** (digits - 1) else f"{value:.1f}"


def words(name: str) -> str:
    """A name as words."""
    return name.replace("_", " ")


_FRAME = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="generator" content="torchdlo">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>
<style>{style}</style></head>
<body>
{body}
</body></html>
"""

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1f2933; background: #fff;
  max-width: 1100px; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; } h2 { margin-top: 2.2rem; }
.verdict { font-size: 1.2rem; border-left: 4px solid #00798c; padding-left: .8rem; }
img { width: 100%; height: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .3rem .9rem; border-bottom: 1px solid #e4e7eb; }
th:first-child, td:first-child { text-align: left; }
.ours td { font-weight: 600; color: #00798c; }
pre { background: #f5f7fa; padding: .8rem; overflow-x: auto; }
"""
