"""Damaged descriptions of data sets end in a value or the input error."""

from __future__ import annotations

import importlib
import random
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from torchdlo.agents.data import open_set
from torchdlo.errors import InputError
from torchdlo.report.dataset import dataset_summary

EXPERIMENTS = Path(__file__).parents[3] / "experiments"


@pytest.fixture
def fuzz(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    pytest.importorskip("configargparse", reason="scripts need the extra dev")
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    yield importlib.import_module("fuzz_files")
    sys.modules.pop("fuzz_files", None)


def test_damaged_descriptions_are_refused_in_a_sentence(own: Path, fuzz: Any) -> None:
    file, faults = own / "meta" / "info.json", []
    sound = file.read_text()
    assert dataset_summary(open_set(own))["episodes"] == 5
    refused = 0
    for number in range(150):
        file.write_text(fuzz.spoiled_json(sound, random.Random(f"info {number}")), encoding="utf-8", errors="replace")
        try:
            dataset_summary(open_set(own))
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 1500
        except Exception as error:  # this is what is looked for
            at = traceback.extract_tb(error.__traceback__)[-1]
            faults.append(f"{number}: {type(error).__name__} {error!s:.60} at {Path(at.filename).name}:{at.lineno}")
    assert not faults, "\n".join(faults)
    assert refused > 20
