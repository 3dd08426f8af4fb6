"""Ropes begin where their markers say that they are, whenever and wherever these are seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import recording
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording


@pytest.fixture(scope="module")
def rope() -> Recording:
    return recording(Path("rope"), frames=12)


def begun(model: RopeModel, start: Start, numbers: dict[str, float]) -> np.ndarray:
    """Where the rope's axis is at the markers when a trial begins, shape (B, M, 3)."""
    values = dict(zip(model.parameters, model.guess(), strict=True)) | numbers
    rows = np.array([[values[n] for n in model.parameters]] * len(start.pos))
    _, _, state = model.build(model.motion(model.recording.train), start, rows)
    return state.rods.pos[:, list(model.marker_vertex)].numpy()


def read(rope: Recording) -> Start:
    """Starts that say what the markers do, evenly moving."""
    speed = np.random.default_rng(0).normal(size=(3, 15, 3)) * 0.3 * ~rope.train[0].gripped[:, None]
    return Start(np.stack([t.markers[0] for t in rope.train]), speed)


def test_a_rope_whose_markers_are_seen_late_has_moved_on(rope: Recording) -> None:
    start, delay = read(rope), 0.02
    late = RopeModel(rope, vertices=31, effects=("time_delay",))
    moved = begun(late, start, {"time_delay.delay": delay})
    wanted = begun(RopeModel(rope, vertices=31), Start(start.pos + delay * start.vel, start.vel), {})
    np.testing.assert_allclose(moved, wanted, atol=1e-9)


def test_a_rope_whose_markers_sit_beside_it_begins_there(rope: Recording) -> None:
    model, start = RopeModel(rope, vertices=31, effects=("marker_offset",)), read(rope)
    free = ~rope.train[0].gripped
    _, _, state = model.build(model.motion(rope.train), start, np.repeat(model.guess()[None], 3, 0))
    axis, first, second = (x.numpy() for x in model.markers.frame(state))
    seen = axis + free[:, None] * (0.01 * first - 0.006 * second)
    found = begun(model, Start(seen, start.vel), {"marker_offset.offset.0": 0.01, "marker_offset.offset.1": -0.006})
    # Two passes, of 12 mm each time directors turn a little with the axis.
    assert np.abs(found - axis).max() < 1e-3 < 5e-3 < np.abs(seen - axis).max()


def test_hinges_at_clamps_are_as_long_for_every_law(rope: Recording) -> None:
    from torchdlo.physics.rod import kinematics as rod

    model = RopeModel(rope, vertices=31, clamp_fraction=1.0)
    scene, params, state = model.build(model.motion(rope.train), read(rope), np.repeat(model.guess()[None], 3, 0))
    lengths = rod.view(scene.topology, params.rods, state.rods, 1.0).hinge_length[..., 0].numpy()
    vertex = model.mesh.clamp_hinges[0]
    free = np.diff(model.arclength)[vertex]
    # Stiff up to the last marker: what bends is half of the first free edge.
    np.testing.assert_allclose(lengths[vertex], 0.5 * free, rtol=1e-12)
    # Stiffness itself is that of the rope.
    np.testing.assert_allclose(params.rods.material.bend.numpy(), model.guess()[0])
