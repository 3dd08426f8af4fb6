"""Gradient descent through contact gets somewhere, and nowhere with contact cut."""

from __future__ import annotations

import dataclasses
import importlib
import math
from pathlib import Path

import pytest
import torch

from torchdlo import scene_files

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.fixture
def problems(monkeypatch: pytest.MonkeyPatch):
    """Return the module of the problems."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    return importlib.import_module("learn_problems")


@pytest.mark.parametrize("name", ["push", "hook", "pour"])
def test_keys_are_commanded_as_the_scene_file_says(problems, name):
    problem = problems.PROBLEMS[name]
    generator = torch.Generator().manual_seed(0)
    first = problems.first_keys(problem.scene())
    keys = first + 0.1 * torch.tensor(problem.free) * torch.randn(first.shape, generator=generator, dtype=first.dtype)
    d = problems.described(problem, keys)
    made = scene_files.assemble(d)
    found, expected = problems.controls(d, made, keys), made.plan.controls
    assert torch.allclose(found.pos, expected.pos, atol=1e-14)
    for part in ("pos", "quat"):
        assert torch.allclose(getattr(found.bodies, part), getattr(expected.bodies, part), atol=1e-14)


def test_a_plate_learns_to_pour_and_not_with_contact_cut(problems):
    whole = problems.PROBLEMS["pour"]
    problem = dataclasses.replace(whole, scene=lambda: dataclasses.replace(whole.scene(), duration=0.2))
    found, cut = (problems.learn(problem, cut=c, iterations=2, seed=1) for c in (False, True))
    assert found.losses[0] == cut.losses[0] and cut.gradient == 0.0 and len(cut.losses) == 1
    assert 0 < found.gradient < math.inf
    assert found.losses[0] > found.losses[1] > found.losses[2]
