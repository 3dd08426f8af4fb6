"""Meshes, matter, robots, weights and calibrated ropes in scene files, and what happens to them in a run."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from torchdlo import scene_files
from torchdlo.coupling.robot.robot_kinematics import panda, tool_pose
from torchdlo.errors import InputError
from torchdlo.scene import rollout, step
from torchdlo.scene_files import (
    Attachment,
    BodySpec,
    GridSpec,
    HangingMass,
    Keyframe,
    ParticleBlockSpec,
    RobotSpec,
    RopeSpec,
    SceneDescription,
)
from torchdlo.scene_files.rope_models import Modelled
from torchdlo.scene_files.run import load_frames, run, save_frames

LINE = RopeSpec(((0.0, 0.0, 0.1), (0.3, 0.0, 0.1)), vertices=7, mass=0.03, bend=1e-3)
FALL = SceneDescription((LINE,), {"gravity": {}, "bend": {}}, duration=0.06, substeps=2)
POSTURE = (0.0, 0.2, 0.0, -2.2, 0.0, 2.4, 0.785, 0.012)


def change(description: SceneDescription, **fields) -> SceneDescription:
    return dataclasses.replace(description, **fields)


def over_a_peg(**fields) -> SceneDescription:
    """A rope of 11 g that hangs over a smooth peg of 5 cm radius, with 200 g at either end."""
    arc = [(0.052 * math.sin(a), 0.0, 0.052 * math.cos(a)) for a in np.linspace(-math.pi / 2, math.pi / 2, 25)]
    points = ((-0.052, 0.0, -0.1), *arc, (0.052, 0.0, -0.1))
    weights = tuple(HangingMass(vertex=v, mass=0.2) for v in (0, -1))
    rope = RopeSpec(points, vertices=41, radius=0.002, mass=0.011, hanging_masses=weights)
    # A capsule along the y axis.
    peg = BodySpec("capsule", (0.05, 0.2), quat=(math.sqrt(0.5), math.sqrt(0.5), 0, 0), motion="fixed")
    effects = {"gravity": {}, "damping": {"rate": 0.5}, "rod_body": {}}
    return change(SceneDescription((rope,), effects, bodies=(peg,), duration=0.2), **fields)


def test_taut_ropes_over_bodies_are_still_without_asking_for_a_way_of_contact():
    made = scene_files.assemble(over_a_peg())
    assert made.scene.contact == "coupled"
    frames = run(over_a_peg())
    moved = np.linalg.norm(frames.pos - frames.pos[0], axis=-1).max()
    assert not frames.problem and moved < 1e-3


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"contact": "sweeps"}, "sweeps"),
        ({"precision": "float32"}, "sweeps"),
        ({"bodies": (), "effects": {"gravity": {}, "rod_contact": {}}}, "sweeps"),
        ({"effects": {"gravity": {}}}, "sweeps"),
        ({"effects": {"gravity": {}, "rod_contact": {}}}, "sweeps"),
        ({"effects": {"gravity": {}, "rod_body": {}, "rod_contact": {}, "self_contact": {}}}, "sweeps"),
        ({"integrator": "implicit", "dt": 1e-3, "substeps": 1}, "sweeps"),
    ],
)
def test_contact_is_by_sweeps_where_one_solve_is_not_wanted_or_not_resolved(fields, expected):
    assert scene_files.assemble(over_a_peg(**fields)).scene.contact == expected


def test_bodies_touch_matter_where_the_effect_says_so():
    ball = ParticleBlockSpec("elastic", (0.03,), 0.01, "ball", (0.0, 0.0, 0.3), vel=(0.0, 0.0, -1.0))
    room, plate = (
        GridSpec((-0.06, -0.06, 0.2), (0.06, 0.06, 0.36), 0.02),
        BodySpec("box", (0.1, 0.1, 0.02), (0.0, 0.0, 0.24), mass=1.0),
    )
    speed = {}
    for effects in ({}, {"body_mpm_coupling": {"sweeps": 6}}):
        d = change(FALL, effects=effects, bodies=(plate,), material_points=(ball,), box=room, duration=0.02, substeps=5)
        scene, params, state, controls = scene_files.build(d)
        state, _ = rollout(lambda p, s, c, scene=scene: step(scene, p, s, c), params, state, controls)
        speed[bool(effects)] = float(state.bodies.vel[0, 2])
    assert speed[False] == 0.0 and speed[True] < -0.02


def test_all_parts_read_back_as_they_were_written(tmp_path):
    whole = SceneDescription(
        (
            change(LINE, hanging_masses=(HangingMass(-1, 1 / 3),)),
            RopeSpec(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), model="model.json"),
        ),
        {"gravity": {}, "rod_mpm_coupling": {"mu": 0.1}},
        bodies=(BodySpec("mesh", file="cube.stl", scale=0.1 + 0.2, motion="fixed", cells=12),),
        attachments=(Attachment((0,), robot=0, close=0.1, release=0.7),),
        robots=(RobotSpec(pos=(0.4, 0.0, 0.3), joints=POSTURE, keyframes=(Keyframe(1.0, move=(0.1, 0.0, 0.0)),)),),
        material_points=(ParticleBlockSpec("sand", (0.1,), 0.02, "ball", parameters={"youngs": 1e4 / 3}),),
        box=GridSpec((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1, ("slip",) * 6, window=(8, 8, 8)),
    )
    scene_files.save(whole, tmp_path / "scene.json")
    assert scene_files.read(tmp_path / "scene.json") == whole


@pytest.fixture
def cube(tmp_path):
    """A file of a cube with sides of 2 units whose corner is the origin."""
    trimesh = pytest.importorskip("trimesh", reason="meshes need the extra robots")
    made = trimesh.creation.box((2.0, 2.0, 2.0))
    made.apply_translation((1.0, 1.0, 1.0))
    made.export(tmp_path / "cube.stl")
    return tmp_path / "cube.stl"


def test_a_mesh_stands_where_its_file_says_and_weighs_its_volume(cube, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHDLO_CACHE", str(tmp_path / "cache"))
    body = BodySpec("mesh", pos=(0.5, 0.0, 0.0), file="cube.stl", scale=0.01, cells=8, density=500.0)
    scene_files.save(change(FALL, bodies=(body,)), cube.with_name("scene.json"))
    # Its file is found beside the scene file, not in the working folder.
    _, params, state, _ = scene_files.load(cube.with_name("scene.json"))
    assert torch.allclose(state.bodies.pos[0], torch.tensor([0.51, 0.01, 0.01], dtype=torch.float64), atol=1e-12)
    assert float(params.bodies.mass) == pytest.approx(500 * 0.02**3, rel=1e-9)


def test_matter_fills_its_shape(tmp_path):
    parts = (
        ParticleBlockSpec("liquid", (0.1, 0.05, 0.02), 0.01, pos=(0.0, 0.0, 0.1), vel=(1.0, 0.0, 0.0)),
        ParticleBlockSpec("elastic", (0.03,), 0.01, "ball", (0.0, 0.0, 0.3), parameters={"density": 200.0}),
    )
    box = GridSpec((-0.2, -0.2, 0.0), (0.2, 0.2, 0.4), 0.02)
    scene, params, state, _ = scene_files.build(change(FALL, material_points=parts, box=box, substeps=5))
    first, second = (piece for _, piece in scene.material_points.pieces())
    assert [g.law.name for g in scene.material_points.groups] == ["liquid", "elastic"]
    assert float(params.material_points.volume[first].sum()) == pytest.approx(0.2 * 0.1 * 0.04, rel=1e-9)
    # A lattice misses a ball's volume by its surface times a fraction of a spacing.
    ball = 4 / 3 * math.pi * 0.03**3
    assert abs(float(params.material_points.volume[second].sum()) - ball) < 0.25 * 4 * math.pi * 0.03**2 * 0.01
    assert float(params.material_points.laws["elastic_1"]["density"]) == 200.0
    assert torch.allclose(state.material_points.pos[first].mean(0), torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64))
    assert bool((state.material_points.vel[first, 0] == 1).all()) and bool(
        (state.material_points.vel[second] == 0).all()
    )


BALL = ParticleBlockSpec("elastic", (0.03,), 0.01, "ball", (0.0, 0.0, 0.3))
ROOM = GridSpec((-0.2, -0.2, 0.0), (0.2, 0.2, 0.4), 0.02)
WRONG = {
    "mesh without file": (change(FALL, bodies=(BodySpec("mesh", motion="fixed"),)), r"bodies\[0\].file: is missing"),
    "no such mesh": (
        change(FALL, bodies=(BodySpec("mesh", motion="fixed", file="no.stl"),)),
        "no.stl: there is no such",
    ),
    "file of a sphere": (
        change(FALL, bodies=(BodySpec("sphere", (0.1,), file="a.stl"),)),
        r"bodies\[0\].file: only a mesh",
    ),
    "no box": (change(FALL, material_points=(BALL,)), "box: is missing"),
    "empty box": (change(FALL, box=ROOM), "box: there are no material points in it"),
    "outside": (
        change(FALL, material_points=(change(BALL, pos=(9.0, 0.0, 0.0)),), box=ROOM),
        "expected all inside the box",
    ),
    "model's parameter": (
        change(FALL, material_points=(change(BALL, parameters={"yongs": 1.0}),), box=ROOM),
        r"material_points\[0\].parameters.yongs: .* did you mean 'youngs'",
    ),
    "size": (
        change(FALL, material_points=(change(BALL, size=(1.0, 2.0)),), box=ROOM),
        r"size: expected 1 numbers above 0",
    ),
    "spacing": (
        change(FALL, material_points=(change(BALL, spacing=0.0),), box=ROOM),
        r"material_points\[0\].spacing: expected more",
    ),
    "weight's place": (
        change(FALL, ropes=(change(LINE, hanging_masses=(HangingMass(7, 1.0),)),)),
        r"vertex: expected -7 to 6",
    ),
    "weight": (
        change(FALL, ropes=(change(LINE, hanging_masses=(HangingMass(0, 0.0),)),)),
        r"hanging_masses\[0\].mass: expected more",
    ),
    "no robot": (change(FALL, attachments=(Attachment((0,), robot=0),)), r"attachments\[0\].robot: there is no robot"),
    "late": (
        change(FALL, attachments=(Attachment((0,), close=0.01),)),
        r"attachments\[0\].close: .* use torchdlo.scene_files.assemble",
    ),
    "early": (change(FALL, attachments=(Attachment((0,), close=-1.0),)), r"close: expected a time from 0 on"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_parts_are_refused_with_place_and_expectation(case, tmp_path):
    description, sentence = WRONG[case]
    scene_files.save(description, tmp_path / "scene.json")
    with pytest.raises(InputError, match=sentence) as caught:
        scene_files.load(tmp_path / "scene.json")
    assert "scene.json" in str(caught.value) or "no.stl" in str(caught.value)


def test_a_weight_that_steps_cannot_hold_is_refused():
    # The hold carried 14 N for 49, and nothing was said.
    rope = RopeSpec(((0, 0, 1), (0, 0, 0)), vertices=11, radius=0.003, mass=0.01, hanging_masses=(HangingMass(-1, 5),))
    still = SceneDescription((rope,), {"gravity": {}}, attachments=(Attachment((0,)),), duration=0.003)
    with pytest.raises(ValueError, match=r"hanging weight allows less than 0\.000504 s"):
        scene_files.assemble(change(still, substeps=1))
    assert not run(still).problem


def test_a_weight_hangs_with_its_weight():
    # The hold bears rope and weight. After many times 1 / rate the swing is gone: exp(-0.5 20 1) of it is left.
    rope = RopeSpec(
        ((0.0, 0.0, 0.2), (0.0, 0.0, 0.1)), vertices=5, mass=0.01, bend=1e-5, hanging_masses=(HangingMass(-1, 0.05),)
    )
    still = SceneDescription(
        (rope,), {"gravity": {}, "damping": {"rate": 20.0}, "bend": {}}, attachments=(Attachment((0,)),)
    )
    frames = run(change(still, duration=0.2))
    assert frames.force[-1, 0, 2] == pytest.approx(0.06 * 9.81, rel=1e-6)
    assert frames.weight.tolist() == [0, 0, 0, 0, 0.05]


def test_a_hold_that_closes_later_keeps_what_it_grips_then():
    free = run(FALL, frame_stride=1)
    held = run(
        change(
            FALL,
            attachments=(
                Attachment((0,), close=0.03, keyframes=(Keyframe(0.06, move=(0.0, 0.0, 0.06)),), path="linear"),
            ),
        ),
        frame_stride=1,
    )
    # Open hands change nothing.
    assert np.array_equal(free.pos[:31], held.pos[:31])
    # From its place at 30 ms it goes up by 1 m/s, as the tool does.
    gone = held.pos[30:, 0] - held.pos[30, 0]
    wanted = np.outer(held.time[30:] - held.time[30], [0.0, 0.0, 1.0])
    assert np.abs(gone - wanted).max() < 1e-12
    assert float(free.pos[30, 0, 2]) < 0.1 - 0.004


@pytest.fixture
def arm():
    pytest.importorskip("pytorch_kinematics", reason="robots need the extra robots")
    return RobotSpec(
        base=(-0.5, 0.0, 0.0), joints=POSTURE, pos=(0.0, 0.0, 0.2), keyframes=(Keyframe(0.4, move=(0.0, 0.05, 0.05)),)
    )


def test_a_robot_brings_what_it_holds_along_its_keys(arm):
    line = change(LINE, points=((0.0, 0.0, 0.2), (0.0, 0.3, 0.2)))
    lift = SceneDescription(
        (line,),
        {"bend": {}, "gravity": {}},
        attachments=(Attachment((0, 1), robot=0),),
        robots=(arm,),
        duration=0.4,
        dt=4e-3,
    )
    scene, _, state, controls = scene_files.build(lift)
    # Inverse kinematics counts as there within 0.1 mm.
    assert (controls.pos[-1, 0] - torch.tensor([0.0, 0.05, 0.25], dtype=torch.float64)).norm() < 1e-4
    assert state.rods.pos[0].tolist() == [0.0, 0.0, 0.2]
    # Links are bodies, in pictures too, and go with the joints.
    made = scene_files.assemble(lift)
    links = made.plan.controls.bodies.pos
    assert links.shape[:2] == (100, len(scene.bodies)) and len(scene.bodies) > 5
    assert float((links[-1] - links[0]).norm(dim=-1).max()) > 0.05
    frames = run(change(lift, duration=0.02))
    assert set(frames.body_motion) == {"robot"}


ARMS = {
    "far": ({"keyframes": (Keyframe(0.4, move=(0.0, 0.0, 2.0)),)}, r"robots\[0\].keyframes: the tool cannot get there"),
    "start": ({"pos": (3.0, 0.0, 0.0)}, r"robots\[0\].pos: the tool cannot get there"),
    "fast": ({"keyframes": (Keyframe(0.02, move=(0.0, 0.1, 0.0)),)}, r"would have to move at .* it can at most"),
    "joints": ({"joints": (0.0,)}, r"robots\[0\].joints: expected 8 numbers"),
    "file": ({"urdf": "no.urdf"}, "no.urdf: expected a URDF file, found none"),
}


@pytest.mark.parametrize("case", ARMS)
def test_robots_that_cannot_do_it_are_refused(case, arm):
    fields, sentence = ARMS[case]
    with pytest.raises(InputError, match=sentence):
        scene_files.build(change(FALL, robots=(change(arm, **fields),), duration=0.4, dt=4e-3))


def test_two_robots_of_a_kind_have_names_of_their_own(arm):
    still = change(arm, pos=None, keyframes=())
    scene, *_ = scene_files.build(change(FALL, robots=(still, change(still, base=(0.5, 0.0, 0.0)))))
    assert len({b.name for b in scene.bodies}) == len(scene.bodies)
    assert tool_pose(panda(), torch.tensor(POSTURE, dtype=torch.float64)).pos.shape == (3,)


def test_a_recorded_run_is_the_run_of_single_steps():
    described = change(
        FALL,
        attachments=(Attachment((0,)),),
        bodies=(BodySpec("sphere", (0.05,), pos=(0.15, 0.0, 0.04), motion="fixed"),),
    )
    described = change(described, effects={**FALL.effects, "rod_body": {}})
    frames = run(described, frame_stride=1)
    scene, params, state, controls = scene_files.build(described)
    with torch.no_grad():
        _, seen = rollout(lambda *a: step(scene, *a), params, state, controls, keep=lambda s: s.rods.pos)
    assert len(frames.time) == 61
    # The rope rests on the ball by then. Lengths are solved to 1e-9, and no better are positions.
    assert float(seen[-1, :, 2].max()) < 0.1001 and np.abs(frames.pos[1:] - seen.numpy()).max() < 1e-9


@pytest.fixture
def modelled(folder):
    """A function that writes a model file for the recording, with a given rest shape or a straight one."""
    from torchdlo.sysid.model.model_file import content
    from torchdlo.sysid.model.rope_model import RopeModel
    from torchdlo.sysid.recordings.recording import load_recording

    def write(rest="straight", effects=("air_drag", "time_delay")):
        model = RopeModel(load_recording(folder), rest=rest, effects=effects)
        values = dict(zip(model.parameters, model.guess(), strict=True)) | {
            "bending_stiffness": 2e-3,
            "damping_rate": 0.7,
        }
        if "air_drag" in effects:
            values["air_drag.c_d"] = 1.1
        text = json.dumps(content(model, np.array(list(values.values()))), default=lambda x: x.tolist())
        (folder / "model.json").write_text(text)
        return folder

    return write


def test_a_model_file_is_a_rope_of_a_scene(modelled):
    folder = modelled()
    rope = RopeSpec(((0.0, 0.0, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.5)), model="model.json")
    said = SceneDescription(
        (rope,), {"damping": {"rate": 9.0}}, attachments=(Attachment((0,)),), duration=0.02, integrator="implicit"
    )
    scene, params, _, _ = scene_files.build(said, folder=folder)
    assert float(params.rods.material.bend.max()) == 2e-3
    assert float(params.rods.material.mass.sum()) == pytest.approx(0.05, rel=1e-12)
    assert float(params.rods.material.radius[0]) == 0.004
    assert float(params.rods.rest.length[:-1].sum()) == pytest.approx(1.0, rel=1e-9)
    assert float(params.effects["air_drag"]["c_d"]) == 1.1
    # The scene's own word counts; what concerns the recording is left out.
    assert float(params.effects["damping"]["rate"]) == 9.0
    assert "time_delay" not in params.effects and scene.twist == "quasistatic"
    assert run(said, folder=folder).problem == ""
    for wrong, sentence in (
        (change(rope, points=((0.0, 0.0, 0.0), (0.9, 0.0, 0.0))), "as long as the rope .* 1 m, given 0.9 m"),
        (change(rope, model="no.json"), "expected a model file, found none"),
    ):
        with pytest.raises(InputError, match=sentence):
            scene_files.build(change(said, ropes=(wrong,)), folder=folder)
    with pytest.raises(InputError, match="expected the same model for every rope"):
        scene_files.build(change(said, ropes=(rope, LINE)), folder=folder)


@pytest.mark.parametrize("effect", ["rest_curvature", "bending_plasticity", "anisotropic_bending"])
def test_effects_of_a_model_that_need_frames_get_them(modelled, effect):
    rope = RopeSpec(((0.0, 0.0, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.5)), model="model.json")
    said = SceneDescription((rope,), {}, attachments=(Attachment((0,)),), duration=0.02, integrator="implicit")
    scene, *_ = scene_files.build(said, folder=modelled(effects=(effect,)))
    assert {type(e).__name__ for e in scene.effects} >= {"BendFrame"} and effect in {e.name for e in scene.effects}


@pytest.mark.parametrize("spoil", [lambda s: s * 20_000, lambda s: s[::-1], lambda s: s[:1]])
def test_a_mesh_of_a_model_rises_and_has_an_end(modelled, spoil):
    folder = modelled()
    content = json.loads((folder / "model.json").read_text())
    content["mesh"]["arclength"] = spoil(content["mesh"]["arclength"])
    (folder / "model.json").write_text(json.dumps(content))
    rope = RopeSpec(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), model="model.json")
    with pytest.raises(InputError, match=r"mesh\.arclength: expected 2 to 100000 numbers that rise"):
        scene_files.build(SceneDescription((rope,), {}), folder=folder)


def test_a_natural_shape_of_a_model_is_that_of_the_rope(modelled):
    folder = modelled("given", ())
    made = scene_files.build(
        SceneDescription((RopeSpec(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), model="model.json"),), {}), folder=folder
    )
    assert [type(e).__name__ for e in made[0].effects] == ["Gravity", "BendFrame", "Twist", "Damping"]
    # Points of a circle of 0.5 m: a curvature of 2 1/m times the share, turned by the roll from the second director.
    angle = torch.linspace(0, 2.0, 33, dtype=torch.float64)
    arc = 0.5 * torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    found = Modelled(arc, 0.8, 0.3).curvature(41)[1:-1]
    # The second derivative of a cubic spline is off by h^2, most at its ends; h is 1/16 of the radius.
    assert torch.allclose(found.norm(dim=-1), torch.tensor(1.6, dtype=torch.float64), rtol=1 / 16**2)
    plain = Modelled(arc, 0.8, 0.0).curvature(41)[1:-1]
    turn = torch.atan2(found[:, 1], found[:, 0]) - torch.atan2(plain[:, 1], plain[:, 0])
    assert torch.allclose(turn, torch.full_like(turn, 0.3), atol=1e-9)


def test_frames_read_back_and_others_are_refused(tmp_path):
    frames = run(change(FALL, duration=0.02))
    save_frames(frames, tmp_path / "frames.npz", FALL)
    back = load_frames(tmp_path)
    for name, value in vars(frames).items():
        assert not isinstance(value, np.ndarray) or np.array_equal(getattr(back, name), value), name
    with pytest.raises(InputError, match="expected the frames of a run, found none"):
        load_frames(tmp_path / "no")
    np.savez(tmp_path / "other.npz", time=np.zeros(3))
    with pytest.raises(InputError, match="lacks pos, "):
        load_frames(tmp_path / "other.npz")
    (tmp_path / "text.npz").write_text("no")
    with pytest.raises(InputError, match=r"expected the frames of a run, .* cannot be read"):
        load_frames(tmp_path / "text.npz")


def test_the_files_shown_in_the_documentation_fit(repository):
    grip, turns, model = (repository / "docs" / "scenes.md").read_text().split("```json\n")[1:]
    assert scene_files.assemble(scene_files.parse(turns.split("```")[0])).scene.prescribed_vertices == (0,)
    assert scene_files.parse(model.split("```")[0]).ropes[0].model == "model.json"
    pytest.importorskip("pytorch_kinematics", reason="robots need the extra robots")
    made = scene_files.assemble(scene_files.parse(grip.split("```")[0]))
    # It grips where the rope lies.
    tool, middle = made.plan.tools.pos[300, 0], made.state.rods.pos[15]
    assert made.plan.closed[299:301, 0, 0].tolist() == [0.0, 1.0] and float((tool - middle).norm()) < 1e-4


def test_a_clamp_at_the_vertex_reaches_the_scene_and_is_refused_where_holds_open():
    given = change(FALL, attachments=(Attachment((0, 1)),), clamp="vertex")
    share = scene_files.assemble(given).params.rods.rest.share
    assert float(share[1]) == pytest.approx(0.5) and float((share - 1).abs().sum()) == pytest.approx(0.5)
    with pytest.raises(InputError, match="released during the run"):
        scene_files.assemble(change(given, attachments=(Attachment((0, 1), release=0.05),)))
