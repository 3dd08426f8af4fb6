"""The command that judges policies: what it is told counts, or is refused."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")
pytest.importorskip("torchrl", reason="training needs the extra rl")

sys.path.insert(0, str(Path(__file__).parent / "rl"))
from lead import Lead

from torchdlo import envs
from torchdlo.agents.policies import Policy, PolicySpec, chunk_rollout, save_policy, task_features
from torchdlo.cli import app, policies

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


@pytest.fixture(autouse=True)
def _task(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(envs.TASKS, "lead", Lead)


def evaluate(*words: object) -> int:
    """Exit code of the command."""
    with pytest.raises(SystemExit) as caught:
        app.main(["evaluate", *map(str, words)])
    return int(caught.value.code or 0)


def policy() -> Policy:
    """One that does what its random weights say."""
    task = Lead()
    return Policy(PolicySpec(task_features(task), 3, task="lead", reach=task.max_translation, turns=3))


def test_policies_that_see_begin_where_the_seed_says(monkeypatch, capsys):
    given = []

    def judge(path, tasks, painter, **choices):
        given.append(choices)
        return {"tasks": {}, "mean": {}}

    monkeypatch.setattr(policies, "_sees", lambda path: True)
    monkeypatch.setattr(chunk_rollout, "evaluate_chunk_policy", judge)
    assert evaluate("policy.pt", "--reset-seed", 7, "--starts", 2) == 0
    assert (given[0]["seed"], given[0]["episodes"]) == (7, 2)
    capsys.readouterr()
    assert evaluate("policy.pt", "--perturb", "--trajectory", "trajectory.json") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "--perturb, --trajectory are for those of train" in said and len(given) == 1


def test_perturbations_take_no_protocol_nor_film(capsys):
    save_policy(policy(), Path("policy.pt"))
    for words, said in (
        (["--film", "--protocol", "one"], "--film, --protocol are not for it"),
        (["--execution", "eager"], "--execution is not for it"),
    ):
        assert evaluate("policy.pt", "--perturb", *words) == 2
        assert said in " ".join(capsys.readouterr().err.split())
