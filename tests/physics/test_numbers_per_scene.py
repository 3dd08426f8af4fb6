"""A rope that is given once, with numbers for every scene, is that rope in each of them."""

from __future__ import annotations

import pytest
import torch

from torchdlo import scene
from torchdlo.physics.effects.elastic import Bend, Twist
from torchdlo.physics.effects.external import Damping, Gravity

COUNT, VERTICES = 3, 12
VALUES = {"bend": 1e-4, "twist": 1e-4, "mass": 0.02, "radius": 0.004, "stretch": 1e3}


def after(numbers: dict, integrator: str, frames: int = 5) -> torch.Tensor:
    """Positions after some steps of a rope that sags between two fixed ends."""
    x = torch.zeros(VERTICES, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(0, 0.3, VERTICES)
    x[:, 1] = 0.02 * torch.sin(torch.linspace(0, 3, VERTICES, dtype=torch.float64))
    rope = scene.Rope(x, **{"mass": 0.02, "bend": 1e-4, "twist": 1e-4} | numbers)
    choices = {"integrator": integrator, "dt": 1e-3 if integrator == "implicit" else 1e-4}
    world, params, state = scene.make(
        [rope], [Gravity(), Bend(), Twist(), Damping()], prescribed_vertices=(0,), **choices
    )
    for _ in range(frames):
        state = scene.step(world, params, state, scene.stationary_control(world, state))
    return state.rods.pos


@pytest.mark.parametrize("integrator", ["implicit", "explicit"])
@pytest.mark.parametrize("name", VALUES)
def test_a_batch_of_numbers_is_a_loop_over_them(name: str, integrator: str) -> None:
    scales = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    values = VALUES[name] * scales
    alone = torch.stack([after({name: float(v)}, integrator) for v in values])
    along = values[:, None].expand(COUNT, VERTICES)
    for given in (values[:, None], along, along[..., None]):
        found = after({name: given}, integrator)
        assert found.shape == (COUNT, VERTICES, 3), tuple(given.shape)
        torch.testing.assert_close(found, alone, rtol=0, atol=1e-9)


def test_as_many_scenes_as_vertices_are_scenes() -> None:
    found = after({"bend": torch.full((VERTICES, 1), 1e-4, dtype=torch.float64)}, "implicit", 1)
    assert found.shape == (VERTICES, VERTICES, 3)
