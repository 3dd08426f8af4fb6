"""Names and texts that may hold anything, made fit for where they are shown: a terminal, a plot, a page, a script."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from torchdlo.errors import InputError

__all__ = ["check_path", "for_html", "for_plot", "for_terminal", "json_in_html", "one_line"]

_SPACES = "\u00a0\u1680\u2000\u2001\u2002\u2003\u2004\u2005\u2006\u2007\u2008\u2009\u200a\u202f\u205f\u3000"
"""Spaces of other widths, which are not called printable, and harm nobody."""
_MOST = 400
"""Most letters of a name in a sentence."""


def for_terminal(text: object) -> str:
    r"""Return text in which what a terminal would obey, or cannot show, is spelt out, as \x1b; lines stay."""
    return "".join(c if c in "\n\t" else _visible(c) for c in str(text))


def one_line(text: object, most: int = _MOST) -> str:
    """Return one printable line of at most `most` letters, for sentences."""
    line = "".join(map(_visible, " ".join(str(text).split())))
    return line if len(line) <= most else line[: most - 3] + "..."


def for_plot(text: object) -> str:
    r"""Return text that matplotlib draws as it stands: dollars, which begin formulas, are escaped."""
    return one_line(text).replace("$", r"\$")


def for_html(text: object) -> str:
    """Return text for a page: nothing in it is markup, and all of it can be encoded. To be used once."""
    import html

    return html.escape(for_terminal(text))


def json_in_html(value: Any) -> str:
    r"""Return JSON for the inside of a <script>: no letter in it begins markup, a comment or another script."""
    import json

    written = json.dumps(value, allow_nan=False)
    return written.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def check_path(path: str | Path, what: str = "name") -> None:
    """Refuse a path that is not text in UTF-8 or holds control characters, before work that would write it down."""
    text = os.fspath(path)
    if not text.isprintable() and any(_visible(c) != c for c in text):
        raise InputError(f"{one_line(path)}: expected a {what} of printable letters in UTF-8, found others; rename it.")


def _visible(c: str) -> str:
    if c.isprintable() or c in _SPACES:
        return c
    code = ord(c)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file name that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
