"""Episodes as frames: what is drawn is where the physics has it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")
sys.path.append(str(Path(__file__).parents[1] / "agents"))

from test_render import enclosed
from test_tasks import Lead

from torchdlo.coupling.robot.robot_kinematics import panda, tool_pose
from torchdlo.envs import find
from torchdlo.envs.core import episode
from torchdlo.report.render.episode_film import film, outcome_of, surfaces
from torchdlo.report.render.run_surfaces import extent, pieces


@pytest.fixture(scope="module")
def made() -> episode.Episode:
    return episode.prepare(Lead(), 1, execution="eager")


def way() -> torch.Tensor:
    actions = torch.zeros(3, 6)
    actions[:, 1] = 0.01
    return actions


def test_frames_are_the_start_and_what_follows_each_action(made):
    told = []
    frames, went = film(made.task, way(), made=made, callback=lambda *said: told.append(said[1:3]))
    assert told == [(1, 3), (2, 3), (3, 3)]
    np.testing.assert_allclose(frames.time, [0.0, 0.002, 0.004, 0.006], atol=1e-7)
    np.testing.assert_array_equal(frames.pos[0], made.start.state.rods.pos[0])
    np.testing.assert_array_equal(frames.pos[-1], went.world.state.rods.pos[0])
    said = outcome_of(went)
    assert said["success"] and said["return"] == pytest.approx(sum(said["rewards"]), rel=1e-6)


def test_arms_are_drawn_where_their_joints_bring_them(made):
    bare, _ = film(made.task, way(), made=made, arms=False)
    frames, went = film(made.task, way(), made=made)
    links = len(panda().shapes)
    assert frames.body_pos.shape[1] - bare.body_pos.shape[1] == links == (frames.body_motion == "robot").sum()
    # Links that look like those of arms have parts of several colours.
    assert len(pieces(frames)) >= len(pieces(bare)) + links
    # The middle of a finger is within 6 cm of where both end.
    middles = frames.body_pos[-1, frames.body_motion == "robot"]
    tool = went.world.tool.pos[0, 0].numpy()
    assert np.linalg.norm(middles - tool, axis=1).min() < 0.06
    base = torch.tensor(Lead.arms.base)
    np.testing.assert_allclose(tool_pose(panda(), went.world.joints).pos[0] + base, [tool], atol=1e-6)
    # The camera is fitted to the rope and to the hand, not to the base.
    seen = extent(frames)
    assert not (np.linalg.norm(seen - Lead.arms.base[0], axis=1) < 0.2).any()
    assert (np.linalg.norm(seen - tool, axis=1) < 0.1).any() and len(seen) > len(extent(bare))


@pytest.mark.parametrize(("name", "shape"), [("gathering", "pebble"), ("lifting", "c_ring")])
def test_bodies_on_grids_are_drawn_with_their_volume(name, shape):
    pytest.importorskip("pyvista", reason="surfaces need the extra view")
    from torchdlo.envs.assets import rigid_objects

    scene, params, _ = find(name).start(1)
    found = surfaces(scene, params)
    assert set(found) == {k for k, body in enumerate(scene.bodies) if body.shape == "mesh"}
    wanted = getattr(rigid_objects, shape)()
    for corners, faces in found.values():
        volume, centre = enclosed(corners.numpy(), faces.numpy())
        # Outwards, and on a grid of 4 mm.
        assert volume == pytest.approx(float(wanted.volume[0]), rel=0.06)
        assert np.abs(centre).max() < 2e-3
