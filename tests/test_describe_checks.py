"""Scene files that say what no run could do are refused in one sentence, with the place."""

from __future__ import annotations

import dataclasses
import logging

import pytest
import torch

from torchdlo import notices, scene, scene_files
from torchdlo.coupling.common.step_diagnostics import WIDTH, explain_diagnostics
from torchdlo.coupling.rod_contact.rod_contact_effect import RodContact
from torchdlo.errors import InputError
from torchdlo.scene_files import Attachment, BodySpec, JointSpec, Keyframe, RobotSpec, RopeSpec, SceneDescription

LINE = RopeSpec(((0.0, 0.0, 0.1), (0.3, 0.0, 0.1)), vertices=7, mass=0.03)
FALL = SceneDescription((LINE,), {"gravity": {}}, duration=0.06, substeps=2)
AT = (Keyframe(0.05, move=(0.0, 0.0, 0.1)),)
EARLY = (Keyframe(0.0), Keyframe(-0.1))
BALL = BodySpec("sphere", (0.02,), mass=0.1)
FIXED = BodySpec("sphere", (0.02,), motion="fixed")

WRONG = {
    "a free body with keyframes": (
        {"bodies": (FIXED, dataclasses.replace(BALL, keyframes=AT))},
        r"bodies\[1\].keyframes: only a kinematic body has keyframes, and this one is free",
    ),
    "a fixed body with keyframes": (
        {"bodies": (dataclasses.replace(FIXED, keyframes=AT),)},
        r"bodies\[0\].keyframes: only a kinematic body has keyframes, and this one is fixed",
    ),
    "a body before the start": (
        {"bodies": (dataclasses.replace(FIXED, motion="kinematic", keyframes=EARLY),)},
        r"bodies\[0\].keyframes\[1\].time: expected a time from 0 on, given -0.1",
    ),
    "a hand before the start": (
        {"attachments": (Attachment((0,), keyframes=EARLY),)},
        r"attachments\[0\].keyframes\[1\].time: expected a time from 0 on",
    ),
    "a robot before the start": (
        {"robots": (RobotSpec(keyframes=EARLY),)},
        r"robots\[0\].keyframes\[1\].time: expected a time from 0 on",
    ),
    "less than a step": ({"duration": 4e-4}, "duration: 0.0004 s is less than half a step of 0.001 s"),
    "no such rope": (
        {"joints": (JointSpec(rope=3, body=0),), "bodies": (BALL,)},
        r"joints\[0\].rope: expected the number of a rope, 0 to 0, given 3",
    ),
    "no such other rope": (
        {"joints": (JointSpec(other_rope=-1),)},
        r"joints\[0\].other_rope: expected the number of a rope, 0 to 0, given -1",
    ),
    "a body that gains speed": (
        {"bodies": (dataclasses.replace(BALL, restitution=1.2),)},
        "body 'sphere 0': restitution is .* expected at most 1",
    ),
    "ropes that gain speed": (
        {"effects": {"rod_contact": {"restitution": 1.2}}},
        "rod_contact.restitution is 1.2; expected at most 1",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_no_run_does_is_refused_with_its_place(case, tmp_path):
    fields, sentence = WRONG[case]
    scene_files.save(dataclasses.replace(FALL, **fields), tmp_path / "scene.json")
    with pytest.raises(InputError, match=sentence) as caught:
        scene_files.load(tmp_path / "scene.json")
    assert "scene.json" in str(caught.value)


@pytest.mark.parametrize(("duration", "said"), [(0.0604, True), (0.06, False), (0.003, False)])
def test_a_duration_between_steps_is_told(duration, said, caplog, monkeypatch):
    monkeypatch.setattr(notices, "_said", set())
    with caplog.at_level(logging.WARNING, logger="torchdlo"):
        controls = scene_files.build(dataclasses.replace(FALL, duration=duration))[-1]
    told = [r.getMessage() for r in caplog.records if "whole number of steps" in r.getMessage()]
    assert bool(told) == said and controls.pos.shape[0] == round(duration / 1e-3)
    assert not said or "0.0604 s, is no whole number of steps of 0.001 s; it runs for 60 of them, 0.06 s" in told[0]


BODIES = {
    "text": ({"mass": "1"}, "mass is '1'; expected numbers"),
    "nothing": ({"mass": 0.1, "pos": None}, "pos is None; expected numbers"),
    "a moment too large": ({"mass": 1.0, "inertia": (1.0, 1.0, 1000.0)}, "inertia is .* none of a solid exceeds"),
    "restitution": ({"mass": 1.0, "restitution": 1.01}, "restitution is .* expected at most 1"),
}


@pytest.mark.parametrize("case", BODIES)
def test_bodies_of_no_world_are_refused(case):
    fields, sentence = BODIES[case]
    x = torch.zeros(3, 3, dtype=torch.float64)
    x[:, 0] = torch.arange(3)
    with pytest.raises(ValueError, match=sentence):
        scene.make([scene.Rope(x, mass=1.0)], [], bodies=[scene.RigidBody("sphere", 0.1, **fields)])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_flat_bodies_and_full_rebound_are_of_this_world(dtype):
    x = torch.zeros(9, 3, dtype=dtype)
    x[:, 0] = torch.arange(9)
    disc = scene.RigidBody("sphere", 0.1, pos=(0.0, 0.0, 1.0), mass=1.0, inertia=(0.1, 0.2, 0.3), restitution=1.0)
    made = scene.make([scene.Rope(x, mass=1.0)], [RodContact()], {"rod_contact": {"restitution": 1.0}}, bodies=[disc])
    assert made[1].bodies.inertia.shape == (1, 3)


def test_a_file_says_the_inertia_of_a_body():
    ball = dataclasses.replace(BALL, inertia=(1e-4, 2e-4, 2.5e-4))
    params = scene_files.build(dataclasses.replace(FALL, bodies=(ball,)))[1]
    assert params.bodies.inertia[0].tolist() == [1e-4, 2e-4, 2.5e-4]


def test_what_had_no_room_is_said_with_the_names_of_effects():
    said = explain_diagnostics(torch.eye(WIDTH)[:1])
    assert all(
        name in said for name in ("RodContact, RodMpmCoupling or BodyMpmCoupling", "SelfContact has a fixed one")
    )
