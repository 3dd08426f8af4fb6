"""What the page about tasks shows works."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from test_cable import write

from torchdlo.envs import TASKS

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"


def test_examples_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tmp_path / "runs" / "diagnose" / "my_rope" / "model.json"
    model.parent.mkdir(parents=True)
    write(model, ("air_drag",))
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == 5
    found: dict = {"__name__": "page"}
    for block in blocks:
        exec(compile(block, str(PAGE), "exec", dont_inherit=True), found)
    assert found["outcome"].returns.shape == (2,) and found["after"]["next", "reward"].shape == (2, 1, 1)
    assert found["seen"].ndim == 1  # Gymnasium users see no axis of the batch
    assert isinstance(found["reward"], float) and found["many"].shape == (2, *found["seen"].shape)


def test_every_task_is_on_the_page_with_a_picture() -> None:
    text = PAGE.read_text()
    for name in TASKS:
        assert f"| `{name}` |" in text, name
    pictures = re.findall(r"\]\((pictures/[^)]+)\)", text)
    assert len(pictures) >= len(TASKS)
    for target in pictures:
        assert (PAGE.parent / target).is_file(), target
