"""Ways by hand: arms can go them, and they lead to success."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.coupling.grasp import Hands
from torchdlo.envs import TASKS, episode
from torchdlo.physics import tree
from torchdlo.physics.traced import record

LED = [name for name in TASKS if TASKS[name]().waypoints()]
TURNED = math.radians(45)


@pytest.mark.parametrize("name", LED)
def test_arms_can_go_the_way_by_hand(name: str) -> None:
    task = TASKS[name]()
    scene, _, state = task.start(1)
    fixed = len(scene.held_vertices) - task.arms.count
    world = episode._begin(task, scene, state, Hands(task.arms.count, (*range(task.arms.count), *[-1] * fixed)))
    actions, want = task.reference().float()[:, None], world.target.pos
    actions = actions[actions.any(-1).flatten()]  # without those that stay
    with torch.no_grad():
        for action in actions:
            want = want + episode.limited(task, action)[0]
            found = episode._solve(task, episode._aim(task, world, action), world.joints, episode.FOLLOW)
            assert found.converged.all()
            world = tree.replace(world, joints=found.joints, target=found.handed, tool=found.pose)
    # What counts as there is 0.1 mm away at most; targets add up in single precision.
    torch.testing.assert_close(world.tool.pos, want, atol=2e-4, rtol=0)


@pytest.mark.parametrize("name", ["lifting", "separation", "wiring_post"])
def test_arms_begin_with_elbow_and_wrist_in_line(name: str) -> None:
    # These arms face what they hold, with tools straight down: a plane arm does it, with nothing turned sideways.
    # Postures at which elbow and forearm are turned by 90 degrees and more reach it too, but soon meet their limits.
    task = TASKS[name]()
    scene, _, state = task.start(1)
    world = episode._begin(task, scene, state, Hands(task.arms.count, tuple(range(task.arms.count))))
    assert world.joints[..., [2, 4]].abs().max() < TURNED


@pytest.mark.slow
def test_the_way_by_hand_takes_hooked_ropes_apart() -> None:
    # Of 94 actions on the way 60 bring the hands 85 cm further apart, more than the 58 cm of a rope.
    task = TASKS["separation"]()
    made = episode.prepare(task, 1, compiled=False)
    control = scenes.hold(made.scene, made.start.state)
    grip = {"vertices": torch.ones_like(control.pos[..., :1]), "edges": torch.ones_like(control.director[..., :1])}
    step = record(made.step, made.params, made.start.state, tree.replace(control, grip=grip))
    actions = task.reference().float()[None, :60]
    with torch.no_grad():
        outcome = episode.play(task, actions, episode=dataclasses.replace(made, step=step))
    assert outcome.success.all()
