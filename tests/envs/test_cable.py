"""Tasks with a rope of one's own, as a calibration or a diagnosis found it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from test_contract import F64, small, stage_waypoints

from torchdlo import scene as scenes
from torchdlo.agents.trajopt.task_problem import task_problem
from torchdlo.envs import TASKS, RopeMaterial, find
from torchdlo.envs.core import episode
from torchdlo.errors import InputError
from torchdlo.physics.effects import EFFECTS
from torchdlo.scene_files import cable
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.model.model_file import content
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import load_recording

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"
STRONG = {
    "air_drag.c_d": 2.0,
    "wind.velocity.0": 3.0,
    "wind.c_d": 1.2,
    "bending_damping.coefficient": 2e-6,
    "rest_curvature.curvature.0": 3.0,
    "varying_rest_curvature.modes.1": 3.0,
    "bending_plasticity.yield_curvature": 1e-3,
    "internal_friction.moment": 1e-3,
    "stiffening_bending.c": 0.1,
    "nonuniform_stiffness.factor": -1.0,
    "anisotropic_bending.ratio": 3.0,
    "point_mass.position": 0.5,
    "point_mass.mass": 0.02,
    "stretch.EA": 20.0,
}
"""Values at which effects show."""


def write(path: Path, effects: tuple[str, ...] = (), **numbers: float) -> Path:
    """A model file of the sample rope."""
    model = RopeModel(load_recording(SAMPLE), effects=effects)
    values = [({"bending_stiffness": 2e-3, "damping_rate": 4.0} | STRONG | numbers).get(n) for n in model.parameters]
    values = np.array([g if v is None else v for v, g in zip(values, model.guess(), strict=True)])
    path.write_text(json.dumps(content(model, values), default=lambda x: x.tolist()))
    return path


def play(name: str, rope: RopeMaterial | None, actions: int = 3) -> torch.Tensor:
    """Where the rope is after a few short actions."""
    task = dataclasses.replace(small(name, actions), rope=rope)
    made = episode.prepare(task, 2, like=torch.zeros((), dtype=F64), execution="eager")
    world = made.start
    with torch.no_grad():
        for action in stage_waypoints(task, actions).unbind(1):
            world = episode.act(made, world, action)
    scenes.check_state(world.state)
    return world.state.rods.pos


def test_a_rope_of_a_model_file_is_that_of_the_task(tmp_path: Path) -> None:
    found = cable(write(tmp_path / "model.json", ("air_drag", "time_delay", "tilted_gravity")))
    recording = load_recording(SAMPLE)
    assert found.bend == 2e-3 and found.line_density == pytest.approx(recording.mass / recording.length)
    # What belongs to the recording is left out.
    assert dict(found.effects) == {"air_drag": (("c_d", (2.0,)),)}
    _, params, state = find("separation", found).start(1, like=torch.zeros((), dtype=F64))
    length = params.rods.rest.length * params.rods.rest.edge_mask
    assert float(params.rods.material.mass.sum()) == pytest.approx(found.line_density * float(length.sum()))
    assert (params.rods.material.bend == 2e-3).all() and float(params.effects["damping"]["rate"]) == 4.0
    assert float(params.effects["damping"]["twist_rate"]) == 20.0  # the task's
    damping = find("gathering", found).start(1)[1].effects["damping"]
    assert float(damping["rate"]) == 4.0 and float(damping["twist_rate"]) == 10.0
    assert find("separation").start(1)[2].rods.pos.double().sub(state.rods.pos).abs().max() < 1e-6


@pytest.mark.parametrize("effect", effect_library.library())
def test_effects_of_a_model_act_in_tasks(tmp_path: Path, effect: str) -> None:
    rope = cable(write(tmp_path / "model.json", (effect,)))
    plain = dataclasses.replace(rope, effects=())
    apart = float((play("wiring_post", rope) - play("wiring_post", plain)).norm(dim=-1).max())
    of_recordings = {name for name, law in EFFECTS.items() if law.kind in ("measurement", "boundary")}
    if effect in of_recordings | {"tilted_gravity", "table_friction", "fluid_forces", "self_contact"}:
        assert rope == plain
    else:
        assert apart > 1e-9


@pytest.mark.parametrize("name", TASKS)
def test_every_task_takes_a_rope(tmp_path: Path, name: str) -> None:
    rope = cable(write(tmp_path / "model.json", ("rest_curvature", "air_drag")))
    assert torch.isfinite(play(name, rope, 1)).all()


def test_a_natural_shape_is_laid_along_the_rope() -> None:
    bent = RopeMaterial(0.05, 2e-3, 4.0, curvature=((0.0, 0.0), (2.0, -1.0)))
    _, params, _ = find("coiling", bent).start(1, like=torch.zeros((), dtype=F64))
    middle = params.rods.rest.curvature.reshape(-1, 60, 2)[0, 30] / 0.02
    torch.testing.assert_close(middle, torch.tensor([2.0, -1.0], dtype=F64) * 30 / 59, rtol=1e-6, atol=1e-9)
    with pytest.raises(InputError, match="expected a task without closed ropes"):
        find("wrapping", bent).start(1)


def test_a_mass_beyond_the_rope_is_refused(tmp_path: Path) -> None:
    rope = cable(write(tmp_path / "model.json", ("point_mass",), **{"point_mass.position": 0.5}))
    with pytest.raises(InputError, match=r"point mass sits at 0.5 m; .*this task's has 0.22 m"):
        find("slingshot", rope).start(1)
    with pytest.raises(InputError, match="expected a model file, found none"):
        cable(tmp_path / "none.json")


def test_what_steps_cannot_follow_is_refused(tmp_path: Path) -> None:
    rope = cable(write(tmp_path / "model.json", ("bending_damping",), **{"bending_damping.coefficient": 1e-5}))
    with pytest.raises(InputError, match=r"coiling steps by 0.2 ms .*bending damping"):
        find("coiling", rope).start(1)


def test_searches_depend_on_the_rope(tmp_path: Path) -> None:
    rope = cable(write(tmp_path / "model.json", ("air_drag",)))
    usual, own = task_problem("coiling"), task_problem("coiling", rope)
    assert "rope" not in usual.choices and own.choices["rope"]["bend"] == 2e-3
