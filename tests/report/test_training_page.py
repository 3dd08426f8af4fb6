"""The pages about training: numbers and pictures are in them, and nothing else is needed."""

import base64
import copy
import io
import re

import matplotlib.image
import pytest

from torchdlo.report.pages.training_page import hybrid_html, training_html

RESULT = {
    "task": "my <task>",
    "algorithm": "shac",
    "fidelity": "1ms/2",
    "episodes": 64,
    "seconds": 90.0,
    "cpu_seconds": 81.0,
    "best_batch": {"success": 0.25, "return": 7.125},
    "interrupted": True,
    "settings": {"rate": 2e-3, "hidden": [16, 8], "device": "cpu"},
    "device": "cpu",
    "curve": [
        {"episodes": 32, "seconds": 40.0, "return": 6.5, "success": 0.0, "failed": 0.5, "loss_actor": 0.1},
        {"episodes": 64, "seconds": 90.0, "return": 7.125, "success": 0.25, "failed": 0.0, "loss_actor": 0.2, "cut": 0},
    ],
}
NOTES = {
    "task": "lifting",
    "plan": {"noise": 0.001},
    "settings": {"rate": 1e-4},
    "robust": {"episodes": 96, "cpu_seconds": 12.0, "log": [{"source": "a", "success": 0.5}]},
    "tune": {
        "episodes": 128,
        "cpu_seconds": 30.0,
        "ended": "minutes",
        "log": [
            {"episodes": 0, "success": 0.8, "best": [0.8, 9.0]},
            {"episodes": 128, "success": 0.7, "noisy": 0.6, "best": [0.8, 9.0]},
        ],
    },
}


def pictures(page: str) -> list[tuple[int, ...]]:
    """Return the shapes of the pictures in a page."""
    found = re.findall(r"data:image/png;base64,([^\"]+)", page)
    return [matplotlib.image.imread(io.BytesIO(base64.b64decode(each))).shape for each in found]


@pytest.mark.parametrize("page", [training_html(RESULT), hybrid_html(NOTES, ("robust", "clone", "tune"))])
def test_a_page_needs_nothing_else(page: str):
    assert not re.search(r"(?:src|href)=\"(?!data:)", page) and "<script" not in page


def test_a_page_says_what_training_came_to():
    page = training_html(RESULT)
    assert "my &lt;task&gt;" in page and "<task>" not in page
    assert "25 % of its episodes and earns 7.125" in page
    assert "64 episodes in 1.5 minutes on cpu, 81 CPU s" in page
    assert "stopped before its budget" in page and "<td>16, 8</td>" in page
    # Curves, and what the algorithm says: two numbers in a row of panels.
    assert len(pictures(page)) == 2


def test_nothing_learned_is_said():
    none = copy.deepcopy(RESULT) | {"curve": [], "best_batch": None, "interrupted": False}
    page = training_html(none)
    assert "No policy has played" in page and not pictures(page) and "was stopped" not in page


def test_the_page_of_a_hybrid_has_the_stages_that_were_run():
    page = hybrid_html(NOTES, ("robust", "clone", "tune"))
    assert "After the stage tune, 80 % of the episodes" in page
    assert "<td>budget of minutes</td>" in page and "<td>its plan</td>" in page and "<td>clone</td>" not in page
    assert len(pictures(page)) == 1
    assert "No stage was run" in hybrid_html({k: NOTES[k] for k in ("task", "plan", "settings")}, ("robust",))
