"""Scene files: what is written reads back equal, and each way in which a file can be wrong has its sentence."""

from __future__ import annotations

import contextlib
import dataclasses
import json

import numpy as np
import pytest
import torch

from torchdlo import scene_files
from torchdlo.cli import app
from torchdlo.errors import InputError
from torchdlo.physics import tree
from torchdlo.scene import rollout, step
from torchdlo.scene_files import Attachment, BodySpec, Keyframe, RopeSpec, SceneDescription
from torchdlo.scene_files.ropes import rope_of

LIFT = SceneDescription(
    ropes=(
        RopeSpec(points=((0.0, 0.0, 0.1), (0.4, 0.0, 0.1)), vertices=9, mass=0.03, bend=1e-3, twist=1e-3),
        RopeSpec(points=((0.0, 0.3, 0.2), (0.1 + 0.2, 0.3, 0.2), (0.3, 0.5, 0.2)), vertices=8, mass=0.02, bend=1e-3),
    ),
    effects={"gravity": {}, "bend": {}, "damping": {"rate": 1 / 3}, "rod_body": {}},
    bodies=(
        BodySpec("box", (0.5, 0.5, 0.02), pos=(0.2, 0.2, -0.02), motion="fixed"),
        BodySpec(
            "sphere",
            (0.03,),
            pos=(0.2, -0.2, 0.1),
            motion="kinematic",
            keyframes=(Keyframe(0.02, move=(0.0, 0.1, 0.0)),),
        ),
    ),
    attachments=(
        Attachment(
            vertices=(0, 1), keyframes=(Keyframe(0.01, move=(0.0, 0.0, 0.01)), Keyframe(0.02, turn=(0.0, 0.1, 0.0)))
        ),
        Attachment(vertices=(-1,), rope=1, release=0.0105),
    ),
    duration=0.02,
    integrator="implicit",
    substeps=1,
)


def test_a_file_reads_back_to_the_last_bit(tmp_path):
    scene_files.save(LIFT, tmp_path / "scene.json")
    assert scene_files.read(tmp_path / "scene.json") == LIFT
    first, second = scene_files.build(LIFT), scene_files.load(tmp_path / "scene.json")
    assert first[0] == second[0]
    for a, b in zip(tree.leaves(first[1:]), tree.leaves(second[1:]), strict=True):
        assert torch.equal(a, b)
    scene_files.save(scene_files.read(tmp_path / "scene.json"), tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "scene.json").read_bytes()


def test_a_described_scene_runs_and_held_parts_go_where_keys_say():
    scene, params, state, controls = scene_files.build(LIFT)
    with torch.no_grad():
        last, seen = rollout(lambda *a: step(scene, *a), params, state, controls, keep=lambda s: s.rods.pos)
    assert torch.isfinite(last.rods.pos).all()
    # Half-way between two keys a smooth motion has gone half of the way.
    height = seen[:, 0, 2] - 0.1
    assert float(height[4]) == pytest.approx(0.005, rel=1e-9) and float(height[9]) == pytest.approx(0.01, rel=1e-9)
    # Then it goes back to its place while it turns by 0.1 about y: the second vertex, 5 cm along x, goes down.
    assert float(seen[-1, 0, 2]) == pytest.approx(0.1, rel=1e-9)
    assert float(seen[-1, 1, 2]) == pytest.approx(0.1 - 0.05 * torch.sin(torch.tensor(0.1)).item(), rel=1e-6)
    # The other rope is let go after 10 steps.
    assert torch.allclose(seen[:10, -1], state.rods.pos[-1])
    assert float(seen[-1, -1, 2]) < 0.2 - 1e-4
    assert torch.allclose(last.bodies.pos[1], state.bodies.pos[1] + torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64))


def test_a_line_is_cut_into_equal_parts():
    corner = RopeSpec(points=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0)), vertices=5, mass=1.0)
    positions = rope_of(corner, 0, torch.float64).positions
    assert positions.tolist() == [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 0.5, 0], [1, 1, 0]]
    square = RopeSpec(
        points=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)), vertices=8, closed=True
    )
    found = rope_of(square, 0, torch.float64).positions
    assert len(found) == 8 and found[-1].tolist() == [0, 0.5, 0]


def test_steps_are_solved_as_a_file_says(tmp_path):
    chosen = {"constraint_iterations": 5, "twist_iterations": 6, "implicit_weight": 0.3, "numerical_damping": 0.1}
    scene_files.save(dataclasses.replace(LIFT, **chosen), tmp_path / "scene.json")
    made = scene_files.load(tmp_path / "scene.json")[0]
    assert {name: getattr(made, name) for name in chosen} == chosen
    (tmp_path / "scene.json").write_text(change("implicit_weight", to=0.1))
    with pytest.raises(ValueError, match=r"implicit_weight is 0.1; expected at least 0.25"):
        scene_files.load(tmp_path / "scene.json")


def test_single_precision_is_used_throughout():
    made = scene_files.build(
        SceneDescription(LIFT.ropes, {"gravity": {}, "bend": {}}, precision="float32", integrator="implicit")
    )
    assert {x.dtype for x in tree.leaves(made[1:])} == {torch.float32}


def change(*path, to=None, drop=False):
    """The file with one entry changed, as text."""
    content = {"format": scene_files.FORMAT} | json.loads(json.dumps(scene_files.plain(LIFT)))
    at = content
    for key in path[:-1]:
        at = at[key]
    if drop:
        del at[path[-1]]
    else:
        at[path[-1]] = to
    return json.dumps(content)


WRONG = {
    "cut": (change("notes", to="x")[:200], r"line 1, column \d+ is not JSON"),
    "no format": (change("format", drop=True), "torchdlo scene 2"),
    "wrong entry": (
        change("ropes", 0, "radios", to=1.0),
        r"ropes\[0\].radios: there is no such entry; did you mean 'radius'",
    ),
    "missing": (change("ropes", 1, "points", drop=True), r"ropes\[1\].points: is missing"),
    "text for number": (
        change("ropes", 0, "mass", to="heavy"),
        r'ropes\[0\].mass: expected a finite number, given "heavy"',
    ),
    "true for number": (change("dt", to=True), "dt: expected a finite number, given true"),
    "fraction": (change("ropes", 0, "vertices", to=2.5), r"vertices: expected a whole number, given 2.5"),
    "short vector": (change("bodies", 0, "pos", to=[0, 1]), r"bodies\[0\].pos: expected a list of 3 numbers"),
    "choice": (change("integrator", to="implict"), "did you mean 'implicit'"),
    "shape": (change("bodies", 0, "shape", to="bax"), r"bodies\[0\].shape: .*did you mean 'box'"),
    "effect": (change("effects", "gravty", to={}), "effects.gravty: there is no such effect; did you mean 'gravity'"),
    "effect's number": (change("effects", "damping", to={"rat": 1}), "effects.damping.rat: .*did you mean 'rate'"),
    "effect's value": (
        change("effects", "damping", to={"rate": "a"}),
        "effects.damping.rate: expected a finite number",
    ),
    "effect's vector": (change("effects", "gravity", to={"acceleration": [1, 2]}), "expected a list of 3 numbers"),
    "list": (change("ropes", to={}), "ropes: expected a list"),
    "object": (change("ropes", 0, to=3), r"ropes\[0\]: expected an object"),
    "vertex": (change("attachments", 0, "vertices", to=[99]), r"attachments\[0\].vertices: expected -9 to 8, given 99"),
    "rope": (change("attachments", 1, "rope", to=7), r"attachments\[1\].rope: expected 0 to 1, given 7"),
    "nothing held": (change("attachments", 1, "vertices", to=[]), r"attachments\[1\].vertices: is empty"),
    "physics": (change("ropes", 0, "mass", to=-1.0), "mass"),
    "step": (change("dt", to=0.0), "dt is 0"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_refused_with_place_and_expectation(case, tmp_path):
    text, sentence = WRONG[case]
    file = tmp_path / "scene.json"
    file.write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        scene_files.load(file)
    assert str(file) in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected a scene file, found none"):
        scene_files.load(tmp_path / "no.json")


def simulate(*arguments: object) -> int:
    """Exit code of the command."""
    with pytest.raises(SystemExit) as caught:
        app.main(["simulate", *map(str, arguments)])
    return int(caught.value.code or 0)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "hang.json"
    rope = RopeSpec(points=((0.0, 0.0, 0.5), (0.4, 0.0, 0.5)), vertices=6, mass=0.03, bend=1e-3)
    scene_files.save(
        SceneDescription((rope,), {"gravity": {}, "bend": {}}, attachments=(Attachment((0,)),), duration=0.03), path
    )
    return path


def test_the_command_keeps_frames_and_a_picture(file, tmp_path, capsys):
    assert simulate(file, "--out", tmp_path / "run", "--frame-stride", 10, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == 4 and summary["time"] == pytest.approx(0.03)
    kept = np.load(tmp_path / "run" / "frames.npz")
    assert kept["pos"].shape == (4, 6, 3) and kept["force"].shape == (4, 1, 3)
    assert scene_files.parse(str(kept["torchdlo_scene"])) == scene_files.read(file)
    assert (tmp_path / "run" / "shapes.png").read_bytes()[:4] == b"\x89PNG"
    # Its own files are replaced, those of others are not.
    assert simulate(file, "--out", tmp_path / "run") == 0
    (tmp_path / "run" / "shapes.png").write_bytes(b"mine")
    assert simulate(file, "--out", tmp_path / "run") == 2


def test_the_command_draws_a_picture_and_a_video(file, tmp_path, capsys):
    pytest.importorskip("pyvista", reason="pictures need the extra view")
    av = pytest.importorskip("av", reason="videos need the extra view")
    assert simulate(file, "--out", tmp_path / "run", "--video", "--picture", "--speed", 0.5) == 0
    written = sorted(p.name for p in (tmp_path / "run").iterdir())
    assert written == ["frames.npz", "motion.mp4", "picture.png", "shapes.png"]
    said = capsys.readouterr().out
    assert all(name in said for name in written)
    with av.open(str(tmp_path / "run" / "motion.mp4")) as video:
        # 0.03 s at half speed: pictures at 0, 1/30 and 2/30 s.
        assert sum(1 for _ in video.decode(video=0)) == 3
    # Its own video is replaced, that of others is not; nothing is simulated before.
    (tmp_path / "run" / "motion.mp4").write_bytes(b"mine")
    (tmp_path / "run" / "frames.npz").unlink()
    assert simulate(file, "--out", tmp_path / "run", "--video") == 2
    assert not (tmp_path / "run" / "frames.npz").exists()


def test_ctrl_c_keeps_frames_so_far(file, tmp_path, monkeypatch):
    from torchdlo.cli import scenes as commands

    @contextlib.contextmanager
    def impatient(show):
        def callback(stage, done, total, message=""):
            if done >= 20:
                raise KeyboardInterrupt

        yield callback

    monkeypatch.setattr(commands, "deferred_interrupt", impatient)
    assert simulate(file, "--out", tmp_path / "run") == 130
    assert len(np.load(tmp_path / "run" / "frames.npz")["time"]) == 3


def test_a_run_that_breaks_says_when_and_keeps_what_was_sound(file, tmp_path, monkeypatch, capsys):
    from torchdlo import scene as scenes

    real, seen = scenes.check_state, []

    def check(state):
        seen.append(state)
        if len(seen) == 2:
            raise RuntimeError("scene: positions or velocities are not finite")
        real(state)

    monkeypatch.setattr(scenes, "check_state", check)
    assert simulate(file, "--out", tmp_path / "run") == 1
    assert "after 0.02 s" in capsys.readouterr().err
    assert len(np.load(tmp_path / "run" / "frames.npz")["time"]) == 2


def test_the_command_refuses_a_wrong_file(tmp_path, capsys):
    (tmp_path / "scene.json").write_text("{")
    assert simulate(tmp_path / "scene.json") == 2
    assert "is not JSON" in capsys.readouterr().err


def test_the_example_of_the_documentation_runs(repository, tmp_path, monkeypatch):
    text = (repository / "docs" / "scenes.md").read_text()
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    exec(text.split("```python\n")[1].split("```")[0], found)
    assert found["controls"].pos.shape == (600, 3, 3)
    assert scene_files.read("lift.json") == found["lift"]
    # Its ends are never led further apart than the rope between them is long, until the second one is let go.
    held = found["controls"].pos[:400]
    length = float(found["params"].rods.rest.length[..., 1:19, 0].sum())
    assert float((held[:, 1] - held[:, 2]).norm(dim=-1).max()) < length


OLD = """{
 "format": "torchdlo scene 1",
 "ropes": [{"points": [[0, 0, 0.5], [0.4, 0, 0.5]], "vertices": 6, "mass": 0.03, 
  "weights": [{"vertex": -1, "mass": 1}]}],
 "effects": {"gravity": {}, "rod_matter": {"mu": 0.1}, "body_matter": {}},
 "robots": [{"base": [-0.5, 0, 0], "keys": [{"time": 0.6, "move": [0, 0, -0.145]}]}],
 "bodies": [{"shape": "sphere", "size": [0.1], "motion": "kinematic", "keys": [{"time": 1, "turn": [0, 0, 1]}]}],
 "matter": [{"law": "sand", "size": [0.1], "spacing": 0.02, "shape": "ball", "numbers": {"youngs": 1e4}}],
 "box": {"low": [-1, -1, -1], "high": [1, 1, 1], "spacing": 0.1},
 "holds": [{"vertices": [2], "robot": 0, "close": 0.6}],
 "look": [1, 0, 0.5]
}"""
"""A file as version 0.1 wrote it, with every entry that has another name today."""


def test_files_of_version_1_are_read():
    found = scene_files.parse(OLD)
    assert found.attachments == (Attachment((2,), robot=0, close=0.6),)
    assert found.robots[0].keyframes == (Keyframe(0.6, move=(0.0, 0.0, -0.145)),)
    assert found.bodies[0].keyframes == (Keyframe(1.0, turn=(0.0, 0.0, 1.0)),)
    assert list(found.effects) == ["gravity", "rod_mpm_coupling", "body_mpm_coupling"]
    assert found.material_points[0].constitutive_model == "sand"
    assert found.material_points[0].parameters == {"youngs": 1e4}
    assert found.camera_direction == (1.0, 0.0, 0.5) and found.ropes[0].hanging_masses[0].mass == 1.0
    # What is written again is of today.
    assert scene_files.parse(scene_files.text(found)) == found and '"torchdlo scene 2"' in scene_files.text(found)
    # An entry of today does not belong into a file of then, nor the other way round.
    with pytest.raises(InputError, match="there is no such entry"):
        scene_files.parse(OLD.replace("scene 1", "scene 2"))


def test_frames_of_version_0_1_are_read(file, tmp_path):
    from torchdlo.scene_files.run import load_frames

    assert simulate(file, "--out", tmp_path / "run") == 0
    older = {"material_points": "matter", "constitutive_model": "law", "camera_direction": "look"}
    with np.load(tmp_path / "run" / "frames.npz") as kept:
        np.savez(tmp_path / "old.npz", **{older.get(name, name): kept[name] for name in kept.files})
    now, then = load_frames(tmp_path / "run"), load_frames(tmp_path / "old.npz")
    assert np.array_equal(now.camera_direction, then.camera_direction) and np.array_equal(now.pos, then.pos)
