"""Fixtures for tests of everything that reads recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def edit_rope(folder: Path) -> Callable[..., None]:
    """Change entries of rope.json; an entry set to `...` is removed."""

    def edit(**entries: object) -> None:
        rope = json.loads((folder / "rope.json").read_text()) | entries
        rope = {key: value for key, value in rope.items() if value is not ...}
        (folder / "rope.json").write_text(json.dumps(rope))

    return edit
