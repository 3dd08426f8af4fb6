"""Gradients through contact and sliding friction, against central differences of whole rollouts."""

from __future__ import annotations

import math

import pytest
import torch
from touching import F64, line

from torchdlo.coupling import RodContact
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Gravity
from torchdlo.scene import Rope, make, ok, rollout, stationary_control, step

pytestmark = pytest.mark.quick

NAMES = ("drift", "approach", "bend", "radius", "mu", "restitution", "mass", "gravity", "handle")
AT = torch.tensor([0.3, 0.2, 1.0, 1.0, 0.3, 0.3, 1.0, 2.0, 0.0], dtype=F64)


def sliding(
    theta: torch.Tensor, count: int, segment: int | None = None, **choices
) -> tuple[torch.Tensor, torch.Tensor]:
    """A rope that falls on a held one, rebounds and slides along it, as a function of nine numbers, (..., 9)."""
    v = dict(zip(NAMES, theta.unsqueeze(-1).unsqueeze(-1).unbind(-3), strict=True))
    n, r, angle = 9, 0.01, 0.6
    s = torch.linspace(-0.2, 0.2, n, dtype=F64)
    a, b = line(n, 0.4, 0.0, r + 0.0015), line(n, 0.4, angle, -r - 0.0015)
    a, b = a + s[:, None] ** 2 * a.new_tensor([0, 0.3, 0]), b + s[:, None] ** 2 * a.new_tensor([0, 0, 0.2])
    ropes = [Rope(a, radius=r, density=1000.0, bend=1e-3), Rope(b, radius=r, density=1200.0, bend=2e-3)]
    choices = {"dt": 1e-3, "substeps": 1, "prescribed_vertices": (n, 2 * n - 1)} | choices
    scene, params, state = make(ropes, [Bend(), Gravity(), RodContact()], **choices)
    one = torch.ones_like(v["mass"])
    fall, lift = torch.cat([v["drift"], 0.05 * one, -v["approach"]], -1), torch.cat([0 * one, 0 * one, 0.1 * one], -1)
    vel = torch.cat([x.expand(*one.shape[:-2], n, 3) for x in (fall, lift)], -2)
    state = tree.map(lambda x: x.expand(*one.shape[:-2], *x.shape[-2:]), state)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
    material = params.rods.material
    material = tree.replace(
        material, bend=material.bend * v["bend"], radius=material.radius * v["radius"], mass=material.mass * v["mass"]
    )
    effects = params.effects | {
        "rod_contact": {"mu_s": v["mu"], "mu_k": v["mu"], "restitution": v["restitution"]},
        "gravity": {"acceleration": torch.cat([0 * one, 0 * one, -v["gravity"]], -1)},
    }
    params = tree.replace(params, rods=tree.replace(params.rods, material=material), effects=effects)
    control = stationary_control(scene, state)
    control = tree.replace(control, pos=control.pos + v["handle"] * a.new_tensor([[0, 0, 0.01], [0, 0.01, 0.01]]))
    controls = tree.map(lambda c: c.expand(count, *c.shape), control)
    last, _ = rollout(
        lambda params, state, control: step(scene, params, state, control), params, state, controls, segment=segment
    )
    weights = torch.sin(torch.arange(6 * n, dtype=F64)).reshape(2 * n, 3)
    return (weights * last.rods.pos).sum((-1, -2)), ok(last)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "choices"),
    [(200, {}), (60, {"integrator": "implicit", "dt": 2e-3, "constraint_iterations": 6}), (12, {"substeps": 5})],
    ids=["200 substeps", "implicit", "5 substeps a step"],
)
def test_gradients_through_contact_and_sliding_agree_with_central_differences(count, choices):
    # All differences in one batch, at two h: h^2 from curvature, 1e-16 / h from rounding; contacts that start within h
    # of their start are kinks, so the better of two h is taken. Implicit steps have their exact derivative where
    # Newton's method has converged, which hits take six steps for.
    theta = AT.clone().requires_grad_()
    value, well = sliding(theta, count, **choices)
    assert bool(well)
    (found,) = torch.autograd.grad(value, theta)
    with torch.no_grad():
        steps = torch.tensor([1e-6, 1e-7], dtype=F64)[:, None, None] * torch.eye(len(AT), dtype=F64)
        ends, fine = sliding(torch.stack([AT + steps, AT - steps]).reshape(-1, len(AT)), count, **choices)
    assert bool(fine.all())
    up, down = ends.reshape(2, 2, len(AT))
    wanted = (up - down) / (2 * steps[:, 0, :1])
    least = ((found - wanted).abs() / wanted.abs().clamp(min=1e-4)).amin(0)
    assert float(least.max()) < 1e-4, dict(zip(NAMES, least.tolist(), strict=True))


def test_replayed_segments_give_the_same_gradient():
    theta = AT.clone().requires_grad_()
    (plain,) = torch.autograd.grad(sliding(theta, 30)[0], theta)
    (replayed,) = torch.autograd.grad(sliding(theta, 30, segment=7)[0], theta)
    assert float((plain - replayed).abs().max()) < 1e-12 * float(plain.abs().max())


def test_friction_is_felt_by_the_gradient():
    theta = AT.clone().requires_grad_()
    (found,) = torch.autograd.grad(sliding(theta, 60)[0], theta)
    assert bool((found.abs() > 1e-6).all()), dict(zip(NAMES, found.tolist(), strict=True))


@pytest.mark.compile
@pytest.mark.slow
def test_compiled_steps_equal_eager_ones_with_gradients():
    from touching import two

    from torchdlo.scene import stepper

    scene, params, state = two(math.pi / 3, 0.8, (0.3, 0.1, 0), {"mu_s": 0.5, "mu_k": 0.4, "restitution": 0.3}, n=9)
    control, results = stationary_control(scene, state), []
    for execution in ("eager", "compiled"):
        run = stepper(scene, execution=execution)
        vel = state.rods.vel.clone().requires_grad_()
        now = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
        for _ in range(3):
            now = run(params, now, control)
        results.append((now.rods.pos.detach(), torch.autograd.grad(now.rods.pos.square().sum(), vel)[0]))
        with torch.no_grad():
            results.append((run(params, state, control).rods.pos,))
    for eager, compiled in zip(results[:2], results[2:], strict=True):
        for a, b in zip(eager, compiled, strict=True):
            assert float((a - b).abs().max()) < 1e-12
