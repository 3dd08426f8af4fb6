"""The derivative of an implicit step is that of the step as computed, also under violent motion."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import F64, effects

from torchdlo import scene
from torchdlo.physics import tree
from torchdlo.scene import Rope, check_gradients


def jerked(bend: torch.Tensor, amplitude: float, **choices) -> torch.Tensor:
    """Mean squared height of a slack rope, one of whose ends is shaken at 20 rad/s for 60 frames of 5 ms."""
    n = 21
    s = torch.linspace(0, 1, n, dtype=F64)
    x = torch.stack([0.8 * s, 0 * s, -0.28 * torch.sin(math.pi * s)], -1)
    made, params, state = scene.make(
        [Rope(x, mass=0.05, bend=1e-3, radius=0.004)],
        effects("bend", "gravity", "damping"),
        integrator="implicit",
        dt=5e-3,
        substeps=1,
        prescribed_vertices=(0, n - 1),
        **choices,
    )
    material = tree.replace(params.rods.material, bend=bend.expand(n, 1))
    params = tree.replace(params, rods=tree.replace(params.rods, material=material))
    control, heights = scene.stationary_control(made, state), []
    for k in range(1, 61):
        pos = control.pos + torch.tensor([[0.0, 0, 0], [0, 0, amplitude * math.sin(0.1 * k)]], dtype=F64)
        state = scene.step(made, params, state, tree.replace(control, pos=pos))
        heights.append(state.rods.pos[:, 2])
    return torch.stack(heights).square().mean()


@pytest.mark.parametrize("amplitude", [0.05, 0.15])
def test_gradients_of_implicit_steps_are_those_of_violent_motion_as_computed(amplitude):
    found = check_gradients(lambda bend: jerked(bend, amplitude), torch.tensor(1e-3, dtype=F64), directions=1)
    assert found.error < 1e-6, str(found)
    # Too few Newton steps leave the derivative of another function: the check sees it.
    if amplitude > 0.1:
        few = check_gradients(
            lambda bend: jerked(bend, amplitude, constraint_iterations=3), torch.tensor(1e-3, dtype=F64)
        )
        assert few.error > 3e-5


def test_check_of_gradients_sees_a_wrong_gradient_and_names_what_it_cannot_use():
    x = {"a": torch.tensor([0.3, 0.4], dtype=F64), "b": torch.tensor(2.0, dtype=F64)}
    assert check_gradients(lambda x: (x["a"].sin() * x["b"] ** 3).sum(), x).error < 1e-8
    assert check_gradients(lambda x: (x["a"].sin() * x["b"].detach() ** 3).sum(), x).error > 0.1
    with pytest.raises(ValueError, match="one number"):
        check_gradients(lambda x: x["a"], x)
    with pytest.raises(ValueError, match="no floating-point tensor"):
        check_gradients(lambda x: x, torch.tensor([1, 2]))


def test_a_scene_of_a_batch_ends_when_it_is_solved_and_moves_as_alone():
    def run(amplitudes: torch.Tensor) -> torch.Tensor:
        n = 12
        s = torch.linspace(0, 1, n, dtype=F64)
        x = torch.stack([0.8 * s, 0 * s, -0.28 * torch.sin(math.pi * s)], -1).expand(*amplitudes.shape, n, 3)
        made, params, state = scene.make(
            [Rope(x, mass=0.05, bend=1e-3)],
            effects("bend", "gravity"),
            integrator="implicit",
            dt=5e-3,
            substeps=1,
            prescribed_vertices=(0, n - 1),
        )
        control = scene.stationary_control(made, state)
        for k in range(1, 20):
            up = torch.stack([torch.zeros_like(amplitudes), amplitudes * math.sin(0.2 * k)], -1)
            pos = control.pos + torch.stack([0 * up, 0 * up, up], -1)
            state = scene.step(made, params, state, tree.replace(control, pos=pos))
        return state.rods.pos

    sizes = torch.tensor([0.0, 0.01, 0.1, 0.2], dtype=F64)
    together = run(sizes)
    for k, size in enumerate(sizes):
        assert torch.allclose(together[k], run(size.reshape(1))[0], atol=1e-12)
