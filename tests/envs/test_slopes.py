"""Gradients of what tasks earn lead through contact: rewards tell hands where to draw, lift and push."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchdlo.envs import TASKS
from torchdlo.envs.core import episode
from torchdlo.envs.core.task import Task
from torchdlo.physics import tree

pytestmark = pytest.mark.slow


class Played:
    """Episodes of a task whose rope starts elsewhere, (V, 3), and whose matter starts lower."""

    def __init__(self, task: Task, x: Tensor | None = None, lower: float = 0.0) -> None:
        like = torch.zeros((), dtype=torch.float64)
        made = episode.prepare(task, 1, like=like, execution="eager", segment=1)
        state = made.start.state
        if x is not None:
            state = tree.replace(state, rods=tree.replace(state.rods, pos=x.expand_as(state.rods.pos)))
        if lower:
            material_points = state.material_points
            state = tree.replace(
                state,
                material_points=tree.replace(
                    material_points, pos=material_points.pos - material_points.pos.new_tensor([0, 0, lower])
                ),
            )
        self.task, self.made = task, replace(made, start=episode.begin(made, state))

    def earned(self, actions: Tensor, term: str) -> Tensor:
        """Return a term of the last reward."""
        outcome = episode.play(self.task, actions[None], episode=self.made)
        assert not outcome.failed.any()
        return outcome.terms[term][-1, 0]

    def gradient(self, actions: Tensor, term: str) -> Tensor:
        """Return its gradient by the ways of the hands, (T, R, 3); a step along that of the first action agrees."""
        actions = actions.double().requires_grad_()
        (found,) = torch.autograd.grad(self.earned(actions, term), actions)
        step = torch.zeros_like(found)
        step[0] = 1e-7 * found[0] / found[0].norm()
        with torch.no_grad():
            gains = [float(self.earned(actions + sign * step, term)) for sign in (1, -1)]
        assert gains[0] - gains[1] == pytest.approx(2e-7 * float(found[0].norm()), rel=0.02)
        return found[:, : 3 * self.task.arms.count].unflatten(-1, (-1, 3))


def test_a_band_that_is_drawn_further_shoots_the_cube_further() -> None:
    task = replace(TASKS["slingshot"](), settle_steps=0, release=90)
    # Drawn by 4 cm already; vertices 1 and 10 are fixed, the fingers hold 6.
    k, straight = torch.arange(12), task.start(1)[2].rods.pos[0].double()
    share = torch.minimum((k - 1).clamp(min=0) / 5, (10 - k).clamp(min=0) / 4)
    played = Played(task, straight + share[:, None] * torch.tensor([0.0018, -0.0396, 0.0]))
    stage_waypoints = torch.zeros(3, task.width)
    stage_waypoints[:, 0], stage_waypoints[:, 1] = 0.0008, -0.0099
    stage_waypoints[2, 0] = -0.01  # aside, so that the band slips out
    found = played.gradient(stage_waypoints, "cube")
    assert (found[:2, 0, 1] < 0).all()


def test_hands_that_go_up_lift_rings() -> None:
    task = TASKS["lifting"]()
    # The last leg of the scripted demonstration goes up with the rope 3 mm below the arches, taut.
    start, hands = task.start(1)[2].rods.pos[0].double(), list(task.arms.vertex)
    ends = start[hands] + torch.tensor(task.waypoints()[3]) + torch.tensor([0.0, 0.0, 0.02])
    share = (torch.arange(len(start)) - hands[0]) / (hands[1] - hands[0])
    played = Played(task, ends[:1] + share[:, None] * (ends[1:] - ends[:1]))
    found = played.gradient(task.demonstration()[48:51], "height")
    assert (found[:2, :, 2] > 0).all()


def test_hands_that_pull_a_bow_draw_the_ball_to_the_others() -> None:
    task = TASKS["gathering"]()
    # The rope lies 3 mm beside the ball, half round it at the height of its middle; the hands are in front of it.
    arc, radius = 0.02 * (torch.arange(45, dtype=torch.float64) - 22), 0.063
    quarter = 0.5 * torch.pi * radius
    angle, legs = arc.clamp(-quarter, quarter) / radius, (arc.abs() - quarter).clamp(min=0)
    bow = torch.stack([0.25 + radius * angle.sin(), 0.02 + radius * angle.cos() - legs, torch.full_like(arc, 0.05)], -1)
    stage_waypoints = torch.zeros(3, task.width)
    stage_waypoints[:, [1, 4]] = -0.009
    found = Played(task, bow, lower=0.02).gradient(stage_waypoints, "together")
    assert (found[0, :, 1] < -1e-3).all()
