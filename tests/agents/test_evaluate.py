"""The command that judges policies: what it is told counts, or is refused."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")
pytest.importorskip("torchrl", reason="training needs the extra rl")

sys.path.insert(0, str(Path(__file__).parent / "rl"))
from lead import Lead

from torchdlo import envs
from torchdlo.agents.policies import Policy, PolicySpec, chunk_rollout, save_policy, task_features
from torchdlo.agents.rl.evaluate import judge_policies, judged_episode
from torchdlo.cli import app, policies
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import TaskState

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


@dataclass(frozen=True)
class Falling(Lead):
    """Its reward is how far the free end has fallen, which damping decides."""

    horizon: int = 3
    settle_steps: int = 2

    def rewards(self, seen: TaskState) -> dict[str, torch.Tensor]:
        """In millimetres."""
        return {"fallen": 1e3 * (0.05 - seen.x[:, -1, 2])}


@pytest.mark.parametrize("protocol", ["varied", "disturbed"])
def test_the_episodes_that_are_filmed_are_those_that_were_judged(protocol: str):
    task = Falling()
    with torch.no_grad():
        plays = judge_policies([policy()], task, starts=2, protocols=[protocol], execution="eager")[protocol]
        assert bool(plays["effects"]) == (protocol == "disturbed")
        begun, actions = judged_episode(task, plays, 1, execution="eager")
        went = episode.play(begun.task, actions[None], episode=begun)
        assert float(went.returns) == pytest.approx(float(plays["returns"][0, 1]), rel=1e-4)
        usual = episode.prepare_at(begun.task, plays["moved"][0, 1:], execution="eager")
        other = episode.play(begun.task, actions[None], episode=usual)
    assert (abs(float(other.returns / went.returns) - 1) < 1e-4) == (protocol == "varied")


def test_the_film_is_of_the_scene_that_was_judged(monkeypatch):
    filmed = []

    def film(task, actions, *, made):
        filmed.append((made.params.effects, actions))
        return None, None

    monkeypatch.setattr("torchdlo.report.render.episode_film.film", film)
    monkeypatch.setattr("torchdlo.report.render.video_writer.write_video", lambda *_, **__: None)
    plays = judge_policies([policy()], Lead(), starts=3, protocols=["disturbed"], execution="eager")["disturbed"]
    policies._films(Lead(), plays, Path())
    rates = [float(effects["damping"]["rate"]) for effects, _ in filmed]
    assert rates[0] != rates[1] and set(rates) <= set(plays["effects"]["damping"]["rate"].flatten().tolist())
