"""Contact of a rope with itself as an effect: nothing where it is off, a rope as thick as said where it is on."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchdlo import scene as scenes
from torchdlo.coupling.rod_contact.closest_points import closest_points
from torchdlo.coupling.rod_contact.self_contact import SelfContact
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.scene import Rope

RADIUS, DT, COUNT = 0.005, 2e-3, 31


def hairpin(share: Tensor, *, speed: float = 0.3, integrator: str = "implicit"):
    """Two legs of a free rope, 4 cm apart and 15 degrees askew, that are thrown at each other, scenes by share."""
    s = torch.linspace(0, 0.6, COUNT, dtype=torch.float64)
    half = math.pi * 0.02
    straight = (0.6 - half) / 2
    angle = ((s - straight) / 0.02).clamp(0, math.pi)
    x = torch.where(s < straight, s, torch.where(s > straight + half, 0.6 - half - s, straight)) + 0.02 * torch.sin(
        angle
    )
    y = -0.02 * torch.cos(angle)
    z = torch.zeros_like(s)
    pos = torch.stack([x, y, z], -1)
    vel = torch.zeros_like(pos)
    vel[:, 1] = speed * torch.where(s < straight, 1.0, torch.where(s > straight + half, -1.0, 0.0))
    # One leg drifts up: they meet at an angle and not along a line.
    vel[:, 2] = 0.05 * (s - 0.3)
    pos, vel = (p.expand(len(share), COUNT, 3).contiguous() for p in (pos, vel))
    rope = Rope(pos, radius=RADIUS, mass=0.03, bend=1e-4, twist=1e-4, stretch=1e4, velocities=vel)
    scene, params, state = scenes.make(
        [rope],
        [Bend(), SelfContact()],
        {"self_contact": {"share": share.reshape(-1, 1, 1)}},
        check=False,
        dt=DT,
        substeps=1,
        integrator=integrator,
        twist="none",
    )
    return scene, params, state


def least_distance(pos: Tensor) -> Tensor:
    """Return the least distance of edges that are 12 cm apart along the rope or more [m], shape (N,)."""
    one, two = torch.triu_indices(COUNT - 1, COUNT - 1, 6)
    a, b = (pos[:, one], pos[:, one + 1]), (pos[:, two], pos[:, two + 1])
    s, t = closest_points(a, b)
    between = a[0] + s * (a[1] - a[0]) - b[0] - t * (b[1] - b[0])
    return between.norm(dim=-1).amin(-1)


def run(share: Tensor, steps: int, **options) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions and momenta at the end, and the least distance that parts of the rope had on the way."""
    scene, params, state = hairpin(share, **options)
    control, nearest = scenes.stationary_control(scene, state), torch.full((len(share),), math.inf, dtype=torch.float64)
    for _ in range(steps):
        state = scenes.step(scene, params, state, control)
        nearest = torch.minimum(nearest, least_distance(state.rods.pos))
    momentum = (params.rods.material.mass * state.rods.vel).sum(-2)
    return state.rods.pos, momentum, nearest


def test_parts_stay_as_far_apart_as_the_rope_is_thick_and_momentum_is_kept() -> None:
    # Without contact the legs go through each other, 1.2 mm a step; with it they stay 2 share r apart, to a tenth of
    # the radius of each by which a shallow overlap may last.
    share = torch.tensor([0.0, 0.5, 1.0, 1.5], dtype=torch.float64)
    with torch.no_grad():
        _, before, _ = run(share, 0)
        _, after, nearest = run(share, 60)
    assert nearest[0] < 1.2e-3
    torch.testing.assert_close(nearest[1:], 2 * share[1:] * RADIUS, rtol=0, atol=0.2 * RADIUS)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9 * 0.03 * 0.3)


def test_where_it_is_off_it_does_nothing() -> None:
    with torch.no_grad():
        off, *_ = run(torch.zeros(1, dtype=torch.float64), 60)
        scene, params, state = hairpin(torch.zeros(1, dtype=torch.float64))
        scene = tree.replace(scene, effects=tuple(e for e in scene.effects if e.name != "self_contact"))
        control = scenes.stationary_control(scene, state)
        for _ in range(60):
            state = scenes.step(scene, params, state, control)
    torch.testing.assert_close(off, state.rods.pos, rtol=0, atol=1e-7)


def test_gradient_of_the_thickness_is_that_of_finite_differences() -> None:
    # Legs that press for 10 ms: beyond that a rebound magnifies rounding.
    def reached(share: Tensor) -> Tensor:
        pos, *_ = run(share, 40)
        return (pos * torch.linspace(-1, 1, COUNT, dtype=torch.float64)[:, None] ** 2).sum()

    share = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(reached(share), share)
    with torch.no_grad():
        change = (reached(share + 1e-6) - reached(share - 1e-6)) / 2e-6
    assert abs(float(change)) > 1e-5
    assert float(gradient) == pytest.approx(float(change), rel=1e-4)
