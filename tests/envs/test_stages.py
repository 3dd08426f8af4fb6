"""Re-grasps: hands open, travel and close as the stages of a task say."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch

from torchdlo.envs import TASKS
from torchdlo.envs.core import episode
from torchdlo.envs.core.stages import ARCH, Schedule
from torchdlo.envs.core.task import RADIUS, Arms, Stage, Task, make, straight
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene import Rope

F64 = torch.float64


@dataclass(frozen=True)
class Passing(Task):
    """Take a rope by one vertex, then by another."""

    horizon: int = 8
    frame_skip: int = 2

    name: ClassVar[str] = "passing"
    arms: ClassVar[Arms] = Arms(base=((0.0, -0.5, 0.0), (0.1, 0.5, 0.0)), vertex=(0, 5))
    travel: ClassVar[int] = 3
    stages: ClassVar[tuple[Stage, ...]] = (Stage(0, (0, None)), Stage(4, (2, 5)), Stage(7, (None, 5)))

    def build(self, moved):
        """Return the scene."""
        return make(
            self, [Rope(straight((0.0, 0.0, 0.012), 6, moved[:, 0]), RADIUS, mass=0.005, youngs=1e4, stretch=30.0)]
        )

    def rewards(self, seen):
        """Return where the rope is."""
        return {"place": seen.x[..., 1].sum(-1) + seen.x[:, 2, 2]}

    def success(self, seen):
        """Return whether the rope is high."""
        return seen.x[..., 2].amax(-1) > 0.1


def worlds(actions: torch.Tensor) -> list[episode.EpisodeState]:
    """The worlds of a scene before and after each of some actions, shape (T, 12)."""
    made = episode.prepare(Passing(), 1, like=torch.zeros((), dtype=F64), execution="eager")
    found = [made.start]
    with torch.no_grad():
        for action in actions:
            found.append(episode.act(made, found[-1], action[None]))
    return found


def led(count: int, hand: int, way: tuple[float, float, float]) -> torch.Tensor:
    """Actions that lead one hand evenly, shape (count, 12)."""
    actions = torch.zeros(count, 12, dtype=F64)
    actions[:, 3 * hand : 3 * hand + 3] = torch.tensor(way, dtype=F64)
    return actions


def test_hands_hold_what_the_stage_says():
    run = worlds(torch.zeros(8, 12, dtype=F64))
    closed = [w.seen(2).closed.flatten().tolist() for w in run[1:]]
    # Hand 0 is on its way in actions 1 to 3, hand 1 is open until action 4; after action 6, hand 0 lets go.
    assert closed == [[1, 0], [0, 0], [0, 0], [0, 0], [1, 1], [1, 1], [1, 1], [0, 1]]
    # Hands that close hold their vertex: inverse kinematics counts 0.1 mm as there, and the rope lies still.
    for hand, vertex in ((0, 2), (1, 5)):
        off = (run[5].tool.pos[0, hand] - run[5].state.rods.pos[0, vertex]).norm()
        assert off < 2e-4


def test_hands_pass_over_the_rope_to_their_next_vertex():
    run = worlds(torch.zeros(4, 12, dtype=F64))
    height = torch.stack([w.tool.pos[0, 0, 2] for w in run[1:]]) - run[0].tool.pos[0, 0, 2]
    # A parabola 4 u (1 - u) ARCH at u = 1/3, 2/3, 1; the rope is flat and at rest.
    wanted = torch.tensor([0.0, 8 / 9 * ARCH, 8 / 9 * ARCH, 0.0], dtype=F64)
    torch.testing.assert_close(height, wanted, atol=1e-3, rtol=0)


def test_a_held_vertex_follows_and_one_that_was_let_go_does_not():
    run = worlds(led(7, 0, (0.0, 0.0, 0.004)))
    way = run[7].tool.pos[0, 0] - run[4].tool.pos[0, 0]
    # Actions of a hand on its way count for nothing: three of them lift, after it has closed.
    torch.testing.assert_close(way[2], torch.tensor(0.012, dtype=F64), atol=2e-4, rtol=0)
    moved = run[7].state.rods.pos[0] - run[4].state.rods.pos[0]
    torch.testing.assert_close(moved[2], way, atol=1e-9, rtol=0)
    assert moved[0, 2] < 0.5 * way[2]


def test_turns_of_a_hand_on_its_way_count_for_nothing():
    actions = torch.zeros(5, 12, dtype=F64)
    plain = worlds(actions)
    # Both hands travel in the first three of the actions that tell them to turn.
    actions[1:5, 6:] = 0.1
    turned = worlds(actions)
    for a, b in zip(plain[:5], turned[:5], strict=True):
        torch.testing.assert_close(b.target.quat, a.target.quat, rtol=0, atol=0)
    # Half of a turn of 0.1 degrees about three axes is 1.5e-3 rad.
    assert ((turned[5].target.quat - plain[5].target.quat).norm(dim=-1) > 1e-3).all()


def test_a_hand_that_does_not_get_there_stays_open():
    made = episode.prepare(Passing(), 1, like=torch.zeros((), dtype=F64), execution="eager")
    world = tree.replace(made.start, count=made.start.count + 4)
    far = world.tool.pos + world.tool.pos.new_tensor([[0.0, 0.0, 2e-2], [0.0, 0.0, 0.0]])
    world = tree.replace(world, tool=tree.replace(world.tool, pos=far))
    with torch.no_grad():
        world = episode.act(made, world, torch.zeros(1, 12, dtype=F64))
        again = episode.act(made, world, torch.zeros(1, 12, dtype=F64))
    assert world.seen(2).closed.flatten().tolist() == [0, 1]
    assert again.seen(2).closed.flatten().tolist() == [0, 1]


def test_scenes_of_a_batch_may_be_in_different_stages():
    actions = led(6, 0, (0.0, 0.002, 0.003)) + led(6, 1, (0.001, 0.0, 0.002))
    run = worlds(actions)
    made = episode.prepare(Passing(), 2, like=torch.zeros((), dtype=F64), execution="eager")
    both = tree.map(lambda a, b: torch.cat([a, b]), run[1], run[4])
    with torch.no_grad():
        for k in range(2):
            both = episode.act(made, both, actions[[1 + k, 4 + k]])
    for k, alone in enumerate((run[3], run[6])):
        torch.testing.assert_close(both.state.rods.pos[k], alone.state.rods.pos[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(both.seen(2).closed[k], alone.seen(2).closed[0])


def test_gradients_go_through_a_change_of_hands():
    made = episode.prepare(Passing(), 1, like=torch.zeros((), dtype=F64), execution="eager")
    actions = (led(7, 0, (0.0001, 0.0002, 0.0003)) + led(7, 1, (0.0, 0.0002, 0.0004)))[None].requires_grad_()
    outcome = episode.play(Passing(), actions, episode=made)
    (gradient,) = torch.autograd.grad(outcome.loss.sum(), actions)
    # On its way the hand is led by the rope, not by its actions.
    assert (gradient[0, 1:4, :3] == 0).all() and (gradient[0, [0, 4, 5, 6], :3].abs().amax(-1) > 0).all()
    way = torch.cos(torch.arange(gradient.numel(), dtype=F64)).reshape(gradient.shape)
    way[..., 6:] = 0.0
    step = 1e-7
    with torch.no_grad():
        up, down = (episode.play(Passing(), actions + sign * step * way, episode=made).loss.sum() for sign in (1, -1))
    # Central differences: the error of the gradient is step^2 of the third derivative, and rounding over the step.
    rounding = 1e3 * torch.finfo(F64).eps * float(up.abs() + 1) / step
    torch.testing.assert_close((gradient * way).sum(), (up - down) / (2 * step), rtol=1e-3, atol=rounding)


def test_the_reference_of_a_task_with_stages_is_made_stage_by_stage():
    @dataclass(frozen=True)
    class Led(Passing):
        """With a way."""

        def stage_waypoints(self):
            """Return a way that only uses the second stage."""
            return [[], [[(0.02, 0.0, 0.0), (0.0, 0.0, 0.0)]], []]

    actions = Led().demonstration()
    assert actions.shape == (8, 12)
    assert actions.any(-1).nonzero().flatten().tolist() == [4, 5]


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        ((Stage(1, (0,)),), "the first begins with action 1"),
        ((Stage(0, (0,)), Stage(2, (1,))), r"has to begin 3 actions later or more"),
        ((Stage(0, (0,)), Stage(3, (1, 2))), r"they say what \[1, 2\] hands hold"),
        ((Stage(0, (0, 1)), Stage(3, (1, 0))), r"vertices \[0, 1\] are held by several hands"),
    ],
)
def test_stages_that_do_not_fit_are_refused(stages, words: str):
    with pytest.raises(InputError, match=words):
        Schedule(stages, 3)


def test_tasks_without_stages_hold_what_they_start_at():
    task = dataclasses.replace(Passing())
    plan = Schedule((Stage(0, task.arms.vertex),), 3)
    assert plan.held == (0, 5) and plan.tools == (0, 1) and plan.room == 1 and plan.actions(8) == [8]


@pytest.mark.parametrize("name", ["letter_art", "wiring_ring"])
def test_arms_can_go_the_way_by_hand_of_tasks_with_stages(name: str):
    # Without physics, as ropes lie at the start: where hands go to take them differs, where they lead them does not.
    task = TASKS[name]()
    made = dataclasses.replace(episode.prepare(task, 1, execution="eager"), step=lambda params, state, control: state)
    world, plan = made.start, task.schedule
    with torch.no_grad():
        for action in task.demonstration().float()[:, None]:
            aim = episode._aim(task, world, action)
            want = plan.steer(world.count, world.target, aim, world.state.rods.pos).pos
            world = episode.act(made, world, action)
            # What counts as there is 0.1 mm away at most.
            torch.testing.assert_close(world.tool.pos, want, atol=1.1e-4, rtol=0)
