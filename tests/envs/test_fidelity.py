"""Fidelity: what it changes, what it must not change, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_contract import small

from torchdlo import envs
from torchdlo.agents.trajopt.task_problem import TaskProblem
from torchdlo.envs import PUBLISHED, TASKS, Fidelity, parse_fidelity, with_fidelity
from torchdlo.envs.core import episode
from torchdlo.errors import InputError


def test_the_published_fidelity_is_1_ms_in_5_explicit_substeps():
    assert PUBLISHED == Fidelity(1e-3, 5, "explicit") == parse_fidelity("published")
    assert envs.find("coiling").fidelity == PUBLISHED
    scene, _, _ = envs.find("coiling").start(1)
    assert (scene.dt, scene.substeps, scene.integrator) == (1e-3, 5, "explicit")


@pytest.mark.parametrize("text", ["1ms/2", "2ms/1/implicit", "5ms/3"])
def test_texts_and_fidelities_are_the_same(text: str):
    assert parse_fidelity(text).text == text


@pytest.mark.parametrize("name", TASKS)
def test_the_cheaper_fidelity_of_every_task_is_stable_and_reaches_the_scene(name: str):
    task = with_fidelity(envs.find(name), "coarse")
    scene, _, _ = task.start(1)
    assert scene.substeps == task.coarse.substeps < PUBLISHED.substeps


@pytest.mark.parametrize("name", [name for name in TASKS if name != "gathering"])
def test_tasks_without_matter_step_implicitly_elastic_ropes_with_their_stiffness(name: str):
    scene, params, _ = with_fidelity(envs.find(name), "2ms/1/implicit").start(1)
    published = envs.find(name).start(1)
    assert scene.integrator == "implicit" and scene.constrained
    assert torch.equal(params.rods.material.stretch, published[1].rods.material.stretch)


def test_an_action_takes_equally_long_in_steps_of_2_ms():
    task = with_fidelity(replace(envs.find("wiring_post"), horizon=2), "2ms/1/implicit")
    world = episode.play(task, torch.zeros(1, 2, 6), execution="eager").world
    # 2 actions of 20 ms.
    torch.testing.assert_close(world.state.time.flatten(), torch.tensor([0.04]))


def test_a_cheaper_fidelity_is_near_the_published_one():
    actions = torch.zeros(1, 4, 6)
    actions[..., 1], actions[..., 2] = -0.002, 0.001
    task = replace(envs.find("wiring_post"), horizon=4, frame_skip=5)
    ends = [
        episode.play(with_fidelity(task, how), actions, execution="eager").world.state.rods.pos
        for how in ("published", "1ms/2")
    ]
    # A tool went 8 mm; ropes differ by less than a twentieth of that, but do differ.
    assert 0 < float((ends[0] - ends[1]).abs().max()) < 4e-4


def test_environments_and_results_name_it():
    env = envs.make(small("wiring_post", 2), execution="eager", fidelity="1ms/2")
    assert env.task.fidelity.text == "1ms/2"
    assert TaskProblem(env.task).choices["fidelity"] == {"step": 1e-3, "substeps": 2, "integrator": "explicit"}
    assert "fidelity" not in TaskProblem(envs.find("wiring_post")).choices


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: with_fidelity(envs.find("gathering"), "2ms/1/implicit").start(1), "sound in plastic_0"),
        (lambda: parse_fidelity("fast"), "it is 'fast'"),
        (lambda: parse_fidelity("1ms/0"), "substeps is 0"),
        (lambda: parse_fidelity("1ms/2/midpoint"), "integrator is 'midpoint'"),
        (lambda: Fidelity(step=0.0015), "step is 0.0015"),
        (lambda: with_fidelity(envs.find("coiling"), Fidelity(3e-3)), "do not divide 20 ms"),
        (lambda: with_fidelity(envs.find("slingshot"), "1ms/2").start(1), "slingshot cannot be simulated by 1ms/2"),
    ],
)
def test_what_is_wrong_is_said(made, said: str):
    with pytest.raises(InputError, match=said):
        made()
