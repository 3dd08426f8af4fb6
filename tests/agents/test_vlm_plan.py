"""Plans in steps: what is asked, what is carried out, what is mended, and how a run goes on."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from torchdlo import envs
from torchdlo.agents.trajopt.search import SearchSettings, optimize
from torchdlo.agents.trajopt.task_problem import TaskProblem
from torchdlo.agents.vlm import decomposition
from torchdlo.agents.vlm.conversation import Conversation
from torchdlo.agents.vlm.decomposition import Options, Result, carry_out
from torchdlo.agents.vlm.geometry import Geometry
from torchdlo.agents.vlm.plan_schema import step_models
from torchdlo.agents.vlm.recorded import RecordedConversation, load_recorded
from torchdlo.cli import app
from torchdlo.envs import Task
from torchdlo.envs.core.task import RADIUS, Arms, TaskState, make, straight
from torchdlo.errors import InputError
from torchdlo.report.pages.plan import plan_html
from torchdlo.scene import Params, Rope, Scene, State

HAND = "written by hand, not by a model"


@dataclass(frozen=True)
class Carry(Task):
    """Carry the end of a short rope 5 cm along x."""

    horizon: int = 12
    frame_skip: int = 4
    name: ClassVar[str] = "carry"
    arms: ClassVar[Arms] = Arms(base=((0.0, -0.4, 0.0), (0.7, -0.4, 0.0)), vertex=(1, 4))
    reset_noise: ClassVar[tuple[tuple[float, float], ...]] = ((0.005, 0.005),)

    def build(self, moved: Tensor) -> tuple[Scene, Params, State]:
        """Return the scene."""
        x = straight((0.3, 0.0, 0.02), 6, moved[:, 0])
        return make(self, [Rope(x, RADIUS, mass=0.006, youngs=1e4, stretch=1e5 * math.pi * RADIUS**2)])

    def rewards(self, seen: TaskState) -> dict[str, Tensor]:
        """Return how far the end has come."""
        return {"x": seen.x[:, 0, 0]}

    def success(self, seen: TaskState) -> Tensor:
        """Return whether it has come 5 cm."""
        return seen.x[:, 0, 0] > 0.35


def step(number: int, to: float, hold: Sequence[int | None] = (1, None), success: str = "", horizon: int = 8) -> dict:
    """A step that leads the hands along x."""
    stage_waypoints = {f"robot_{k + 1}": None if h is None else [[to + 0.02 * h, 0, 0.04]] for k, h in enumerate(hold)}
    return {
        "id": number,
        "description": f"go to {to}",
        "grasps": {f"robot_{k + 1}": h for k, h in enumerate(hold)},
        "waypoints": stage_waypoints,
        "reward": {"near": f"-abs(x(rope[0]) - {to})"},
        "success": success or f"abs(x(rope[0]) - {to}) < 0.01",
        "horizon": horizon,
    }


def answers(*rows: tuple[str, Any]) -> RecordedConversation:
    """A conversation that somebody wrote."""
    kept = [
        {"kind": k, "text": r if isinstance(r, str) else json.dumps(r), "sha256": None, "tokens": 0} for k, r in rows
    ]
    return RecordedConversation(f"recorded: {HAND}", kept, "here")


CHEAP = {"method": "cmaes", "episodes": 4, "population": 4, "execution": "eager"}


def carried_out(
    model: Any, *, folder: Path | None = None, resume: bool = False, task: Task | None = None, **options: Any
) -> Result:
    """What comes of a plan."""
    talk = Conversation(model, folder, resume=resume)
    return carry_out(task or Carry(), talk, Options(**(CHEAP | options)), folder=folder)


FAR = [step(1, 0.33), step(2, 0.36)]
NEAR = [step(1, 0.32), step(2, 0.30)]


def test_a_plan_is_carried_out_until_the_task_is_done() -> None:
    found = carried_out(answers(("plan", {"steps": FAR}), ("update", {"steps": FAR[1:]})))
    assert found.success and found.ended == "the task is done"
    assert [c.success for c in found.carried] == [True, True]
    assert (found.updates, found.calls, found.source) == (1, 2, f"recorded: {HAND}")
    assert [c.task_success for c in found.carried] == [False, True]


def test_way_points_that_reach_the_condition_are_not_searched() -> None:
    found = carried_out(answers(("plan", FAR[:1])), update=False)
    assert found.carried[0].success and found.carried[0].episodes == 1


def test_a_search_begins_with_way_points_that_do_not() -> None:
    near = {**step(1, 0.33), "success": "x(rope[0]) > 0.34"}
    found = carried_out(answers(("plan", [near])), update=False)
    # What is drawn about them comes as near; ways from nothing would leave the rope at 0.30.
    assert found.carried[0].episodes == 4 and float(found.world.state.rods.pos[0, 0, 0]) > 0.32


def test_way_points_are_places_in_the_world_whatever_moves_before() -> None:
    # The rope is let go above the floor and falls while the other hand travels to it.
    lift = {
        **step(1, 0.31, success="z(rope[0]) > 0.03", horizon=12),
        "waypoints": {"robot_1": [[0.33, 0, 0.1]], "robot_2": None},
    }
    lift["reward"] = {"up": "z(rope[0])"}
    carry = {**step(2, 0.3, hold=(None, 4), success="z(rope[4]) > 0.06", horizon=20), "reward": {"up": "z(rope[4])"}}
    carry["waypoints"] = {"robot_1": None, "robot_2": [[0.38, 0.0, 0.09]]}
    found = carried_out(answers(("plan", [lift, carry])), update=False)
    assert [c.episodes for c in found.carried] == [1, 1]
    torch.testing.assert_close(found.world.tool.pos[0, 1], torch.tensor([0.38, 0.0, 0.09]), rtol=0, atol=2e-3)


def test_a_plan_that_is_wrong_is_mended_by_updates_only() -> None:
    rows = [("plan", {"steps": NEAR}), ("update", {"steps": [step(2, 0.36)]})]
    assert carried_out(answers(*rows)).success
    found = carried_out(answers(rows[0]), update=False)
    assert not found.success and found.updates == 0 and len(found.carried) == 2
    assert found.ended == "the plan was carried out, and the task is not done"


def test_the_task_decides_whether_it_is_done() -> None:
    done = {"complete": True, "reason": "I see that it is."}
    found = carried_out(answers(("plan", NEAR[:1]), *[("update", done)] * 3, ("update", {"steps": [step(2, 0.36)]})))
    assert not found.success and found.ended == "3 updates made no progress" and found.updates == 3
    found = carried_out(answers(("plan", NEAR[:1]), ("update", done), ("update", {"steps": [step(2, 0.36)]})))
    assert found.success


def test_updates_without_progress_end_the_run() -> None:
    idle = step(1, 0.32, success="x(rope[0]) > 9")
    found = carried_out(answers(("plan", [idle]), *[("update", {"steps": [idle]})] * 5))
    assert found.ended == "3 updates made no progress" and found.updates == 3 and len(found.carried) == 4


def test_a_plan_has_so_many_steps_at_most() -> None:
    rows = [("update", {"steps": [step(k, 0.31)]}) for k in range(2, 9)]
    found = carried_out(answers(("plan", [step(1, 0.31)]), *rows), steps=3)
    assert found.ended.startswith("3 steps were carried out") and len(found.carried) == 3


def test_hands_take_hold_of_others_between_steps() -> None:
    rows = [
        ("plan", [step(1, 0.33), step(2, 0.36, hold=(None, 4), horizon=8)]),
        ("update", {"steps": [step(2, 0.36, hold=(None, 4), horizon=8)]}),
    ]
    found = carried_out(answers(*rows), episodes=8)
    assert found.carried[1].failed == "" and found.carried[1].actions is not None
    # It travels for ten actions before.
    assert len(found.carried[1].actions) == 18


def test_a_step_that_fails_is_taken_back_and_told() -> None:
    # Vertex 1 is held already by the hand that stays.
    bad = step(2, 0.36, hold=(1, 2))
    model = answers(("plan", [FAR[0], bad]), ("update", {"steps": [bad]}), ("update", {"steps": FAR[1:]}))
    found = carried_out(model)
    assert found.success and len(found.carried) == 2  # refused before it was carried out, and asked for again
    found = carried_out(answers(("plan", [FAR[0], bad])), update=False)
    assert "cm apart" in found.carried[1].failed and found.ended.startswith("step 2 failed: ")


BAD = [
    {},
    {"steps": []},
    {"steps": [step(1, 0.33)] * 9},
    {"steps": [{**step(1, 0.33), "code": "import os"}]},
    {"steps": [{**step(1, 0.33), "reward": {"a": "__import__('os')"}}]},
    {"steps": [{**step(1, 0.33), "success": "length"}]},
    {"steps": [{**step(1, 0.33), "reward": {"a": "z(ring_0)"}}]},
    {"steps": [{**step(1, 0.33), "horizon": 141}]},
    {"steps": [{**step(1, 0.33), "horizon": 0}]},
    {"steps": [{**step(1, 0.33), "grasps": {"robot_1": 99, "robot_2": None}}]},
    {"steps": [{**step(1, 0.33), "grasps": {"robot_1": 1}}]},
    {"steps": [{**step(1, 0.33), "grasps": {"robot_1": None, "robot_2": None}}]},
    {"steps": [{**step(1, 0.33), "waypoints": {"robot_1": [[0.9, 0, 0.1]]}}]},
    {"steps": [{**step(1, 0.33), "waypoints": {"robot_1": [[0, 0]]}}]},
    {"steps": [step(1, 0.33), {**step(2, 0.33), "reward": {"a": "rope"}}]},
    "print('hello')",
]


@pytest.mark.parametrize("plan", BAD, ids=range(len(BAD)))
def test_plans_that_cannot_be_are_asked_for_again(plan: Any) -> None:
    found = carried_out(answers(("plan", plan), ("plan", FAR[:1])), update=False)
    assert found.calls == 2 and found.carried[0].success


def test_updates_say_one_thing() -> None:
    model = answers(
        ("plan", NEAR[:1]),
        ("update", {"complete": True, "steps": FAR[1:]}),
        ("update", {}),
        ("update", {"steps": FAR[1:]}),
    )
    assert carried_out(model).success


def test_a_run_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [("plan", FAR), ("update", {"steps": FAR[1:]})]
    whole = carried_out(answers(*rows), folder=tmp_path / "whole")
    with pytest.raises(InputError, match="it holds 1 answers"):
        carried_out(answers(rows[0]), folder=tmp_path / "cut")
    assert sorted(p.name for p in (tmp_path / "cut").rglob("*.json")) == ["001.json", "01.json"]
    led: list[int] = []
    before = decomposition._Part.travelled

    def counted(*given: Any) -> Any:
        led.append(1)
        return before(*given)

    monkeypatch.setattr(decomposition._Part, "travelled", counted)
    again = carried_out(answers(*rows), folder=tmp_path / "cut", resume=True)
    assert again.world is not None and whole.world is not None
    assert len(led) == 1 and again.success
    torch.testing.assert_close(again.world.state.rods.pos, whole.world.state.rods.pos, rtol=0, atol=0)
    plain = [json.loads(r.json(Options(**CHEAP))) for r in (whole, again)]
    for each in plain:
        each.pop("seconds")
        for c in each["steps"]:
            c.pop("seconds")
    assert plain[0] == plain[1]


def test_a_search_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Nothing reaches it, so that all of the budget is played.
    far = {**step(1, 0.36, success="x(rope[0]) > 9", horizon=3), "waypoints": None}
    choices: dict[str, Any] = {"update": False, "episodes": 12}
    whole = carried_out(answers(("plan", [far, far])), folder=tmp_path / "whole", **choices)
    played: list[int] = []
    before = decomposition._Part.evaluate

    def counted(self: Any, actions: Tensor) -> Any:
        played.append(len(actions))
        return before(self, actions)

    monkeypatch.setattr(decomposition._Part, "evaluate", counted)

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if stage == "step 1" and done == 8:
            raise KeyboardInterrupt

    ends: list[Result] = []
    cut, options = tmp_path / "cut", Options(**(CHEAP | choices))
    talk = Conversation(answers(("plan", [far, far])), cut)
    with pytest.raises(KeyboardInterrupt):
        carry_out(Carry(), talk, options, folder=cut, callback=stop, unfinished=ends.append)
    assert [r.ended for r in ends] == ["not finished: it was stopped"] and played == [4, 4]
    assert [p.is_dir() for p in (cut / "steps").iterdir()] == [True]
    again = carried_out(answers(("plan", [far, far])), folder=cut, resume=True, **choices)
    # The rest of the first, and all of the second step.
    assert played == [4] * 6
    assert sorted(p.name for p in (cut / "steps").iterdir()) == ["01.json", "02.json"]
    for one, other in zip(again.carried, whole.carried, strict=True):
        torch.testing.assert_close(one.actions, other.actions, rtol=0, atol=0)


def test_a_run_without_way_points_to_search_can_be_stopped_between_steps() -> None:
    def stop(stage: str, done: int, total: int, message: str) -> None:
        if stage == "step 2":
            raise KeyboardInterrupt

    ends: list[Result] = []
    with pytest.raises(KeyboardInterrupt):
        talk = Conversation(answers(("plan", FAR)))
        carry_out(Carry(), talk, Options(**CHEAP, update=False), callback=stop, unfinished=ends.append)
    assert [c.success for c in ends[0].carried] == [True]


def test_what_was_sent_is_kept_and_shown_if_no_answer_comes(tmp_path: Path) -> None:
    class Deaf:
        source, remote = "model m at localhost:1", True

        def reply(self, question: Any, messages: Any, digest: str) -> Any:
            raise InputError("model m at localhost:1: it is off.")

        def skip(self, count: int) -> None:
            pass

    ends: list[Result] = []
    talk = Conversation(Deaf(), tmp_path)
    with pytest.raises(InputError, match="it is off"):
        carry_out(Carry(), talk, Options(**CHEAP), folder=tmp_path, unfinished=ends.append)
    kept = json.loads((tmp_path / "exchanges" / "001.json").read_text())
    assert kept["response"] is None and "Task carry" in kept["request"]["messages"][1]["text"]
    page = plan_html(json.loads(ends[0].json(Options(**CHEAP))), [kept], {})
    assert "(no answer came)" in page and "Task carry" in page and "it is off" in page
    with pytest.raises(InputError, match="expected a conversation"):
        load_recorded(tmp_path)
    again = carried_out(answers(("plan", FAR[:1])), folder=tmp_path, resume=True, update=False)
    assert again.carried[0].success and again.calls == 1


def test_options_that_cannot_be_are_not_the_fault_of_a_step() -> None:
    with pytest.raises(InputError, match="seed"):
        carried_out(answers(("plan", [{**step(1, 0.36), "waypoints": None}])), seed=-1)


def test_starts_can_vary() -> None:
    found = [carried_out(answers(("plan", FAR[:1])), update=False, reset_seed=vary) for vary in (None, 1, 2)]
    ends = [float(r.world.state.rods.pos[0, 5, 1]) for r in found]
    assert len({round(y, 4) for y in ends}) == 3


def test_the_stand_in_plans_one_step_and_says_what_it_is() -> None:
    task = envs.find("lifting")
    plan, _ = step_models(2)

    class Asked(Exception):
        pass

    class Perturbation(Geometry):
        def reply(self, question: Any, messages: Any, digest: str) -> Any:
            found = super().reply(question, messages, digest)
            plan.model_validate_json(found.text)
            raise Asked(found.text)

    with pytest.raises(Asked) as caught:
        carried_out(Perturbation(), task=task)
    made = json.loads(str(caught.value))["steps"][0]
    assert made["success"] == "z(ring_0) > 0.110 and z(ring_1) > 0.110"
    assert Geometry.source == "geometry, no model"


@pytest.mark.parametrize("name", ["wiring_ring", "letter_art"])
def test_the_stand_in_says_which_tasks_it_cannot_plan(name: str) -> None:
    with pytest.raises(InputError, match=rf"^geometry, no model: {name} takes several grasps .* use --endpoint"):
        carried_out(Geometry(), task=envs.find(name))


@pytest.mark.parametrize("name", envs.TASKS)
def test_the_stand_in_has_a_plan_for_every_task(name: str) -> None:
    from torchdlo.agents.vlm.geometry import _step
    from torchdlo.agents.vlm.grasp_proposal import check_grasps, places_of
    from torchdlo.envs.core import scene_names
    from torchdlo.envs.core.subtask import opening, with_reward
    from torchdlo.reward_language import reward

    task = envs.find(name)
    places, (here, seen) = places_of(task), opening(task)
    made = _step(places, scene_names.named_values(task, here, seen))
    with_reward(task, reward(made["reward"], made["success"]))
    check_grasps(places, list(made["grasps"].values()))


def test_the_page_shows_what_was_said_and_escapes_it(tmp_path: Path) -> None:
    evil = {**step(1, 0.36, horizon=8), "description": "<script>alert(1)</script>"}
    found = carried_out(answers(("plan", [evil])), folder=tmp_path)
    exchanges = [json.loads(p.read_text()) for p in sorted((tmp_path / "exchanges").iterdir())]
    page = plan_html(json.loads(found.json(Options(**CHEAP))), exchanges, {})
    assert "<script>" not in page and "&lt;script&gt;" in page
    assert "The task is done." in page and HAND in page and "x(rope[0])" in page
    assert "Nothing was sent to anybody" in page and "were sent to" not in page
    content = json.loads(found.json(Options(**CHEAP))) | {"source": "model m at localhost:1"}
    assert "were sent to the one that is named above" in plan_html(content, exchanges, {})


def test_first_trajectories_are_played_as_they_are() -> None:
    problem = TaskProblem(Carry(), execution="eager")
    first = torch.zeros(1, 12, 6, dtype=torch.float64)
    first[0, :6, [0, 3]] = 0.009
    for method in ("cmaes", "hybrid"):
        settings = SearchSettings(method=method, episodes=4, population=4, seed=0, chunk=4)
        found = optimize(problem, settings, first=first)
        with torch.no_grad():
            alone = problem.evaluate(first)
        assert found.max_return >= float(alone.returns[0]) - 1e-6
        assert bool(found.outcome.success[0])
    with pytest.raises(InputError, match="use cmaes or hybrid"):
        optimize(problem, SearchSettings(method="gd", episodes=4, population=1), first=first)


def test_the_command_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, said in (
        (["wiring_ring"], "expected one of --endpoint"),
        (["knitting", "--geometry"], "there is no task 'knitting'"),
        (["wiring_ring", "--geometry", "--method", "gd"], "expected hybrid or cmaes"),
    ):
        with pytest.raises(SystemExit) as caught:
            app.main(["plan", *options, "--out", str(tmp_path)])
        assert caught.value.code == 2 and said in capsys.readouterr().err


CONVERSATIONS = sorted((Path(__file__).parent / "conversations").glob("*.json"))


@pytest.mark.parametrize("file", CONVERSATIONS, ids=lambda f: f.stem)
def test_recorded_conversations_say_that_no_model_wrote_them(file: Path) -> None:
    found = load_recorded(file)
    assert found.source == f"recorded: {HAND}"
    plan, update = step_models(2)
    for answer in found.answers:
        (plan if answer["kind"] == "plan" else update).model_validate_json(answer["text"])
