"""What scene files say of ropes beyond single numbers: lists along them, directors, twist, velocities, forces."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from torchdlo import measures, scene, scene_files
from torchdlo.errors import InputError
from torchdlo.physics.effects.elastic import BendFrame
from torchdlo.physics.effects.point_forces import PointForce, PointForces
from torchdlo.scene_files import Attachment, PointForceSpec, RopeSpec, SceneDescription
from torchdlo.scene_files.run import run

COUNT, LENGTH = 9, 0.4
ALONG = tuple(1e-3 * (1 + k / 7) for k in range(COUNT))
LINE = RopeSpec(((0.0, 0.0, 0.0), (LENGTH, 0.0, 0.0)), vertices=COUNT, mass=0.02)
FREE = SceneDescription((LINE,), {"bend_frame": {}, "twist": {}}, duration=0.05, substeps=10)


def rope(**fields) -> RopeSpec:
    return dataclasses.replace(LINE, **fields)


def scene_of(one: RopeSpec, **fields) -> SceneDescription:
    return dataclasses.replace(FREE, ropes=(one,), **fields)


GIVEN = {
    "radius": ALONG,
    "bend": ALONG,
    "bend2": tuple(2 * x for x in ALONG),
    "twist": ALONG,
    "stretch": tuple(1e6 * x for x in ALONG),
    "rest_twist": tuple(x - 1 for x in ALONG),
    "rest_curvature": tuple((1 / 3, x) for x in ALONG),
    "velocities": tuple((x, 0.0, 1 / 3) for x in ALONG),
    "rest": tuple((0.5 * math.sin(0.1 * k), 0.5 * math.cos(0.1 * k), 0.0) for k in range(COUNT)),
    "director": (0.0, 1 / 3, 1.0),
    "rest_director": (0.0, 0.0, 1.0),
}


def test_lists_and_directors_of_a_file_are_the_tensors_of_a_rope(tmp_path):
    whole = scene_of(rope(**GIVEN, point_forces=(PointForceSpec(-1, (0.0, 0.0, 0.1), 0.1, 0.1 + 0.2),)))
    scene_files.save(whole, tmp_path / "scene.json")
    assert scene_files.read(tmp_path / "scene.json") == whole
    _, params, state, _ = scene_files.load(tmp_path / "scene.json")
    x = torch.linspace(0, LENGTH, COUNT, dtype=torch.float64)[:, None] * torch.eye(3, dtype=torch.float64)[0]
    same = {name: torch.tensor(value, dtype=torch.float64) for name, value in GIVEN.items()}
    _, expected, first = scene.make([scene.Rope(x, mass=0.02, **same)], [BendFrame()], check=False)
    for name in ("stretch", "bend", "twist", "radius"):
        torch.testing.assert_close(getattr(params.rods.material, name), getattr(expected.rods.material, name))
    torch.testing.assert_close(params.rods.rest.curvature, expected.rods.rest.curvature)
    torch.testing.assert_close(params.rods.rest.twist, expected.rods.rest.twist)
    torch.testing.assert_close(state.rods.director, first.rods.director)
    torch.testing.assert_close(state.rods.vel, first.rods.vel)


def test_one_velocity_and_one_curvature_are_those_of_all_vertices():
    given = rope(velocities=((0.0, 1.0, 0.0),), rest_curvature=((0.0, 2.0),), bend=1e-3)
    _, params, state, _ = scene_files.build(scene_of(given))
    assert bool((state.rods.vel == torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)).all())
    assert torch.allclose(params.rods.rest.curvature[1:-1, 1], torch.tensor(2.0 * LENGTH / (COUNT - 1)).double())


@pytest.mark.parametrize("twist", ["dynamic", "quasistatic"])
def test_a_rope_that_starts_twisted_is_held_by_its_torque(twist):
    turns, stiffness = 3.0, 2e-4
    given = rope(bend=1e-3, twist=stiffness, stretch=1e4, radius=0.004, initial_twist=turns)
    ends = Attachment((0, 1, -2, -1), edges=(0, -1))
    d = scene_of(given, attachments=(ends,), effects=FREE.effects | {"damping": {}}, twist=twist)
    made = scene_files.assemble(d)
    world, params, state = made.scene, made.params, made.state
    assert measures.twist(world, params, state)[1:-1, 0].tolist() == pytest.approx([turns] * (COUNT - 2))
    control = made.plan.follow(world)
    for k in range(5):
        state = scene.step(world, params, state, control(k, state))
    assert measures.twist(world, params, state)[1:-1, 0].tolist() == pytest.approx([turns] * (COUNT - 2), rel=1e-6)
    assert state.reaction.couple[:, 0].abs().tolist() == pytest.approx([turns * stiffness] * 2, rel=1e-6)


def test_a_force_bends_a_cantilever_as_in_beam_theory():
    # Clamped at the second of 22 vertices; the tip sags by P L^3 / (3 EI), of small angles.
    stiffness, pull = 1e-3, 1e-3
    beam = RopeSpec(
        ((-0.01, 0.0, 0.0), (0.2, 0.0, 0.0)),
        vertices=22,
        mass=0.01,
        bend=stiffness,
        point_forces=(PointForceSpec(-1, (0.0, 0.0, -0.5 * pull)), PointForceSpec(21, (0.0, 0.0, -0.5 * pull))),
    )
    d = SceneDescription(
        (beam,),
        {"bend": {}, "damping": {"rate": 25.0}},
        attachments=(Attachment((0, 1)),),
        clamp="vertex",
        duration=1.5,
        dt=5e-3,
        substeps=1,
        integrator="implicit",
    )
    frames = run(d, frame_stride=300)
    assert -frames.pos[-1, -1, 2] == pytest.approx(pull * 0.2**3 / (3 * stiffness), rel=0.01)
    assert frames.force[-1].sum(0)[2] == pytest.approx(pull, rel=1e-4)


@pytest.mark.parametrize("steps", [{"substeps": 10}, {"integrator": "implicit", "substeps": 1}])
def test_forces_give_momentum_while_they_act(steps):
    pulls = (
        PointForceSpec(0, (0.0, 0.2, 0.0), since=0.01, until=0.03003),
        PointForceSpec(-1, (0.0, 0.0, 0.4), until=0.015),
        PointForceSpec(4, (0.1, 0.0, 0.0), since=0.045),
    )
    scene_, params, state, controls = scene_files.build(scene_of(rope(bend=1e-3, point_forces=pulls), **steps))
    for k in range(50):
        state = scene.step(scene_, params, state, scene.tree.map(lambda c, k=k: c[k], controls))
    momentum = (params.rods.material.mass * state.rods.vel).sum(-2)
    # Velocities lie half a substep before positions: of a force that still acts, half a substep is missing.
    short = 0.5 * scene_.dt / scene_.substeps
    expected = [0.1 * (0.005 - short), 0.2 * 0.02003, 0.4 * 0.015]
    assert momentum.tolist() == pytest.approx(expected, abs=1e-12)


def test_forces_carry_a_gradient_by_their_scale():
    x = torch.linspace(0, 1, 5, dtype=torch.float64)[:, None] * torch.eye(3, dtype=torch.float64)[0]
    pull = PointForces((PointForce(4, (0.0, 0.0, 1.0)),))
    world, params, state = scene.make([scene.Rope(x, mass=1.0)], [pull], substeps=2)
    params.effects["point_forces"]["scale"].requires_grad_()
    after = scene.step(world, params, state, scene.stationary_control(world, state))
    lifted = after.rods.pos[4, 2]
    lifted.backward()
    grad = float(params.effects["point_forces"]["scale"].grad)
    assert grad == pytest.approx(float(lifted.detach()), rel=1e-9) and grad > 0


WRONG = {
    "too few": (rope(bend=(1e-3,) * 8), r"ropes\[0\].bend: expected one number or a list of 9, .* given 8"),
    "velocities": (rope(velocities=((0.0, 0.0, 0.0),) * 2), r"ropes\[0\].velocities: expected one for all vertices or"),
    "rest": (rope(rest=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))), r"ropes\[0\].rest: expected positions, 9 of them, .* 2"),
    "negative": (rope(bend=(-1e-3, *ALONG[1:])), "rope 0: bend is -0.001; it must be finite and at least 0"),
    "huge": (rope(twist=(*ALONG[1:], 1e13)), r"ropes\[0\].twist\[8\]: expected a number of at most 1e\+12"),
    "along the edge": (rope(director=(1.0, 0.0, 0.0)), "rope 0: director points along the first edge"),
    "no twist": (rope(initial_twist=1.0), r"ropes\[0\].initial_twist: twist is 'none'"),
    "closed": (
        rope(initial_twist=1.0, closed=True, points=((0, 0, 0), (1, 0, 0), (0, 1, 0))),
        "a closed rope has none",
    ),
    "no vertex": (rope(point_forces=(PointForceSpec(9, (0.0,) * 3),)), r"point_forces\[0\].vertex: expected -9 to 8"),
    "ends first": (
        rope(point_forces=(PointForceSpec(0, (0.0,) * 3, 1.0, 0.5),)),
        r"ropes\[0\].point_forces\[0\].until: expected a time from 1 s on, given 0.5",
    ),
    "before the start": (rope(point_forces=(PointForceSpec(0, (0.0,) * 3, -1.0),)), "since: expected a time from 0 on"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_no_rope_has_is_refused_with_its_place(case, tmp_path):
    one, sentence = WRONG[case]
    with pytest.raises((InputError, ValueError), match=sentence):
        scene_files.assemble(scene_of(one))


def test_null_is_no_number():
    text = '{"format": "torchdlo scene 2", "effects": {}, "ropes": [{"points": [[0, 0, 0]], "radius": null}]}'
    with pytest.raises(InputError, match=r"ropes\[0\].radius: expected a finite number, given null"):
        scene_files.parse(text)


def test_the_python_effect_refuses_what_is_no_force():
    with pytest.raises(ValueError, match="a force acts on vertex 9; the scene has 0 to 8"):
        PointForces((PointForce(9, (0.0, 0.0, 0.0)),)).check(scene_files.build(FREE)[0].topology)
    with pytest.raises(ValueError, match="expected three finite numbers"):
        PointForces((PointForce(0, (0.0, math.nan, 0.0)),)).check(scene_files.build(FREE)[0].topology)
