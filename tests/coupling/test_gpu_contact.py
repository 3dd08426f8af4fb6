"""Kernels of contact for GPUs do what those of the CPU do, which are tested against tensor operations.

Where there is no GPU, threads of the CPU run them. Sums are taken in another order: rounding of 1e-16 grows with the
stiffness of contact, some 1e4.
"""

from __future__ import annotations

import dataclasses

import interpreted
import pytest
import torch
from test_body_sweeps import SOLIDS, crossing, rolled
from test_rod_pairs import heap
from torch.utils._python_dispatch import TorchDispatchMode
from touching import F64

from torchdlo import scene
from torchdlo.coupling import RodBody, RodContact
from torchdlo.coupling.rod_body import rod_body_op
from torchdlo.coupling.rod_contact import broad_phase_op, rod_contact_op
from torchdlo.physics import tree
from torchdlo.physics.effects.external import Gravity
from torchdlo.physics.kernels import cuda
from torchdlo.scene import make, stationary_control

pytestmark = pytest.mark.skipif(not rod_body_op.ready("cpu", F64), reason="there is no C++ compiler")

KERNELS = {
    "rod_near": broad_phase_op._look,
    "rod_outrun": broad_phase_op._outrun,
    "rod_pairs": rod_contact_op._sweep,
    "rod_pairs_back": rod_contact_op._back,
    "body_sweeps": rod_body_op._sweep,
    "body_sweeps_back": rod_body_op._back,
}


class _Calls(TorchDispatchMode):
    """What operators of ours were called with, and returned."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, tuple, object]] = []

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        found = operator(*args, **(kwargs or {}))
        name = operator.name().removeprefix("torchdlo::").partition(".")[0]
        if name in KERNELS:
            self.seen.append((name, args, found))
        return found


def calls(made, frames: int = 1) -> list[tuple[str, tuple, object]]:
    """Calls in some frames and in the derivative of what comes of them."""
    choice, params, state = made
    vel = state.rods.vel.clone().requires_grad_()
    now = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
    with _Calls() as known:
        for _ in range(frames):
            now = scene.step(choice, params, now, stationary_control(choice, state))
        found = now.rods.pos + 0.1 * now.rods.vel
        (found * torch.sin(torch.arange(found.numel(), dtype=F64)).reshape(found.shape)).sum().backward()
    return known.seen


def ropes(count: int, **choices):
    """A heap of three ropes on a plane."""
    effects = [Gravity(), RodContact(**choices), RodBody()]
    numbers = {"rod_contact": {"mu_s": 0.4, "mu_k": 0.3, "restitution": 0.4}}
    choices = {"dt": 1e-3, "substeps": 3, "prescribed_vertices": (0,), "check": False}
    ground = dataclasses.replace(SOLIDS["plane"], pos=(0, 0, -0.027))
    return make(heap(count), effects, numbers, bodies=[ground], **choices)


def paired(found, expected) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """What a kernel returned beside what was expected."""
    both = zip(*([x] if isinstance(x, torch.Tensor) else x for x in (found, expected)), strict=True)
    return [(one.detach(), other.detach()) for one, other in both]


def agree(seen, bound: float = 1e-9) -> set[str]:
    """Run kernels again, compare, and return the names of those that made something."""
    made = set()
    for name, args, expected in seen:
        found = KERNELS[name](*args)
        for one, other in paired(found, expected):
            assert bool((one.isnan() == other.isnan()).all()), name
            one, other = one.nan_to_num(0.0), other.nan_to_num(0.0)
            assert float((one - other).abs().sum()) <= bound * float(other.abs().sum()), name
            if bool(other.any()):
                made.add(name)
    return made


@pytest.mark.parametrize(
    ("count", "choices"), [(3, {}), (1, {"friction": False, "sweeps": 2}), (2, {"room": 5})], ids=["", "smooth", "full"]
)
def test_kernels_of_ropes_agree_with_those_of_the_cpu(count: int, choices, monkeypatch):
    # With room for five pairs others are lost, and both say how many.
    seen = calls(ropes(count, **choices))
    interpreted.use(monkeypatch)
    assert agree(seen) >= set(KERNELS) - {"rod_outrun"}


def test_kernels_of_bodies_agree_with_those_of_the_cpu(monkeypatch):
    seen = calls(crossing(3, list(SOLIDS.values()), pieces=3))
    interpreted.use(monkeypatch)
    assert agree(seen) >= {"body_sweeps", "body_sweeps_back"}


def test_memory_that_is_not_fast_does_as_well(monkeypatch):
    # One warp works on three scenes, one after the other, all in slow memory.
    seen = calls(ropes(3))
    interpreted.use(monkeypatch)
    monkeypatch.setattr(cuda, "SHARED", 0)
    monkeypatch.setattr(cuda, "SCRATCH", 1)
    agree(seen)


def test_ropes_that_touch_nothing_feel_nothing(monkeypatch):
    choice, params, state = ropes(2)
    apart = state.rods.pos + torch.arange(37, dtype=F64)[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=F64) + 1
    seen = calls((choice, params, tree.replace(state, rods=tree.replace(state.rods, pos=apart))))
    interpreted.use(monkeypatch)
    assert not agree(seen) & {"rod_pairs", "body_sweeps"}


def test_what_is_not_a_number_stays_so_and_in_its_scene(monkeypatch):
    choice, params, state = ropes(2)
    pos = state.rods.pos.clone()
    pos[1, 3, 0] = torch.nan
    seen = calls((choice, params, tree.replace(state, rods=tree.replace(state.rods, pos=pos))))
    interpreted.use(monkeypatch)
    for name, args, expected in seen:
        found = KERNELS[name](*args)
        for one, other in paired(found, expected):
            torch.testing.assert_close(one[..., 0], other[..., 0], rtol=1e-9, atol=1e-12)
            assert not one[..., 0].is_floating_point() or bool(one[..., 0].isfinite().all()), name


def test_whole_steps_and_gradients_agree(monkeypatch):
    # With positions that the kernels of GPUs led to, not those of the CPU.
    made = crossing(2, [SOLIDS[name] for name in ("plane", "box", "ring")])
    wanted, expected = rolled(made, 2)
    interpreted.use(monkeypatch)
    found, gradient = rolled(made, 2)
    assert float((found - wanted).norm()) < 1e-9 * float(wanted.norm())
    for one, other in zip(gradient, expected, strict=True):
        assert float((one - other).norm()) <= 1e-8 * float(other.norm())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("made", [ropes(70), crossing(70, list(SOLIDS.values()))], ids=["ropes", "bodies"])
def test_gpu_does_what_the_cpu_does(made):
    assert rod_body_op.ready("cuda", F64) and rod_contact_op.ready("cuda", F64) and broad_phase_op.ready("cuda", F64)
    found = []
    for device in ("cpu", "cuda"):
        choice, params, state = made[0], *(tree.map(lambda x, d=device: x.to(d), part) for part in made[1:])
        vel = state.rods.vel.clone().requires_grad_()
        now = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
        for _ in range(2):
            now = scene.step(choice, params, now, stationary_control(choice, state))
        (gradient,) = torch.autograd.grad(now.rods.pos.square().sum(), vel)
        found.append((now.rods.pos.detach().cpu(), gradient.cpu()))
    for one, other in zip(*found, strict=True):
        assert float((one - other).norm()) <= 1e-7 * float(one.norm())
