"""Starts of ropes in motion as their first pictures show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdlo.sysid.estimation.observation import Spines, seen_by
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video.filmed_problem import FilmedProblem, begin_from_balance, filmed_problem
from torchdlo.sysid.video.filmed_starts import START_WINDOW, start_window
from torchdlo.sysid.video.first_pictures import look_at_first_pictures
from torchdlo.sysid.video.footage import views_of
from torchdlo.vision.camera import looking_at

DATA = Path(__file__).parents[2] / "torchdlo" / "data"


@pytest.fixture(scope="module")
def swing() -> FilmedProblem:
    """The beginning of a film of a rope in motion."""
    recording = load_recording(DATA / "sample_film")
    views, _ = views_of(recording, recording.train[:1])
    return filmed_problem(recording, recording.train[:1], views, options={"vertices": 13}).shortened(0.2)


def raw_of(own: FilmedProblem) -> np.ndarray:
    """Return coordinates of numbers as they are, and of cameras as written down."""
    return own.space.to_raw(np.concatenate([own.fixed[list(own.free)], np.zeros(len(own.spines.nuisances.names))]))


def pixels(own: FilmedProblem, motion: np.ndarray, camera: Sequence[float] = (0.0,) * 8) -> np.ndarray:
    """Return where the camera, which is off by so much, sees motions (T, M, 3) by pictures, (F, M, 2)."""
    sims = torch.as_tensor(motion[None, None]).float()
    return seen_by(own.spines.views[0], sims, torch.tensor([camera]), own.model.dt)[0][0, 0].numpy()


def shown(own: FilmedProblem, true: Start, camera: Sequence[float] = (0.0,) * 8) -> np.ndarray:
    """Let the camera see ropes that go on as they begin, and return where in its pictures they are, (F, M, 2)."""
    times = own.model.dt * np.arange(own.motion.markers.shape[1])
    seen = pixels(own, true.pos[0] + true.vel[0] * times[:, None, None], camera)
    along = np.diff(seen, axis=1)
    parts = {
        "places": seen[None, :, :-1] + 0.5 * along,
        "tangents": along[None] / np.linalg.norm(along[None], axis=-1)[..., None],
    }
    view = replace(own.spines.views[0], good=np.ones_like(own.spines.views[0].good), **parts)
    own.spines = Spines([view], own.model.dt, own.extent, own.spines.free)
    return seen


def beside(points: np.ndarray, line: np.ndarray) -> float:
    """Return the largest distance of points from the nearest place of a line [px]."""
    fine = np.stack([np.interp(np.linspace(0, 1, 2000), np.linspace(0, 1, len(line)), x) for x in line.T], 1)
    return float(np.linalg.norm(points[:, None] - fine, axis=-1).min(1).max())


@pytest.mark.parametrize("side", [-5.0, 5.0])
def test_a_rope_that_hangs_elsewhere_is_found_where_its_first_pictures_show_it(
    swing: FilmedProblem, side: float
) -> None:
    across, own = np.array(swing.spines.views[0].camera.rotation)[0], replace(swing)
    modes = np.zeros((1, 2, own.shapes.shape[1], 3))
    modes[0, 0, 0], modes[0, 1, 0] = side * across, 2 * across
    true = own.begin(modes.reshape(1, 1, -1))
    seen = shown(own, true)
    look_at_first_pictures(own, raw_of(own))
    off, balance = (beside(pixels(own, pos)[0], seen[0]) for pos in (own.begin(own.offset[None]).pos, own.start.pos))
    assert balance > 25 and off < 2


def test_cameras_are_found_by_the_grippers_between_which_ropes_are_drawn(swing: FilmedProblem) -> None:
    """A camera that is turned by a degree sees the whole rope elsewhere, and a rope cannot be elsewhere at its ends."""
    modes, off = np.zeros((1, 2, swing.shapes.shape[1], 3)), []
    modes[0, 0, 0], modes[0, 1, 0] = [1.0, -1.0, 0.5], [0.5, 1.0, 0.0]
    for cameras in (False, True):
        own = replace(swing)
        true = own.begin(modes.reshape(1, 1, -1))
        shown(own, true, (0.017, -0.01, 0.012, 0.0, 0.0, 0.0, 0.0, 0.0))
        raw = look_at_first_pictures(own, raw_of(own), cameras=cameras)
        assert np.array_equal(raw, raw_of(own)) != cameras
        aside = np.array(own.spines.views[0].camera.rotation)[:2] @ (own.begin(own.offset[None]).pos - true.pos)[0].T
        off.append(float(np.abs(aside).max()))
    assert off[1] < 0.02 and off[0] > 3 * off[1], off


def test_what_was_shown_is_kept_where_ropes_of_another_stiffness_are_in_balance(swing: FilmedProblem) -> None:
    own = replace(swing)
    look_at_first_pictures(own, raw_of(own))
    assert own.shown is not None
    own.fixed = own.fixed * np.array([20.0, 20.0, 1.0])
    balance = own.start.pos
    begin_from_balance(own, own.fixed)
    assert np.abs(own.start.pos - balance).max() > 5e-3
    there = own.moved(own.offset[None]).pos
    assert np.abs(there - own.shown.pos).max() < 0.2 * np.abs(own.start.pos - own.shown.pos).max()


def test_one_camera_sees_how_far_away_a_rope_on_a_table_is(swing: FilmedProblem) -> None:
    camera = looking_at("a", [0.15, -1.0, 1.9], [0.0, 0.0, 0.88], focal=650.0)
    views = [replace(swing.spines.views[0], camera=camera)]
    away, off = np.array(camera.rotation)[2] * [1, 1, 0], {}
    for height in (None, float(swing.start.pos[..., 2].min()) - 0.01):
        recording = replace(swing.model.recording, table_height=height)
        own = filmed_problem(recording, swing.trials, views, options={"vertices": 13})
        modes = np.zeros((1, 2, own.shapes.shape[1], 3))
        modes[0, 0, 0] = 0.1 * away / own.reach[0]
        true = own.begin(modes.reshape(1, 1, -1))
        shown(own, true)
        look_at_first_pictures(own, raw_of(own))
        found = own.begin(own.offset[None]).pos[0] - true.pos[0]
        off[height is None] = np.abs(found @ away / np.linalg.norm(away)).max()
    assert off[False] < 0.01 and off[True] > 3 * off[False], off


def test_ropes_do_not_begin_below_the_table(swing: FilmedProblem) -> None:
    lowest = float(swing.start.pos[..., 2].min())
    recording = replace(swing.model.recording, table_height=lowest - 0.01)
    own = filmed_problem(recording, swing.trials, swing.spines.views, options={"vertices": 13})
    modes = np.zeros((1, 1, 2, own.shapes.shape[1], 3))
    modes[..., 0, 0, 2] = -4.0
    floor = lowest - 0.01 + recording.radius
    assert own.begin(modes.reshape(1, 1, -1)).pos[..., 2].min() > floor - 2e-3


def two(swing: FilmedProblem) -> FilmedProblem:
    """Return the problem of two trials that are alike."""
    own = swing.picked(np.zeros(2, int))
    own.trials = tuple(replace(t, name=f"train_{k}") for k, t in enumerate(own.trials))
    return own


def without(own: FilmedProblem, trial: int, seconds: float) -> FilmedProblem:
    """Return the problem in which the first pictures of a trial do not count."""
    good = [view.good.copy() for view in own.spines.views]
    for each, view in zip(good, own.spines.views, strict=True):
        each[trial, view.time[trial] < seconds] = False
    return own.counting(good)


def test_a_trial_that_is_seen_late_or_rests_leaves_others_as_they_are(swing: FilmedProblem) -> None:
    alone = replace(swing)
    look_at_first_pictures(alone, raw_of(alone))
    late = without(two(swing), 1, 0.15)
    resting = two(swing)
    resting.start = replace(resting.start, still=np.array([False, True]))
    for own in (late, resting):
        look_at_first_pictures(own, raw_of(own))
        np.testing.assert_allclose(own.offset[0], alone.offset[0], atol=1e-6)
        assert not own.offset[1].any()


def test_a_trial_whose_first_picture_is_wrong_begins_as_the_next_one_shows_it(swing: FilmedProblem) -> None:
    own = without(two(swing), 1, 0.02)
    look_at_first_pictures(own, raw_of(own))
    one, other = own.begin(own.offset[None]).pos
    assert own.offset[1].any() and np.abs(one - other).max() < 0.1
    window = start_window(without(two(swing), 1, 0.15))
    assert window > START_WINDOW + 0.2


def test_fresh_starts_are_those_that_were_shown(swing: FilmedProblem) -> None:
    own = two(swing)
    own.offset = 2 * np.random.default_rng(0).normal(size=own.offset.shape)
    moved = own.moved(own.offset[None])
    own.shown = replace(own.start, pos=moved.pos, vel=moved.vel)
    np.testing.assert_allclose(own.fresh, own.offset, atol=1e-9)
    np.testing.assert_allclose(own.picked(np.array([1])).fresh[0], own.offset[1], atol=1e-9)
