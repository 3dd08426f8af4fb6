"""Tasks that files name: policies and trajectories are data, and what they name is looked up and never run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")
pytest.importorskip("torchrl", reason="training needs the extra rl")

from torchdlo import envs
from torchdlo.agents.policies import FeatureSpec, Policy, PolicySpec, chunk_rollout, save_policy, task_features
from torchdlo.agents.rl import student
from torchdlo.cli import app
from torchdlo.errors import InputError

HOSTILE, OWN = "hostile.py:Hostile", "own.py:Lead"


@pytest.fixture(autouse=True)
def _folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def hostile() -> Path:
    """A task file that leaves a mark when it is run; policies and trajectories name it."""
    Path("hostile.py").write_text("from pathlib import Path\n\nPath('ran').touch()\n")
    save_policy(Policy(PolicySpec(FeatureSpec(10), 3, task=HOSTILE)), Path("policy.pt"))
    content = {"generator": "torchdlo optimize", "task": HOSTILE, "actions": [[0.0]]}
    Path("trajectory.json").write_text(json.dumps(content))
    return Path("ran")


def run(*words: object) -> int:
    """Exit code of the program."""
    with pytest.raises(SystemExit) as caught:
        app.main([*map(str, words)])
    return int(caught.value.code or 0)


@pytest.mark.parametrize(
    "words",
    [
        ("evaluate", "policy.pt"),
        ("evaluate", "policy.pt", "--perturb"),
        ("distill", "policy.pt"),
        ("deploy", "policy.pt"),
        ("deploy", "trajectory.json"),
    ],
)
def test_files_name_no_code_that_is_run(words, hostile: Path, capsys):
    assert run(*words) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "its task is 'hostile.py:Hostile'; expected one of" in said and "never run" in said
    assert not hostile.exists()


@pytest.mark.parametrize(("tasks", "condition"), [((), "varied"), (("coiling",), "swapped")])
def test_policies_that_see_name_no_code_that_is_run(tasks, condition, hostile: Path, monkeypatch):
    about = {"language": "hashed", "tasks": [HOSTILE]}
    monkeypatch.setattr(chunk_rollout, "load_policy", lambda path: (None, about))
    monkeypatch.setattr(chunk_rollout, "_prepared", lambda name, count: type("Made", (), {"task": envs.find(name)}))
    with pytest.raises(InputError, match=r"its task is 'hostile|learned no other task"):
        chunk_rollout.evaluate_chunk_policy(Path("seeing.pt"), tasks, None, episodes=1, conditions=[condition])
    assert not hostile.exists()


@pytest.fixture
def own() -> Path:
    """A policy of a task of one's own, as `train own.py:Lead` would write it."""
    text = (Path(__file__).parent / "rl" / "lead.py").read_text()
    Path("own.py").write_text(text.replace('"lead"', '"leading"'))
    task = envs.find(OWN)
    spec = PolicySpec(task_features(task), 3, task="leading", reach=task.max_translation, turns=3)
    save_policy(Policy(spec), Path("policy.pt"))
    return Path("policy.pt")


def test_policies_of_ones_own_tasks_are_judged_and_deployed(own: Path, capsys):
    assert run("evaluate", own, "--task", OWN, "--protocol", "one", "--execution", "eager", "--json") == 0
    assert json.loads(capsys.readouterr().out)["task"] == "leading"
    assert run("evaluate", own, "--task", OWN, "--perturb", "--starts", 1, "--json") == 0
    assert list(json.loads(capsys.readouterr().out)["actors"]) == [f"policy {Path().resolve().name}"]
    assert run("deploy", own, "--task", OWN, "--json") == 0
    assert json.loads(capsys.readouterr().out)["task"] == "leading"


def test_policies_of_ones_own_tasks_teach(own: Path, monkeypatch, capsys):
    tasks = []
    monkeypatch.setattr(student, "teach", lambda task, *_, **__: tasks.append(task.name) or (None, {"log": []}))
    assert run("distill", own, "--task", OWN) == 0 and tasks == ["leading"]


def test_a_task_of_another_name_is_refused(own: Path, capsys):
    for command in ("evaluate", "deploy", "distill"):
        assert run(command, own, "--task", "coiling") == 2
        assert "its task is 'leading'; the task coiling has the name 'coiling'" in capsys.readouterr().err
        assert run(command, own) == 2
        assert "with --task FILE.py:CLASS" in " ".join(capsys.readouterr().err.split())
    assert run("evaluate", own, "--task", OWN, "--task", OWN) == 2
    assert "give it once" in capsys.readouterr().err
