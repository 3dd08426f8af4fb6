"""What finer steps and meshes change is added to simulations, and what may be left of it is the floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import NOISE, PLACES
from tests.sysid.swaying import recording as swaying
from torchdlo.sysid.diagnosis import error_floor
from torchdlo.sysid.diagnosis.error_floor import Refinement, noise_beside, noise_notes, shown_noise
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import Fitted, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.recordings.recording import Recording, Trial

OPTIONS = {"vertices": 33, "numerical_damping": 0.0, "clamp_fraction": 0.0}


def carried(path: Path) -> Recording:
    """A rope that hangs at rest from a gripper, which then sets out softly."""
    recording = swaying(path, frames=40)
    time = recording.train[0].time
    moves = [size * (1 - np.cos(rate * time)) for size, rate in ((0.05, 4.0), (0.03, 6.0), (0.04, 5.0))]

    def trial(old: Trial, k: int) -> Trial:
        markers = np.stack([0 * PLACES, 0 * PLACES, 1.0 - PLACES], -1) + np.zeros((len(time), 1, 1))
        markers[:, :, 0] += moves[k % 3][:, None]
        return replace(old, markers=markers)

    trials = [trial(t, k) for k, t in enumerate((*recording.train, *recording.test))]
    return replace(recording, train=tuple(trials[:3]), test=tuple(trials[3:]))


def test_a_correction_leaves_little_of_the_error_of_steps_and_mesh(tmp_path: Path) -> None:
    with Pool(carried(tmp_path), OPTIONS, workers=1) as pool:
        model, values = pool.local.model(()), np.array([3e-3, 2e-3, 2.0])
        bench = Workspace(pool).begin(values, ())
        none = ParameterSpace((), ())
        fitted = Fitted((), values, none, Point(np.empty(0), 0.0, np.empty(0), np.empty(0), np.empty(0)))
        coarse, count = bench.prediction(fitted, "all"), len(model.arclength)
        fine = (("vertices", 4 * count - 3), ("substep", model.dt / (8 * model.substeps)))
        exact = dict(pool.simulate([SimulationJob((), values[None], "all", bench.starts["all"], fine)]))[0][0]
        before, bench = bench, bench.correct(fitted)
        corrected = bench.prediction(fitted, "all")
        assert bench.prediction(fitted, "all") is not before.prediction(fitted, "all")
        np.testing.assert_array_equal(before.prediction(fitted, "all"), coarse)
    free = ~pool.recording.train[0].gripped

    def error(sims: np.ndarray) -> float:
        """Of the test trials, as the floor is."""
        return float(np.sqrt(np.mean((sims - exact)[3:][:, :, free] ** 2)))

    # On so coarse a mesh halving does not yet divide the error by four.
    assert error(corrected) < error(coarse) / 2
    assert np.hypot(bench.floor.step, bench.floor.grid) < error(coarse) / 2
    # Held markers are where they are told to be on any mesh.
    assert np.abs(corrected - coarse)[:, :, ~free].max() < 1e-12


def test_extrapolation_knows_the_order_of_the_steps() -> None:
    step, grid = np.full((2, 3, 4, 3), 0.3), np.full((2, 3, 4, 3), 0.6)
    for order, rest in ((2, 1 / 3), (1, 1.0)):
        found = Refinement(step, grid, 1e-4, order, 0.02)
        np.testing.assert_allclose(found.correction, (1 + rest) * 0.3 + 4 / 3 * 0.6)
        parts = found.floor(slice(1, None), np.ones(4, bool))
        assert (parts.noise, parts.step, parts.grid) == pytest.approx((1e-4, rest * 0.3, 0.2))


def test_trials_whose_finer_simulation_fails_are_not_corrected() -> None:
    step, grid = np.full((2, 3, 4, 3), 0.03), np.full((2, 3, 4, 3), 0.03)
    step[0], grid[1, 2, 1, 0] = 7.0, np.nan
    found = Refinement(error_floor._tame(step), error_floor._tame(grid), 1e-4, 2, 0.02)
    np.testing.assert_allclose(found.correction, np.full(step.shape, 0.04))
    # Where no test trial tells, the others do; where none does, nothing is known.
    assert found.floor(slice(1, None), np.ones(4, bool)).grid == pytest.approx(0.01)
    assert replace(found, grid=np.full_like(grid, np.nan)).floor(slice(None), np.ones(4, bool)).grid == np.inf


def test_motions_that_magnify_errors_count_less() -> None:
    free, noise = np.array([False, True, True]), 1e-3
    step, grid = np.zeros((2, 4, 3, 3)), np.zeros((2, 4, 3, 3))
    grid[0, 2:, free] = 9e-3
    found = Refinement(step, grid, noise, 2, 0.02)
    frame_weights, level = found.frame_weights(free)
    # What is left of a change of 9 mm is a third of it.
    deviation = np.full((2, 4), noise)
    deviation[0, 2:] = np.hypot(noise, 3e-3)
    np.testing.assert_allclose(frame_weights * deviation, level)
    assert np.mean(frame_weights**2) == pytest.approx(1.0)
    # The links of a chain are where vertices of the mesh are: nothing to correct, but all the more may be wrong.
    chain = replace(found, links=0.02)
    assert not chain.correction.any()
    assert chain.floor(slice(None), free).grid == pytest.approx(3 * found.floor(slice(None), free).grid)
    assert chain.frame_weights(free)[0][0, 2] < frame_weights[0, 2]


def test_a_chain_is_corrected_by_what_its_links_do_not_explain(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path, frames=5), OPTIONS, workers=1) as pool:
        bench, none = Workspace(pool).begin(pool.local.model(()).guess(), ()), ParameterSpace((), ())
        edge = np.mean(np.diff(pool.local.model(()).arclength))
        for links, wrong in ((0.0, 1.0), (0.5, 0.75), (-1.0, 0.0), (4.0, -1.0)):
            values = np.append(pool.local.model(()).guess(), links * edge)
            point = Point(np.empty(0), 0.0, np.empty(0), np.empty(0), np.empty(0))
            base = Fitted(("link_chain",), values, none, point)
            assert error_floor.refine(pool, base, bench.starts["all"], "link_chain").wrong == pytest.approx(wrong)


def test_trials_that_tell_nothing_of_their_errors_count_as_others_do() -> None:
    step, grid = np.zeros((3, 2, 4, 3)), np.full((3, 2, 4, 3), 3e-3)
    grid[1] = np.nan
    frame_weights, level = Refinement(step, grid, 1e-3, 2, 0.02).frame_weights(np.ones(4, bool))
    np.testing.assert_allclose(frame_weights, 1.0)
    assert level == pytest.approx(np.hypot(1e-3, 1e-3))
    assert Refinement(step, np.full_like(grid, np.nan), 1e-3, 2, 0.02).frame_weights(np.ones(4, bool))[1] == np.inf


def test_gaps_are_weighted_by_frame(tmp_path: Path) -> None:
    trials = swaying(tmp_path, frames=10).train
    sims = np.stack([t.markers for t in trials]) + 1e-3
    frame_weights = np.zeros((3, 10))
    frame_weights[1], frame_weights[2, :5] = 1.0, 2.0
    np.testing.assert_allclose(error_floor.trial_gaps(sims, trials), 1e-3)
    np.testing.assert_allclose(error_floor.trial_gaps(sims, trials, frame_weights), [0.0, 1e-3, np.sqrt(2) * 1e-3])


def test_the_noise_is_no_more_than_a_fit_leaves(tmp_path: Path) -> None:
    given, unknown = (replace(swaying(tmp_path, frames=600), marker_noise_std=x) for x in (2e-3, None))
    slow = replace(unknown, train=tuple(_every(t, 20) for t in unknown.train))
    shown = shown_noise(slow)
    # At 5 frames a second motion shows, and in fourth differences more of it.
    fourth = [np.abs(np.diff(t.markers[:, ~t.gripped], n=4, axis=0)) for t in slow.train]
    assert shown_noise(unknown) == pytest.approx(NOISE, rel=0.05)
    assert 5 * NOISE < shown < 1.4826 * np.median([np.median(x) for x in fourth]) / np.sqrt(70)
    small, gaps = np.array([3.1e-4, 3.1e-4, np.inf]), np.full(3, 1e-3)
    assert noise_beside(slow, small) == pytest.approx(3.1e-4) and noise_beside(unknown, gaps) == shown_noise(unknown)
    # What is given stands unless it is three times what is left.
    assert noise_beside(given, gaps) == 2e-3 and noise_beside(given, small) == pytest.approx(3.1e-4)
    assert noise_beside(given, np.array([np.inf])) == 2e-3
    assert "what neighbouring frames show" in noise_notes(slow, 3.1e-4)[0] and noise_notes(given, 2e-3) == []
    assert "what rope.json gives, 2 mm, is too much" in noise_notes(given, 3.1e-4)[0]


def _every(trial: Trial, step: int) -> Trial:
    """A trial with every so manieth frame."""
    return replace(trial, time=trial.time[::step], markers=trial.markers[::step], suspect=trial.suspect[::step])
