"""Work that a machine cannot do is refused before anything is made of it, with the numbers; long work is told."""

from __future__ import annotations

import json
import logging
import re
import resource
import time
from pathlib import Path
from typing import Any

import pytest

from torchdlo import notices, scene_files, work_budget
from torchdlo.cli import app
from torchdlo.errors import InputError
from torchdlo.scene_files import limits
from torchdlo.sysid.model import model_file

pytestmark = pytest.mark.quick

ROPE = {"points": [[0, 0, 0], [1, 0, 0]], "vertices": 20, "radius": 0.005, "mass": 0.1, "bend": 1e-3}
SCENE: dict[str, Any] = {"format": scene_files.FORMAT, "ropes": [ROPE], "effects": {"gravity": {}}}
MATTER = {
    "material_points": [{"constitutive_model": "elastic", "size": [0.05, 0.05, 0.05], "spacing": 1e-5}],
    "box": {"low": [-0.1, -0.1, -0.1], "high": [0.1, 0.1, 0.1], "spacing": 2e-5},
}
LARGE = {
    "vertices": ({"ropes": [ROPE | {"vertices": 10**9}]}, r"1e.09 vertices, 1000 steps need about 5 TB of memory"),
    "steps": ({"duration": 1e9, "dt": 1e-6}, r"20 vertices, 1e.15 steps need about .* TB of memory"),
    "matter": (MATTER, r"1e.12 material points, .* cells need about .* of memory, and this machine has .* larger spac"),
    "substeps": (
        {"ropes": [ROPE | {"vertices": 10**5}], "substeps": 999_999},
        r"1000 steps of 999999 substeps with 1e.05 vertices take about 25 years on this machine, and at most 30 days",
    ),
    "frames": ({"ropes": [ROPE | {"vertices": 10**5}], "duration": 1000.0}, r"1e.05 frames need about"),
}


@pytest.mark.parametrize("case", LARGE)
def test_scenes_beyond_the_machine_are_refused_before_the_work(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work_budget, "available_memory", lambda: 20e9)
    change, sentence = LARGE[case]
    (tmp_path / "scene.json").write_text(json.dumps(SCENE | change))
    before, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    with pytest.raises(SystemExit) as caught:
        app.main(["simulate", str(tmp_path / "scene.json"), "--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert caught.value.code == 2 and said.count("\n") == 1
    assert re.search(f"scene.json: .*{sentence}", said), said
    assert not (tmp_path / "out").exists()
    assert time.process_time() - begun < 5.0 and resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 5e5


def test_the_cells_of_a_mesh_are_counted_before_they_are_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh = pytest.importorskip("trimesh")
    from torchdlo.coupling.bodies.mesh_sdf import load_mesh

    monkeypatch.setattr(work_budget, "available_memory", lambda: 20e9)
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "box.stl")
    with pytest.raises(InputError, match=r"box.stl: 100000 cells .* need about .* TB of mem"):
        load_mesh(tmp_path / "box.stl", cells=100_000, cache=tmp_path)


def test_long_work_is_told_once_and_short_work_is_not(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notices, "_said", set())
    described = scene_files.parse(json.dumps(SCENE))
    with caplog.at_level(logging.WARNING, logger="torchdlo"):
        limits.check_time(described)
        assert not caplog.records
        long = scene_files.parse(json.dumps(SCENE | {"duration": 100.0}))
        limits.check_time(long)
        limits.check_time(long)
    assert [r.getMessage() for r in caplog.records] == [
        "scene: 1e+05 steps of 5 substeps with 20 vertices take about 9.7 minutes."
    ]


def test_the_estimate_of_time_is_of_the_right_size() -> None:
    # A factor of 20 tells seconds from minutes; machines differ by less.
    described = scene_files.parse(json.dumps(SCENE | {"integrator": "implicit", "substeps": 1, "duration": 0.05}))
    from torchdlo.scene_files.run import run

    begun = time.process_time()
    run(described)
    taken = time.process_time() - begun
    told = limits.steps_of(described) * (limits._SUBSTEP + 20 * limits._VERTEX_SECONDS)
    assert told / 20 < taken < told * 100


def test_sizes_and_times_are_for_people() -> None:
    assert work_budget.size_text(4.98e12) == "4.98 TB" and work_budget.size_text(12) == "12 bytes"
    assert work_budget.duration_text(90) == "1.5 minutes" and work_budget.duration_text(3e9) == "95 years"
    assert work_budget.duration_text(59) == "59 s"
    assert 1e8 < work_budget.available_memory() < 1e15


def test_batches_beyond_the_machine_are_refused() -> None:
    from torchdlo.envs import find
    from torchdlo.envs.core import episode

    with pytest.raises(InputError, match=r"lifting: 1000000000 scenes at once need about 100 TB of memory"):
        episode.prepare(find("lifting"), 10**9)


def test_searches_and_calibrations_beyond_the_machine_are_refused(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(work_budget, "available_memory", lambda: 20e9)
    many = ("optimize", "lifting", "--method", "gd", "--population", "1000000000", "--episodes", "2000000000")
    for words, sentence in (
        (many, r"population: 1e.09 trajectories at once need about .* TB of memory"),
        (
            ("calibrate", str(folder), "--vertices", "1000000000"),
            r"vertices: expected 2 to 100000 for a rope, given 1e.09",
        ),
    ):
        with pytest.raises(SystemExit) as caught:
            app.main(list(words))
        assert caught.value.code == 2 and re.search(sentence, capsys.readouterr().err)


def test_models_of_broken_meshes_are_refused(folder: Path) -> None:
    content = {
        "format": model_file.FORMAT,
        "version": model_file.VERSION,
        "parameters": {"bending_stiffness": 1e-3, "twisting_stiffness": 1e-3, "damping_rate": 0.5},
        "effects": {},
        "options": {
            "vertices": 9,
            "rest": "straight",
            "numerical_damping": 0.1,
            "clamp_fraction": 0.5,
            "substep": 1e-3,
        },
    }
    file = folder / "model.json"
    file.write_text(json.dumps(content))
    assert model_file.load(file).options["vertices"] == 9
    for vertices, said in ((5.7, "5.7"), (10**12, "1000000000000"), ("x", "'x'"), (True, "True")):
        file.write_text(json.dumps(content | {"options": content["options"] | {"vertices": vertices}}))
        with pytest.raises(InputError, match=f"options.vertices: expected a .*number from 2 to 100000, found {said}"):
            model_file.load(file)
