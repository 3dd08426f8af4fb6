"""What comes from strangers: files of JSON and of arrays, and names that are shown.

Every reader returns a value or raises `InputError`, whatever is in the file. Names are imported when used: commands
show their help without any reader.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchdlo.lazy import attach

if TYPE_CHECKING:
    from torchdlo.untrusted.json_file import Entry, locate, parse_json, read_entry, read_json
    from torchdlo.untrusted.names import check_path, for_html, for_plot, for_terminal, json_in_html, one_line
    from torchdlo.untrusted.regular_file import MissingFile, open_regular, read_bytes, read_text

__all__ = [
    "Entry",
    "MissingFile",
    "check_path",
    "for_html",
    "for_plot",
    "for_terminal",
    "json_in_html",
    "locate",
    "one_line",
    "open_regular",
    "parse_json",
    "read_bytes",
    "read_entry",
    "read_json",
    "read_text",
]

_MODULES = {
    "json_file": ("Entry", "locate", "parse_json", "read_entry", "read_json"),
    "names": ("check_path", "for_html", "for_plot", "for_terminal", "json_in_html", "one_line"),
    "regular_file": ("MissingFile", "open_regular", "read_bytes", "read_text"),
}
__getattr__, __dir__ = attach(
    __name__, {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}
)
