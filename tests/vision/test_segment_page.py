"""The page to set colours works in a browser, saves what was set, and answers nobody else."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.report import browser
from tests.vision.test_segment import COLORS, swinging
from torchdlo.vision.segment import Ranges, load_ranges, ranges_of
from torchdlo.vision.segment_server import segment_server

BAR = ((0.0, 0.0, 0.02, 0.03), (0.97, 0.98, 1.0, 1.0))
"""What is left out of pictures, which the page cannot set."""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """The address of a page, and the file that it saves."""
    out = tmp_path / "segment.json"
    server = segment_server(swinging(3).pictures, Ranges(ignore=BAR), out)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.address, out
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def ask(url: str, content: Any = None, **headers: str) -> tuple[int, Any]:
    data = None if content is None else (content if isinstance(content, bytes) else json.dumps(content).encode())
    request = urllib.request.Request(url, data=data, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=300) as answer:
            body = answer.read()
            return answer.status, json.loads(body) if answer.headers["Content-Type"].endswith("json") else body
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def test_only_its_own_page_may_ask(served: tuple[str, Path]) -> None:
    address, out = served
    own = address.rstrip("/")
    body = {"ranges": {"hue": [0, 10]}}
    assert ask(address)[0] == 200 and ask(address + "state")[1]["frames"] == 3
    assert ask(address + "state")[1]["ranges"]["ignore"] == [list(part) for part in BAR]
    assert ask(address, Host="evil.example")[0] == 403
    assert ask(address + "save", body)[0] == 403  # no origin
    assert ask(address + "save", body, Origin="http://evil.example")[0] == 403
    assert not out.exists()
    assert ask(address + "save", {"ranges": {"hue": [0, 999]}}, Origin=own)[0] == 400
    assert ask(address + "save", b"{" * 20, Origin=own)[0] == 400
    assert ask(address + "save", b" " * 20_000, Origin=own)[0] == 400
    assert ask(address + "elsewhere", body, Origin=own)[0] == 400 and ask(address + "elsewhere")[0] == 404
    assert ask(address + "save", body, Origin=own)[0] == 200 and load_ranges(out).hue == (0, 10)


@pytest.mark.slow
def test_a_person_clicks_on_the_rope_and_saves(served: tuple[str, Path]) -> None:
    program = browser.find()
    if program is None:
        pytest.skip("no browser at hand: set TORCHDLO_BROWSER")
    address, out = served
    with browser.launch(program) as page:
        page._call("Page.navigate", url=address)
        page.wait("location.protocol === 'http:' && document.getElementById('said')?.textContent.includes('marked')")
        everything = int(page.run("document.getElementById('said').textContent").split()[0])
        mask = swinging(1).masks[0]
        y, x = [int(a[len(a) // 2]) for a in mask.nonzero()]
        page.run(
            f"""(() => {{ const p = document.getElementById('picture'), b = p.getBoundingClientRect();
            p.dispatchEvent(new MouseEvent('click', {{bubbles: true, clientX: b.left + {x + 0.5} / 640 * b.width,
            clientY: b.top + {y + 0.5} / 480 * b.height}})); }})()"""
        )
        page.wait(f"parseInt(document.getElementById('said').textContent) < {everything // 4}")
        page.run("document.getElementById('limits').requestSubmit()")
        page.wait("document.getElementById('said').textContent.startsWith('saved')")
        assert all(c.startswith("asked for http://127.0.0.1") for c in page.complaints), page.complaints
    assert load_ranges(out).ignore == BAR
    low, high = load_ranges(out).hue
    middle = sum(ranges_of(COLORS[0]).hue) / 2
    assert low < middle < high
