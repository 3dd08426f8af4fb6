"""Ways by hand: arms can go them, and they lead to success."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.coupling.robot.attachment import Hands
from torchdlo.envs import TASKS
from torchdlo.envs.core import curve_geometry, episode, reach
from torchdlo.envs.core.task import Task, actions_through
from torchdlo.envs.tasks.gathering import GatheringSurrogate
from torchdlo.physics import tree
from torchdlo.physics.execution.tracing import record

LED = [name for name in TASKS if TASKS[name]().waypoints()]
TURNED = math.radians(45)


@pytest.mark.parametrize("name", LED)
def test_arms_can_go_the_way_by_hand(name: str) -> None:
    task = TASKS[name]()
    scene, _, state = task.start(1)
    fixed = len(scene.prescribed_vertices) - task.arms.count
    world = episode._begin(task, scene, state, Hands(task.arms.count, (*range(task.arms.count), *[-1] * fixed)))
    actions, want = task.demonstration().float()[:, None], world.target.pos
    actions = actions[actions.any(-1).flatten()]  # without those that stay
    with torch.no_grad():
        for action in actions:
            want = want + episode.limit_action(task, action)[0]
            found = reach.solve_reach(task, episode._aim(task, world, action), world.joints, reach.FOLLOW)
            assert found.converged.all()
            world = tree.replace(world, joints=found.joints, target=found.handed, tool=found.pose)
    # What counts as there is 0.1 mm away at most; targets add up in single precision.
    torch.testing.assert_close(world.tool.pos, want, atol=2e-4, rtol=0)


@pytest.mark.parametrize("name", LED)
def test_ways_by_hand_fit_into_the_episode_from_all_starts(name: str) -> None:
    task, sign = TASKS[name](), torch.tensor([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 0.0]])
    moved = torch.nn.functional.pad(sign[:, None] * torch.tensor(task.reset_noise), (0, 1))
    start = task.build(moved)[2]
    tools = start.rods.pos[:, list(task.arms.vertex)].double()
    actions = task.demonstration(start)
    assert actions.shape == (5, task.horizon, task.width)
    torch.testing.assert_close(actions[4], task.demonstration())
    ends = tools + actions.sum(-2).unflatten(-1, (2, -1, 3))[:, 0]
    want = ends[4] if task.anchored else ends[4] + tools - tools[4]
    # Starts are in single precision.
    torch.testing.assert_close(ends, want.expand_as(ends), atol=1e-6, rtol=0)


def test_ways_by_hand_take_steps_as_long_as_the_task_allows() -> None:
    @dataclasses.dataclass(frozen=True)
    class Slow(TASKS["coiling"]):
        """With half the reach."""

        horizon: int = 200
        max_translation: ClassVar[float] = 0.005

    usual, slow = (task.demonstration().unflatten(-1, (2, 3))[:, 0] for task in (TASKS["coiling"](), Slow()))
    assert 0.0045 < slow.norm(dim=-1).max() <= 0.005 + 1e-12
    torch.testing.assert_close(slow.sum(0), usual.sum(0))


def test_ways_by_hand_are_made_on_the_device_of_the_start() -> None:
    off = torch.zeros(1, 3, device="cpu")
    # What is made without a device lands elsewhere and cannot be added.
    with torch.device("meta"):
        assert actions_through([[(0.03, 0.0, 0.0)]], 6, off).device.type == "cpu"


@pytest.mark.parametrize("name", ["lifting", "separation", "wiring_post"])
def test_arms_begin_with_elbow_and_wrist_in_line(name: str) -> None:
    # These arms face what they hold, with tools straight down: a plane arm does it, with nothing turned sideways.
    # Postures at which elbow and forearm are turned by 90 degrees and more reach it too, but soon meet their limits.
    task = TASKS[name]()
    scene, _, state = task.start(1)
    world = episode._begin(task, scene, state, Hands(task.arms.count, tuple(range(task.arms.count))))
    assert world.joints[..., [2, 4]].abs().max() < TURNED


def test_the_rehearsal_of_gathering_has_objects_as_heavy_and_where_they_are() -> None:
    task = TASKS["gathering"]()
    (_, real, start), (_, drums, begun) = task.start(1), task.surrogate().start(1)
    ball = float((real.material_points.volume * next(iter(real.material_points.laws.values()))["density"]).sum())
    masses = [ball, *real.bodies.mass[..., 1:, 0].flatten().tolist()]
    assert drums.bodies.mass[..., 1:, 0].flatten().tolist() == pytest.approx(masses, rel=0.02)
    places = torch.cat([start.material_points.pos.mean(-2, keepdim=True), start.bodies.pos[:, 1:]], -2)
    torch.testing.assert_close(begun.bodies.pos[:, 1:, :2], places[..., :2], atol=4e-3, rtol=0)
    assert task.surrogate().surrogate() is None and task.surrogate().horizon == task.horizon


def led(task: Task, count: int, moved: tuple[float, float] = (0.0, 0.0)) -> episode.EpisodeResult:
    """What the first actions of the scripted demonstration come to, from a start that is moved in x and y."""
    made = episode.prepare(task, 1, execution="eager")
    start = task.build(torch.tensor([*moved, 0.0]).expand(1, len(task.reset_noise), 3))[2]
    control = scenes.stationary_control(made.scene, start)
    attachment_weight = {
        "vertices": torch.ones_like(control.pos[..., :1]),
        "edges": torch.ones_like(control.director[..., :1]),
    }
    step = record(made.step, made.params, start, tree.replace(control, attachment_weight=attachment_weight))
    actions = task.demonstration(start)[:, :count].float()
    with torch.no_grad():
        made = dataclasses.replace(made, step=step, start=episode.begin(made, start))
        return episode.play(task, actions, episode=made)


@pytest.mark.slow
def test_the_way_by_hand_takes_hooked_ropes_apart() -> None:
    # Of 94 actions on the way 60 bring the hands 85 cm further apart, more than the 58 cm of a rope.
    assert led(TASKS["separation"](), 60).success.all()


def test_the_way_by_hand_coils_a_rope() -> None:
    # The start that is nearest to the cone is on its way for 87 actions.
    assert led(TASKS["coiling"](), 87, (0.05, -0.01)).success.all()


def test_the_way_by_hand_takes_an_end_out_of_the_knot() -> None:
    # After 32 actions the first hand is beyond the second strand; then what is left has crossings, but no knot.
    found = led(TASKS["unknotting"](), 32)
    assert not found.failed.any()
    assert (curve_geometry.knot_determinant(found.world.state.rods.pos) == 1).all()


def test_the_way_by_hand_shoots_the_ball_at_the_cube() -> None:
    # The band slips out of the fingers in action 10; scenes lie still from the start, up to the sag of the band.
    assert led(dataclasses.replace(TASKS["slingshot"](), settle_steps=0), 10).success.all()


@pytest.mark.slow
def test_the_way_by_hand_gathers_drums() -> None:
    # The way takes 72 actions; hands then wait.
    assert led(GatheringSurrogate(), 75).success.all()


@pytest.mark.slow
def test_the_way_by_hand_lifts_rings_by_their_arches() -> None:
    # The last leg, upwards, begins with action 46; after two more the rope is 3 mm below the arches, straight.
    task = TASKS["lifting"]()
    made = episode.prepare(task, 1, execution="eager")
    rods, hands = made.start.state.rods, list(task.arms.vertex)
    ends = rods.pos[:, hands] + torch.tensor(task.waypoints()[3]) + torch.tensor([0.0, 0.0, 0.02])
    share = (torch.arange(rods.pos.shape[-2]) - hands[0]) / (hands[1] - hands[0])
    x = ends[:, :1] + share[:, None] * (ends[:, 1:] - ends[:, :1])
    start = tree.replace(made.start.state, rods=tree.replace(rods, pos=x))
    with torch.no_grad():
        made = dataclasses.replace(made, start=episode.begin(made, start))
        found = episode.play(task, task.demonstration()[None, 48:53].float(), episode=made)
    # Of 5 cm, the rope's tension of 2 N lets it sag by 1 cm under the rings' 0.14 N each, and it lags behind the hands.
    rise = found.world.notes["heights"][:, -1] - made.start.notes["heights"][:, -1]
    assert not found.failed.any() and (rise > 0.01).all()
