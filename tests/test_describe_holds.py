"""Vertices of ropes in scene files that go from one attachment to another."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from torchdlo import scene_files
from torchdlo.errors import InputError
from torchdlo.scene_files import Attachment, Keyframe, RopeSpec, SceneDescription
from torchdlo.scene_files.run import run

HANGING = RopeSpec(((0.0, 0.0, 0.2), (0.0, 0.0, 0.0)), vertices=6, mass=0.05)
STILL = SceneDescription((HANGING,), {"gravity": {}, "damping": {"rate": 30.0}}, duration=0.1, dt=1e-3, substeps=2)
UP = (Keyframe(0.04, move=(0.0, 0.0, -0.3)), Keyframe(0.1, move=(0.0, 0.0, -0.24)))


def held(*attachments: Attachment, **fields) -> SceneDescription:
    return dataclasses.replace(STILL, attachments=attachments, **fields)


@pytest.mark.parametrize("steps", [{}, {"integrator": "implicit", "substeps": 1}])
def test_a_rope_is_handed_over_and_stays_with_who_has_it(steps):
    # The first one would fling it away after it has let go.
    first = Attachment((0,), release=0.04, keyframes=(Keyframe(0.04), Keyframe(0.1, move=(1.0, 0.0, 0.0))))
    second = Attachment((0,), close=0.04, keyframes=UP, path="linear")
    frames = run(held(first, second, **steps), frame_stride=1)
    alone = run(
        held(Attachment((0,), keyframes=(Keyframe(0.04), Keyframe(0.1, (0.0, 0.0, 0.06))), path="linear"), **steps),
        frame_stride=1,
    )
    assert not frames.problem and frames.force.shape == (101, 1, 3)
    # It is lifted by 1 m/s from where it hung, though the second attachment came from elsewhere.
    lifted = frames.pos[40:, 0, 2] - 0.2
    assert np.abs(lifted - (frames.time[40:] - 0.04)).max() < 1e-12
    assert np.abs(frames.pos[:, 0, :2]).max() == 0.0
    # It is not free in between: all moves as in one hand, whose force is the weight while it is still.
    assert np.abs(frames.pos - alone.pos).max() < 1e-12
    assert np.abs(frames.force - alone.force).max() < 1e-9
    assert np.abs(frames.force[2:40, 0, 2] - 0.05 * 9.81).max() < 1e-6


def test_a_vertex_that_is_let_go_before_it_is_taken_falls_in_between():
    frames = run(held(Attachment((0,), release=0.02), Attachment((-6,), close=0.05)), frame_stride=1)
    assert np.array_equal(frames.pos[20, 0], frames.pos[0, 0]) and np.abs(frames.force[30, 0]).max() < 1e-9
    assert frames.pos[50, 0, 2] < 0.2 - 1e-3 and np.array_equal(frames.pos[50:, 0], frames.pos[50:51, 0].repeat(51, 0))


@pytest.mark.parametrize("time", [0.03, 0.0304, 0.0305, 0.0306, 0.3 * 0.1])
def test_a_time_between_two_steps_leaves_no_step_without_a_hand(time):
    frames = run(held(Attachment((0,), release=time), Attachment((0,), close=time), duration=0.04), frame_stride=1)
    assert np.array_equal(frames.pos[:, 0], frames.pos[:1, 0].repeat(41, 0))


def test_the_twist_of_an_edge_is_handed_over():
    rope = dataclasses.replace(HANGING, bend=1e-3, twist=1e-3)
    turn = (Keyframe(0.03), Keyframe(0.08, turn=(0.0, 0.0, 1.0)))
    one, other = (Attachment((0, 1), edges=(0,), **k) for k in ({"release": 0.03}, {"close": 0.03, "keyframes": turn}))
    effects = {"gravity": {}, "bend": {}, "twist": {}, "damping": {}}
    frames = run(held(one, other, ropes=(rope,), effects=effects, twist="quasistatic"), frame_stride=1)
    assert frames.force.shape[1] == 2 and not frames.problem
    assert np.abs(frames.twist[:31, 0]).max() < 1e-9
    # The rope hangs down: turned about the z axis, it turns the other way about its own.
    assert abs(frames.twist[-1, 0] - frames.twist[0, 0]) == pytest.approx(1.0, abs=1e-6)


WRONG = {
    "together": (
        held(Attachment((0,)), Attachment((3, -6), close=0.05)),
        r"attachments\[1\]: it holds vertex 0 of rope 0 from 0.05 s on, and so does attachments\[0\]; let one go",
    ),
    "for a while": (
        held(Attachment((0,), release=0.07), Attachment((0,), close=0.05)),
        r"attachments\[1\]: it holds vertex 0 of rope 0 from 0.05 to 0.07 s, and so does attachments\[0\]",
    ),
    "twice": (held(Attachment((0, -6))), r"attachments\[0\]: it names vertex 0 of rope 0 twice"),
    "let go first": (held(Attachment((0,), close=0.05, release=0.02)), r"attachments\[0\].release: expected a time"),
    "let go before": (held(Attachment((0,), release=-0.02)), r"attachments\[0\].release: expected a time from 0 s on"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_two_hands_cannot_do_is_refused(case):
    description, sentence = WRONG[case]
    with pytest.raises(InputError, match=sentence):
        scene_files.assemble(description)
