"""The page of a diagnosis says what happened, works in a browser, and needs nothing but itself."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tests.report import browser
from tests.report.fake_diagnosis import fake_diagnosis
from tests.sysid.swaying import recording as swaying
from torchdlo.report.figures.chart import bars, scale
from torchdlo.report.pages.diagnosis import diagnosis_html, write_report
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.recordings.data_quality import DataIssue
from torchdlo.sysid.recordings.recording import Recording


@pytest.fixture(scope="module")
def rope() -> Recording:
    """A rope that sways."""
    return swaying(Path("my <rope>"))


@pytest.fixture(scope="module")
def page(rope: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a diagnosis, in a file."""
    result = fake_diagnosis(rope, data_issues=[DataIssue("train_1", "swap", "markers 3 and 4 are swapped")])
    return write_report(result, rope, tmp_path_factory.mktemp("page"), command="torchdlo diagnose 'a b'")


def test_the_page_tells_the_whole_story(page: Path) -> None:
    text = page.read_text()
    for said in (
        "Missing: air drag (c_d 1.4 [",
        "not to be told from wind",
        "repeat the motion in the opposite direction",
        "calibration had set the damping rate 60% too high",
        "The measurement runs 10 ms behind the simulation",
        "Nothing above the floor",
        "does not help on the test trials",
        "vₙ: velocity across the rope",
        "train_1: markers 3 and 4 are swapped",
        "model_file.load(",
        "torchdlo diagnose &#x27;a b&#x27;",
        "my &lt;rope&gt;",
    ):
        assert said in text, said
    assert text.index("Missing: air drag") < text.index("<h2>")
    assert "<rope>" not in text and len(text) < 3e6


def test_the_page_asks_for_nothing_from_outside(page: Path) -> None:
    text = page.read_text()
    assert not re.search(r'(src|href)="(?!data:)', text) and "http" not in text.replace("http-equiv", "")
    assert not re.search(r"@import|url\((?!data:)", text)


def test_tags_are_closed(page: Path) -> None:
    class Balance(HTMLParser):
        open: list[str] = []  # noqa: RUF012
        void = {"meta", "link", "input", "img", "path", "circle", "image", "br"}  # noqa: RUF012

        def handle_starttag(self, tag: str, attrs: object) -> None:
            if tag not in self.void:
                self.open.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert self.open.pop() == tag or tag in self.void, tag

        def handle_startendtag(self, tag: str, attrs: object) -> None:
            pass

    parser = Balance()
    # Implied ends of paragraphs are not used.
    parser.feed(page.read_text())
    assert parser.open == []


@pytest.mark.parametrize(("verdict", "said"), [("none", "Nothing is missing"), ("unknown", "Something is missing")])
def test_verdicts_without_a_name_have_a_page_too(rope: Recording, verdict: str, said: str) -> None:
    found = fake_diagnosis(rope)
    none = replace(
        found,
        verdict=verdict,
        effects=[],
        ties={},
        shares={},
        final=found.baseline,
        drifts=found.drifts[:, : len(found.baseline.space.names)],
        after=found.before,
        candidates=[],
    )
    text = diagnosis_html(none, rope)
    assert said in text and "What was found</h2>" not in text and "What calibration had absorbed" not in text
    # What was fitted stands there all the same, and what did not change is drawn once.
    assert "Fitted numbers of the rope</h2>" in text and "bending stiffness" in text
    maps = [
        html.count('class="heat"') or html.count("with what was found") for html in (text, diagnosis_html(found, rope))
    ]
    assert "both maps have one scale" not in text and maps[0] < maps[1]


def test_failed_and_long_trials_do_not_break_the_page(rope: Recording) -> None:
    found = fake_diagnosis(rope)
    broken = {k: np.full_like(v, np.nan) if k == "test_1" else v for k, v in found.predictions["before"].items()}
    result = replace(
        found,
        before=np.array([5e-3, np.inf]),
        predictions=found.predictions | {"before": broken},
        floor=ErrorFloor(0, 0, np.inf),
    )
    assert "failed" in diagnosis_html(result, rope)
    long = swaying(Path("long"), frames=1200)
    assert len(diagnosis_html(fake_diagnosis(long), long)) < 3e6


def test_bars_are_drawn_to_scale() -> None:
    drawn = bars([("all", 8.0, 2.0), ("test_0", float("inf"), 4.0)], 1.0)
    assert re.findall(r'<i style="width:([\d.]+)%', drawn) == ["100.00", "25.00", "100.00", "50.00"]
    assert re.findall(r'<u style="left:([\d.]+)%', drawn) == ["12.50"] * 4 and "failed" in drawn


@pytest.mark.parametrize("most", [0.7, 1.0, 3.9, 12.0, 88.0, 5e-4])
def test_ticks_are_round_and_few(most: float) -> None:
    ticks = scale(most)
    assert 3 <= len(ticks) <= 7 and ticks[0] == 0 and ticks[-1] <= most < ticks[-1] + ticks[1] * (1 + 1e-9)
    assert f"{ticks[1]:e}"[0] in "125"


@pytest.fixture(scope="module")
def opened() -> Iterator[browser.Page]:
    """A headless browser; skips if there is none."""
    program = browser.find()
    if program is None:
        pytest.skip(f"no browser: put one of {', '.join(browser.NAMES)} on the path or name it in TORCHDLO_BROWSER")
    with browser.launch(program) as page:
        yield page


def drawn(page: browser.Page) -> np.ndarray:
    """Return the picture in the player, (height, width, 4)."""
    data = page.run("document.querySelector('#player canvas').toDataURL()")
    return imread(io.BytesIO(base64.b64decode(data.split(",")[1])))


def press(page: browser.Page, what: str) -> None:
    """Click on an element."""
    page.run(f"document.querySelector({what!r}).click()")


def test_the_player_plays_pauses_seeks_and_turns(opened: browser.Page, page: Path) -> None:
    opened.open(page)
    at = "Number(document.querySelector('#at').value)"
    first = drawn(opened)
    assert (first[..., 3] > 0).sum() > 500  # lines and dots, not an empty canvas
    # It opens where the gap is largest, with the gap in words.
    assert re.fullmatch(
        r"\d\.\d\d s, distance [\d.]+ → 0\.\d mm", opened.run("document.querySelector('#now').textContent")
    )
    opened.run("const e = document.querySelector('#at'); e.value = 10; e.dispatchEvent(new Event('input'));")
    assert (drawn(opened) != first).any()
    press(opened, "#play")
    opened.wait(f"{at} > 12")
    press(opened, "#play")
    stopped = opened.run(at)
    opened.run("new Promise(done => setTimeout(done, 150))")
    assert opened.run(at) == stopped
    seen = drawn(opened)
    press(opened, "[data-turn='0,1.5708']")
    turned = drawn(opened)
    assert (turned != seen).any()
    press(opened, "[data-layer='1']")
    assert (drawn(opened)[..., 3] > 0).sum() < (turned[..., 3] > 0).sum()
    first = drawn(opened)
    opened.run("const t = document.querySelector('#trial'); t.value = 1; t.dispatchEvent(new Event('change'));")
    assert (drawn(opened) != first).any()
    opened.run(
        "const c = document.querySelector('canvas'), o = {pointerId: 1, buttons: 1, movementX: 40, movementY: 5};"
        "c.setPointerCapture = function () {}; c.dispatchEvent(new PointerEvent('pointerdown', o));"
        "c.dispatchEvent(new PointerEvent('pointermove', o));"
        "c.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}));"
    )
    assert opened.complaints == []


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [360, 1200])
def test_the_page_fits_its_window(opened: browser.Page, page: Path, width: int, dark: bool) -> None:
    opened.open(page, width=width, dark=dark)
    assert opened.run("document.documentElement.scrollWidth") <= width
    assert (
        opened.run(
            "Math.min(...[...document.querySelectorAll('p,li,td,th,b')].map("
            "e => parseFloat(getComputedStyle(e).fontSize)))"
        )
        >= 12
    )
    back, ink = (opened.run(f"getComputedStyle(document.body).{k}") for k in ("backgroundColor", "color"))
    brightness = [sum(map(int, re.findall(r"\d+", c)[:3])) / 765 for c in (back, ink)]
    assert (brightness[0] < 0.2 and brightness[1] > 0.8) if dark else (brightness[0] > 0.9 and brightness[1] < 0.3)
    assert opened.complaints == []


def test_complaints_of_a_page_are_heard(opened: browser.Page, tmp_path: Path) -> None:
    bad = "<img src='http://localhost:9/x.png'><script>console.error('boo'); setTimeout(() => nothing(), 1)</script>"
    (tmp_path / "bad.html").write_text(bad)
    before = len(opened.complaints)
    opened.open(tmp_path / "bad.html")
    opened.run("new Promise(done => setTimeout(done, 100))")
    heard, opened.complaints = " ".join(opened.complaints[before:]), []
    assert "boo" in heard and "nothing is not defined" in heard and "localhost:9" in heard
