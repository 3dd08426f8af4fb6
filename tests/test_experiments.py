"""Every script runs, at least a little."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from torchdlo.physics import tree

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
SCRIPTS = [
    "agent_benchmark.py",
    "agent_starts.py",
    "baselines.py",
    "bench_contact.py",
    "bench_render.py",
    "bench_coupled.py",
    "bench_gpu.py",
    "bench_implicit.py",
    "bench_env.py",
    "bench_rod.py",
    "bench_tasks_gpu.py",
    "draw_tasks.py",
    "fidelities.py",
    "gallery.py",
    "learn_through_contact.py",
    "make_reference.py",
    "make_sample.py",
    "peers.py",
    "peers_contact.py",
]
PREFIX = "TORCHDLO_PROBE_"
BAD = {"WORKERS": ["x", "", "0", "1.5"], "NOISE": ["much", ""], "QUICK": ["maybe", ""]}
PROBE = """
import json
from options import Parser, count

parser = Parser("probe.py")
parser.add_argument("--workers", type=count, default=2)
parser.add_argument("--noise", type=float, default=0.5)
parser.add_argument("--some-file", default="")
parser.flag("quick", "be quick")
print(json.dumps(vars(parser.parse_args())))
"""


def surroundings(**given: str) -> dict[str, str]:
    """Environment of a script, without options that someone has set."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("TORCHDLO_BENCH_ROD_", PREFIX))}
    return kept | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(EXPERIMENTS.parent)} | given


def call(*words: object, **given: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=surroundings(**given), check=False)


@pytest.fixture
def probe(tmp_path: Path):
    """Return a function that runs a script with one option of each kind."""
    script = tmp_path / "probe.py"
    script.write_text(f"import sys\nsys.path.insert(0, {str(EXPERIMENTS)!r})\n{PROBE}")

    def run(*words: str, **given: str) -> subprocess.CompletedProcess[str]:
        return call(script, *words, **{PREFIX + name: value for name, value in given.items()})

    return run


def test_the_contact_benchmark_writes_its_rows(tmp_path: Path) -> None:
    target = tmp_path / "contact.json"
    done = call(EXPERIMENTS / "bench_contact.py", "--smoke", "--json", target)
    assert done.returncode == 0, done.stderr
    rows = json.loads(target.read_text())["rows"]
    assert len(rows) == 3 and all(row["frames_per_s_per_core"] > 0 for row in rows)


def test_the_gallery_runs_a_scene_and_says_what_happened(tmp_path: Path) -> None:
    target = tmp_path / "gallery.json"
    done = call(EXPERIMENTS / "gallery.py", "--smoke", "--json", target, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(target.read_text())["rows"]
    assert row["name"] == "chain" and not row["wrong"]
    assert row["claims"]["least linking number"][0] == pytest.approx(1, abs=1e-6)
    assert (tmp_path / "chain" / "scene.json").is_file() and (tmp_path / "chain" / "frames.npz").is_file()
    done = call(EXPERIMENTS / "gallery.py", "--only", "chain,knott")
    assert done.returncode == 2 and "there is no knott; known are knot, chain" in done.stderr


@pytest.mark.slow
def test_the_coupled_benchmark_writes_its_rows(tmp_path: Path) -> None:
    target = tmp_path / "coupled.json"
    done = call(EXPERIMENTS / "bench_coupled.py", "--smoke", "--json", target)
    assert done.returncode == 0, done.stderr
    rows = json.loads(target.read_text())["rows"]
    assert [row["scenario"] for row in rows] == ["coiling", "lifting", "gathering", "coiling"]
    assert all(row["frames_per_s"] > 0 for row in rows)


def test_the_benchmark_of_tasks_writes_its_rows(tmp_path: Path) -> None:
    target = tmp_path / "env.json"
    done = call(EXPERIMENTS / "bench_env.py", "--smoke", "--tasks", "unknotting", "--json", target)
    assert done.returncode == 0, done.stderr
    rows = json.loads(target.read_text())["rows"]
    assert [row["mode"] for row in rows] == ["forward", "forward+backward"]
    assert all(row["frames_per_cpu_s"] > 0 and row["published"] > 0 for row in rows)
    done = call(EXPERIMENTS / "bench_env.py", "--memory", "--smoke", "--tasks", "unknotting", "--json", target)
    assert done.returncode == 0, done.stderr
    assert [row["frames"] for row in json.loads(target.read_text())["memory"]] == [20, 40]
    done = call(EXPERIMENTS / "bench_env.py", "--tasks", "knot")
    assert done.returncode == 1 and "there is no task knot; known are coiling" in done.stderr


def test_baselines_of_tasks_are_measured_once(tmp_path: Path) -> None:
    target = tmp_path / "baselines.json"
    words = (EXPERIMENTS / "baselines.py", "--smoke", "--tasks", "coiling", "--json", target)
    done = call(*words)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(target.read_text())["rows"]
    assert row["nothing"] != row["hand"] and row["published"] == 7.0 and not row["random_varied_done"]
    assert [len(row[f"{what}_varied"]) for what in ("nothing", "random", "hand")] == [2, 2, 2]
    assert len({*row["random_varied"]}) == 2 and f"| coiling | {row['nothing']:.2f} | 7 | " in done.stdout
    assert call(*words).stdout == done.stdout and target.stat().st_size > 0
    done = call(EXPERIMENTS / "baselines.py", "--tasks", "knot")
    assert done.returncode == 1 and "there is no task knot; known are coiling" in done.stderr


@pytest.mark.slow
def test_random_scenes_write_a_row_each_and_say_what_is_wrong(tmp_path: Path) -> None:
    target = tmp_path / "random.json"
    words = ["--scenes", 2, "--batch", 2, "--seconds", 0.02, "--json", target]
    done = call(EXPERIMENTS / "random_scenes.py", *words)
    assert done.returncode == 0, done.stderr
    content = json.loads(target.read_text())
    assert content["summary"]["scenes"] == len(content["rows"]) == 2
    assert all(not row["faults"] and row["strain"] < 0.01 for row in content["rows"])
    done = call(EXPERIMENTS / "random_scenes.py", *words, "--resume", "--scenes", 4)
    rows = json.loads(target.read_text())["rows"]
    assert done.returncode == 0 and rows[:2] == content["rows"] and [row["kind"] for row in rows] == [0, 0, 1, 1]


def test_overlaps_of_random_scenes_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    random_scenes = importlib.import_module("random_scenes")
    made, shapes = random_scenes.build(0, 2, (2e-3, 4))
    assert len(shapes) == 3
    body, own = random_scenes.overlaps(made, made[2])
    assert not body.any() and not own.any()
    # Laid on the plane, then half a radius deeper; the lowest vertex of a tangle starts 25 cm up.
    rods = made[2].rods
    down = rods.pos - rods.pos.new_tensor([1.0, 0.0, 0.25 - 0.5 * random_scenes.RADIUS])
    body, own = random_scenes.overlaps(made, tree.replace(made[2], rods=tree.replace(rods, pos=down)))
    assert body.tolist() == pytest.approx([0.5, 0.5], abs=1e-9) and not own.any()
    # Folded flat onto itself: its two halves are in one place.
    folded = torch.cat([rods.pos[:, :20], rods.pos[:, :20].flip(1)], 1)
    _, own = random_scenes.overlaps(made, tree.replace(made[2], rods=tree.replace(rods, pos=folded)))
    assert own.tolist() == pytest.approx([2.0, 2.0], abs=1e-6)


def test_pictures_of_tasks_are_drawn(tmp_path: Path) -> None:
    done = call(EXPERIMENTS / "draw_tasks.py", "--tasks", "slingshot", "--out", tmp_path)
    assert done.returncode == 0 and (tmp_path / "task_slingshot.webp").stat().st_size > 1000, done.stderr


@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_explain_themselves(script: str) -> None:
    done = call(EXPERIMENTS / script, "--help")
    assert done.returncode == 0 and "usage" in done.stdout.lower(), done.stderr
    assert f"TORCHDLO_{Path(script).stem.upper()}_SMOKE" in done.stdout


def test_a_rope_slides_off_a_peg_as_the_closed_form_has_it(tmp_path: Path) -> None:
    target = tmp_path / "contact.json"
    done = call(EXPERIMENTS / "peers_contact.py", "--smoke", "--peer", "torchdlo implicit", "--json", target)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(target.read_text())["rows"]
    assert row["mean_error_m"] < 1e-3  # of 137 mm that it slides, in steps of 5 ms
    shown = call(EXPERIMENTS / "peers_contact.py", "--table", target)
    assert "torchdlo implicit" in shown.stdout


def test_the_command_line_wins_over_the_environment_and_that_over_the_default(probe) -> None:
    default = {"workers": 2, "noise": 0.5, "some_file": "", "quick": False}
    assert json.loads(probe().stdout) == default
    given = {"WORKERS": "3", "NOISE": "-1e-3", "SOME_FILE": "-a b", "QUICK": "true"}
    assert json.loads(probe(**given).stdout) == {"workers": 3, "noise": -1e-3, "some_file": "-a b", "quick": True}
    done = probe("--workers", "4", "--noise=-2", "--some-file", "", "--no-quick", **given)
    assert json.loads(done.stdout) == {"workers": 4, "noise": -2.0, "some_file": "", "quick": False}
    assert json.loads(probe("--quick", QUICK="off").stdout)["quick"]


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name, bad in BAD.items() for value in bad],
)
def test_malformed_environment_is_refused_by_name(probe, name: str, value: str) -> None:
    done = probe(**{name: value})
    assert done.returncode == 2 and not done.stdout
    assert f"{PREFIX}{name}={value}" in done.stderr and "Traceback" not in done.stderr, done.stderr
    assert probe(f"--{name.lower()}", *["1"] * (name != "QUICK"), **{name: value}).returncode == 0


def test_the_rod_benchmark_writes_its_rows(tmp_path: Path) -> None:
    target = tmp_path / "results" / "rod.json"
    done = call(EXPERIMENTS / "bench_rod.py", "--json", target, TORCHDLO_BENCH_ROD_SMOKE="1")
    assert done.returncode == 0, done.stderr
    rows = json.loads(target.read_text())["rows"]
    assert [row["mode"] for row in rows] == ["forward", "forward+backward"]
    for row in rows:
        assert {"scenes", "vertices", "dtype", "compiled"} <= set(row)
        assert row["frames_per_s"] > 0 and row["peak_mb"] > 10
    assert [p.name for p in target.parent.iterdir()] == [target.name]


def test_the_rod_benchmark_refuses_parts_that_it_does_not_have() -> None:
    done = call(EXPERIMENTS / "bench_rod.py", TORCHDLO_BENCH_ROD_ONLY="rows,bread")
    assert done.returncode == 2 and "rows,bread" in done.stderr and "Traceback" not in done.stderr


def test_an_interrupted_rod_benchmark_keeps_its_rows(tmp_path: Path) -> None:
    target = tmp_path / "rod.json"
    process = subprocess.Popen(
        [sys.executable, str(EXPERIMENTS / "bench_rod.py"), "--smoke", "--json", str(target)],
        env=surroundings(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    while process.poll() is None and not target.exists():
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=600)
    assert process.returncode == 130 and b"Traceback" not in error, error.decode()
    # The second row takes seconds; but this process may have slept meanwhile.
    assert len(json.loads(target.read_text())["rows"]) >= 1
