"""Bodies that start inside of each other are moved apart before the first step, or refused, not thrown."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.coupling import BodyContact, RodBody
from torchdlo.coupling.bodies import contact_op
from torchdlo.physics.effects import Gravity
from torchdlo.scene import RigidBody, Rope, RopeJoint, make

F64 = torch.float64
STEPS = {
    "explicit": {"dt": 1e-3, "substeps": 5},
    "implicit": {"integrator": "implicit", "dt": 2e-3, "substeps": 1},
}
PLANE = RigidBody("plane", motion="fixed", name="plane")


def box(height, name: str = "box", **numbers) -> RigidBody:
    pos = torch.tensor([0.5, 0.0, 0.0], dtype=F64) + torch.tensor([0.0, 0.0, 1.0], dtype=F64) * height
    return RigidBody("box", (0.05, 0.05, 0.05), pos=pos, mass=1.0, name=name, **numbers)


def balls(depth: float, heavier: float = 1.0) -> list[RigidBody]:
    places = ((0.0, 0.0, 0.0), (0.1 - depth, 0.0, 0.0))
    return [
        RigidBody("sphere", 0.05, pos=pos, mass=mass, name=f"ball {k}")
        for k, (pos, mass) in enumerate(zip(places, (1.0, heavier), strict=True))
    ]


def made(bodies, acting=(), steps="implicit", **choices):
    x = torch.zeros(3, 3, dtype=F64)
    x[:, 0], x[:, 2] = torch.linspace(0, 0.2, 3, dtype=F64), 1.0
    rope = Rope(x, radius=0.003, mass=0.01)
    return make(
        [rope], [*acting, RodBody(), BodyContact()], bodies=bodies, prescribed_vertices=(0, 2), **STEPS[steps] | choices
    )


def fastest(given, steps: int) -> float:
    """Greatest speed of a body along an axis [m/s]."""
    static, params, state = given
    control, most = scene.stationary_control(static, state), 0.0
    with torch.no_grad():
        for _ in range(steps):
            state = scene.step(static, params, state, control)
            most = max(most, float(state.bodies.vel.abs().max()))
    scene.check_state(state)
    return most


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("depth", [0.004, 0.04])
def test_a_box_that_starts_in_a_plane_is_moved_onto_it_and_stays_at_rest(steps, depth) -> None:
    # It left at 1.6 to 20 m/s.
    given = made([PLANE, box(0.05 - depth)], [Gravity()], steps)
    expected = torch.tensor([0.5, 0.0, 0.05], dtype=F64)
    torch.testing.assert_close(given[2].bodies.pos[1], expected, atol=1e-5, rtol=0)
    assert fastest(given, 10) < 0.01


@pytest.mark.parametrize(("depth", "heavier"), [(0.004, 3.0), (0.09, 1.0)])
def test_two_balls_part_by_their_masses_and_stay_at_rest(depth, heavier) -> None:
    # They left at 0.8 and 22 m/s.
    given = made(balls(depth, heavier))
    share = heavier / (1 + heavier)
    expected = torch.tensor([-share * depth, 0.1 - share * depth], dtype=F64)
    torch.testing.assert_close(given[2].bodies.pos[:, 0], expected, atol=1e-6, rtol=0)
    assert fastest(given, 10) < 1e-3


def test_a_stack_is_moved_apart() -> None:
    given = made([PLANE, *(box(0.046 + 0.1 * k, f"box {k}") for k in range(3))], [Gravity()])
    expected = torch.tensor([0.05, 0.15, 0.25], dtype=F64)
    torch.testing.assert_close(given[2].bodies.pos[1:, 2], expected, atol=1e-5, rtol=0)
    assert fastest(given, 10) < 0.02


def test_what_cannot_be_parted_is_refused_with_the_pair_and_the_depth() -> None:
    with pytest.raises(ValueError, match="body 'box' in body 'plane' starts 80 mm deep, and cannot be moved out"):
        made([PLANE, box(-0.03)])
    with pytest.raises(ValueError, match="body 'box' in body 'floor' starts 20 mm deep"):
        floor = RigidBody("box", (0.5, 0.5, 0.05), pos=(0.5, 0.0, -0.05), motion="fixed", name="floor")
        lid = RigidBody("box", (0.5, 0.5, 0.05), pos=(0.5, 0.0, 0.13), motion="fixed", name="lid")
        made([floor, lid, box(0.03)])  # between a floor and a lid that are nearer than it is high


def test_a_body_that_a_rope_is_joined_to_stays_where_it_is() -> None:
    x = torch.zeros(5, 3, dtype=F64)
    x[:, 2] = torch.linspace(1.0, 0.096, 5, dtype=F64)
    x[:, 0] = 0.5
    ropes, joint = [Rope(x, radius=0.003, mass=0.01)], [RopeJoint(body="box", kind="ball")]
    effects, held = [Gravity(), BodyContact()], {"prescribed_vertices": (0,), **STEPS["implicit"]}
    with pytest.raises(ValueError, match=r"4 mm deep, and cannot .* what ropes are joined to stays where it is"):
        make(ropes, effects, bodies=[PLANE, box(0.046)], joints=joint, **held)
    # What is free of ropes moves out of it.
    side = RigidBody("sphere", 0.05, pos=(0.596, 0.0, 0.05), mass=1.0, name="ball")
    _, _, state = make(ropes, effects, bodies=[side, box(0.046)], joints=joint, **held)
    torch.testing.assert_close(state.bodies.pos[:, 0], torch.tensor([0.6, 0.5], dtype=F64), atol=1e-6, rtol=0)


def test_only_the_scenes_of_a_batch_that_overlap_are_moved() -> None:
    height = torch.tensor([[0.05], [0.046], [0.0495]], dtype=F64)
    _, _, state = made([PLANE, box(height)])
    assert state.bodies.pos[[0, 2], 1, 2].tolist() == [0.05, 0.0495]
    assert float(state.bodies.pos[1, 1, 2]) == pytest.approx(0.05, abs=1e-5)


@pytest.mark.parametrize("kernel", [True, False])
@pytest.mark.parametrize("steps", STEPS)
def test_overlaps_that_are_there_all_the_same_part_slowly(steps, kernel, monkeypatch) -> None:
    if not kernel:
        monkeypatch.setattr(contact_op, "ready", lambda *_: False)
    assert 0.05 < fastest(made([PLANE, box(0.01)], [Gravity()], steps, check=False), 5) < 0.1
    assert fastest(made(balls(0.09), steps=steps, check=False), 5) < 0.051
