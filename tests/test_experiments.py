"""Every script runs, at least a little."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
SCRIPTS = ["bench_rod.py", "make_reference.py", "make_sample.py", "peers.py"]


def call(*words: object) -> subprocess.CompletedProcess[str]:
    env = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(EXPERIMENTS.parent)}
    return subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, env=env, check=False)


@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_explain_themselves(script: str) -> None:
    done = call(EXPERIMENTS / script, "--help")
    assert done.returncode == 0 and "usage" in done.stdout.lower(), done.stderr


def test_the_rod_benchmark_writes_its_rows(tmp_path: Path) -> None:
    target = tmp_path / "rod.json"
    done = call(EXPERIMENTS / "bench_rod.py", "--smoke", "--json", target)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(target.read_text())["rows"]
    wanted = {"scenes", "vertices", "mode", "dtype", "compiled", "frames_per_s", "peak_mb"}
    assert wanted <= set(row) and row["frames_per_s"] > 0 and row["finite"]
