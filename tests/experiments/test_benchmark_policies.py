"""The table of policies is made of what is stored."""

from __future__ import annotations

import importlib
import json
import sys
import zipfile
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    yield importlib.import_module("benchmark_policies")
    sys.modules.pop("benchmark_policies", None)


def stored(folder: Path, success: float, seed: int) -> None:
    folder.mkdir(parents=True)
    varied = {"episodes": 15, "success": success, "return": 60.0 + seed}
    found = {"task": "wiring_post", "algorithm": "ppo", "seed": seed, "varied": varied}
    (folder / "evaluation.json").write_text(json.dumps(found | {"one": {"success": 1.0, "return": 65.0}}))
    (folder / "result.json").write_text(json.dumps({"episodes": 100 + seed, "cpu_seconds": 600.0 * (1 + seed)}))
    (folder / "checkpoint.pt").write_text("large")


def test_rows_are_means_over_seeds_and_the_archive_has_no_checkpoints(script, tmp_path: Path):
    stored(tmp_path / "wiring_post-ppo-0", 9 / 15, 0)
    stored(tmp_path / "wiring_post-ppo-1", 12 / 15, 1)
    (tmp_path / "wiring_post-ppo-2").mkdir()  # not finished
    file = tmp_path / "all.zip"
    script.pack(tmp_path, file)
    (row,) = script.rows(file)
    assert (row["seeds"], row["success"], row["return"], row["episodes"]) == (2, 21 / 30, 60.5, 101)
    # Wilson's interval of 21 in 30.
    assert row["interval"] == pytest.approx((0.5212, 0.8333), abs=1e-3)
    text = script.table([row])
    assert "| wiring_post | ppo | 2 | 0 | 70% | 52% to 83% | 60.50 | 100% | 65.00 | 101 | 20 | 62.17, 67% |" in text
    assert "ppo: mean success from unseen starts over 1 task 70%." in text
    assert file.stat().st_size < 2000


def test_clouds_and_perturbations_have_tables_of_their_own(script, tmp_path: Path):
    stored(tmp_path / "wiring_post-ppo-0", 9 / 15, 0)
    actors = {"policy": {"none": {"success": 0.9}, "noise": {"success": 0.5}}}
    found = {"task": "wiring_post", "starts": 10, "perturbations": {"none": {}, "noise": {}}, "actors": actors}
    (tmp_path / "wiring_post-ppo-0" / "robustness.json").write_text(json.dumps(found))
    cloud = tmp_path / "wiring_post-cloud-0"
    cloud.mkdir()
    rows = {"usual": {"success": 0.6, "episodes": 15, "interval": [0.36, 0.8]}}
    (cloud / "evaluation.json").write_text(json.dumps({"task": "wiring_post", "conditions": rows}))
    (cloud / "student.json").write_text(json.dumps({"episodes": 192}))
    file = tmp_path / "all.zip"
    script.pack(tmp_path, file)
    assert len(script.rows(file)) == 1
    assert "| wiring_post | usual | 60% of 15 | 36% to 80% | 192 |" in script.clouds(file)
    assert "| noise | 50% |" in script.robustness(file)


def test_weights_that_never_succeed_are_left_out(script, tmp_path: Path):
    import torch

    for name, success in (("a-ppo-0", 0.0), ("b-ppo-0", 0.2), ("b-ppo-1", 0.2)):
        stored(tmp_path / name, success, int(name[-1]))
        torch.save({"state": {"weight": torch.ones(2, 2)}}, tmp_path / name / "policy.pt")
    script.pack(tmp_path, file := tmp_path / "all.zip")
    with zipfile.ZipFile(file) as archive:
        assert [n for n in archive.namelist() if n.endswith(".pt")] == ["b-ppo-0/policy.pt"]
        assert "a-ppo-0/result.json" in archive.namelist()
