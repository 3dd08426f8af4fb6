"""The command that plays episodes: by hand, idle, from a file, bit by bit."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

from test_tasks import Lead

from torchdlo import envs
from torchdlo.agents.trajopt.script import script
from torchdlo.cli import app
from torchdlo.envs.core import episode
from torchdlo.scene_files.run import load_frames


class Led(Lead):
    """With a scripted demonstration."""

    def waypoints(self):
        """To the left."""
        return [[(0.0, 0.03, 0.0)]]


@pytest.fixture(autouse=True)
def _tasks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    monkeypatch.setitem(envs.TASKS, "led", Led)


def play(*words: object) -> int:
    """Exit code of the command."""
    with pytest.raises(SystemExit) as caught:
        app.main(["play", *map(str, words)])
    return int(caught.value.code or 0)


def test_the_way_by_hand_is_played_and_kept(capsys):
    assert play("led", "--json") == 0
    said = capsys.readouterr()
    went = json.loads(said.out)
    assert went["success"] and not went["failed"] and f"led: return {went['return']:.4g}, success" in said.err
    assert went["files"] == ["runs/play/led/frames.npz", "runs/play/led/shapes.png"]
    frames = load_frames("runs/play/led")
    assert len(frames.time) == 4 and frames.pos[-1, 1, 1] - frames.pos[0, 1, 1] == pytest.approx(0.03, abs=3e-4)
    # Its own files are replaced.
    assert play("led", "--no-op", "--json") == 0
    assert not json.loads(capsys.readouterr().out)["success"]


def test_another_start_is_that_of_its_seed(capsys):
    starts = []
    for seed in (1, 1, 2):
        assert play("led", "--reset-seed", seed, "--json") == 0
        capsys.readouterr()
        starts.append(load_frames("runs/play/led").pos[0])
    assert np.array_equal(starts[0], starts[1]) and not np.allclose(starts[0], starts[2], atol=1e-4)


def test_a_trajectory_comes_back_bit_by_bit(capsys):
    words = ["optimize", "lead", "--method", "cmaes", "--episodes", "8", "--population", "4", "--dtype", "float64"]
    with pytest.raises(SystemExit):
        app.main([*words, "--execution", "eager", "--out", "found"])
    capsys.readouterr()
    assert play("lead", "--trajectory", "found/trajectory.json", "--json") == 0
    went, kept = json.loads(capsys.readouterr().out), json.loads(Path("found/trajectory.json").read_text())
    assert went["return"] == kept["return"] and went["rewards"] == kept["rewards"]
    # On another rope it shows how well it carries over.
    rope = envs.RopeMaterial(line_density=0.05, bend=1e-4, damping=20.0)
    same, other = (script("lead", Path("found/trajectory.json"), given) for given in (None, rope))
    went, moved = (episode.play(s.task, s.actions[None], episode=s.episode) for s in (same, other))
    assert same.actions.tolist() == other.actions.tolist() and went.returns.item() == kept["return"]
    assert (went.world.state.rods.pos - moved.world.state.rods.pos).abs().max() > 1e-6
    # What was found for a rope of its own needs one.
    kept["choices"]["rope"] = {"bend": 1e-3}
    Path("other.json").write_text(json.dumps(kept))
    assert play("lead", "--trajectory", "other.json") == 2
    assert "found for its own rope; give that one, or another, with --rope-model" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nothing"], "there is no task 'nothing'; expected one of"),
        (["lead"], "lead: has no scripted demonstration; give a --trajectory, or --no-op"),
        (["lead", "--no-op", "--trajectory", "x.json"], "--no-op and --trajectory: expected one of them"),
        (["lead", "--trajectory", "x.json"], "x.json: expected a trajectory of torchdlo optimize"),
    ],
)
def test_it_says_what_is_wrong(words, sentence, capsys):
    assert play(*words) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not list(Path().rglob("*.npz"))


def test_ctrl_c_keeps_the_frames_so_far(monkeypatch, capsys):
    from torchdlo.cli import tasks as commands

    @contextlib.contextmanager
    def impatient(show):
        def callback(stage, done, total, message=""):
            if done == 2:
                raise KeyboardInterrupt

        yield callback

    assert play("led") == 0
    whole = load_frames("runs/play/led")
    capsys.readouterr()
    monkeypatch.setattr(commands, "deferred_interrupt", impatient)
    assert play("led", "--out", "cut", "--json") == 130
    said = capsys.readouterr()
    went = json.loads(said.out)
    assert went["return"] is None and went["interrupted"] and "led: interrupted" in said.err
    cut = load_frames("cut")
    assert len(cut.time) == 3 < len(whole.time) and np.array_equal(cut.pos, whole.pos[:3])


def test_a_task_of_ones_own_is_played_from_its_file(capsys):
    Path("my_tasks.py").write_text(
        "from dataclasses import dataclass\n\nimport torch\n\nfrom torchdlo.envs.tasks.coiling import Coiling\n\n\n"
        "@dataclass(frozen=True)\nclass Reaching(Coiling):\n    '''Coiling, in two short actions.'''\n\n"
        "    horizon: int = 2\n    frame_skip: int = 1\n\n"
        "    def rewards(self, seen):\n        return {'one': torch.ones_like(seen.x[:, 0, 0])}\n"
    )
    assert play("my_tasks.py:Reaching", "--no-op", "--json") == 0
    went = json.loads(capsys.readouterr().out)
    assert went["return"] == 2.0 and went["files"][0] == "runs/play/Reaching/frames.npz"
    for name, words in (
        ("no.py:Reaching", "there is no file no.py"),
        ("my_tasks.py:Away", "tasks there: Coiling, Reaching"),
    ):
        assert play(name, "--no-op") == 2
        assert words in capsys.readouterr().err


def test_what_lies_in_a_folder_is_of_one_run(capsys):
    for name in ("motion.mp4", "picture.png"):
        Path("runs/play/led").mkdir(parents=True, exist_ok=True)
        (Path("runs/play/led") / name).write_bytes(b"of an earlier run")
    assert play("led", "--no-op", "--json") == 0
    assert sorted(p.name for p in Path("runs/play/led").iterdir()) == ["frames.npz", "shapes.png"]
