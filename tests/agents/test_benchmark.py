"""The benchmark runs, reads what is finished, and puts published returns beside its own."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.agents.problems import Push
from torchdlo.agents.trajopt.search import SearchSettings
from torchdlo.errors import InputError

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPT = REPOSITORY / "experiments" / "benchmark_trajopt.py"


def call(*words: object) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("TORCHDLO_BENCHMARK_TRAJOPT_")}
    environment = kept | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


@pytest.mark.slow
def test_the_benchmark_writes_its_table_and_reads_finished_runs(tmp_path: Path) -> None:
    words = ("--smoke", "--tasks", "wiring_post", "--methods", "cmaes", "--out", tmp_path)
    done = call(*words)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "benchmark.json").read_text())["rows"]
    assert (row["task"], row["method"], row["seeds"], row["episodes"]) == ("wiring_post", "cmaes", 1, 4)
    assert row["published"] == 64.31 and 0 <= row["return"] <= 1
    assert "| wiring_post | cmaes | 1 |" in done.stdout == (tmp_path / "benchmark.md").read_text()
    assert (tmp_path / "curves.webp").read_bytes()[8:12] == b"WEBP"
    result = tmp_path / "wiring_post-cmaes-0" / "result.json"
    # What a finished run has written is taken as it is.
    content = json.loads(result.read_text())
    result.write_text(json.dumps(content | {"return": 0.25}))
    assert "| wiring_post | cmaes | 1 | 0.25 |" in call(*words).stdout
    # What another version has written is marked, and found anew if that is asked for.
    fewer = {name: value for name, value in content["settings"].items() if name != "surrogate_share"}
    result.write_text(json.dumps(content | {"return": 0.25, "program": "another", "settings": fewer}))
    marked = call(*words).stdout
    assert "| wiring_post | cmaes | 1* | 0.25 |" in marked and "another version of the program" in marked
    # All but the seconds, the last column but one, is as it was.
    again, first = (text.rsplit("|", 3)[0] for text in (call(*words, "--again").stdout, done.stdout))
    assert again == first
    # What was stopped with other settings is not gone on with.
    result.unlink()
    journal = result.parent / "journal" / "journal.json"
    journal.parent.mkdir()
    mark = {"generator": "torchdlo optimize", "options": content["settings"] | {"population": 7}, "program": "another"}
    journal.write_text(json.dumps(mark))
    refused = call(*words)
    assert refused.returncode == 1 and "whose population, version differ; --again begins anew" in refused.stderr
    assert call(*words, "--again").returncode == 0 and result.is_file() and not journal.exists()
    # What ended early counts where time is limited, and is gone on with where it is not.
    result.write_text(json.dumps(content | {"return": 0.25, "interrupted": True}))
    assert "| wiring_post | cmaes | 1 | 0.25 |" in call(*words, "--minutes", "60").stdout
    assert call(*words).stdout.rsplit("|", 3)[0] == first


def test_a_search_ends_when_time_is_over_and_keeps_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(SCRIPT.parent)
    benchmark = importlib.import_module("benchmark_trajopt")
    settings = SearchSettings("cmaes", episodes=80, population=8, hold=5)
    case, calls = benchmark.Case("push", "cmaes", 0, settings, tmp_path), []

    def over() -> bool:
        calls.append(None)
        return len(calls) > 3

    case.search(Push(), lambda *_: None, over)
    found = json.loads(case.result.read_text())
    assert found["interrupted"] and found["episodes"] == 24 and len(found["curve"]) == 3
    case.search(Push(), lambda *_: None, lambda: False)
    found = json.loads(case.result.read_text())
    assert not found["interrupted"] and found["episodes"] == 80 and len(found["curve"]) == 10
    late = benchmark.Case("push", "cmaes", 1, settings, tmp_path / "late")
    late.search(Push(), lambda *_: None, lambda: True)
    assert "late: time was over before the first iteration was" in capsys.readouterr().err
    assert not late.result.exists()
    # What others found here is not overwritten.
    other = benchmark.Case("push", "cmaes", 0, replace(settings, episodes=160), tmp_path)
    with pytest.raises(InputError, match="a search with other settings found is here; --again replaces it"):
        other.found(Push(), again=False, ended=False)
    assert other.found(Push(), again=True, ended=False) is None


def test_a_trajectory_is_played_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(SCRIPT.parent)
    benchmark, replays = (importlib.import_module(name) for name in ("benchmark_trajopt", "replay_trajopt"))
    settings = SearchSettings("cmaes", episodes=80, population=8, hold=5)
    benchmark.Case("push", "cmaes", 0, settings, tmp_path / "push").search(Push(), lambda *_: None, lambda: False)
    row = replays.replay("push", replays.trajectories(tmp_path)["push"], lambda task, **_: Push(name=task))
    before, now = row["return"]
    assert row["search"] == "push" and before == now and row["success"][0] == row["success"][1]
    content = json.loads((tmp_path / "push" / "trajectory.json").read_text())
    (tmp_path / "push" / "trajectory.json").write_text(json.dumps(content | {"return": before + 1}))
    other = replays.replay("push", replays.trajectories(tmp_path)["push"], lambda task, **_: Push(name=task))
    assert other["return"] == [before + 1, now] and f"now {now:10.4f}" in replays.shown(other)


def test_a_report_shows_what_is_finished_beside_the_hybrid_at_as_many_episodes(tmp_path: Path) -> None:
    def finish(method: str, seed: int, best: dict[int, float]) -> None:
        curve = [{"episodes": n, "best": value} for n, value in best.items()]
        found = {
            "task": "lifting",
            "return": max(best.values()),
            "max_return": max(best.values()),
            "success": seed == 0,
            "episodes": max(best),
            "seconds": 1.0,
            "episodes_to_success": None,
            "settings": {"seed": seed, "episodes": max(best)},
            "program": "another",
            "curve": [point | {"median": 0.0} for point in curve],
        }
        folder = tmp_path / f"lifting-{method}-{seed}"
        folder.mkdir()
        (folder / "result.json").write_text(json.dumps(found))

    for seed in (0, 1):
        finish("gd", seed, {10: 249.0, 20: 250.0})
        finish("hybrid", seed, {10: 251.0, 20: 252.0 + seed, 30: 340.0})
    done = call("--report", "--tasks", "lifting,coiling", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    descent, hybrid = json.loads((tmp_path / "benchmark.json").read_text())["rows"]
    assert (descent["method"], descent["episodes"], descent["return"], descent["hybrid"]) == ("gd", 20, 250.0, 252.5)
    assert (hybrid["method"], hybrid["episodes"], hybrid["hybrid"], hybrid["success"]) == ("hybrid", 30, 340.0, 0.5)
    assert "| 255.55, 0% after 10000 |" in done.stdout and "| 335.59, 87% after 10000 |" in done.stdout
    nothing = call("--report", "--out", tmp_path / "elsewhere")
    assert nothing.returncode == 1 and "elsewhere: expected finished searches" in nothing.stderr


def test_unknown_names_are_refused() -> None:
    done = call("--methods", "luck")
    assert done.returncode == 2 and "--methods is 'luck'; expected some of cmaes, gd, hybrid" in done.stderr
