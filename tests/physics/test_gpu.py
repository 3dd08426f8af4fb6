"""What a GPU computes is what the CPU computes."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene as scenes
from torchdlo.physics import tree
from torchdlo.physics.effects.elastic import Bend, BendFrame, Twist
from torchdlo.physics.effects.external import AirDrag, Damping, Gravity
from torchdlo.physics.effects.table import Table, TableFriction
from torchdlo.physics.linalg import banded

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def _scene(dtype: torch.dtype, closed: bool, **choices):
    angle = torch.linspace(0, 6.0 if not closed else 2 * torch.pi * 11 / 12, 12, dtype=dtype)
    x = torch.stack([0.2 * angle.cos(), 0.2 * angle.sin(), 0.02 * angle.sin() + 0.01], -1).repeat(40, 1, 1)
    x = x + 1e-3 * torch.randn(x.shape, dtype=dtype, generator=torch.Generator().manual_seed(0))
    rope = scenes.Rope(x, mass=0.05, bend=1e-3, twist=1e-3, closed=closed, rest="as_placed")
    effects = [Gravity(), BendFrame(), Twist(), Damping(), AirDrag(), Table(), TableFriction()]
    return scenes.make(
        [rope], effects, {"table_friction": {"mu": 0.3}}, dt=2e-3, substeps=2, prescribed_vertices=(0, 1), **choices
    )


@pytest.mark.parametrize("name", ["tridiagonal:o60", "tridiagonal:c24,o7", "saddle:o30", "saddle:c12,o9"])
@pytest.mark.parametrize("transpose", [False, True])
def test_gpu_solves_banded_systems(name: str, transpose: bool) -> None:
    shape = banded.pattern(name)
    generator = torch.Generator().manual_seed(1)
    entries = 0.1 * torch.rand(int(shape.index.max()) + 1, 70, dtype=torch.float64, generator=generator)
    entries[shape.index[shape.half_bandwidth].long()] += 3.0
    rhs = torch.rand(shape.size, 70, dtype=torch.float64, generator=generator)
    expected = banded.solve_dense(entries, rhs, name, transpose)
    found = torch.ops.torchdlo.solve_banded(entries.cuda(), rhs.cuda(), name, transpose).cpu()
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize(
    "choices", [{"integrator": "explicit", "twist": "quasistatic"}, {"integrator": "implicit", "twist": "dynamic"}]
)
def test_gpu_rollout_and_gradient_equal_those_of_the_cpu(closed: bool, choices: dict) -> None:
    scene, params, state = _scene(torch.float64, closed, **choices)
    found = []
    for device in ("cpu", "cuda"):
        p, s = (tree.map(lambda x, d=device: x.to(d), t) for t in (params, state))
        bend = p.rods.material.bend.clone().requires_grad_()
        p = tree.replace(p, rods=tree.replace(p.rods, material=tree.replace(p.rods.material, bend=bend)))
        control = tree.map(lambda c: c.expand(10, *c.shape), scenes.stationary_control(scene, s))
        last, _ = scenes.rollout(lambda p, s, c: scenes.step(scene, p, s, c), p, s, control, segment=3)
        last.rods.pos.square().sum().backward()
        found.append((last.rods.pos.detach().cpu(), bend.grad.cpu()))
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=1e-9)


def test_gpu_replay_keeps_states_in_cpu_memory() -> None:
    scene, params, state = _scene(torch.float32, False, integrator="explicit")
    params, state = (tree.map(lambda x: x.to("cuda"), t) for t in (params, state))

    def peak(frames: int) -> int:
        torch.cuda.reset_peak_memory_stats()
        vel = state.rods.vel.clone().requires_grad_()
        begin = tree.replace(state, rods=tree.replace(state.rods, vel=vel))
        control = tree.map(lambda c: c.expand(frames, *c.shape), scenes.stationary_control(scene, state))
        last, _ = scenes.rollout(
            lambda p, s, c: scenes.step(scene, p, s, c),
            params,
            begin,
            control,
            segment=5,
            keep=lambda s: s.time,
            offload=True,
        )
        last.rods.pos.sum().backward()
        return torch.cuda.max_memory_allocated()

    peak(5)
    assert peak(100) < 1.1 * peak(20)


def test_bend_without_frames_runs_on_the_gpu() -> None:
    x = torch.zeros(3, 30, 3)
    x[..., 0] = torch.linspace(0, 1, 30)
    scene, params, state = scenes.make(
        [scenes.Rope(x, density=1000.0, youngs=1e6)], [Gravity(), Bend()], prescribed_vertices=(0, 1)
    )
    params, state = (tree.map(lambda t: t.to("cuda"), part) for part in (params, state))
    for _ in range(20):
        state = scenes.step(scene, params, state, scenes.stationary_control(scene, state))
    assert scenes.finite(state).all()
