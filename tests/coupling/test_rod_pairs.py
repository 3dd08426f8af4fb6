"""The kernel for contact among ropes does what the tensor operations do, and so does its derivative."""

from __future__ import annotations

import dataclasses
import math
import os
import shutil

import pytest
import torch
from touching import F64, line

from torchdlo.coupling import RodContact
from torchdlo.coupling.common.step_diagnostics import broad_phase
from torchdlo.coupling.rod_contact import broad_phase_op
from torchdlo.coupling.rod_contact import rod_contact_op as rod_pairs
from torchdlo.physics import tree
from torchdlo.physics.effects import base as effect
from torchdlo.physics.effects.base import PredictedMotion
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.execution import tracing
from torchdlo.physics.rod import kinematics as rod
from torchdlo.scene import Rope, make, stationary_control, step

COMPILER = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")

GIVEN = ("pos", "vel", "change", "mobility", "radius", "laws")
CHOICES = {
    "touching": (1e-4, {}),
    "deep in each other": (-2e-3, {"recovery": 0.3}),
    "smooth": (1e-4, {"friction": False, "sweeps": 2}),
    "many sweeps": (-1e-3, {"sweeps": 6}),
}
"""Gaps among the ropes [m], and choices of the effect."""


def heap(count: int, seed: int = 0, gap: float = 1e-4):
    """Two open ropes and a squeezed loop, one on another and a little different in each scene, that move at random."""
    g = torch.Generator().manual_seed(seed)
    r = 0.01
    a = 2 * math.pi * torch.arange(16, dtype=F64) / 16
    loop = torch.stack([0.15 * a.cos(), 0.0099 * a.sin(), 0 * a + 2 * r + gap], -1)
    shapes = [line(12, 0.4), line(9, 0.3, 0.6, -2 * r - gap), loop]
    ropes = []
    for k, x in enumerate(shapes):
        moved = x + 3e-4 * torch.randn(count, *x.shape, generator=g, dtype=F64)
        vel = torch.tensor([0.3 * (k == 2), 0.1, (0.3, 0.9, -0.5)[k]], dtype=F64)
        vel = vel + 0.1 * torch.randn(count, *x.shape, generator=g, dtype=F64)
        ropes.append(
            Rope(moved, radius=r * (1 + 0.01 * k), density=1000.0 + 200 * k, velocities=vel, closed=k == 2, bend=1e-4)
        )
    return ropes


def inputs(ropes: list[Rope], dtype: torch.dtype, numbers: dict[str, float] | None = None, **choices):
    """An effect, its arguments in a substep of free motion as a function of tensors, and these tensors."""
    contact = RodContact(**choices)
    numbers = {"mu_s": 0.4, "mu_k": 0.3, "restitution": 0.4} | (numbers or {})
    scene, params, state = make(ropes, [contact], {"rod_contact": numbers}, dt=1e-3, substeps=5, check=False)
    params, state = tree.to(params, dtype), tree.to(state, dtype)
    control = stationary_control(scene, state)
    values = broad_phase(scene, params, state, control, control).effects["rod_contact"]
    rods = effect.altered_params(scene.effects, scene.topology, params.rods, params.effects)
    dt = 2e-4
    free = torch.ones_like(state.rods.pos[..., :1]).index_fill(-2, torch.tensor([0, 20]), 0.0)
    mobility = (dt * dt / rods.material.mass).expand_as(state.rods.pos[..., :1])
    scatter = torch.sin(torch.arange(mobility.numel(), dtype=dtype)).reshape(mobility.shape)
    mobility = mobility * (1 + 0.1 * scatter) * mobility.new_tensor([1.0, 0.9, 0.8])
    laws = torch.cat([values[name].expand(*mobility.shape[:-2], 1, 1) for name in ("mu_s", "mu_k", "restitution")], -1)
    given = (state.rods.pos, state.rods.vel, dt * state.rods.vel, mobility, rods.material.radius, laws)

    def arguments(pos, vel, change, mobility, radius, laws):
        there = tree.replace(state.rods, pos=pos, vel=vel)
        made = tree.replace(rods, material=tree.replace(rods.material, radius=radius))
        known = values | dict(zip(("mu_s", "mu_k", "restitution"), laws.split(1, -1), strict=True))
        return rod.view(scene.topology, made, there, dt), PredictedMotion(change, mobility, mobility * free), known

    return contact, arguments, tuple(x.detach().clone() for x in given)


def pushed(contact: RodContact, arguments, given) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Forces on vertices, and the derivative of a sum of them by all that they depend on."""
    leaves = [x.clone().requires_grad_() for x in given]
    force = contact.solve_contact(*arguments(*leaves))
    weight = torch.sin(torch.arange(force.numel(), dtype=force.dtype)).reshape(force.shape)
    found = torch.autograd.grad((weight * force).sum(), leaves, allow_unused=True)
    return force.detach(), [torch.zeros_like(x) if g is None else g for x, g in zip(leaves, found, strict=True)]


def by_tensors(monkeypatch, *words):
    """The same by tensor operations."""
    with monkeypatch.context() as patch:
        patch.setattr(rod_pairs, "ready", lambda *_: False)
        return pushed(*words)


def test_the_kernels_are_built_where_there_is_a_compiler():
    for dtype in (F64, torch.float32):
        assert rod_pairs.ready("cpu", dtype) and broad_phase_op.ready("cpu", dtype)
    assert not rod_pairs.ready("cuda", F64) and not broad_phase_op.ready("cpu", torch.float16)


@pytest.mark.parametrize("count", [1, 11, 100])
@pytest.mark.parametrize("choices", CHOICES.values(), ids=CHOICES)
def test_the_kernel_and_tensor_operations_agree_with_their_gradients(choices, count, monkeypatch):
    # Rounding of 1e-16 grows by what Jacobi sweeps and the inverse of slender moments of inertia, 1 / WEAK, make of it.
    gap, given = choices
    made = inputs(heap(count, gap=gap), F64, **given)
    force, gradient = pushed(*made)
    wanted, expected = by_tensors(monkeypatch, *made)
    assert int((wanted.norm(dim=-1) > 0).sum()) > 10 * count, "hardly anything touches"
    slides, rebounds = (float(x.norm()) > 0 for x in expected[-1].split(1, -1)[1:])
    assert slides == made[0].friction and (rebounds or gap < 0)
    assert float((force - wanted).norm()) <= 1e-12 * float(wanted.norm())
    for name, one, other in zip(GIVEN, gradient, expected, strict=True):
        assert float(other.norm()) > 0, name
        assert float((one - other).norm()) <= 1e-11 * float(other.norm()), name


@pytest.mark.parametrize("count", [1, 11, 100])
def test_single_precision_is_close_to_double(count):
    # Places of up to 0.2 m round by 1.2e-8 m, and pairs have to part by 1e-4 m: 1e-4 of the forces, and as much again
    # per sweep and with the derivative, more where parting is slowed down.
    ropes = heap(count, gap=-1e-4)
    double, single = (pushed(*inputs(ropes, dtype)) for dtype in (F64, torch.float32))
    assert single[0].dtype == torch.float32
    assert float((single[0] - double[0]).norm()) <= 3e-3 * float(double[0].norm())
    for name, one, other in zip(GIVEN, single[1], double[1], strict=True):
        assert float((one - other).norm()) <= 3e-3 * float(other.norm()), name


def test_pairs_that_do_not_touch_exert_nothing_and_neither_does_an_empty_list(monkeypatch):
    far = heap(3)
    far = [dataclasses.replace(rope, positions=rope.positions + 5.0 * k) for k, rope in enumerate(far[:2])]
    for ropes in (far, heap(3, gap=1e-3)[:2]):
        made = inputs(ropes, F64, {"restitution": 0.0})
        listed = made[1](*made[2])[2]["real"].sum()
        assert (float(listed) > 0) == (ropes is not far)
        if ropes is not far:  # near enough for the list, but they stay where they are
            made = (
                *made[:2],
                tuple(0 * x if name in ("vel", "change") else x for name, x in zip(GIVEN, made[2], strict=True)),
            )
        force, gradient = pushed(*made)
        assert float(force.abs().max()) == 0.0
        assert all(float(g.abs().max()) == 0.0 for g in gradient)
        wanted, expected = by_tensors(monkeypatch, *made)
        assert float(wanted.abs().max()) == 0.0 and all(float(g.abs().max()) == 0.0 for g in expected)


def test_scenes_do_together_what_each_does_alone_on_any_number_of_threads():
    ropes = heap(20)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        force, gradient = pushed(*inputs(ropes, F64))
    finally:
        torch.set_num_threads(threads)
    again = pushed(*inputs(ropes, F64))
    assert torch.equal(force, again[0]) and all(torch.equal(a, b) for a, b in zip(gradient, again[1], strict=True))
    contact, arguments, given = inputs(ropes, F64)
    with torch.no_grad():
        for k in (0, 7, 19):
            _, motion, _ = arguments(*given)
            one = inputs(
                [dataclasses.replace(r, positions=r.positions[k], velocities=r.velocities[k]) for r in ropes], F64
            )
            alone = tree.map(lambda x, k=k: x[k] if x.dim() == 3 else x, motion)
            its = one[1](*one[2])
            found = contact.solve_contact(its[0], alone, its[2])
            # The same operations in the same order.
            assert torch.equal(found, force[k])


def test_values_without_scenes_and_several_axes_of_scenes_are_understood():
    # Two axes of scenes, numbers of the effect per scene, one radius for all.
    ropes = [
        dataclasses.replace(r, positions=r.positions.unflatten(0, (2, 3)), velocities=r.velocities.unflatten(0, (2, 3)))
        for r in heap(6)
    ]
    contact, arguments, given = inputs(ropes, F64)
    force = contact.solve_contact(*arguments(*given))
    flat = inputs(heap(6), F64)
    view, _, values = flat[1](*flat[2])
    assert force.shape == (2, 3, 37, 3)
    made = arguments(*given)
    motion = tree.map(lambda x: x.flatten(0, 1), made[1])
    assert torch.equal(contact.solve_contact(view, motion, values), force.flatten(0, 1))


def test_what_is_not_a_number_is_not_hidden():
    contact, arguments, given = inputs(heap(2), F64)
    change = given[2].clone()
    change[0, 16, 2] = math.nan  # where the second rope crosses the first
    force = contact.solve_contact(*arguments(*given[:2], change, *given[3:]))
    assert not bool(torch.isfinite(force[0]).all()) and bool(torch.isfinite(force[1]).all())


def test_a_second_derivative_is_refused():
    contact, arguments, given = inputs(heap(1), F64)
    leaves = [x.clone().requires_grad_() for x in given]
    (slope,) = torch.autograd.grad(
        contact.solve_contact(*arguments(*leaves)).square().sum(), leaves[2], create_graph=True
    )
    with pytest.raises(RuntimeError, match="no second derivative"):
        slope.sum().backward()


def test_recorded_steps_do_what_steps_do():
    scene, params, state = make(heap(3), [Bend(), RodContact()], dt=1e-3, substeps=2, check=False)
    control = stationary_control(scene, state)

    def both(params, state, control):
        return step(scene, params, state, control)

    recorded = tracing.record(both, params, state, control)
    with torch.no_grad():
        for _ in range(2):
            wanted, state = both(params, state, control), recorded(params, state, control)
            # Recording may fuse operations of the step: rounding, 1e-16 of 0.4 m, times the stiffness of contact.
            assert float((wanted.rods.pos - state.rods.pos).abs().max()) < 1e-12
            assert float((wanted.diagnostics - state.diagnostics).abs().max()) < 1e-12


@pytest.mark.compile
def test_a_compiled_reaction_and_survey_agree_with_eager_ones():
    contact, arguments, given = inputs(heap(2), F64)

    def reaction(*given):
        view, motion, known = arguments(*given)
        carried = view.state.pos[..., :0, :]
        with torch.no_grad():
            fresh = contact.broad_phase(view, carried)
        return contact.solve_contact(view, motion, known | {k: fresh[k] for k in ("corners", "real")}), fresh["reach"]

    found = []
    for way in (reaction, torch.compile(reaction, backend="aot_eager", fullgraph=True)):
        leaves = [x.clone().requires_grad_() for x in given]
        force, reach = way(*leaves)
        gradients = torch.autograd.grad(force.square().sum(), leaves)
        found.append([force.detach(), reach, *gradients])
    for eager, other in zip(*found, strict=True):
        # The same operations: rounding at most.
        assert float(eager.norm()) > 0 and float((eager - other).norm()) <= 1e-12 * float(eager.norm())
