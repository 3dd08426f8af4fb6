"""Ropes that are taken to hang at rest are let swing out until they do, and no longer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.sysid.swaying import recording as swaying
from torchdlo.physics import tree
from torchdlo.scene import Control
from torchdlo.sysid.estimation.jobs import Models
from torchdlo.sysid.model import equilibrium
from torchdlo.sysid.model import initial_state as starts


@pytest.fixture
def hung(tmp_path: Path):
    """A stiff rope's scene, two trials of it, as it begins bent aside."""
    models = Models(swaying(tmp_path, frames=40), {"vertices": 17, "numerical_damping": 0.05, "clamp_fraction": 0.0})
    model = models.model(())
    motion = models.motion(model, "train").pick(np.arange(2))
    begin = starts.begin(model, models.recording.train).pick(np.arange(2))
    values = np.repeat(model.guess()[None], 2, 0)
    values[:, model.parameters.index("bending_stiffness")] = 5e-2
    scene, params, state = model.build(motion, begin, values)
    held = Control(*(tree.batch_innermost(x[:, 0]) for x in (motion.held, model._commands(scene, state, motion))))
    return scene, tree.map(tree.batch_innermost, params), state, held


@torch.no_grad()
def test_what_hangs_still_is_stepped_no_further(hung, monkeypatch: pytest.MonkeyPatch) -> None:
    count, step = [0], equilibrium.recorded_step

    def counted(*given):
        take = step(*given)

        def taken(*inputs):
            count[0] += 1
            return take(*inputs)

        return taken

    monkeypatch.setattr(equilibrium, "recorded_step", counted)
    early = equilibrium.come_to_rest(*hung)
    taken, count[0] = count[0], 0
    monkeypatch.setattr(equilibrium, "_STILL", 0.0)
    late = equilibrium.come_to_rest(*hung)
    assert taken < count[0] == 40
    # It moved, and where it came to is the same to less than a micrometre.
    assert float((late.rods.pos - hung[2].rods.pos).abs().max()) > 1e-2
    assert float((late.rods.pos - early.rods.pos).abs().max()) < 1e-6
    assert float(early.rods.vel.abs().max()) == 0.0
