"""Tasks that files name: policies and trajectories are data, and what they name is looked up and never run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")
pytest.importorskip("torchrl", reason="training needs the extra rl")

from torchdlo import envs
from torchdlo.agents.policies import FeatureSpec, Policy, PolicySpec, chunk_rollout, save_policy
from torchdlo.cli import app
from torchdlo.errors import InputError

HOSTILE = "hostile.py:Hostile"


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
