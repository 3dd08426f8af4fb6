"""What every task has to keep, at the least sizes that show it: a frame per action, few actions, few scenes."""

from __future__ import annotations

import dataclasses
import functools

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.envs import TASKS
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import combined
from torchdlo.physics import tree

F64 = torch.float64
FRAMES = 1


def small(name: str, horizon: int = 2):
    """A task with short actions, settling and release."""
    task = TASKS[name]()
    return dataclasses.replace(
        task, horizon=horizon, frame_skip=FRAMES, settle_steps=min(task.settle_steps, 1), release=min(task.release, 1)
    )


@functools.cache
def prepared(name: str) -> episode.Episode:
    """Two scenes with different starts, in double precision."""
    generator = torch.Generator().manual_seed(0)
    like = torch.zeros((), dtype=F64)
    return episode.prepare(small(name), 2, like=like, generator=generator, variation=True, execution="eager")


def stage_waypoints(task, count: int = 2) -> torch.Tensor:
    """Some actions that differ from scene to scene and from component to component, shape (2, count, A).

    They are as much shorter than the limit as they take less time, so that tools are not faster than in a full action.
    """
    wave = torch.arange(2 * count * task.width, dtype=F64).reshape(2, count, task.width)
    share = task.frame_skip / type(task)().frame_skip
    return share * torch.sin(1 + wave) * torch.tensor(task.limit, dtype=F64)


@functools.cache
def played(name: str) -> tuple[episode.EpisodeResult, torch.Tensor]:
    """An episode of two actions with the gradient of its loss."""
    task = prepared(name).task
    actions = stage_waypoints(task).requires_grad_()
    outcome = episode.play(task, actions, episode=prepared(name), keep=episode.scene_positions)
    (gradient,) = torch.autograd.grad(outcome.loss.sum(), actions, retain_graph=True)
    return tree.detach(outcome), gradient


@pytest.fixture(params=TASKS)
def name(request) -> str:
    return request.param


def test_a_task_starts_soundly_with_tools_at_what_they_hold(name: str) -> None:
    made = prepared(name)
    task, start = made.task, made.start
    assert scenes.ok(start.state).all()
    assert not start.failed.any()
    held = start.state.rods.pos[:, list(task.arms.vertex)]
    # Inverse kinematics counts a pose as reached within 0.1 mm.
    assert (start.tool.pos - held).norm(dim=-1).max() < 1e-4
    assert not task.success(start.seen(task.arms.count)).any()


def test_the_reward_is_made_of_its_named_terms(name: str) -> None:
    outcome, _ = played(name)
    task = prepared(name).task
    for k in range(2):
        whole = combined(task, {n: t[k] for n, t in outcome.terms.items()}, 2)
        torch.testing.assert_close(torch.where(outcome.failed, outcome.rewards[k], whole), outcome.rewards[k])
    assert outcome.rewards.shape == (2, 2) and torch.isfinite(outcome.rewards).all()
    torch.testing.assert_close(outcome.returns, outcome.rewards.sum(0))


def test_the_loss_follows_the_actions_as_finite_differences_say(name: str) -> None:
    made, (_, gradient) = prepared(name), played(name)
    task = made.task
    assert torch.isfinite(gradient).all()
    moves = gradient[..., : 3 * task.arms.count]
    assert (moves.abs().amax((1, 2)) > 0).all(), "an action has no influence on the loss"
    # Turns are seen by the loss only through what hangs on them: the direction is one of ways.
    way = torch.zeros_like(gradient)
    way[..., : 3 * task.arms.count] = torch.cos(torch.arange(moves.numel(), dtype=F64)).reshape(moves.shape)
    step = 1e-7
    with torch.no_grad():
        up, down = (
            episode.play(task, stage_waypoints(task) + s * step * way, episode=made).loss.sum() for s in (1, -1)
        )
    # Strands that lie on each other start and cease to press and to slip within a step, which makes an error in
    # proportion to it. Rounding of a loss L, some thousand operations deep, leaves 1e3 eps L / step.
    rounding = 1e3 * torch.finfo(F64).eps * float(up.abs() + 1) / step
    torch.testing.assert_close((gradient * way).sum(), (up - down) / (2 * step), rtol=1e-3, atol=rounding)


def test_scenes_of_a_batch_do_not_touch_each_other(name: str) -> None:
    outcome, _ = played(name)
    made = prepared(name)
    swapped = tree.map(lambda x: x.flip(0).clone(), made.start)
    params = tree.map(lambda x: x.flip(0) if x.dim() > 2 and x.shape[0] == 2 else x, made.params)
    other = dataclasses.replace(made, start=swapped, params=params)
    with torch.no_grad():
        again = episode.play(made.task, stage_waypoints(made.task).flip(0), episode=other)
    # Equal but for the order of sums: rounding, which contact of bodies may amplify a thousandfold.
    torch.testing.assert_close(again.returns.flip(0), outcome.returns, rtol=1e-9, atol=1e-9)


def test_a_scene_that_is_not_finite_has_failed_and_earns_nothing(name: str) -> None:
    made = prepared(name)
    pos = made.start.state.rods.vel.clone()
    pos[1] = torch.nan
    state = tree.replace(made.start.state, rods=tree.replace(made.start.state.rods, vel=pos))
    broken = dataclasses.replace(made, start=tree.replace(made.start, state=state))
    with torch.no_grad():
        outcome = episode.play(made.task, stage_waypoints(made.task, 1), episode=broken)
    assert outcome.failed.tolist() == [False, True]
    assert outcome.returns[1] == 0 and torch.isfinite(outcome.returns).all() and not outcome.success[1]


def test_observations_have_one_size_and_single_precision(name: str) -> None:
    made = prepared(name)
    task, start = made.task, made.start
    seen = episode.observe(made, start)
    bodies = sum(b.motion == "free" for b in made.scene.bodies)
    blobs = 1 if start.state.material_points else 0
    v, r = start.state.rods.pos.shape[-2], task.arms.count
    assert seen.shape == (2, 6 * (v + bodies + blobs) + r * (3 + 4 + 7)) and seen.dtype == torch.float32


def test_the_reference_keeps_the_limits_of_actions(name: str) -> None:
    task = TASKS[name]()
    actions = task.demonstration()
    assert actions.shape == (task.horizon, task.width)
    way, turn = episode.limit_action(task, actions)
    torch.testing.assert_close(torch.cat([way.flatten(1), torch.rad2deg(turn).flatten(1)], -1), actions)
