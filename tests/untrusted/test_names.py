"""Names are text from strangers: in a terminal, a plot, a page, a script of a page, and before long work."""

from __future__ import annotations

import html
import html.parser
import json
import os
from pathlib import Path

import numpy as np
import pytest

from torchdlo.cli import app
from torchdlo.errors import InputError
from torchdlo.files import check_writable
from torchdlo.report.figures.motion_figure import motion_png
from torchdlo.report.pages.page import page, table
from torchdlo.sysid import load_recording
from torchdlo.untrusted import check_path, for_html, for_plot, for_terminal, json_in_html, one_line

pytestmark = pytest.mark.quick

HOSTILE = (
    "\x1b]0;owned\x07\x1b[2J",
    "\x9b31m",
    "caf\udce9",
    "$\\foo$",
    "<!--<script>",
    "</script><script>alert(1)</script>",
    "a\u2028b\u202eb",
    "\x00",
    "rope & \"co\" 'x'",
    "\r\n",
)


@pytest.mark.parametrize("name", HOSTILE)
def test_terminals_are_told_nothing(name: str) -> None:
    shown = for_terminal(f"a{name}b\n")
    assert all(c.isprintable() or c == "\n" for c in shown) and shown.endswith("b\n")
    assert shown.encode()  # all of it can be written
    assert (
        one_line(name * 1000, 40) == one_line(name * 1000, 40).replace("\n", "")
        and len(one_line(name * 1000, 40)) <= 40
    )


def test_escapes_are_spelt_out() -> None:
    assert for_terminal("a\x1b[2Jb\udce9\u202e") == "a\\x1b[2Jb\\xe9\\u202e"
    assert for_terminal("ein Gewähr\u00a0名前") == "ein Gewähr\u00a0名前"


@pytest.mark.filterwarnings("ignore:Glyph")
@pytest.mark.parametrize("name", HOSTILE)
def test_plots_draw_names_as_they_stand(name: str) -> None:
    time, pos = np.arange(3.0), np.zeros((3, 2, 3))
    pos[:, 1] = 1.0
    made = motion_png(time, pos, np.zeros(2, int), np.zeros((3, 0, 3)), title=name)
    assert made[:4] == b"\x89PNG"
    assert for_plot("$a$ $5") == r"\$a\$ \$5"


class _Texts(html.parser.HTMLParser):
    """Texts and tags of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.title = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.tags.append(tag)

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1] == "title":
            self.title += data


@pytest.mark.parametrize("name", HOSTILE)
def test_pages_show_names_once_and_as_text(name: str) -> None:
    made = page(name, "", table(("a",), [(name,)]))
    assert made.encode()
    reader = _Texts()
    reader.feed(made)
    assert "script" not in reader.tags and reader.title.startswith(html.unescape(for_html(name))[:3])
    assert reader.tags.count("td") == 1


@pytest.mark.parametrize("name", HOSTILE)
def test_json_in_a_page_comes_back_and_ends_nothing(name: str) -> None:
    written = json_in_html({"name": name, "x": [1.5, None]})
    assert not set("<>&") & set(written) and written.isascii()
    assert json.loads(written) == {"name": name, "x": [1.5, None]}
    with pytest.raises(ValueError, match="JSON compliant"):
        json_in_html(float("nan"))


def test_titles_of_reports_are_escaped_once() -> None:
    assert "<title>rope &amp; co</title>" in page("rope & co", "", "")


def test_paths_that_cannot_be_written_down_are_refused_before_the_work(tmp_path: Path) -> None:
    for name in ("caf\udce9", "a\x1b[2J", "a\nb", "a\u202eb"):
        with pytest.raises(InputError, match="expected a name of printable letters in UTF-8, found others; rename it"):
            check_path(name)
        with pytest.raises(InputError, match="expected a path to write to of printable letters"):
            check_writable(tmp_path / name / "x")
    for name in ("Gewähr 名前", "$\\foo$", "<!--", "a\u00a0b"):
        check_path(name)


def test_trials_that_are_not_utf8_are_refused_before_the_work(folder: Path) -> None:
    for name in (b"test_\xe9.npz", b"test_\x1b[2J.npz"):
        there = os.path.join(os.fsencode(folder), name)
        with open(there, "wb") as file:
            file.write((folder / "test_1.npz").read_bytes() if (folder / "test_1.npz").exists() else b"")
        with pytest.raises(InputError, match=r"test_\\x(e9|1b).*: expected a name of a trial of printable letters"):
            load_recording(folder)
        os.unlink(there)


@pytest.mark.parametrize("words", [("calibrate", "rope", "--out", "caf\udce9"), ("simulate", "\x1b[2J.json")])
def test_commands_refuse_such_paths_at_once(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        app.main(list(words))
    said = capsys.readouterr()
    assert caught.value.code == 2 and said.out == ""
    assert said.err.startswith("error: ") and said.err.isprintable() is False and said.err[:-1].isprintable()
