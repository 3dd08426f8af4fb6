"""A policy is trained from scenes that are drawn anew, and the pictures are those that it will be shown."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow", reason="data sets need the extra dataset")
pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

TESTS = Path(__file__).parents[2]
sys.path.insert(0, str(TESTS / "agents/data"))

from short_task import SHORT  # noqa: E402

from torchdlo import envs  # noqa: E402
from torchdlo.agents.data import demonstration_scenes as kept  # noqa: E402
from torchdlo.agents.data.demonstrators import scripted_demonstrator  # noqa: E402
from torchdlo.agents.data.painting import TaskPainter  # noqa: E402
from torchdlo.agents.data.record import Noise, draw_starts, play_batch, scene_in_time  # noqa: E402
from torchdlo.agents.policies import scene_training  # noqa: E402
from torchdlo.agents.policies.chunk_policy import load_policy  # noqa: E402
from torchdlo.agents.policies.chunk_training import ChunkRun, Training  # noqa: E402
from torchdlo.agents.policies.scene_training import ScenePictures, SceneTraining, train_on_scenes  # noqa: E402
from torchdlo.errors import InputError  # noqa: E402

TASKS = ("short", "pair")
TRAINING = Training(epochs=3, batch=6, chunk=4, width=32, language="hashed", followed=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A batch of demonstrations of each task."""
    envs.TASKS.update(SHORT)
    out = tmp_path_factory.mktemp("scenes")
    for name in TASKS:
        kept.play_scenes((name, "published", 0, out))
    return out


@pytest.fixture(autouse=True)
def _short_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in SHORT.items():
        monkeypatch.setitem(envs.TASKS, name, kind)
    monkeypatch.setattr(scene_training, "JUDGED", 6)


def about(folder: Path, **choices) -> SceneTraining:
    usual = {"fidelity": "published", "held_out": 2, "pictures": 24, "size": 32, "seen": 12}
    return SceneTraining(folder, TASKS, **usual | choices)


class Here:
    """A process that works when it begins."""

    exitcode = None

    def __init__(self, target, args, daemon) -> None:
        self.work, self.args = target, args

    def start(self) -> None:
        self.work(*self.args)

    def join(self) -> None:
        """Nothing."""

    terminate = join


@pytest.fixture
def drawn_here(monkeypatch: pytest.MonkeyPatch) -> None:
    context = type("Context", (), {"Process": Here})
    monkeypatch.setattr(scene_training.multiprocessing, "get_context", lambda kind: context)


def test_scenes_that_are_kept_are_drawn_as_a_policy_sees_them(folder: Path) -> None:
    (short, _) = about(folder).demonstrations(0)
    task = envs.find("short")
    made = kept._prepared(task, kept.BATCH)
    starts = draw_starts(task, "scenes", range(kept.BATCH))
    with torch.no_grad():
        steps = play_batch(made, starts, scripted_demonstrator(task), Noise(task.demonstration_noise), None)[0]
    good = steps[-1].success.nonzero()[:, 0].tolist()
    assert len(short.target) == len(good) < kept.BATCH
    which = int(np.flatnonzero(np.random.default_rng(0).permutation(len(good)) == 3)[0])
    world = scene_in_time([step.before for step in steps], good[3])
    expected = TaskPainter()(made, world, [7] * 4, 32)
    found = torch.from_numpy(short.drawn(np.full(4, which), np.arange(4), [7] * 4, 32))
    for k, name in enumerate(kept.CAMERAS):
        if name not in expected:
            assert not found[:, k].any()  # the second arm is not there
            continue
        # Scenes are kept in single precision, which may move an edge from one sample to the next.
        off = (found[:, k].movedim(1, -1).float() - expected[name].float()).abs()
        assert float(off.mean()) < 0.05 and float(expected[name].float().std()) > 10
    goal = torch.stack([step.target[good[3], :, :3] for step in steps])
    assert np.allclose(short.target[which], goal.numpy(), atol=1e-6)


def test_the_network_learns_the_targets_of_both_tasks(folder: Path, tmp_path: Path) -> None:
    scenes, training = about(folder), Training(epochs=1, batch=12, rate=3e-3, chunk=4, width=32, language="hashed")
    tasks = scenes.demonstrations(0)
    source = ScenePictures(tasks, scenes, training, scene_training._Album.open(tmp_path, scenes))
    pictures, labels = source.held_out()
    generator = torch.Generator().manual_seed(0)
    shown = source._shown(pictures, labels, source._words(labels[:, 0], generator))
    for k, (task, which, when) in enumerate(labels.tolist()):
        own = torch.from_numpy(tasks[task].target[which, min(when + 1, 3)])
        assert torch.equal(shown.target[k, 1, : own.numel()], own.flatten())
        assert int((shown.scale[k] == 0).sum()) == 6 - own.numel()  # the second arm may not be there
    run = ChunkRun(source, training)
    run.steps = 40
    losses = [float(run.step(shown, k, generator)) for k in range(40)]
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    judged = run.source.judged(run.averaged)
    assert judged.keys() == {"held_out_mm", "unknown_sentences_mm"} and judged["held_out_mm"].keys() == set(TASKS)


def test_a_training_that_was_stopped_comes_to_the_same_whoever_draws(folder: Path, tmp_path: Path, drawn_here) -> None:
    train_on_scenes(about(folder), tmp_path / "whole.pt", TRAINING)

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if done == 5:
            raise KeyboardInterrupt

    (tmp_path / ".pictures-parts-killed").mkdir()
    with pytest.raises(KeyboardInterrupt):
        train_on_scenes(about(folder), tmp_path / "parts.pt", TRAINING, callback=stop)
    assert load_policy(tmp_path / "parts.pt")[1]["epochs"] == 2
    with pytest.raises(InputError, match="it is of another data set or training"):
        train_on_scenes(about(folder, pictures=30), tmp_path / "parts.pt", TRAINING, resume=True)
    train_on_scenes(about(folder, workers=2), tmp_path / "parts.pt", TRAINING, resume=True)
    (a, one), (b, other) = (load_policy(tmp_path / f"{name}.pt") for name in ("whole", "parts"))
    assert one["loss"] == other["loss"] and one["held_out"] == other["held_out"] and one["tasks"] == list(TASKS)
    assert all(torch.equal(x, y) for x, y in zip(a.parameters(), b.parameters(), strict=True))
    assert not list(tmp_path.glob(".pictures-*")) and not list(tmp_path.glob("*checkpoint*"))


def test_processes_draw_what_this_one_draws(folder: Path, tmp_path: Path, monkeypatch) -> None:
    scenes = about(folder, workers=1)
    tasks = scenes.demonstrations(0)
    scene_training._paint(tmp_path, scenes, 0, 0)
    album = scene_training._Album.open(tmp_path, scenes)
    assert album.done.all() and set(album.labels[..., 0].ravel()) <= {0, 1}
    pictures, labels = scene_training.paint_group(tasks, (), (0, 2), 32)
    assert np.array_equal(album.pictures[2], pictures) and np.array_equal(album.labels[2], labels)
    # Where words alone tell what to do, half of the pictures are of the start.
    monkeypatch.setattr(type(envs.find("short")), "counterpart", "pair")
    monkeypatch.setattr(scene_training, "FIRST", 1)
    rows = np.concatenate([scene_training.paint_group(tasks[:1], (), (0, g), 32)[1] for g in range(20)])
    assert 0.4 < np.mean(rows[:, 2] == 0) < 0.85


def test_the_script_plays_and_learns(folder: Path, tmp_path: Path, monkeypatch, capsys, drawn_here) -> None:
    monkeypatch.syspath_prepend(str(TESTS.parent / "experiments"))
    script = importlib.import_module("train_seeing_policy")
    words = ["--tasks", "short,pair", "--fidelity", "published", "--batches", "1", "--workers", "0", "--size", "32"]
    words += ["--pictures", "24", "--batch", "6", "--chunk", "4", "--width", "32", "--language", "hashed"]
    words += ["--held-out", "2", "--epochs", "1", "--steps", "2", "--scenes", str(folder)]
    script.main([*words, "--out", str(tmp_path / "policy.pt")])
    policy, found = load_policy(tmp_path / "policy.pt")
    assert found["tasks"] == list(TASKS) and policy.shape.arms == 2 and policy.shape.cameras == kept.CAMERAS
    assert "of 16" not in capsys.readouterr().out  # what was played is there
    # One task of one arm can go on from a policy of two.
    more = [*words, "--tasks", "short", "--from", str(tmp_path / "policy.pt"), "--out", str(tmp_path / "more.pt")]
    script.main(more)
    assert load_policy(tmp_path / "more.pt")[0].shape == policy.shape
    with pytest.raises(SystemExit, match="there is no checkpoint to resume"):
        script.main([*words, "--resume", "--out", str(tmp_path / "other.pt")])
    with pytest.raises(InputError, match="demonstrations of short succeeded, and 90 are held out; play more of them"):
        about(folder, held_out=90).demonstrations(0)
