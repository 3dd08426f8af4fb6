"""What is refused: words say what was given, what was expected and how to mend it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from test_contract import F64, prepared, small

from torchdlo import envs
from torchdlo.envs import TASKS, find
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import Arms, combined
from torchdlo.errors import InputError

pytestmark = pytest.mark.quick

ONE = ((0.0, -0.5, 0.0),)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"base": (0, -0.5, 0), "vertex": (0,)},
            r"base is \(0, -0.5, 0\); expected a place \(x, y, z\) \[m\] for each arm",
        ),
        ({"base": ((0, -0.5),), "vertex": (0,)}, r"base is \(\(0, -0.5\),\)"),
        ({"base": (), "vertex": ()}, r"base is \(\)"),
        ({"base": ONE, "vertex": 4}, r"vertex is 4; expected a tuple of 1 whole numbers"),
        ({"base": ONE, "vertex": (0, 3)}, r"vertex is \(0, 3\); expected a tuple of 1"),
        ({"base": ONE, "vertex": (0.5,)}, r"vertex is \(0.5,\)"),
        ({"base": ONE, "vertex": (0,), "quat": (0.0, 1.0, 0.0, 0.0)}, r"quat is \(0.0, 1.0, 0.0, 0.0\); expected an"),
        ({"base": ONE, "vertex": (0,), "quat": ((0.0, 1.0, 0.0, 0.0),) * 2}, r"for each of 1 arms"),
    ],
)
def test_arms_that_are_not_one_entry_each_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Arms(**given)
    assert Arms(base=[[0, -0.5, 0]], vertex=(0,)).count == 1


def test_what_is_no_cable_is_refused() -> None:
    words = r"rope: it is 'model.json'; expected a torchdlo.envs.Cable; torchdlo.scene_files.cable\(path\) makes one"
    for make in (lambda: envs.make("coiling", rope="model.json"), lambda: find("coiling", "model.json")):
        with pytest.raises(InputError, match=words):
            make()


def test_what_is_no_task_is_refused() -> None:
    pytest.importorskip("torchrl")
    with pytest.raises(InputError, match=r"it is the class Coiling; .*; write Coiling\(\)\."):
        envs.make(TASKS["coiling"])
    with pytest.raises(InputError, match=r"task: it is 3; expected a name of `envs.TASKS` or an instance of a Task\."):
        envs.make(3)


@pytest.mark.parametrize("count", [0, -1, 2.0, True, "2"])
def test_what_is_no_number_of_scenes_is_refused(count: Any) -> None:
    pytest.importorskip("torchrl")
    with pytest.raises(InputError, match=f"num_envs: it is {count!r}; expected how many"):
        envs.make("coiling", num_envs=count, execution="eager")


@pytest.mark.parametrize(
    ("terms", "words"),
    [
        ({"near": torch.ones(2), "far": torch.ones(2, 1)}, r"rewards returned {'far': \(2, 1\)}; .* of shape \(2,\)"),
        ({"near": torch.ones(1)}, r"{'near': \(1,\)}"),
        ({"near": torch.ones(())}, r"{'near': \(\)}"),
        ({"near": 1.0}, r"{'near': 1.0}"),
        ({}, r"rewards returned {}; expected one or more terms"),
    ],
)
def test_terms_that_are_not_a_number_for_each_scene_are_refused(terms: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        combined(find("coiling"), terms, 2)
    kind = type("Other", (TASKS["coiling"],), {"rewards": lambda self, seen: terms, "__doc__": "With other terms."})
    pytest.importorskip("torchrl")
    with pytest.raises(InputError, match=words):
        envs.make(kind(), num_envs=2, execution="eager")


def test_choices_beside_an_episode_and_episodes_of_other_tasks_are_refused() -> None:
    made, actions = prepared("coiling"), torch.zeros(2, 1, 6, dtype=F64)
    with pytest.raises(InputError, match="coiling: segment beside an episode that is prepared already"):
        episode.play(made.task, actions, episode=made, segment=3)
    with pytest.raises(InputError, match=r"wiring_post: the episode is of Coiling\(horizon=2.*expected one of Wiring"):
        episode.play(small("wiring_post"), actions, episode=made)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("horizon", 0, "horizon: it is 0; expected a whole number from 1 on"),
        ("horizon", 2.5, "horizon: it is 2.5"),
        ("frame_skip", 0, "frame_skip: it is 0"),
        ("release", -1, "release: it is -1; expected a whole number from 0 on"),
    ],
)
def test_numbers_of_actions_that_are_none_are_refused(name: str, value: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        TASKS["coiling"](**{name: value})


@pytest.mark.parametrize(
    ("method", "value", "words"),
    [
        ("rewards", torch.ones(1), r"rewards returned a tensor of shape \(1,\); expected a dictionary"),
        ("rewards", 1.0, r"rewards returned 1.0; expected a dictionary"),
        ("success", 0.7, r"success returned 0.7; expected a tensor of bool of shape \(1,\)"),
        ("success", torch.ones(1), r"success returned a tensor of torch.float32, \(1,\)"),
        ("success", torch.ones(1, 1, dtype=torch.bool), r"torch.bool, \(1, 1\)"),
    ],
)
def test_rewards_and_success_of_another_kind_are_refused(method: str, value: Any, words: str) -> None:
    pytest.importorskip("torchrl")
    kind = type("Other", (TASKS["coiling"],), {method: lambda self, seen: value, "__doc__": "Says something else."})
    with pytest.raises(InputError, match=words):
        envs.make(kind(), execution="eager")


def test_actions_and_rewards_that_are_not_finite_are_said_once(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("torchrl")
    from torchdlo import notices

    notices._said -= {"nan actions", "nan rewards of unknotting"}
    kind = type(small("unknotting"))
    bad = type(
        "Odd",
        (kind,),
        {"rewards": lambda self, seen: {"far": 0 / seen.x[:, 0, 0].mul(0)}, "__doc__": "Divides by zero."},
    )
    env = envs.make(bad(horizon=5), execution="eager")
    seen = env.reset()
    for _ in range(2):
        env.step(seen.set("action", torch.zeros(1, 12)))
    assert [r.message for r in caplog.records if "reward is not finite" in r.message] == [
        "unknotting: a reward is not finite although its scene is; check the task's `rewards`."
    ]
    after = env.step(seen.set("action", torch.full((1, 12), torch.nan)))
    assert after["next", "terminated"].all()
    assert sum("an action is not finite" in r.message for r in caplog.records) == 1
