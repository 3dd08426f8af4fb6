"""Recorded steps do what steps do."""

import gc
import itertools
from pathlib import Path

import pytest
import torch
from torch.autograd import forward_ad

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.effects import EFFECTS
from torchdlo.physics.execution import tracing


def _rope(batch=2, vertices=8):
    x = torch.linspace(0, 0.5, vertices, dtype=torch.float64)
    points = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], -1).expand(batch, -1, 3)
    rope = scenes.Rope(points, radius=0.005, mass=0.03, bend=1e-4)
    return scenes.make([rope], [EFFECTS["gravity"](), EFFECTS["bend"]()], prescribed_vertices=(0,))


def test_a_recorded_step_does_what_the_step_does_with_other_numbers_too():
    scene, params, state = _rope()
    step = scenes.stepper(scene, execution="eager")
    control = scenes.stationary_control(scene, state)
    recorded = tracing.record(step, params, state, control)
    stiffer = tree.replace(params, rods=tree.map(lambda x: 1.5 * x, params.rods))
    for numbers in (params, stiffer):
        a = b = state
        for k in range(5):
            moved = tree.replace(control, pos=control.pos + 1e-5 * k)
            a, b = step(numbers, a, moved), recorded(numbers, b, moved)
        for x, y in zip(tree.leaves(a), tree.leaves(b), strict=True):
            # Edge lengths are found in a kernel, whose system is another one in its last digits.
            torch.testing.assert_close(x, y, rtol=1e-7, atol=1e-10)


def test_numbers_that_are_nearly_the_same_stay_apart():
    # TorchScript takes numbers that differ by less than 6e-8 for one.
    near = 1 + 1e-10, 1 + 2e-10, 1 + 5e-8, 1.0, 1 + 1e-10

    def step(x):
        return *(n * x for n in near), x + near[0], x.clamp(min=near[1])

    x = torch.tensor([0.7, 1.3], dtype=torch.float64)
    recorded = tracing.record(step, x)
    for given in (x, 3 * x):
        assert all(torch.equal(a, b) for a, b in zip(recorded(given), step(given), strict=True))


@pytest.mark.parametrize("names, twist", [(["bend"], "none"), (["bend", "twist"], "dynamic")])
def test_a_rope_in_free_flight_keeps_its_momentum_to_rounding(names, twist):
    s = torch.linspace(0, 1, 21, dtype=torch.float64)
    helix = torch.stack([0.3 * torch.cos(3 * s), 0.3 * torch.sin(3 * s), 0.1 * s], -1)
    rope = scenes.Rope(helix, radius=0.005, density=1000.0, bend=1e-4, twist=1e-4)
    scene, params, state = scenes.make([rope], [EFFECTS[n]() for n in names], dt=2e-4, substeps=1, twist=twist)
    thrown = torch.randn(21, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    state = tree.replace(state, rods=tree.replace(state.rods, vel=0.5 * thrown))
    step, control = scenes.stepper(scene, execution="recorded"), scenes.stationary_control(scene, state)
    momentum = []
    with torch.no_grad():
        for _ in range(12):
            state = step(params, state, control)
            momentum.append((params.rods.material.mass * state.rods.vel).sum(-2))
    change = torch.stack([after - before for before, after in itertools.pairwise(momentum)])
    assert float(change.abs().max()) < 1e-12 * float(momentum[0].norm()), change


def test_recordings_are_found_again_by_key_and_shapes_and_the_oldest_goes():
    calls = []

    def step(x):
        calls.append(x.shape)
        return (2 * x,)

    known, x = tracing.Recordings(2), torch.ones(3)
    first = known.find("double", step, x)
    assert known.find("double", step, 5 * x) is first and len(calls) == 1
    assert torch.equal(first(5 * x)[0], 10 * x)
    known.find("double", step, torch.ones(4))
    known.find("other", step, x)
    assert known.find("double", step, x) is not first and len(calls) == 4


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory of a process is read from /proc")
def test_recordings_that_are_let_go_free_their_memory():
    def megabytes():
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20

    def step(x):
        for _ in range(800):
            x = 1.0001 * x + torch.ones(3)
        return (x,)

    def use():
        recorded = tracing.record(step, torch.zeros(3))
        for _ in range(3):
            recorded(torch.zeros(3))

    use()
    before = megabytes()
    for _ in range(4):
        use()
    # Kept, each would take 25 MB.
    assert megabytes() - before < 30


def test_steps_are_recorded_at_first_use_without_gradients_and_run_as_they_are_with_them():
    calls = []

    def step(factor, x):
        calls.append(None)
        return (factor * x,)

    recorded = tracing.RecordedStep(step)
    factor, x = torch.tensor(2.0), torch.ones(3)
    for _ in range(3):
        assert torch.equal(recorded(factor, x)[0], 2 * x)
    assert len(calls) == 1
    learned = factor.clone().requires_grad_()
    (found,) = recorded(learned, x)
    assert len(calls) == 2 and torch.autograd.grad(found.sum(), learned)[0] == 3
    with torch.no_grad():
        (found,) = recorded(learned, x)
    assert torch.equal(found, 2 * x) and not found.requires_grad and found.grad_fn is None
    assert len(calls) == 2
    with forward_ad.dual_level():  # recorded steps do not see what is carried forward
        (found,) = recorded(forward_ad.make_dual(factor, torch.tensor(1.0)), x)
        assert torch.equal(forward_ad.unpack_dual(found).tangent, x)


def test_a_step_that_cannot_be_recorded_runs_as_it_is():
    calls = []

    def step(x):
        calls.append(None)
        if len(calls) == 1:
            raise RuntimeError("the recorder does not know this operation")
        return (2 * x,)

    recorded, x = tracing.RecordedStep(step), torch.ones(3)
    for _ in range(2):
        assert torch.equal(recorded(x)[0], 2 * x)
    assert len(calls) == 3
