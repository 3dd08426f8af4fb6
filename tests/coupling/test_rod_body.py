"""Ropes and rigid bodies: momentum, friction, rest, thin posts, and what a taut rope carries."""

from __future__ import annotations

import math

import pytest
import torch
from touching import F64, line, run

from torchdlo.coupling import RodBody
from torchdlo.coupling.bodies import shape_sdf
from torchdlo.coupling.bodies.dynamics import conjugate
from torchdlo.coupling.rod_body import rod_body_op as body_sweeps
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.physics.linalg.rotation import rotate
from torchdlo.scene import Params, RigidBody, Rope, Scene, State, check_state, finite, make, stationary_control, step

G = 9.81
ON_Y = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Turns the z axis of a body to -y."""


def gap(scene: Scene, params: Params, state: State, body: int = 0, parts: int = 9) -> float:
    """Least distance of a body from the surface of an open rope over the rope's radius, at places along all edges."""
    x, radius = state.rods.pos, float(params.rods.material.radius.flatten()[0])
    f = torch.linspace(0, 1, parts, dtype=x.dtype)[:, None, None]
    points = (x[:-1] + f * (x[1:] - x[:-1])).reshape(-1, 3)
    local = rotate(conjugate(state.bodies.quat[body]), points - state.bodies.pos[body])
    distance = shape_sdf.distance(scene.bodies[body].shape, params.bodies.size[body : body + 1], local)
    return float(distance.min()) / radius - 1


def momenta(params: Params, state: State) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear momentum of all, and angular momentum about the origin. Positions after a substep will do for v x p."""
    p, body = params.rods.material.mass * state.rods.vel, state.bodies
    q = params.bodies.mass * body.vel
    spin = rotate(body.quat, params.bodies.inertia * rotate(conjugate(body.quat), body.omega))
    turning = torch.linalg.cross(state.rods.pos, p, dim=-1).sum(-2) + torch.linalg.cross(body.pos, q, dim=-1).sum(-2)
    return p.sum(-2) + q.sum(-2), turning + spin.sum(-2)


@pytest.mark.parametrize("angle", [0.0, 0.5], ids=["parallel", "inclined"])
@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_free_rods_and_bodies_keep_momentum_and_angular_momentum(shape, angle):
    # A spinning body hits a free rope off its centre, with friction and rebound. Nothing else acts.
    x = line(11, 0.3, angle)
    rope = Rope(x, radius=0.005, density=1000.0, bend=1e-4)
    size = 0.03 if shape == "sphere" else (0.03, 0.04, 0.02)
    ball = RigidBody(
        shape, size, pos=(0.04, 0.01, 0.045), vel=(0.3, -0.2, -1.0), omega=(5.0, 3.0, -4.0), density=800.0,
        quat=(math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0), restitution=0.4,
    )  # fmt: skip
    made = make([rope], [Bend(), RodBody()], bodies=[ball], dt=1e-3, substeps=2)
    scene, params, state = made
    linear, angular = momenta(params, state)
    after = run(scene, params, state, 30)
    moved = float((params.rods.material.mass * after.rods.vel).sum(-2).norm())
    assert moved > 0.02 * float(linear.norm()), "they have not met"
    found = momenta(params, after)
    assert float((found[0] - linear).norm()) < 1e-12 * float(linear.norm())
    assert float((found[1] - angular).norm()) < 1e-12 * float(angular.norm())


def test_two_way_impulse_of_a_central_hit_is_newtons():
    # A ball falls centrally on the middle vertex of three: v' of the contact point = -e v, all along z.
    x = line(3, 0.1)
    ball = RigidBody("sphere", 0.02, pos=(0.0, 0.0, 0.026), vel=(0.0, 0.0, -1.0), mass=0.02, restitution=0.5)
    scene, params, state = make(
        [Rope(x, radius=0.005, mass=0.01)], [RodBody(sweeps=30)], bodies=[ball], dt=1e-3, substeps=1
    )
    after = run(scene, params, state, 2)
    parting = float(after.bodies.vel[0, 2] - after.rods.vel[1, 2])
    # The last sweep leaves less than 1 % of the approach.
    assert parting == pytest.approx(0.5, rel=0.01)


def capstan(mu: float, radius: float, count: int):
    """A light rope over half of a fixed cylinder, a mass on one end, the other end pulled down slowly."""
    big, r, tail, speed = 0.05, radius, 5, 0.02
    a = math.pi / count
    outer = (big + r) / math.cos(a / 2)
    edge = 2 * outer * math.sin(a / 2)
    phi = math.pi - a * torch.arange(count + 1, dtype=F64)
    arc = torch.stack([outer * torch.cos(phi), 0 * phi, outer * torch.sin(phi)], -1)
    down = torch.tensor([0, 0, -1.0], dtype=F64) * edge * torch.arange(1, tail + 1, dtype=F64)[:, None]
    x = torch.cat([(arc[0] + down).flip(0), arc, arc[-1] + down])
    post = RigidBody("cylinder", (big, 0.1), motion="fixed", quat=ON_Y, mu_s=mu, mu_k=mu)
    scene, params, state = make(
        [Rope(x, radius=r, mass=len(x) * 3e-6, bend=1e-9)], [Gravity(), Bend(), Damping(), RodBody()],
        {"damping": {"rate": 200.0}}, bodies=[post], dt=1e-3, substeps=10, prescribed_vertices=(len(x) - 1,),
    )  # fmt: skip
    mass = params.rods.material.mass.clone()
    mass[0] = 0.01
    params = tree.replace(
        params, rods=tree.replace(params.rods, material=tree.replace(params.rods.material, mass=mass))
    )
    control, seen = stationary_control(scene, state), []
    with torch.no_grad():
        for k in range(40):
            pull = x.new_tensor([0, 0, -speed * scene.dt * (k + 1)])
            state = step(scene, params, state, tree.replace(control, pos=control.pos + pull))
            seen.append(state.rods.tension[[1, -4], 0])
    low, high = torch.stack(seen[20:]).mean(0)
    return float(high / low), gap(scene, params, state)


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.15, 0.3])
def test_capstan(mu):
    # C5. T2 / T1 = exp(mu pi) for a thin rope (Euler 1769). Friction acts r below the centreline, which the tension
    # follows at R + r: the balance of moments about the axis makes it exp(mu pi R / (R + r)).
    r, big = 1e-3, 0.05
    ratio, least = capstan(mu, r, 31)
    # Each end of the arc is uncertain by half an edge of thirty-one where tension has no grip: 1 % of ln T2 / T1 each.
    assert ratio == pytest.approx(math.exp(mu * math.pi * big / (big + r)), rel=0.02 * mu * math.pi)
    assert ratio == pytest.approx(math.exp(mu * math.pi), rel=0.03)
    assert least > -0.1


@pytest.mark.parametrize("tangent", [0.3, 0.45, 0.6, 0.9])
def test_a_rope_on_a_tilted_plane_sticks_below_and_slides_above_the_friction_angle(tangent):
    # C3. Sticks while tan a < mu = 0.5, slides with g (sin a - mu cos a) above.
    a, mu = math.atan(tangent), 0.5
    down = torch.tensor([math.cos(a), 0.0, -math.sin(a)], dtype=F64)
    up = torch.tensor([math.sin(a), 0.0, math.cos(a)], dtype=F64)
    x = torch.linspace(-0.05, 0.05, 6, dtype=F64)[:, None] * (0.8 * down + 0.6 * down.new_tensor([0, 1.0, 0]))
    rope = Rope(x + 0.005 * up, radius=0.005, density=1000.0, bend=1e-4)
    plane = RigidBody("plane", quat=(math.cos(a / 2), 0.0, math.sin(a / 2), 0.0), motion="fixed", mu_s=mu, mu_k=mu)
    scene, params, state = make([rope], [Gravity(), Bend(), RodBody()], bodies=[plane], dt=1e-3, substeps=1)
    early = run(scene, params, state, 50)
    late = run(scene, params, early, 100)
    if tangent < mu:
        moved = float((late.rods.pos - state.rods.pos).mean(-2) @ down)
        assert abs(moved) < 0.001 * 0.5 * G * 0.15**2 * math.sin(a)  # a thousandth of what it would slide freely
        return
    found = float((late.rods.vel - early.rods.vel).mean(-2) @ down) / 0.1
    assert found == pytest.approx(G * (math.sin(a) - mu * math.cos(a)), rel=0.01)
    assert gap(scene, params, late) > -0.01


@pytest.mark.slow
def test_a_ball_sits_in_a_taut_string_as_deep_as_its_length_allows_and_is_carried_by_the_tension():
    # C10. A string of length 2 L between ends 2 a apart leaves the ball at the angle b to the horizontal where its free
    # parts, l each, are tangents: a = (R + r) sin b + l cos b, l + (R + r) b = L. Vertical tension carries the weight.
    a, half, mass, big, r, n = 0.2, 0.204, 0.05, 0.015, 0.002, 21
    start = math.acos(a / half)
    s = torch.linspace(-1, 1, n, dtype=F64)
    x = torch.stack([a * s, 0 * s, -(1 - s.abs()) * a * math.tan(start)], -1)
    place = (0.0, 0.0, (big + r) / math.cos(start) - a * math.tan(start))
    ball = RigidBody("sphere", big, pos=place, mass=mass, mu_s=0.0, mu_k=0.0, damping=30.0)
    scene, params, state = make(
        [Rope(x, radius=r, mass=0.004, bend=1e-7)], [Gravity(), Bend(), Damping(), RodBody(rounds=2)],
        {"damping": {"rate": 30.0}}, bodies=[ball], dt=1e-3 / 3, substeps=1, prescribed_vertices=(0, n - 1),
    )  # fmt: skip
    state, pull, height = run(scene, params, state, 200), [], []
    first = float(state.bodies.vel[0, 2])
    for _ in range(200):
        state = run(scene, params, state, 1)
        end = state.rods.pos[1] - state.rods.pos[0]
        pull.append(-2 * float(state.rods.tension[0, 0] * end[2] / end.norm()))
        height.append(float(state.bodies.pos[0, 2]))
    low, high = 0.0, 1.0
    for _ in range(60):
        b = 0.5 * (low + high)
        free = half - (big + r) * b
        low, high = (b, high) if (big + r) * math.sin(b) + free * math.cos(b) > a else (low, b)
    sag = free * math.sin(b) - (big + r) * math.cos(b)
    assert -sum(height) / len(height) == pytest.approx(sag, rel=0.02)
    # Held vertices carry a fortieth of the rope each; the ball's change of momentum is on the way to its weight.
    speed, span = float(state.bodies.vel[0, 2]) - first, 200 * scene.dt
    drag = 30.0 * mass * (height[-1] - height[0]) / span
    carried = G * (mass + 0.95 * 0.004) + mass * speed / span + drag
    assert sum(pull) / len(pull) == pytest.approx(carried, rel=0.02)


@pytest.mark.parametrize("share", [0.1, 0.9], ids=["near a vertex", "inside an edge"])
def test_a_long_edge_does_not_slip_past_a_thin_post(share):
    # Edges of 2 cm, a post of 1 mm radius between their ends, a rope of 1 mm, at a radius of the rope per substep.
    r, speed = 1e-3, 1.0
    x = line(6, 0.1, math.pi / 2) + torch.tensor([-0.01, 0.02 * (share - 0.5), 0.0], dtype=F64)
    rope = Rope(x, radius=r, density=1000.0, bend=1e-5, velocities=torch.tensor([speed, 0, 0], dtype=F64).expand(6, 3))
    post = RigidBody("cylinder", (1e-3, 0.05), motion="fixed")
    scene, params, state = make([rope], [Bend(), RodBody()], bodies=[post], dt=1e-3, substeps=1)
    for _ in range(40):
        state = run(scene, params, state, 1)
        assert gap(scene, params, state, parts=41) > -1.0, "the centreline is inside the post"
        y = state.rods.pos[:, 1]
        crossing = [(k, float(y[k] / (y[k] - y[k + 1]))) for k in range(5) if float(y[k] * y[k + 1]) < 0]
        for k, f in crossing:
            assert float((1 - f) * state.rods.pos[k, 0] + f * state.rods.pos[k + 1, 0]) < 0.0, "it is behind the post"


RESTING = {"sphere": (0.06,), "box": (0.05, 0.06, 0.04), "torus": (0.06, 0.02)}


@pytest.mark.slow
@pytest.mark.parametrize("shape", RESTING)
def test_a_rope_that_falls_on_a_body_stays_outside(shape):
    x = line(16, 0.24, 0.2, 0.1)
    body = RigidBody(shape, RESTING[shape], motion="fixed", mu_s=0.6, mu_k=0.6)
    effects = [Gravity(), Bend(), Damping(), RodBody()]
    scene, params, state = make(
        [Rope(x, radius=0.005, density=1000.0, bend=1e-5)], effects, {"damping": {"rate": 3.0}},
        bodies=[body, RigidBody("plane", pos=(0, 0, -0.06), motion="fixed")], dt=1e-3, substeps=1,
    )  # fmt: skip
    for _ in range(6):
        state = run(scene, params, state, 50)
        assert min(gap(scene, params, state, k) for k in range(2)) > -0.1
    assert abs(min(gap(scene, params, state, k) for k in range(2))) < 0.1 and bool(finite(state))


@pytest.mark.parametrize("eager", [False, True], ids=["kernel", "tensors"])
@pytest.mark.parametrize("off", [0.0, 1e-5, 2e-4, 3e-3, 6e-3])
def test_a_body_that_overlaps_a_held_vertex_does_not_throw_the_free_ends_of_its_edges(off, eager, monkeypatch):
    # The body is nearest to a point that is `off` from the held vertex in the middle. A free end would have to move by
    # length / off times the overlap to bring that point out at once.
    monkeypatch.setattr(body_sweeps, "ready", lambda *_: not eager)
    x, overlap = line(3, 0.04), 0.003
    ball = RigidBody("sphere", 0.03, pos=(off, 0.0, -0.035 + overlap), motion="fixed")
    rope, effects = Rope(x, radius=0.005, mass=0.003), [RodBody(), Damping()]
    made = make([rope], effects, bodies=[ball], dt=2e-4, substeps=1, prescribed_vertices=(1,))
    after = run(*made, 1)
    assert torch.equal(after.rods.pos[1], made[2].rods.pos[1])
    speed = float(after.rods.vel.norm(dim=-1).max())
    assert speed <= 2 * overlap / 2e-4
    # They come to rest outside.
    after = run(*made, 500)
    assert float(after.rods.vel.norm(dim=-1).max()) < 0.02 and bool(finite(after).all())


@pytest.mark.parametrize("speed", [20.0, 30.0])
def test_a_body_that_is_far_too_fast_is_noticed_and_nothing_crashes(speed):
    # Edges that were left out as too far off are placed late, in single precision many lanes at once.
    x = torch.zeros(40, 3)
    x[:, 0], x[:, 2] = torch.linspace(-0.3, 0.3, 40), 0.16
    solids = [
        RigidBody("plane", motion="fixed", mu_s=0.5, mu_k=0.4),
        RigidBody("box", (0.04, 0.04, 0.08), pos=(0.1, 0, 0.04), motion="fixed"),
        RigidBody("sphere", 0.03, pos=(0, 0, 0.3), density=200.0, vel=(0, 0, -speed)),
    ]
    rope, effects = Rope(x, 0.005, density=1000.0, bend=1e-5), [Gravity(), Bend(), Damping(), RodBody()]
    scene, params, state = make([rope], effects, bodies=solids, dt=2e-3, substeps=2)
    for _ in range(20):
        state = step(scene, params, state, stationary_control(scene, state))
    with pytest.raises(RuntimeError, match="scene: "):
        check_state(state)
