"""Kernels of implicit steps with contact do what the tensor operations do, and so do their derivatives."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from test_body_sweeps import SOLIDS, crossing, rolled
from test_rod_pairs import heap
from touching import F64

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.coupling.rod_body import body_touch_op as body_touch
from torchdlo.coupling.rod_contact import rod_touch_op as rod_touch
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend
from torchdlo.physics.effects.external import Damping, Gravity
from torchdlo.physics.integrators import contact_kernel
from torchdlo.scene import Rope, make, stationary_control

pytestmark = pytest.mark.skipif(not body_touch.ready("cpu", F64), reason="there is no C++ compiler")

LAWS = {"rod_contact": {"mu_s": 0.4, "mu_k": 0.3, "restitution": 0.4}}
IMPLICIT = {"integrator": "implicit", "dt": 1e-3, "substeps": 1, "check": False}


def among_bodies(count: int, **choices):
    """Two ropes among bodies of all shapes."""
    choice, params, state = crossing(count, list(SOLIDS.values()), **choices)
    return dataclasses.replace(choice, integrator="implicit", substeps=1), params, state


def heaped(count: int, **choices):
    """Three ropes on each other, held at one vertex."""
    effects = [Gravity(), Bend(), Damping(), RodContact(**choices)]
    return make(heap(count), effects, LAWS, prescribed_vertices=(0,), **IMPLICIT)


def learned(made) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Where ropes are after a step, and the derivative of a sum of it by laws, material and state."""
    choice, params, state = made
    leaves, build = tree.flatten((params.effects, params.rods.material, state))
    leaves = [x.clone().requires_grad_() for x in leaves]
    laws, material, now = build(leaves)
    params = tree.replace(params, effects=laws, rods=tree.replace(params.rods, material=material))
    now = scene.step(choice, params, now, stationary_control(choice, now))
    found = torch.cat([now.rods.pos.flatten(), now.rods.vel.flatten(), now.rods.tension.flatten()])
    weight = torch.sin(torch.arange(len(found), dtype=found.dtype))
    gradient = torch.autograd.grad((weight * found).sum(), leaves, allow_unused=True)
    return found.detach(), [torch.zeros_like(x) if g is None else g for x, g in zip(leaves, gradient, strict=True)]


def engaged(monkeypatch, effect, module, made):
    """What an effect says of a step, by its kernel and by tensor operations."""
    found, plain, ready = [], effect.engage, module.ready

    def both(self, *given):
        for kernel in (True, False):
            monkeypatch.setattr(module, "ready", lambda *_, kernel=kernel: kernel)
            found.append(plain(self, *given))
        monkeypatch.setattr(module, "ready", ready)
        return found[0]

    monkeypatch.setattr(effect, "engage", both)
    choice, params, state = made
    with torch.no_grad():
        scene.step(choice, params, state, stationary_control(choice, state))
    return found


@pytest.mark.parametrize("choices", [{}, {"friction": False, "pieces": 3}], ids=["default", "smooth"])
def test_points_on_bodies_are_those_of_tensor_operations(choices, monkeypatch):
    one, other = engaged(monkeypatch, RodBody, body_touch, among_bodies(3, **choices))
    for field in dataclasses.fields(one):
        found, wanted = getattr(one, field.name), getattr(other, field.name)
        assert found.shape == wanted.shape, field.name
        assert torch.allclose(found, wanted, rtol=1e-10, atol=1e-12), field.name


@pytest.mark.parametrize("choices", [{}, {"friction": False, "recovery": 0.5}], ids=["default", "smooth"])
def test_pairs_of_edges_are_those_of_tensor_operations(choices, monkeypatch):
    one, other = engaged(monkeypatch, RodContact, rod_touch, heaped(3, **choices))
    assert torch.equal(one.real, other.real)
    assert float(one.real.sum()) > 10
    for name in ("normal", "radius", "wanted", "mu"):
        assert torch.allclose(one.real * getattr(one, name), one.real * getattr(other, name), atol=1e-13), name
    for found, wanted in zip(one.linear, other.linear, strict=True):
        assert torch.allclose(one.real.unsqueeze(-1) * found, one.real.unsqueeze(-1) * wanted, atol=1e-11)


@pytest.mark.parametrize("kind", ["bodies", "ropes"])
def test_steps_and_gradients_are_those_of_tensor_operations(kind, monkeypatch):
    # Rounding of 1e-16 grows with the stiffness of contact, 1e4.
    made = among_bodies(2) if kind == "bodies" else heaped(2)
    run = (lambda: rolled(made, 1)) if kind == "bodies" else (lambda: learned(made))
    found, gradient = run()
    for module in (body_touch, rod_touch):
        monkeypatch.setattr(module, "ready", lambda *_: False)
    monkeypatch.setattr(contact_kernel, "available", lambda like: False)
    wanted, expected = run()
    assert float((found - wanted).norm()) < 1e-10 * float(wanted.norm())
    assert sum(bool(g.abs().max() > 0) for g in expected if g.numel()) > 8
    for one, other in zip(gradient, expected, strict=True):
        assert float((one - other).norm()) <= 1e-9 * float(other.norm())


def test_steps_in_single_precision_are_near_those_in_double():
    choice, *numbers = heaped(2)
    ends, gradients = [], []
    for dtype in (torch.float64, torch.float32):
        params, state = tree.map(lambda x, t=dtype: x.to(t), numbers)
        found, gradient = learned((choice, params, state))
        ends.append(found.double())
        gradients.append([g.double() for g in gradient])
    assert float((ends[0] - ends[1]).norm()) < 1e-4 * float(ends[0].norm())
    for one, other in zip(*gradients, strict=True):
        assert float((one - other).norm()) <= 0.05 * float(one.norm()) + 1e-9


def test_a_batch_is_its_scenes_one_by_one():
    choice, params, state = heaped(5)
    control = stationary_control(choice, state)
    with torch.no_grad():
        whole = scene.step(choice, params, state, control).rods.pos
        for k in range(5):
            mine = tree.map(lambda x, k=k: x[k : k + 1] if x.dim() > 2 and x.shape[0] == 5 else x, (params, state))
            alone = scene.step(choice, *mine, stationary_control(choice, mine[1])).rods.pos
            assert torch.allclose(alone[0], whole[k], rtol=0, atol=1e-13)


def test_held_stretchy_ropes_with_finite_grip_have_gradients_of_tensor_operations(monkeypatch):
    # Ropes that yield, are heavy at one end and held there: each part of the equations has its say.
    x = torch.zeros(2, 8, 3, dtype=F64)
    x[..., 0] = torch.linspace(0, 0.14, 8, dtype=F64)
    x[..., 2] = 0.0049
    rope = Rope(x, radius=0.005, density=1e3, bend=1e-4, stretch=50.0)
    solids = [SOLIDS["sphere"], dataclasses.replace(SOLIDS["plane"], pos=(0.0, 0.0, 0.0))]
    effects = [Gravity(), Bend(), Damping(), RodBody()]
    made = make([rope], effects, {"damping": {"rate": 3.0}}, bodies=solids, prescribed_vertices=(0, 7), **IMPLICIT)
    found, gradient = learned(made)
    monkeypatch.setattr(body_touch, "ready", lambda *_: False)
    monkeypatch.setattr(contact_kernel, "available", lambda like: False)
    wanted, expected = learned(made)
    assert float((found - wanted).norm()) < 1e-10 * float(wanted.norm())
    for one, other in zip(gradient, expected, strict=True):
        assert float((one - other).norm()) <= 1e-9 * float(other.norm())
