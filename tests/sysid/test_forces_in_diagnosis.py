"""Forces at the grippers in a diagnosis: they stand behind the markers in fits, and tell what markers cannot."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.test_diagnose import GRIPPED, S, hanging
from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis import effect_library, effect_search, gripper_forces
from torchdlo.sysid.diagnosis.findings import findings, summary
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model.grip_wrench import grips, packed, unpacked
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording
from torchdlo.sysid.recordings.wrench import ForceSensor

MASS, BEND, TWIST, RATE, DRAG = 0.03, 2e-3, 1.5e-3, 0.5, 6.0
NOISE, FORCE, TORQUE = 2e-4, 1e-3, 2e-4
TOO_HEAVY = 1.5
"""What rope.json says of the mass, over what it is."""


def weighed(path: Path, effects: dict[str, float], vertices: int = 31) -> Recording:
    """Trials of a rope whose gripper has a sensor, and of which rope.json says that it is heavier than it is."""
    rng = np.random.default_rng(5)
    trials = tuple(
        replace(hanging(n, rng), wrench=np.zeros((41, 1, 6)), wrench_marker=np.array([1]))
        for n in ("train_0", "train_1", "test_0")
    )
    sensor = ForceSensor("world", FORCE, TORQUE)
    gravity = np.array([0, 0, -9.81])
    empty = Recording(path, 0.6, 0.005, MASS, gravity, None, NOISE, None, None, False, "", trials[:2], trials[2:])
    names = sorted({key.split(".")[0] for key in effects})
    model = RopeModel(empty, vertices=vertices, effects=names, substep=5e-3, numerical_damping=0.05, clamp_fraction=0.0)
    values = dict(zip(model.parameters, model.guess(), strict=True)) | effects
    values |= {"bending_stiffness": BEND, "twisting_stiffness": TWIST, "damping_rate": RATE}
    start = Start(np.stack([t.markers[0] for t in trials]), np.zeros((3, len(S), 3)), np.ones(3, bool))
    # The correction of starts reads the markers: none is seen while the recording is made.
    motion = replace(model.motion(trials), markers=np.full((3, 41, len(S), 3), np.nan))
    row = np.array([[values[n] for n in model.parameters]])
    (sims,), (felt,) = model.with_forces(motion, start, row, grips(model.mesh, trials[0]))
    made = []
    for trial, sim, wrench in zip(trials, sims, felt, strict=True):
        seen = np.where(GRIPPED[:, None], trial.markers, sim + NOISE * rng.normal(size=sim.shape))
        wrench = wrench + np.repeat([FORCE, TORQUE], 3) * rng.normal(size=wrench.shape)
        made.append(replace(trial, markers=seen, wrench=wrench))
    return replace(empty, mass=TOO_HEAVY * MASS, train=tuple(made[:2]), test=tuple(made[2:]), wrench=sensor)


@pytest.fixture(scope="module")
def dragged(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return weighed(tmp_path_factory.mktemp("rope"), {"air_drag.c_d": DRAG})


def test_readings_are_packed_and_unpacked() -> None:
    rng = np.random.default_rng(0)
    markers, wrench = rng.normal(size=(2, 5, 7, 3)), rng.normal(size=(2, 5, 2, 6))
    again = unpacked(packed(markers, wrench, (0.1, 2.0)), 7, (0.1, 2.0))
    np.testing.assert_allclose(again, wrench)
    alone = packed(markers, wrench, (0.1, None))
    assert alone.shape == (2, 5, 9, 3)
    np.testing.assert_array_equal(alone[..., :7, :], markers)
    np.testing.assert_allclose(unpacked(alone, 7, (0.1, None))[..., :3], wrench[..., :3])
    assert np.isnan(unpacked(alone, 7, (0.1, None))[..., 3:]).all()


def test_simulations_have_forces_behind_the_markers(dragged: Recording) -> None:
    options = {"vertices": 31, "forces": True, "force_worth": (0.05, 0.4)}
    with Pool(dragged, options, workers=1) as pool:
        model = pool.local.model(())
        motion, rows = pool.local.motion(model, "train"), model.guess()[None] * [[1.0], [1.1]]
        correction = np.full((2, 41, 10, 3), 1e-3)
        start = Start(motion.markers[:, 0], np.zeros((2, len(S), 3)), discretisation_correction=correction)
        ((_, sims),) = pool.simulate([SimulationJob((), rows, "train", start, frames=6)])
        shorter = replace(motion, markers=motion.markers[:, :6])
        markers, wrench = model.with_forces(shorter, start, rows, model.grips)
        measured = pool.local.measured(model, "train")
    assert sims.shape == (2, 2, 6, 12, 3) and measured.shape == (2, 41, 12, 3)
    np.testing.assert_allclose(sims[..., :10, :], markers, atol=1e-12)
    np.testing.assert_allclose(unpacked(sims, 10, (0.05, 0.4)), wrench, rtol=1e-9)
    np.testing.assert_allclose(unpacked(measured, 10, (0.05, 0.4))[0, :-1], dragged.train[0].wrench[:-1])
    assert np.isnan(measured[:, -1, 10:]).all() and not np.isnan(measured[:, :-1]).any()


def fitted(bench: Workspace, forces: bool) -> tuple[Workspace, Fitted, Fitted]:
    """A workspace, its baseline, and the model with air drag."""
    plain = bench.pool.local.model(())
    first = np.array([TOO_HEAVY * BEND, TOO_HEAVY * TWIST, RATE])
    bench = bench.begin(first, ())
    base = bench.fit([FitJob((), first[None], tuple(plain.parameters), (1.0,) * 3, 2, bench.starts["train"])])[0]
    bench, base = gripper_forces.take_forces(bench, base, 3, lambda *_: None) if forces else (bench, base)
    names = (*base.space.names, "air_drag.c_d")
    values = np.append(base.values, 3.0)[None]
    job = FitJob(("air_drag",), values, names, (1.0,) * len(names), 5, bench.starts["train"])
    return bench, base, bench.fit([job])[0]


@pytest.mark.parametrize("forces", [True, False])
def test_forces_tell_how_large_a_drag_is(dragged: Recording, forces: bool) -> None:
    # Markers tell stiffness and drag only over mass: by what rope.json says too much of that, both are too large.
    said = dragged if forces else replace(dragged, wrench=None)
    with Pool(said, {"vertices": 31, "numerical_damping": 0.05, "clamp_fraction": 0.0}, workers=1) as pool:
        bench, base, more = fitted(Workspace(pool), forces)
        found = dict(zip(more.space.names, more.values, strict=True))
        before, after = (gripper_forces.force_errors(bench, f) for f in (base, more))
    factor = 1.0 if forces else TOO_HEAVY
    assert found["bending_stiffness"] == pytest.approx(factor * BEND, rel=0.05)
    assert found["air_drag.c_d"] == pytest.approx(factor * DRAG, rel=0.08)
    if forces:
        assert found["mass"] == pytest.approx(MASS, rel=0.03)
        # With the drag, forces are off by little more than their noise.
        assert after.force < 0.8 * before.force and after.torque < before.torque
    else:
        assert before is None and "mass" not in found


def test_a_bias_of_forces_widens_what_goes_with_the_mass(dragged: Recording) -> None:
    biased = replace(dragged, wrench=ForceSensor("world", FORCE, TORQUE, force_bias_std=0.01 * MASS * 9.81))
    options = {"vertices": 31, "forces": True, "force_worth": (0.05, None)}
    with Pool(biased, options, workers=1) as pool:
        bench, model = Workspace(pool), pool.local.model(("air_drag",))
        values = np.array([{"mass": MASS, "air_drag.c_d": 2.0}.get(n, 0.5) for n in model.parameters])
        space = ParameterSpace(tuple(model.parameters), tuple(model.params), (4.0,) * len(values))
        point = Point(space.to_raw(values), 0.0, np.empty(0), np.empty(0), np.empty(0))
        (row,) = gripper_forces.bias_drift(bench, Fitted(("air_drag",), values, space, point))
    # 1 % of logarithms and of 2.0 in steps of 4.0; nothing of the rate of damping, which is told over the mass.
    assert dict(zip(model.parameters, row, strict=True)) == pytest.approx(
        {
            "bending_stiffness": 0.01,
            "twisting_stiffness": 0.01,
            "damping_rate": 0.0,
            "mass": 0.01,
            "air_drag.c_d": 0.005,
        },
        rel=1e-3,
    )


def test_forces_that_cannot_be_are_refused_by_a_diagnosis_too(dragged: Recording) -> None:
    train = tuple(replace(t, wrench=-t.wrench) for t in dragged.train)
    with pytest.raises(InputError, match="multiply it by -1"):
        effect_search.diagnose(replace(dragged, train=train))


@pytest.mark.slow
def test_a_diagnosis_weighs_the_rope(dragged: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effect_library, "library", lambda: ("air_drag", "point_mass"))
    monkeypatch.setattr(effect_search, "BUDGETS", {"fast": effect_search.Budget(3, 2, 3, 3, 1)})
    result = effect_search.diagnose(dragged, vertices=31, workers=1)
    said = json.loads(json.dumps(findings(result, dragged), default=str))
    assert result.effects == ["air_drag"] and result.verdict == "effects"
    assert said["effects"][0]["parameters"]["c_d"]["value"] == pytest.approx(DRAG, rel=0.1)
    assert said["baseline"]["mass"]["value"] == pytest.approx(MASS, rel=0.03)
    assert said["forces"]["test_force_rmse_after_n"] < said["forces"]["test_force_rmse_before_n"]
    assert any("rope.json 45 g" in note for note in said["notes"])
    assert "Force at the grippers" in summary(result, dragged)
