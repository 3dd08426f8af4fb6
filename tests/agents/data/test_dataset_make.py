"""Making sets: what is in them is what happened, and nothing is lost or different after a stop."""

from __future__ import annotations

import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from short_task import Dots, Pair, Short, plan

from torchdlo.agents.data import attempts, check_dataset, merge_datasets, open_set
from torchdlo.agents.data.making import UNFINISHED, DatasetPlan, make_dataset
from torchdlo.agents.distributed import LocalProcesses
from torchdlo.cli import app
from torchdlo.envs.core import episode
from torchdlo.errors import InputError

HERE = Path(__file__).parent


def content(folder: Path) -> dict[str, bytes]:
    """All files of a set."""
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_what_was_executed_earns_again_what_is_kept(made: Path) -> None:
    data = open_set(made)
    columns, rows = data.columns(), data.provenance["episodes"]
    task = Short()
    moved = torch.tensor([row["offsets"] for row in rows])
    scene = episode.prepare(task, 5, execution="eager")
    world = episode.begin(scene, task.build(moved)[2])
    actions = torch.as_tensor(columns["torchdlo.executed"]).view(5, 4, 6)
    for k in range(4):
        state = columns["observation.state"].reshape(5, 4, 15)[:, k]
        assert np.allclose(state[:, 8:11], world.tool.pos[:, 0], atol=1e-5)
        assert np.allclose(state[:, :7], world.joints[:, 0, :7], atol=1e-4)
        world = episode.act(scene, world, actions[:, k])
        reward = episode.episode_reward(scene, world)[1]
        assert np.allclose(columns["next.reward"].reshape(5, 4)[:, k], reward, atol=1e-5)
    sums = columns["next.reward"].reshape(5, 4).sum(1)
    assert np.allclose([row["return"] for row in rows], sums, atol=1e-5)


def test_actions_lead_back_to_where_noise_led_away_from(made: Path) -> None:
    columns = open_set(made).columns()
    state, target = columns["observation.state"], columns["torchdlo.target"]
    away = target[:, :3] - state[:, 8:11]
    far = np.linalg.norm(away, axis=1, keepdims=True)
    wanted = away * np.minimum(1, 0.01 / far)
    assert np.allclose(columns["action"][:, :3], wanted, atol=2e-4)
    shaken = columns["torchdlo.executed"] - columns["action"]
    assert 1e-4 < shaken[:, :3].std() < 2e-3 and 1e-3 < shaken[:, 3:].std() < 0.1


def test_sets_are_as_wide_as_the_task_with_the_most_arms(tmp_path: Path) -> None:
    make_dataset(plan(tasks=("short", "pair"), episodes=2), tmp_path / "set", painter=Dots())
    assert check_dataset(tmp_path / "set") == []
    data = open_set(tmp_path / "set")
    columns = data.columns()
    one = columns["episode_index"] % 2 == 0  # tasks take turns
    assert columns["action"].shape[1] == 12 and columns["observation.state"].shape[1] == 30
    names = data.features["action"]["names"]
    assert names == [f"{s}_d{a}" for g in ("xyz", ("roll", "pitch", "yaw")) for s in ("right", "left") for a in g]
    left = [k for k, name in enumerate(names) if name.startswith("left")]
    assert not columns["action"][one][:, left].any() and columns["action"][~one][:, left].any()
    assert not columns["observation.state"][one][:, 15:].any()
    # The camera of an arm that is not there is black; yuv of 8 bits has no other black than nearly 0.
    dark = np.stack(list(data.pictures(0, "observation.images.wrist_left")))
    light = np.stack(list(data.pictures(3, "observation.images.wrist_left")))
    assert dark.max() <= 2 < light.max()


@pytest.mark.slow
def test_sets_of_one_arm_can_have_room_for_two(tmp_path: Path) -> None:
    make_dataset(plan(tasks=("short",), episodes=1, arms=2, size=0), tmp_path / "one")
    make_dataset(plan(tasks=("pair",), episodes=1, size=0), tmp_path / "two")
    merge_datasets([tmp_path / "one", tmp_path / "two"], tmp_path / "both")
    state = open_set(tmp_path / "both").columns()["observation.state"]
    assert state.shape == (8, 30) and not state[:4, 15:].any() and state[4:, 15:].any()


def test_tasks_say_their_noise_and_plans_their_fidelity() -> None:
    usual = DatasetPlan(("coiling", "slingshot"), 1, size=0)
    assert usual.shake("coiling").size == 0.002 and usual.shake("slingshot").size == 0.0003
    assert DatasetPlan(("coiling", "slingshot"), 1, size=0, noise=0.001).shake("slingshot").size == 0.001
    coarse = DatasetPlan(("coiling", "slingshot"), 1, size=0, fidelity="coarse")
    assert [coarse.task(name).fidelity.text for name in coarse.tasks] == ["1ms/2", "1ms/4"]
    assert usual.task("coiling").fidelity.text == "1ms/5"


def test_workers_make_the_same_bytes(made: Path, tmp_path: Path) -> None:
    with LocalProcesses(2) as pool:
        # Workers do not know the tasks of tests: they get them with what they are told to do.
        make_dataset(plan(), tmp_path / "set", painter=Dots(), executor=_Taught(pool))
    assert content(tmp_path / "set") == content(made)


class _Taught:
    """An executor whose workers know the tasks of these tests."""

    def __init__(self, pool: LocalProcesses) -> None:
        self.pool = pool

    def map(self, fn, items):
        """Teach and do."""
        return self.pool.map(_Lesson(fn, str(HERE)), items)

    def close(self) -> None:
        """Nothing."""


class _Lesson:
    def __init__(self, fn, folder: str) -> None:
        self.fn, self.folder = fn, folder

    def __call__(self, item):
        from short_task import SHORT

        from torchdlo import envs

        envs.TASKS.update(SHORT)
        return self.fn(item)


def test_a_stopped_run_keeps_what_is_finished_and_goes_on(made: Path, tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "set"

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_dataset(plan(), out, painter=Dots(), callback=stop)
    kept = content(out)
    assert sum(name.endswith("attempt.json") for name in kept) in (4, 8) and not (out / "meta").exists()
    with pytest.raises(InputError, match="a run was begun there; --resume goes on with it"):
        make_dataset(plan(), out, painter=Dots())
    with pytest.raises(InputError, match="other options or versions"):
        make_dataset(plan(seed=3), out, painter=Dots(), resume=True)
    # One attempt of a batch that was half written is made again, and only it is written.
    lost = out / UNFINISHED / "short/000002"
    for file in lost.iterdir():
        file.unlink()
    lost.rmdir()
    make_dataset(plan(), out, painter=Dots(), resume=True)
    assert content(out) == content(made)
    # A finished set is left as it is.
    report = make_dataset(plan(), out, painter=Dots(), resume=True)
    assert content(out) == content(made) and report["short"]["attempts"] > 5
    with pytest.raises(InputError, match="it exists already"):
        make_dataset(plan(), out, painter=Dots())


@pytest.mark.slow
def test_runs_that_are_killed_at_any_moment_end_with_the_same_bytes(tmp_path: Path) -> None:
    command = [sys.executable, str(HERE / "short_task.py"), str(tmp_path / "set"), "0.15", "12"]
    path = os.environ | {"PYTHONPATH": str(HERE.parents[2])}
    subprocess.run([*command[:2], str(tmp_path / "whole"), "0", "12"], check=True, env=path)
    drawn, killed = random.Random(5), 0
    for _ in range(40):
        process = subprocess.Popen([*command, "--resume"], stderr=subprocess.DEVNULL, env=path)
        begun = time.monotonic()
        # Most of the time goes into starting; moments are counted from when there is something.
        while not (tmp_path / "set").exists() and process.poll() is None and time.monotonic() < begun + 60:
            time.sleep(0.01)
        try:
            process.wait(drawn.uniform(0.2, 4.0) if killed < 4 else 120)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            killed += 1
            continue
        assert process.returncode == 0
        break
    assert killed and content(tmp_path / "set") == content(tmp_path / "whole")


def test_a_full_disk_is_one_sentence_and_nothing_is_lost(made: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    out, real, written = tmp_path / "set", Path.write_bytes, []

    def full(self: Path, data: bytes) -> int:
        written.append(self)
        if len(written) > 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match=r"No space left on device: .*set/unfinished/short/00000\d'") as caught:
            make_dataset(plan(), out, painter=Dots())
    assert len(str(caught.value).splitlines()) == 1
    folders = [f for f in (out / UNFINISHED / "short").iterdir()]
    assert folders and all(attempts.read_attempt(f) is not None for f in folders)
    make_dataset(plan(), out, painter=Dots(), resume=True)
    assert content(out) == content(made)


def run(*words: object) -> int:
    """Exit code of the command."""
    try:
        app.main(["dataset", *map(str, words)])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_wrong_requests_are_one_sentence(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("torchdlo.cli.datasets._painter", Dots)
    cases = {
        ("make", "sweeping"): "there is no task 'sweeping'; expected one of",
        ("make", "../short"): "there is no task '../short'; expected one of",
        ("make", "<b>short</b>"): "there is no task '<b>short</b>'; expected one of",
        ("make", "short", "short"): "the task short is named twice",
        ("make", "short", "--noise", "0.5"): "noise: expected 0 to 0.01 m, given 0.5",
        ("make", "short", "--fidelity", "fast"): "fidelity: it is 'fast'; expected published, or step and substeps",
        ("make", "short", "--size", "31"): "size: expected an even number of pixels",
        ("make", "short", "--codec", "gif"): "codec: expected one of h264, av1, given 'gif'",
        ("make", "short", "--actor", "nobody"): "there is no file 'nobody'; expected scripted, a trajectory.json",
    }
    for words, said in cases.items():
        assert run(*words, "--out", tmp_path / "set", "--workers", 0) == 2
        error = capsys.readouterr().err
        assert said in error and len(error.splitlines()) == 1
        assert not (tmp_path / "set").exists()


def test_a_task_without_success_is_given_up_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"never: only 0 of 8 attempts succeeded, and 1 were asked for; give less"):
        make_dataset(plan(tasks=("never",), episodes=1), tmp_path / "set", painter=Dots())


def test_a_task_of_ones_own_is_told_what_it_says_of_itself(tmp_path: Path) -> None:
    name = f"{HERE / 'short_task.py'}:Short"
    make_dataset(plan(tasks=(name,), episodes=1, size=0), tmp_path / "own")
    assert open_set(tmp_path / "own").tasks == ("Lead the first end of a short rope to the left of a place.",)
    assert not list(HERE.glob("short_task.py:*"))  # all that was written is in the set's folder
    with pytest.raises(InputError, match="the task Short is named twice"):
        plan(tasks=(name, f"other/{name}"))


def test_a_stored_trajectory_is_followed_from_other_starts(tmp_path: Path) -> None:
    task = Short()
    start = task.start(1)[2].rods.pos[0, 1]
    places = [[(start + torch.tensor([0.0, 0.01 * k, 0.0])).tolist()] for k in range(1, 5)]
    file = tmp_path / "found" / "trajectory.json"
    file.parent.mkdir()
    file.write_text(json.dumps({"task": "short", "tool": places, "success": True, "return": 1.0}))
    for actor in (file, tmp_path):
        out = tmp_path / f"set_{actor.suffix}"
        make_dataset(plan(actor=str(actor), episodes=2, size=0), out)
        data = open_set(out)
        assert check_dataset(out) == [] and data.cameras == ()
        assert data.provenance["episodes"][0]["actions_from"] == "trajectory found/trajectory.json"
        target = data.columns()["torchdlo.target"][:4, :3]
        away = np.array(data.provenance["episodes"][0]["offsets"][0])
        assert np.allclose(target, np.array(places)[:, 0] + away, atol=1e-5)
    assert Pair().arms.count == 2
    with pytest.raises(InputError, match="it is a trajectory of short"):
        make_dataset(plan(tasks=("pair",), actor=str(file), size=0), tmp_path / "other")
