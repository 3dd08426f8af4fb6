"""Contact among rigid bodies: closed forms of collisions, sliding, rolling and stacking."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from tests.coupling.tumbling import F64, SHAPES, G, energy, ground, momenta, move, run
from torchdlo.coupling.bodies import contact_op
from torchdlo.coupling.bodies.contact_effect import BodyContact
from torchdlo.coupling.bodies.dynamics import RigidBody, place_bodies
from torchdlo.physics import tree

R = 0.05


def ball(x: float, v: float = 0.0, **numbers) -> RigidBody:
    given = {"mass": 1.0, "restitution": 1.0} | numbers
    return RigidBody("sphere", R, (x, 0.0, 0.0), vel=(v, 0.0, 0.0), **given)


def box(pos=(0.0, 0.0, R), half=(R, R, R), **numbers) -> RigidBody:
    return RigidBody("box", half, pos, **({"density": 500.0} | numbers))


def tilted(angle: float) -> tuple[float, float, float]:
    """Gravity as an incline of this angle sees it."""
    return (G * math.sin(angle), 0.0, -G * math.cos(angle))


@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_head_on_balls_part_with_the_restitution(e: float) -> None:
    # m v = m a + M b, b - a = e v.
    m, other, v = 1.0, 2.5, 0.7
    balls = [ball(0.0, v, mass=m, restitution=e), ball(0.11, mass=other, restitution=e)]
    _, _, end = run(balls, 0.03, gravity=(0, 0, 0))
    parting = e * v
    a = (m * v - other * parting) / (m + other)
    # A share of 1e-4 of an impact is let through.
    assert torch.allclose(end.vel[:, 0], torch.tensor([a, a + parting], dtype=F64), atol=2e-4 * v)


def test_a_row_of_balls_hands_the_speed_on() -> None:
    # Newton's cradle with gaps: equal balls exchange their speeds one after the other.
    row = [ball(0.101 * k, 0.5 if k == 0 else 0.0) for k in range(4)]
    _, _, end = run(row, 0.05, gravity=(0, 0, 0))
    assert torch.allclose(end.vel[:, 0], torch.tensor([0.0, 0.0, 0.0, 0.5], dtype=F64), atol=3 * 1e-4)


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations_with_replacement(SHAPES, 2)))
def test_every_pair_collides_and_conserves_momentum(one: str, other: str) -> None:
    turn = (0.8, 0.3, -0.4, 0.33)
    solids = [
        RigidBody(one, SHAPES[one], (0.0, 0.0, 0.0), turn, (0.6, 0.1, 0.0), (1.0, 2.0, -1.0), density=600.0),
        RigidBody(
            other, SHAPES[other], (0.17, 0.01, 0.01), turn[::-1], (-0.6, 0.0, 0.1), (0.5, -1.0, 2.0), density=900.0
        ),
    ]
    params, start, end = run(solids, 0.12, 2e-3, gravity=(0, 0, 0))
    assert (end.vel[0] - start.vel[0]).norm() > 0.1  # they met
    for before, after in zip(momenta(params, start), momenta(params, end), strict=True):
        scale = (params.mass * start.vel.norm(dim=-1, keepdim=True)).sum() * (start.pos.norm() + 1)
        assert (after - before).norm() < 1e-12 * scale
    assert energy(params, end) < energy(params, start)
    # They do not stick in each other: what pushed them apart lets them part.
    assert (end.pos[1] - end.pos[0]).norm() > 0.04


def test_three_boxes_stand() -> None:
    stack = [ground(), *(box((0.0, 0.0, (2 * k + 1) * R)) for k in range(3))]
    _, start, end = run(stack, 5.0, 1e-2, pairs=((0, 1), (1, 2), (2, 3)))
    assert (end.pos - start.pos).norm(dim=-1).max() < 0.01 * 2 * R
    assert (end.quat - start.quat).abs().max() < 1e-3
    assert end.vel.norm(dim=-1).max() < 1e-4


def test_a_staggered_stack_stands_until_its_centre_is_over_the_edge() -> None:
    # The upper box may be shifted by half its width, here 0.9 and 1.1 of that.
    for shift, stands in ((0.9, True), (1.1, False)):
        # Edges of bodies are rounded by 4 % of the smallest half length.
        stack = [ground(), box(), box((shift * R, 0.0, 3 * R))]
        _, start, end = run(stack, 0.5, 5e-3)
        fell = float((start.pos - end.pos)[2, 2])
        assert (fell < 1e-3) == stands, (shift, fell)


def test_a_box_slides_and_stops() -> None:
    # v^2 / (2 mu g), v falls by mu g per second.
    v, mu = 0.6, 0.3
    moving = [ground(), box(half=(R, R, 0.02), pos=(0, 0, 0.02), vel=(v, 0, 0))]
    _, _, end = run(moving, 0.3, 2e-3)
    way = v * v / (2 * mu * G)
    assert end.pos[1, 0] == pytest.approx(way, rel=0.02)
    assert end.vel[1].norm() < 1e-5


@pytest.mark.parametrize("mu", [0.15, 0.4, 0.7])
def test_a_box_on_an_incline_sticks_below_the_angle_of_friction(mu: float) -> None:
    limit, near = math.atan(mu), math.radians(0.5)
    rough = {"mu_s": mu, "mu_k": mu}
    bodies = [ground(**rough), box(half=(R, R, 0.02), pos=(0, 0, 0.02), **rough)]
    time = 0.2
    _, _, held = run(bodies, time, 2e-3, gravity=tilted(limit - near))
    assert held.pos[1, :2].norm() < 1e-6
    angle = limit + near
    _, _, slid = run(bodies, time, 2e-3, gravity=tilted(angle))
    way = 0.5 * G * (math.sin(angle) - mu * math.cos(angle)) * time**2
    assert slid.pos[1, 0] == pytest.approx(way, rel=0.01)


ROUND = {
    # Resistance to turning over m r^2.
    "sphere": (R, (1, 0, 0, 0), R, 2 / 5),
    "cylinder": ((R, 0.04), (0.5**0.5, 0.5**0.5, 0, 0), R, 1 / 2),
    "capsule": ((R, 0.04), (0.5**0.5, 0.5**0.5, 0, 0), R, None),
    "torus": ((0.04, 0.01), (0.5**0.5, 0.5**0.5, 0, 0), 0.05, None),
}


@pytest.mark.parametrize("shape", ROUND)
def test_round_bodies_roll_without_slip_or_spin_as_they_slip(shape: str) -> None:
    size, turn, radius, share = ROUND[shape]
    angle, time = 0.2, 0.2
    for mu in (0.3, 0.04):
        rough = {"mu_s": mu, "mu_k": mu}
        rolling = RigidBody(shape, size, (0, 0, radius), turn, density=500.0, **rough)
        params, _, end = run([ground(**rough), rolling], time, 1e-3, gravity=tilted(angle))
        q = float(params.inertia[1, 0 if shape == "sphere" else 2] / (params.mass[1] * radius**2))
        assert share is None or q == pytest.approx(share)
        # No slip: a = g sin / (1 + q), for the sphere 5/7 g sin; else g (sin - mu cos) and q r alpha = mu g cos.
        slips = math.tan(angle) > mu * (1 + 1 / q)
        a = G * (math.sin(angle) - mu * math.cos(angle)) if slips else G * math.sin(angle) / (1 + q)
        alpha = mu * G * math.cos(angle) / (q * radius) if slips else a / radius
        assert slips == (mu < 0.1)
        assert end.pos[1, 0] == pytest.approx(0.5 * a * time**2, rel=0.01)
        assert end.omega[1, 1] == pytest.approx(alpha * time, rel=0.01)
        assert end.pos[1, 2] == pytest.approx(radius, abs=1e-4 * radius)


def test_a_ball_bounces_with_the_restitution() -> None:
    # From height h: the next apex is e^2 h. The step in which it hits is not split: an error of v dt in the height.
    e, h, dt = 0.8, 0.2, 5e-4
    fall = math.sqrt(2 * h / G)
    bouncing = {"restitution": e}
    _, _, end = run(
        [ground(**bouncing), RigidBody("sphere", R, (0, 0, R + h), mass=1.0, **bouncing)], fall * (1 + e), dt
    )
    assert end.pos[1, 2] - R == pytest.approx(e * e * h, abs=2 * math.sqrt(2 * G * h) * dt)


def test_scenes_of_a_batch_do_not_touch() -> None:
    heights = torch.tensor([0.06, 0.07, 0.08], dtype=F64)
    pos = torch.stack([0 * heights, 0 * heights, heights], -1)
    quat = (0.9, 0.1, 0.2, 0.3)

    def fallen(at) -> torch.Tensor:
        bodies = [ground(), box(at, quat=quat), RigidBody("capsule", (0.02, 0.05), (0.02, 0.01, 0.2), mass=0.3)]
        return run(bodies, 0.1, 2e-3)[2].pos

    together = fallen(pos)
    for k in range(3):
        assert torch.allclose(together[k], fallen(pos[k]), atol=1e-9)


def test_gradients_of_200_steps_agree_with_differences() -> None:
    # A box slides and turns on the ground, and a ball hits a ball: both away from the start and the end of contact.
    bodies = [
        ground(),
        box(half=(R, 0.03, 0.02), pos=(0, 0.3, 0.02), vel=(0.9, 0.0, 0.0), omega=(0, 0, 3.0), mu_s=0.2, mu_k=0.2),
        ball(0.0, 0.5, mu_s=0.2, mu_k=0.2, restitution=0.6),
        RigidBody("sphere", 0.04, (0.12, 0.02, 0.01), mass=0.4, restitution=0.7),
    ]
    like = torch.zeros(1, dtype=F64)
    kinds, params, state = place_bodies(bodies, like)
    contact = BodyContact(pairs=((0, 1), (2, 3)))
    gravity = like.new_tensor([[0.0, 0.0, -G]])

    def outcome(x: torch.Tensor) -> torch.Tensor:
        """Return a number per row of factors (..., 7)."""
        scale = torch.cat([torch.zeros_like(x[..., :1]), x[..., :3]], -1).unsqueeze(-1) + 1
        factor = [1 + part.unsqueeze(-1) for part in x[..., 3:].split(1, -1)]
        numbers = tree.replace(
            params,
            mass=params.mass * scale,
            mu_k=params.mu_k * factor[0],
            restitution=params.restitution * factor[1],
        )
        pos = state.pos + 0.01 * (factor[3] - 1) * state.vel
        begun = tree.replace(state, vel=state.vel * factor[2], pos=pos)
        end = move(kinds, numbers, begun, 200, 1e-3, gravity, contact)
        weight = torch.linspace(1, 2, 12, dtype=F64).reshape(4, 3)
        return (weight * (end.pos + end.omega))[..., 1:, :].sum((-1, -2))

    x = torch.zeros(7, dtype=F64, requires_grad=True)
    (found,) = torch.autograd.grad(outcome(x), x)
    step = 1e-5
    with torch.no_grad():
        ahead, behind = outcome(step * torch.stack([torch.eye(7, dtype=F64), -torch.eye(7, dtype=F64)]))
    differences = (ahead - behind) / (2 * step)
    assert (found - differences).abs().max() < 1e-4 * differences.abs().max(), (found, differences)


@pytest.mark.parametrize("kernel", [True, False])
@pytest.mark.parametrize("shape", ["box", "cylinder", "sphere"])
def test_gradients_know_that_bodies_at_rest_are_held_by_friction(shape: str, kernel: bool, monkeypatch) -> None:
    # Points of a body at rest do not slip at all: the direction of the slip says nothing of what friction does next.
    size = SHAPES[shape]
    height = {"box": 0.03, "cylinder": 0.05, "sphere": 0.05}[shape]
    rub = {"mu_s": 0.6, "mu_k": 0.6, "density": 120.0}
    kinds, params, state = place_bodies(
        [ground(**rub), RigidBody(shape, size, (0.0, 0.0, height), **rub)], torch.zeros(1, dtype=F64)
    )
    if not kernel:
        monkeypatch.setattr(contact_op, "kernel_fits", lambda _: False)
    gravity = torch.tensor([[0.0, 0.0, -G]], dtype=F64)

    def speeds(x: torch.Tensor, begun) -> torch.Tensor:
        """Return velocity and turn rate (6,) after three substeps, from those that are added at first."""
        added = torch.stack([torch.zeros_like(x), x])
        begun = tree.replace(begun, vel=begun.vel + added[:, :3], omega=begun.omega + added[:, 3:])
        end = move(kinds, params, begun, 3, 1e-3, gravity, BodyContact())
        return torch.cat([end.vel[1], end.omega[1]])

    with torch.no_grad():
        rest = move(kinds, params, state, 100, 1e-3, gravity, BodyContact())
    gradients = torch.autograd.functional.jacobian(lambda x: speeds(x, rest), torch.zeros(6, dtype=F64))
    with torch.no_grad():
        steps = 1e-7 * torch.eye(6, dtype=F64)
        differences = torch.stack([(speeds(x, rest) - speeds(-x, rest)) / 2e-7 for x in steps], -1)
    # Upwards it is another thing to push a body than downwards.
    across = [0, 1, 3, 4] if shape == "sphere" else [0, 1, 5]
    torch.testing.assert_close(gradients[:, across], differences[:, across], atol=2e-3, rtol=1e-3)
    # Friction alone stops what slides; a ball is set rolling by 5/7 of what is left of both.
    assert gradients[:2, :2].abs().max() < (0.8 if shape == "sphere" else 1e-3)


@pytest.mark.parametrize("kernel", [True, False])
def test_gradients_hold_where_rounds_have_not_found_the_slip(kernel: bool, monkeypatch) -> None:
    # A box slides and spins on the ground, hit by a ball that turns fast: six rounds are too few for both.
    rub = {"mu_s": 0.6, "mu_k": 0.5, "density": 120.0}
    solids = [ground(**rub), RigidBody("box", (0.03, 0.03, 0.03), (0.0, 0.0, 0.03), **rub)]
    solids += [RigidBody("sphere", 0.03, (0.0, -0.0599, 0.035), **rub)]
    kinds, params, state = place_bodies(solids, torch.zeros(1, dtype=F64))
    if not kernel:
        monkeypatch.setattr(contact_op, "kernel_fits", lambda _: False)
    gravity = torch.tensor([[0.0, 0.0, -G]], dtype=F64)

    def speeds(x: torch.Tensor) -> torch.Tensor:
        """Return velocities and turn rates (2, 6) after a substep, from those at first."""
        begun = tree.replace(
            state, vel=torch.cat([x.new_zeros(1, 3), x[:, :3]]), omega=torch.cat([x.new_zeros(1, 3), x[:, 3:]])
        )
        end = move(kinds, params, begun, 1, 1e-3, gravity, BodyContact(steps=6))
        return torch.cat([end.vel[1:], end.omega[1:]], -1)

    x = torch.tensor([[0.8, 0.3, -0.01, 0.1, 0.2, 8.0], [0.3, 0.7, -0.02, -30.0, 3.0, 2.0]], dtype=F64)
    gradients = torch.autograd.functional.jacobian(speeds, x).flatten(2).flatten(0, 1)
    with torch.no_grad():
        steps = 1e-7 * torch.eye(12, dtype=F64).unflatten(-1, (2, 6))
        differences = torch.stack([(speeds(x + h) - speeds(x - h)).flatten() / 2e-7 for h in steps], -1)
    torch.testing.assert_close(gradients, differences, atol=2e-3, rtol=1e-3)


def test_single_precision_stands_too() -> None:
    stack = [ground(), box(), box((0.0, 0.0, 3 * R))]
    _, start, end = run(stack, 0.5, 5e-3, dtype=torch.float32, pairs=((0, 1), (1, 2)))
    assert (end.pos - start.pos).norm(dim=-1).max() < 0.01 * R


def test_bad_choices_are_refused() -> None:
    with pytest.raises(ValueError, match="points is 0"):
        BodyContact(points=0)
    with pytest.raises(ValueError, match="recovery"):
        BodyContact(recovery=0.0)
