"""Tasks as problems: what the optimiser asks for is what the task plays, and what is kept plays again."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from torchdlo import envs
from torchdlo.agents.trajopt.presets import PUBLISHED, search_preset
from torchdlo.agents.trajopt.search import METHODS, Robust
from torchdlo.agents.trajopt.search_result import load_actions
from torchdlo.agents.trajopt.task_problem import TaskProblem, task_problem
from torchdlo.cli import app
from torchdlo.coupling.robot.robot_kinematics import panda, tool_pose
from torchdlo.envs.core.task import RADIUS, Arms, Task, TaskState, make, straight
from torchdlo.errors import InputError
from torchdlo.scene import Params, Rope, Scene, State

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")


@dataclass(frozen=True)
class Lead(Task):
    """Lead the first end of a short rope to the left."""

    horizon: int = 3
    name: ClassVar[str] = "lead"
    arms: ClassVar[Arms] = Arms(base=((-0.2, -0.45, 0.0),), vertex=(1,))
    frame_skip: ClassVar[int] = 2
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.02, 0.01),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """The rope may be moved."""
        return make(self, [Rope(straight((0.0, 0.1, 0.05), 8, moved[:, 0]), RADIUS, mass=0.008, youngs=1e4)])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """How far the rope is to the left of y = 0.1."""
        return {"left": seen.x[:, 1, 1] - 0.1}

    def success(self, seen: TaskState) -> Tensor:
        """Whether that is 2 cm."""
        return seen.x[:, 1, 1] > 0.12


@pytest.fixture(scope="module")
def lead() -> TaskProblem:
    """The task in double precision; its few frames are not worth compiling."""
    return TaskProblem(Lead(), double=True, execution="eager")


def test_returns_and_slopes_are_those_of_the_way_of_the_tool(lead: TaskProblem) -> None:
    actions = torch.zeros(2, 3, 3, dtype=torch.float64)
    actions[0, :, 1], actions[1, 0, 1] = 0.005, 0.01
    actions.requires_grad_()
    outcome = lead.evaluate(actions)
    # The vertex that is held goes where the tool goes: 5, 10, 15 mm, and three times 10 mm. The tool comes to the
    # target within the tolerance of inverse kinematics, 0.1 mm, at each action.
    torch.testing.assert_close(outcome.returns, torch.tensor([0.03, 0.03], dtype=torch.float64), atol=3e-4, rtol=0)
    (gradient,) = torch.autograd.grad(outcome.loss[0], actions)
    wanted = torch.tensor([-3.0, -2.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(gradient[0, :, 1], wanted, atol=1e-2, rtol=0)
    assert (gradient[1] == 0).all()


def test_varied_starts_are_the_same_for_all_trajectories(lead: TaskProblem) -> None:
    actions = torch.zeros(1, 3, 3, dtype=torch.float64)
    both = lead.varied(2, 1.0, 7).evaluate(actions.expand(2, 3, 3))
    assert both.returns[0] == pytest.approx(float(both.returns[1]), rel=1e-12)
    half, none = (float(lead.varied(2, scale, 7).evaluate(actions).returns[0]) for scale in (0.5, 0.0))
    # Nothing moves, so that the return is three times the mean shift in y.
    assert half == pytest.approx(0.5 * float(both.returns[0]), abs=1e-6) and none == pytest.approx(0, abs=1e-6)
    assert abs(half) > 1e-4


class Still(Lead):
    """The same from one start only."""

    reset_noise = ((0.0, 0.0),)


def test_a_task_without_spread_cannot_be_robust() -> None:
    with pytest.raises(InputError, match="lead: its start does not vary; leave out --robust"):
        TaskProblem(Still(), execution="eager").varied(2, 1.0, 0)


def test_the_command_finds_keeps_and_plays_again(
    lead: TaskProblem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    out = tmp_path / "out"
    words = ["optimize", "lead", "--method", "hybrid", "--episodes", "16", "--population", "4", "--dtype", "float64"]
    with pytest.raises(SystemExit) as done:
        app.main([*words, "--execution", "eager", "--out", str(out), "--json"])
    assert done.value.code in (0, None)
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert json.loads((out / "result.json").read_text()) == result
    assert f"lead: return {result['return']:.4g} after 16 episodes, success" in said.err
    # Straight to the left is 1, 2, 3 cm; more than 2 cm in the end is a success.
    assert 0.02 < result["return"] < 0.06 + 3e-4 and result["success"]
    assert result["settings"]["seed"] == 0 and result["versions"]["torch"] == torch.__version__
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG") and not (out / "journal").exists()

    kept = json.loads((out / "trajectory.json").read_text())
    outcome, again = lead.record(load_actions(out / "trajectory.json", lead))
    assert float(outcome.returns[0]) == kept["return"] == result["return"]
    assert again["joints"] == kept["joints"] and again["tool"] == kept["tool"]
    # The joints alone say where the tool went.
    base = torch.tensor(Lead.arms.base, dtype=torch.float64)
    tool = tool_pose(panda(), torch.tensor(kept["joints"], dtype=torch.float64)).pos + base
    torch.testing.assert_close(tool, torch.tensor(kept["tool"], dtype=torch.float64), atol=1e-12, rtol=0)


class Missing(Lead):
    """The same, of which contact has missed something."""

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """As if an edge had become a fifth too short."""
        scene, params, state = super().build(moved)
        return scene, params, replace(state, diagnostics=state.diagnostics + torch.tensor([0.0, 0.0, 0.2, 0.0, 0.0]))


def test_a_trajectory_that_cannot_be_trusted_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--episodes", "4", "--population", "4", "--execution", "eager", "--json"]
    for kind, missed in ((Lead, ""), (Missing, "an edge became 20% shorter than it has to be")):
        monkeypatch.setitem(envs.TASKS, "lead", kind)
        out = tmp_path / kind.__name__
        found = ["--trajectory", str(out / "trajectory.json"), "--out", str(out / "play"), "--json"]
        for command in (["optimize", "lead", *words, "--out", str(out)], ["play", "lead", *found]):
            with pytest.raises(SystemExit):
                app.main(command)
            said = capsys.readouterr()
            told = json.loads(said.out)["missed"]
            assert told.startswith(missed) and bool(told) == bool(missed)
            assert ("do not trust it: an edge became" in said.err) == bool(missed)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["nothing"], "there is no task 'nothing'; expected one of"),
        (["lead", "--method", "luck"], "method is 'luck'; expected one of cmaes, gd, hybrid"),
        (["lead", "--episodes", "10"], "episodes is 10; expected at least 12"),
        (["lead", "--resume"], "expected the journal of a search to resume, found none; leave out --resume"),
    ],
)
def test_the_command_says_what_is_wrong(
    words: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(envs.TASKS, "lead", Lead)
    with pytest.raises(SystemExit) as done:
        app.main(["optimize", *words, "--execution", "eager"])
    assert done.value.code == 2 and sentence in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.pt"))


def test_trajectories_of_other_tasks_are_refused(lead: TaskProblem, tmp_path: Path) -> None:
    file = tmp_path / "trajectory.json"
    file.write_text(json.dumps({"task": "lead", "actions": [[0.0] * 3] * 2}))
    with pytest.raises(InputError, match=r"expected 3 actions of 3 numbers for lead, found \(2, 3\) for lead"):
        load_actions(file, lead)
    file.write_text("[]")
    with pytest.raises(InputError, match="expected a trajectory of torchdlo optimize"):
        load_actions(file, lead)


def test_presets_are_the_published_settings() -> None:
    assert search_preset("lifting", "cmaes").sigma == 0.005 and search_preset("lifting", "gd").rate == 1e-4
    assert search_preset("coiling", "cmaes").episodes // search_preset("coiling", "cmaes").population == 50
    # Small budgets leave room for as many iterations.
    sizes = {m: [search_preset("coiling", m, episodes=n).population for n in (2000, 500, 100)] for m in METHODS}
    assert sizes == {"cmaes": [40, 20, 20], "gd": [16, 10, 4], "hybrid": [40, 12, 12]}
    assert search_preset("coiling", "cmaes", episodes=20_000, robust=Robust(copies=8)).population == 50
    assert search_preset("coiling", "hybrid", episodes=2000, population=7).population == 7
    assert search_preset("coiling", "cmaes", seed=None, episodes=7).episodes == 7
    plan = search_preset("coiling", "cmaes").plan(task_problem("coiling"))
    assert plan.encoding(plan.hold).knots == 10 and plan.encoding(plan.hold).reach == pytest.approx(0.1)
    assert plan.rate == 1e-3 and plan.last == pytest.approx(1e-6)
    assert all(row["cmaes"][0] >= row["gd"][0] for name, row in PUBLISHED.items() if name != "separation")
