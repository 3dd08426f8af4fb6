"""A sample of damaged files of each kind: reading one gives a value or the input error, soon and in little memory."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import pytest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
CASES = 60
KINDS = (
    *("scene", "scene of material points", "rope.json", "trial", "model", "trajectory", "checkpoint", "cameras"),
    *("colour ranges", "reward", "grasps", "conversation", "frames", "archive of searches", "masks", "policy"),
    *("policy of pictures", "expert", "DEFORM pickle", "URDF"),
    *("mesh .stl", "mesh .obj", "mesh .ply", "mesh .off", "mesh .glb"),
)


@pytest.fixture(scope="module")
def fuzz() -> Any:
    pytest.importorskip("configargparse", reason="scripts need the extra dev")
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        yield importlib.import_module("fuzz_files")
    finally:
        sys.path.remove(str(EXPERIMENTS))
        sys.modules.pop("fuzz_files", None)


def test_all_kinds_are_here(fuzz: Any) -> None:
    assert set(fuzz.KINDS) == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_end_in_a_value_or_the_input_error(kind: str, fuzz: Any) -> None:
    if kind.startswith("mesh"):
        pytest.importorskip("trimesh")
    if kind in ("conversation", "grasps"):
        pytest.importorskip("pydantic")
    found = fuzz.run(kind, 0, CASES)
    assert not found.faults, "\n".join(found.faults)
    assert found.refused > CASES / 2 and found.values + found.refused == CASES
    assert found.slowest < fuzz.SLOW and found.memory < fuzz.LARGE


@pytest.mark.parametrize(("kind", "number"), [("model", 3322), ("policy", 1611), ("DEFORM pickle", 4659)])
def test_what_ten_thousand_files_found_stays_mended(kind: str, number: int, fuzz: Any) -> None:
    assert not fuzz.run(kind, number, 1).faults


def test_a_reader_with_a_fault_is_found_out(fuzz: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = fuzz.Kind("reward.json", fuzz.KINDS["reward"].sound, lambda f: json.loads((f / "reward.json").read_text()))
    monkeypatch.setitem(fuzz.KINDS, "broken", broken)
    assert fuzz.run("broken", 0, 20).faults
