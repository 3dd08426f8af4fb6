"""The bytes of a set that LeRobot has accepted have not changed."""

from __future__ import annotations

import json
from pathlib import Path

import lerobot_case
import pytest

from torchdlo.agents.data import check_dataset


def test_bytes_are_those_that_lerobot_has_accepted(tmp_path: Path) -> None:
    lerobot_case.make(tmp_path / "set")
    assert check_dataset(tmp_path / "set") == []
    record = json.loads(lerobot_case.RECORD.read_text())
    if record["versions"] != lerobot_case.versions():
        pytest.skip(f"other libraries write: {lerobot_case.versions()}; run make lerobot and record again")
    assert lerobot_case.hashes(tmp_path / "set") == record["files"]
