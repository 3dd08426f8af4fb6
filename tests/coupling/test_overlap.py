"""Ropes that start inside of something are moved out of it before the first step, or refused, not thrown."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene import RigidBody, Rope, make

F64 = torch.float64


def highest(bodies, choices, seconds: float, depth: float) -> tuple[float, float]:
    """Greatest height of a rope of radius 3 mm that starts with its axis `depth` below z = 0, and its last one [m]."""
    x = torch.zeros(21, 3, dtype=F64)
    x[:, 0] = torch.linspace(-0.1, 0.1, 21, dtype=F64)
    x[:, 2] = -depth
    effects = [EFFECTS["bend"](), EFFECTS["gravity"](), RodBody()]
    made, params, state = make([Rope(x, radius=0.003, mass=0.01, bend=1e-4)], effects, bodies=bodies, **choices)
    step, control, most = scene.stepper(made, execution="recorded"), scene.stationary_control(made, state), 0.0
    with torch.no_grad():
        for _ in range(round(seconds / made.dt)):
            state = step(params, state, control)
            most = max(most, float(state.rods.pos[:, 2].max()))
    assert bool(scene.ok(state))
    return most, float(state.rods.pos[:, 2].mean())


STEPS = {
    "explicit": {"dt": 1e-3, "substeps": 5},
    "implicit": {"integrator": "implicit", "dt": 2e-3, "substeps": 1},
}


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize(
    "body",
    [
        RigidBody("plane", motion="fixed"),
        RigidBody("box", (0.2, 0.2, 0.05), pos=(0.0, 0.0, -0.05), motion="fixed"),
    ],
    ids=["plane", "box"],
)
def test_a_rope_that_starts_inside_of_a_body_is_moved_out_of_it_and_not_thrown(steps, body):
    # It rose by 6.6 m from a plane, and 14.6 m from a box, in explicit steps.
    most, last = highest([body], STEPS[steps], 0.1, 0.004)
    assert most < 0.003 + 1e-3 and last == pytest.approx(0.003, abs=6e-4)


def test_a_shallow_overlap_is_left_to_the_steps():
    most, last = highest([RigidBody("plane", motion="fixed")], STEPS["explicit"], 0.1, -0.0028)
    assert most < 0.003 + 0.003 and last == pytest.approx(0.003, abs=1e-4)


def test_a_rope_that_is_held_does_not_keep_another_one_from_sliding_out():
    apart = [
        torch.stack([torch.linspace(-0.1, 0.1, 21, dtype=F64), torch.full((21,), y, dtype=F64)], -1) for y in (0, 1)
    ]
    held, loose = (Rope(torch.nn.functional.pad(x, (0, 1), value=-0.002), radius=0.003, mass=0.01) for x in apart)
    bodies = [RigidBody("plane", motion="fixed")]
    _, _, state = make([held, loose], [RodBody()], bodies=bodies, prescribed_vertices=(0,), **STEPS["explicit"])
    # The loose one has slid out as it is, straight; the held one is bent out, but for the edge beside its hold.
    torch.testing.assert_close(state.rods.pos[21:, 2], torch.full((21,), 0.003, dtype=F64), atol=1e-5, rtol=0)
    assert float(state.rods.pos[0, 2]) == -0.002 and float(state.rods.pos[2:21, 2].min()) > 0.003 - 3e-4


def line(start: tuple[float, ...], end: tuple[float, ...]) -> Rope:
    s = torch.linspace(0, 1, 21, dtype=F64)[:, None]
    x = torch.tensor(start, dtype=F64) * (1 - s) + torch.tensor(end, dtype=F64) * s
    return Rope(x, radius=0.003, mass=0.01, bend=1e-4)


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("height", [0.005, 0.0], ids=["off centre", "through the centre"])
def test_ropes_that_start_in_each_other_are_moved_apart_and_stay_at_rest(steps, height):
    ropes = [line((-0.1, 0, 0), (0.1, 0, 0)), line((0, -0.1, height), (0, 0.1, height))]
    made, params, state = make(ropes, [EFFECTS["bend"](), RodContact()], **STEPS[steps])
    pos = state.rods.pos
    # Each by half of the overlap, without a change of shape.
    assert float((pos[10] - pos[31]).norm()) == pytest.approx(0.006, rel=2e-3)
    moved = torch.cat([pos[:21] - ropes[0].positions, pos[21:] - ropes[1].positions]).norm(dim=-1)
    assert float(moved.max()) == pytest.approx(0.5 * (0.006 - height), rel=2e-2)
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(20):
            state = scene.step(made, params, state, control)
    # Surfaces that just touch part by less than sqrt(0.1 r) in implicit steps.
    assert float(state.rods.vel.norm(dim=-1).max()) < 0.02


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("height", [0.001, -0.01])
def test_a_rope_that_starts_inside_of_the_table_lies_on_it_and_is_not_thrown(steps, height):
    # It was thrown at 0.9 to 4 m/s.
    rope, effects = line((-0.1, 0, height), (0.1, 0, height)), [EFFECTS[k]() for k in ("bend", "gravity", "table")]
    made, params, state = make([rope], effects, **STEPS[steps])
    rest = 0.003 - 9.81 / 500**2
    torch.testing.assert_close(state.rods.pos[:, 2], torch.full((21,), rest, dtype=F64), atol=1e-5, rtol=0)
    control = scene.stationary_control(made, state)
    with torch.no_grad():
        for _ in range(10):
            state = scene.step(made, params, state, control)
            assert float(state.rods.vel.abs().max()) < 0.01


def test_a_rope_that_is_held_in_the_table_is_refused_with_its_depth():
    rope, effects = line((-0.1, 0, -0.02), (0.1, 0, -0.02)), [EFFECTS[k]() for k in ("bend", "gravity", "table")]
    with pytest.raises(ValueError, match=r"rope 0 in the table starts 23 mm deep, and cannot be moved out"):
        make([rope], effects, prescribed_vertices=(0, 20))


def test_a_rope_where_it_rests_on_the_table_stays_there():
    # It rests a quarter of its radius deep: that is where the table carries it.
    x = line((-0.1, 0, 0.15e-3 - 9.81 / 500**2), (0.1, 0, 0.15e-3 - 9.81 / 500**2)).positions
    effects = [EFFECTS[k]() for k in ("gravity", "table")]
    _, _, state = make([Rope(x, radius=0.15e-3, mass=1e-4)], effects)
    assert torch.equal(state.rods.pos, x)


def test_what_cannot_be_moved_out_is_refused_with_what_overlaps_and_how_deep():
    ball = RigidBody("sphere", (0.02,), motion="fixed", name="ball")
    rope, effects = line((-0.1, 0, 0.012), (0.1, 0, 0.012)), [EFFECTS["bend"](), RodBody()]
    with pytest.raises(ValueError, match="rope 0 in body 'ball' starts 11 mm deep, and cannot be moved out"):
        make([rope], effects, bodies=[ball], prescribed_vertices=(0, 20))
    make([rope], effects, bodies=[ball], prescribed_vertices=(0, 20), check=False)


def test_only_the_scenes_of_a_batch_that_overlap_are_moved_and_edges_keep_their_lengths():
    x = line((-0.1, 0, 0.003), (0.1, 0, 0.003)).positions
    x = torch.stack([x, x - torch.tensor([0, 0, 0.002], dtype=F64)])
    x[1, :, 2] += 1e-3 * torch.sin(30 * x[1, :, 0])
    rope = Rope(x, radius=0.003, mass=0.01, bend=1e-6)
    plane = [RigidBody("plane", motion="fixed")]
    _, params, state = make([rope], [EFFECTS["bend"](), RodBody()], bodies=plane, prescribed_vertices=(20,))
    pos = state.rods.pos
    assert torch.equal(pos[0], x[0]) and torch.equal(pos[1, 20], x[1, 20])
    assert float(pos[1, :19, 2].min()) > 0.003 * (1 - 2e-3) and float((pos[1] - x[1]).norm(dim=-1).max()) < 0.0045
    length = (pos[:, 1:] - pos[:, :-1]).norm(dim=-1)
    assert float((length / params.rods.rest.length[..., :-1, 0] - 1).abs().max()) < 1e-6


def test_a_rope_of_two_edges_has_nothing_to_touch_itself_with():
    x = torch.zeros(3, 3, dtype=F64)
    x[:, 0] = torch.linspace(0, 0.1, 3, dtype=F64)
    made, params, state = make([Rope(x, radius=0.003, mass=0.01, bend=1e-4)], [EFFECTS["bend"](), RodContact()])
    state = scene.step(made, params, state, scene.stationary_control(made, state))
    scene.check_state(state)
    assert torch.equal(state.rods.pos, x)
