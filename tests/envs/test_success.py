"""Conditions of success, on shapes that are made to be right and on others that are not quite."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch

from torchdlo.coupling.common.pose import Pose
from torchdlo.envs import TASKS
from torchdlo.envs.assets.rigid_objects import c_ring
from torchdlo.envs.core import curve_geometry
from torchdlo.envs.core.task import Task, TaskState, resample_evenly, straight
from torchdlo.envs.tasks import letter_art as letters
from torchdlo.envs.tasks import wiring_post as wiring
from torchdlo.envs.tasks.lifting import distance_into_ring
from torchdlo.physics import tree

pytestmark = pytest.mark.quick

F64 = torch.float64


@functools.cache
def first(name: str):
    """The scene of a task at its start."""
    return TASKS[name]().start(1, like=torch.zeros((), dtype=F64))[2]


def judged(
    name: str, *shapes: torch.Tensor, notes: dict | None = None, bodies: list | None = None, material_points=None
):
    """Whether a task has succeeded with each of some shapes of its ropes (V, 3), and positions of its bodies."""
    state, task = first(name), TASKS[name]()
    count = max(len(shapes), len(bodies or ()))
    state = tree.map(lambda x: x.expand(count, *x.shape[1:]).clone(), state)
    if shapes:
        state = tree.replace(state, rods=tree.replace(state.rods, pos=torch.stack(shapes)))
    if bodies:
        state = tree.replace(state, bodies=tree.replace(state.bodies, pos=torch.stack(bodies)))
    if material_points is not None:
        state = tree.replace(state, material_points=tree.replace(state.material_points, pos=material_points))
    arms = task.arms.count
    tool = Pose(torch.zeros(count, arms, 3, dtype=F64), torch.zeros(count, arms, 4, dtype=F64))
    seen = TaskState(state, tool, torch.ones(count, arms, 1, dtype=F64), notes or {})
    if notes is None:
        seen = tree.replace(seen, notes=task.note(seen))
    done, short = task.success(seen), task.terminal_cost(seen)
    if type(task).terminal_cost is not Task.terminal_cost:
        assert (short >= 0).all() and (done | (short > 0)).all()
    return done.tolist()


def helix(turns: float, off: float, count: int = 60) -> torch.Tensor:
    """A rope round the cone at a distance from its flank, rising."""
    dense = torch.linspace(0, 1, 4000, dtype=F64)
    height = 0.02 + 0.1 * dense
    radius = 0.12 * (1 - height / 0.30) + off
    angle = 2 * math.pi * turns * dense
    return resample_evenly(torch.stack([radius * angle.cos(), radius * angle.sin(), height], -1), count)


def test_coiling_takes_a_whole_turn_near_the_cone():
    assert judged("coiling", helix(1.1, 0.02), helix(-1.1, 0.02), helix(0.9, 0.02), helix(1.5, 0.12)) == [
        True,
        True,
        False,
        False,
    ]


def test_wiring_takes_the_right_sides_of_both_posts():
    goal = wiring.goal_vertices()
    mirrored = goal * goal.new_tensor([1.0, -1.0, 1.0]) + goal.new_tensor([0.0, 0.4, 0.0])
    line = torch.stack([torch.linspace(0.62, 0.04, 30, dtype=F64), torch.full((30,), 0.2, dtype=F64)], -1)
    line = torch.cat([line.flip(0), torch.full((30, 1), 0.01, dtype=F64)], -1)
    near = goal + goal.new_tensor([0.0, 0.0, 0.005])
    far = goal + goal.new_tensor([0.0, 0.0, 0.03])
    assert judged("wiring_post", goal, near, far, line, mirrored) == [True, True, False, False, False]


def band(points: list[tuple[float, float]], height: float = 0.02) -> torch.Tensor:
    """A loop of 50 vertices about some points in the plane, its first vertex not repeated."""
    corners = torch.tensor([*points, points[0]], dtype=F64)
    dense = torch.cat(
        [torch.lerp(a, b, torch.linspace(0, 1, 500, dtype=F64)[:, None]) for a, b in itertools.pairwise(corners)]
    )
    flat = resample_evenly(torch.cat([dense, torch.full((len(dense), 1), height, dtype=F64)], -1), 51)
    return flat[:-1]


def triangle(wider: float, longer: float = 1.0) -> list[tuple[float, float]]:
    """The corners of a triangle about the three posts, `wider` outside of their axes, or some times as long."""
    posts = torch.tensor([(0.45, -0.115), (0.45, 0.115), (0.25, 0.0)], dtype=F64)
    middle = posts.mean(0)
    arms = posts - middle
    arms = longer * arms * (1 + wider / arms.norm(dim=-1, keepdim=True))
    return [tuple(p) for p in (middle + arms).tolist()]


def two_of_three() -> list[tuple[float, float]]:
    """The corners of a triangle about two of the posts."""
    return [*triangle(0.024)[:2], (0.32, 0.0)]


@pytest.mark.parametrize(
    ("name", "good", "worse"),
    [
        ("coiling", helix(1.1, 0.02), (helix(0.9, 0.02), helix(0.5, 0.02), helix(0.5, 0.12))),
        (
            "wiring_post",
            wiring.goal_vertices(),
            tuple(wiring.goal_vertices() + step * torch.eye(3)[2] for step in (0.02, 0.03, 0.05)),
        ),
        (
            "wrapping",
            band(triangle(0.024)),
            (band(triangle(0.024), 0.09), band(two_of_three()), band([(0.55, -0.1), (0.55, 0.1), (0.75, 0.0)])),
        ),
    ],
)
def test_the_further_from_success_the_more_is_lacking(name, good, worse):
    state = tree.map(lambda x: x.expand(len(worse) + 1, *x.shape[1:]).clone(), first(name))
    x = torch.stack([good, *worse]).requires_grad_()
    seen = TaskState(tree.replace(state, rods=tree.replace(state.rods, pos=x)), None, None, {})
    short = TASKS[name]().terminal_cost(seen)
    assert short[0] == 0 and (short.diff() > 0).all()
    (gradient,) = torch.autograd.grad(short.sum(), x)
    assert torch.isfinite(gradient).all() and not gradient[0].any() and gradient[1:].flatten(1).any(1).all()


def test_the_goal_of_wiring_is_where_the_task_says():
    goal = wiring.goal_vertices()
    step = (goal[1:] - goal[:-1]).norm(dim=-1)
    # Chords of an arc of 3 cm that are 2 cm along it: 2 r sin(s / 2 r) = 1.963 cm.
    assert float(step.min()) > 0.0196 and float(step.max()) < 0.02 + 1e-6
    assert float((goal[15, :2] - goal.new_tensor(wiring.MIDDLE)).norm()) < 0.005
    for post, side in zip(wiring.POSTS, (-1, 1), strict=True):
        apart = (goal[:, :2] - goal.new_tensor(post)).norm(dim=-1)
        assert float(apart.min()) == pytest.approx(wiring.CLEAR, abs=1.7e-3)
        assert side * float(goal[apart.argmin(), 1] - post[1]) > 0


def test_wrapping_takes_all_three_posts():
    out, wide = triangle(0.024), triangle(0.0, 1.6)
    assert judged("wrapping", band(out), band(out).flip(0), band(two_of_three()), band(wide), band(out, 0.08)) == [
        True,
        True,
        False,
        False,
        False,
    ]


def test_separation_takes_room_between_the_ropes():
    along = torch.arange(30, dtype=F64) * 0.02
    one = torch.stack([along, 0 * along, 0.01 + 0 * along], -1)

    def other(gap: float, gradient: float) -> torch.Tensor:
        return torch.cat([one, one + torch.stack([0 * along, gap + gradient * along, 0 * along], -1)])

    shapes = [other(0.06, 0.0), other(0.04, 0.0), other(-0.06, 0.2), first("separation").rods.pos[0]]
    assert judged("separation", *shapes) == [True, False, False, False]


def test_unknotting_takes_more_than_an_unknotted_rope():
    along = torch.arange(50, dtype=F64) * 0.02
    line = torch.stack([along, 0 * along, 0.01 + 0 * along], -1)
    # A loop of a long cycloid: one crossing, no knot.
    angle = torch.linspace(-2.8, 2.8, 50, dtype=F64)
    curl = torch.stack([0.04 * angle - 0.1 * angle.sin(), 0.1 * angle.cos(), 0.05 + 0.01 * angle], -1)
    assert judged("unknotting", line, curl, first("unknotting").rods.pos[0]) == [True, False, False]


def test_slingshot_takes_a_hit():
    start = first("slingshot").bodies.pos[0]

    def moved(ball: float, cube: float) -> torch.Tensor:
        return start + start.new_tensor([[0, 0, 0], [0, ball, 0], [0, cube, 0.0]])

    assert judged("slingshot", bodies=[moved(0.1, 0.06), moved(0.1, 0.04), moved(0.0, 0.06)]) == [True, False, False]


def test_lifting_takes_both_rings_for_a_while():
    heights = torch.full((4, 5, 2), 0.115, dtype=F64)
    heights[1, 0, 1] = 0.105  # fell below within the last 0.1 s
    heights[2, :, 0] = 0.06
    heights[3] = 0.11 + 1e-9
    shapes = [first("lifting").rods.pos[0]] * 4
    assert judged("lifting", *shapes, notes={"heights": heights}) == [True, False, False, True]


def test_the_way_into_a_ring_leads_over_it_and_through_its_gap():
    degrees = torch.tensor([0.0, 40.0, 60.0, 90.0, 135.0, 180.0, 225.0, 300.0], dtype=F64)
    angle = torch.deg2rad(degrees)
    round_it = torch.stack([-angle.cos(), angle.sin()], -1)
    way = distance_into_ring(0.1 * round_it)
    # From the gap straight to where the rope touches the top of the hole; from elsewhere along the ring's outside to an
    # end of the gap, 45 degrees from its middle, and on from there as far out.
    out, top = 0.045 + 0.012 + 0.01, way.new_tensor([0.0, 0.045 - 0.012 - 0.01])
    end = way.new_tensor([-math.sqrt(0.5), math.sqrt(0.5)])
    begin = torch.where((degrees > 45)[:, None], end, round_it)
    expected = (0.1 * begin - top).norm(dim=-1) + out * torch.deg2rad((degrees - 45).clamp(min=0))
    assert torch.allclose(way, expected)
    assert (
        torch.allclose(distance_into_ring(0.02 * round_it), (0.02 * round_it - top).norm(dim=-1))
        and float(distance_into_ring(top)) < 1e-9
    )
    middle = torch.zeros(1, 2, dtype=F64, requires_grad=True)
    assert torch.isfinite(torch.autograd.grad(distance_into_ring(middle).sum(), middle)[0]).all()


def test_lifting_lacks_less_in_front_of_the_gaps_than_behind_the_rings_and_nothing_in_raised_ones():
    state = tree.map(lambda x: x.expand(5, *x.shape[1:]).clone(), first("lifting"))
    x = straight((0.3, 0.0, 0.06), 30, state.rods.pos.new_zeros(5, 3))
    x[:, :, 1] = x.new_tensor([0.1, -0.1, 0.0, 0.0, 0.0])[:, None]
    x[:, :, 2] += x.new_tensor([0.0, 0.0, 0.0, 0.023, 0.073])[:, None]
    bodies = state.bodies.pos.clone()
    bodies[4, 1:, 2] += 0.05
    seen = TaskState(tree.replace(state, rods=tree.replace(state.rods, pos=x)), None, None, {})
    seen = tree.replace(seen, state=tree.replace(seen.state, bodies=tree.replace(state.bodies, pos=bodies)))
    short = TASKS["lifting"]().terminal_cost(seen)
    assert (short.diff() < 0).all() and short[3:].tolist() == pytest.approx([40.0, 0.0])


def test_gathering_takes_objects_together_and_hands_clear():
    state = first("gathering")
    shapes = [state.rods.pos[0]] * 3
    ball = (
        state.material_points.pos[0]
        - state.material_points.pos[0].mean(0)
        + state.rods.pos.new_tensor([0.2, 0.0, 0.05])
    )
    plane = state.bodies.pos[0, 0]
    close = torch.stack([plane, plane.new_tensor([0.3, 0.0, 0.03]), plane.new_tensor([0.2, 0.11, 0.03])])
    apart = torch.stack([plane, plane.new_tensor([0.3, 0.0, 0.03]), plane.new_tensor([0.2, 0.18, 0.03])])
    notes = {"closest": torch.tensor([0.07, 0.07, 0.05], dtype=F64)}
    material_points = ball.expand(3, *ball.shape)
    assert judged("gathering", *shapes, notes=notes, bodies=[close, apart, close], material_points=material_points) == [
        True,
        False,
        False,
    ]


def test_the_further_objects_are_apart_and_the_nearer_hands_the_more_is_lacking():
    state = tree.map(lambda x: x.expand(4, *x.shape[1:]).clone(), first("gathering"))
    ball = (
        state.material_points.pos[0]
        - state.material_points.pos[0].mean(0)
        + state.rods.pos.new_tensor([0.2, 0.0, 0.05])
    )
    bodies = state.bodies.pos.clone()
    bodies[:, 1] = bodies.new_tensor([0.3, 0.0, 0.03])
    bodies[:, 2] = bodies.new_tensor([0.2, 0.11, 0.03])
    bodies[1:3, 2, 1] += bodies.new_tensor([0.03, 0.06])
    bodies.requires_grad_()
    state = tree.replace(state, bodies=tree.replace(state.bodies, pos=bodies))
    state = tree.replace(state, material_points=tree.replace(state.material_points, pos=ball.expand(4, *ball.shape)))
    closest = torch.tensor([0.07, 0.07, 0.07, 0.05], dtype=F64, requires_grad=True)
    short = TASKS["gathering"]().terminal_cost(TaskState(state, None, None, {"closest": closest}))
    assert short[0] == 0 and 0 < short[1] < short[2] and short[3] > 0
    moved, nearer = torch.autograd.grad(short.sum(), [bodies, closest])
    assert moved.flatten(1).any(1).tolist() == [False, True, True, False] and nearer.nonzero().tolist() == [[3]]


def test_c_rings_have_the_mass_of_their_parts_and_stand():
    ring = c_ring()
    # Three quarters of a torus with round ends, and a box; they overlap in a thin slice, counted in cells of 1.5 mm.
    tube = 2 * math.pi**2 * 0.045 * 0.012**2 * 0.75 + 4 / 3 * math.pi * 0.012**3
    box = 0.04 * 0.06 * 0.008
    assert float(ring.volume) == pytest.approx(tube + box, rel=0.05)
    assert abs(float(ring.centre[0])) < 1e-6
    # The centre of mass is above the foot.
    assert abs(float(ring.centre[1])) < 0.03


def led_through(*corners: tuple[float, float, float], count: int = 30) -> torch.Tensor:
    """A rope of 2 cm per edge from its lead end along some corners, straight on behind the last one."""
    points = torch.tensor(corners, dtype=F64)
    away = points[-1] - points[-2]
    points = torch.cat([points, points[-1:] + away / away.norm()])
    dense = torch.cat(
        [torch.lerp(a, b, torch.linspace(0, 1, 2000, dtype=F64)[:, None]) for a, b in itertools.pairwise(points)]
    )
    along = torch.cat([dense.new_zeros(1), (dense[1:] - dense[:-1]).norm(dim=-1).cumsum(0)])
    return dense[torch.searchsorted(along, 0.02 * torch.arange(count, dtype=F64))]


def test_wiring_takes_both_rings_in_order():
    turn, behind = (0.09, 0.0, 0.05), (0.4, 0.0, 0.05)
    good = led_through((0.09, -0.301, 0.05), turn, behind)
    short = led_through((0.09, -0.299, 0.05), turn, behind)
    first_only = led_through((0.2, -0.31, 0.05), (0.2, 0.0, 0.05), behind)
    above = led_through((0.09, -0.31, 0.1), (0.09, 0.0, 0.1), (0.4, 0.0, 0.1))
    # Out of the first ring at its far side, having come through the second: both rings, the wrong one first.
    wrong = led_through((0.3, 0.02, 0.05), (0.25, 0.0, 0.05), (0.09, -0.2, 0.05), (0.09, -0.4, 0.05))
    notes = {"tool": torch.zeros(5, 2, 3, dtype=F64), "through": torch.zeros(5, dtype=torch.bool)}
    shapes = [good, short, first_only, above, wrong]
    assert judged("wiring_ring", *shapes, notes=notes) == [True, False, False, False, False]


def test_a_hand_that_goes_through_a_ring_has_failed():
    task, state = TASKS["wiring_ring"](), first("wiring_ring")
    state = tree.map(lambda x: x.expand(3, *x.shape[1:]), state)
    quat = torch.zeros(3, 2, 4, dtype=F64)
    before = torch.tensor([0.28, 0.0, 0.05], dtype=F64).expand(3, 2, 3)
    # Through the hole, through the tube, over the ring.
    after = before.clone()
    after[:, 1] = torch.tensor([[0.26, 0.0, 0.05], [0.26, 0.04, 0.05], [0.26, 0.0, 0.15]], dtype=F64)
    closed = torch.ones(3, 2, 1, dtype=F64)
    seen = TaskState(state, Pose(before, quat), closed, {})
    seen = TaskState(state, Pose(after, quat), closed, task.note(seen))
    seen = tree.replace(seen, notes=task.note(seen))
    assert task.failed(seen).tolist() == [True, True, False]


def test_letters_are_taken_in_their_places():
    goal = torch.cat(letters.goal_vertices())
    off = torch.zeros_like(goal)
    off[:, 1] = 0.0074  # each vertex at most that far from its goal, both ways: at most 1.48 cm in all
    aside, apart = goal + off, goal.clone()
    # The L is a wire of its own: 2 cm beside its place, its mean distance is more than 1.5 cm on the long leg's side.
    apart[54:] += goal.new_tensor([0.015, 0.015, 0.0])
    shapes = [goal, aside, apart, first("letter_art").rods.pos[0]]
    assert judged("letter_art", *shapes) == [True, True, False, False]


def test_letters_are_rounded_where_posts_are():
    for corners, goal, count in zip(letters.CORNERS, letters.goal_vertices(), letters.COUNTS, strict=True):
        _, centres = letters.round_corners(corners)
        dense = curve_geometry.distances(centres, letters.round_corners(corners)[0])
        for away in dense:
            # A circle of that radius about the post touches the curve from within.
            assert float(away.min()) == pytest.approx(letters.ROUND, rel=1e-9)
        step = (goal[1:] - goal[:-1]).norm(dim=-1)
        # Chords of 2 cm along arcs of 3 cm: 2 r sin(s / 2 r) = 1.963 cm.
        assert len(goal) == count and float(step.min()) > 0.0196 and float(step.max()) < 0.02 + 1e-6
