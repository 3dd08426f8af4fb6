"""Gradients through contact of ropes with bodies and through the bodies' motion, against central differences."""

from __future__ import annotations

import pytest
import torch
from touching import F64, line

from torchdlo.coupling import RodBody
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity
from torchdlo.scene import RigidBody, Rope, make, ok, stationary_control, step

AT = {
    "body speed": -1.0,
    "body drift": 0.3,
    "body spin": 4.0,
    "body place": 0.0,
    "mass": 1.0,
    "inertia": 1.0,
    "size": 1.0,
    "mu": 0.3,
    "restitution": 0.3,
    "tool": 0.0,
    "rope speed": 0.1,
    "rope radius": 1.0,
    "bend": 1.0,
}


def rolled(theta: torch.Tensor, shape: str, count: int) -> torch.Tensor:
    """A spinning body that falls on a rope, rebounds and slides along it, beside a moving tool; of `AT`, (..., 13)."""
    v = dict(zip(AT, theta.unsqueeze(-1).unsqueeze(-1).unbind(-3), strict=True))
    n, r = 9, 0.005
    x = line(n, 0.24, 0.3)
    size = {"sphere": 0.03, "box": (0.03, 0.025, 0.02), "torus": (0.03, 0.01)}[shape]
    high = 0.0357 if shape == "sphere" else 0.03
    turned = (0.9, 0.3, -0.2, 0.1) if shape == "torus" else (0.95, 0.2, 0.1, 0.15)
    ball = RigidBody(shape, size, pos=(0.011, 0.006, high), quat=turned, density=300.0)
    tool = RigidBody("cylinder", (0.004, 0.05), pos=(-0.06, 0.0, -0.012), quat=(0.7, 0.7, 0.1, 0.0), motion="kinematic")
    scene, params, state = make(
        [Rope(x, radius=r, density=1000.0, bend=2e-4)], [Gravity(), Bend(), RodBody()], bodies=[ball, tool],
        dt=2.5e-4, substeps=1, prescribed_vertices=(0, n - 1), check=False,
    )  # fmt: skip
    one = torch.ones_like(v["mass"])
    zero = 0 * one
    only = torch.tensor([[1.0], [0.0]], dtype=F64)
    material = params.rods.material
    material = tree.replace(material, radius=material.radius * v["rope radius"], bend=material.bend * v["bend"])
    solid = params.bodies
    solid = tree.replace(
        solid, mass=solid.mass * v["mass"], inertia=solid.inertia * v["inertia"], size=solid.size * v["size"],
        mu_s=one.expand(*one.shape[:-2], 2, 1) * v["mu"], mu_k=one.expand(*one.shape[:-2], 2, 1) * v["mu"],
        restitution=one.expand(*one.shape[:-2], 2, 1) * v["restitution"],
    )  # fmt: skip
    params = tree.replace(params, rods=tree.replace(params.rods, material=material), bodies=solid)
    bodies = tree.replace(
        state.bodies,
        vel=only * torch.cat([v["body drift"], 0.2 * one, v["body speed"]], -1),
        omega=only * torch.cat([v["body spin"], one, -2 * one], -1),
        pos=state.bodies.pos + only * torch.cat([v["body place"], zero, zero], -1),
    )
    bodies = tree.replace(bodies, quat=bodies.quat.expand(*bodies.pos.shape[:-1], 4))
    state = tree.map(lambda x: x.expand(*theta.shape[:-1], *x.shape[-2:]), tree.replace(state, bodies=bodies))
    rise = torch.cat([zero, zero, one], -1) * state.rods.pos.new_ones(n, 1)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=v["rope speed"] * rise))
    control = stationary_control(scene, state)
    for k in range(count):
        lift = (k + 1) / count * torch.cat([zero, 0.01 * one, 0.004 * one + v["tool"]], -1)
        told = tree.replace(control.bodies, pos=control.bodies.pos + lift)
        state = step(scene, params, state, tree.replace(control, bodies=told))
    assert bool(ok(state).all())
    weight = torch.sin(torch.arange(3 * n, dtype=F64)).reshape(n, 3)
    others = (state.bodies.pos[..., :1, :] * weight[:1]).sum((-1, -2)) + 0.01 * state.bodies.quat[..., 0, 1]
    return (weight * state.rods.pos).sum((-1, -2)) + others


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["sphere", "box", "torus"])
def test_gradients_agree_with_central_differences_over_200_steps(shape):
    # All differences in one batch. h^2 from curvature, 1e-16 / h from rounding; contacts that start within h of their
    # start are kinks, so the best of three h is taken.
    at = torch.tensor(list(AT.values()), dtype=F64)
    theta = at.clone().requires_grad_()
    (found,) = torch.autograd.grad(rolled(theta, shape, 200), theta)
    errors = []
    with torch.no_grad():
        for h in (1e-6, 1e-7, 1e-8):
            d = h * torch.eye(len(at), dtype=F64)
            up, down = rolled(torch.cat([at + d, at - d]), shape, 200).split(len(at))
            wanted = (up - down) / (2 * h)
            errors.append((found - wanted).abs() / wanted.abs().clamp(min=1e-4))
    least = torch.stack(errors).amin(0)
    assert bool((found.abs() > 1e-9).all()), dict(zip(AT, found.tolist(), strict=True))
    assert float(least.max()) < 1e-4, dict(zip(AT, least.tolist(), strict=True))
