"""Calibration finds the numbers that made a recording, keeps its promises on the way, and predicts unseen trials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.physics.effects.base import Param
from torchdlo.sysid.calibration import refinement
from torchdlo.sysid.calibration.calibrate import calibrate
from torchdlo.sysid.diagnosis.effect_library import PARAMETERS
from torchdlo.sysid.estimation import levenberg_marquardt, model_uncertainty
from torchdlo.sysid.estimation.levenberg_marquardt import Point
from torchdlo.sysid.model import initial_state
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"
TRUE = np.array([2e-3, 1.2e-3, 0.8])  # bending, twisting stiffness [N m^2], damping rate [1/s]
OPTIONS = {"starts": 6, "iterations": 5, "vertices": 13, "refined": False}


def make_recording(path: Path, *, ends: int = 2, seed: int = 0, noise: float = 0.0) -> Recording:
    """A rope of known numbers, shaken at one or both ends for 0.8 s, as the model itself moves it."""
    rng = np.random.default_rng(seed)
    s = np.array([0.0, 0.03, 0.14, 0.25, 0.36, 0.47, 0.5])
    gripped = np.array([True, True, False, False, False, ends == 2, ends == 2])
    time = np.arange(41) * 0.02

    def trial(name: str) -> Trial:
        a, b = rng.uniform(0.05, 0.1, 2)
        w = rng.uniform(6, 12, 2)
        span = 0.8 * s[-1]
        line = np.stack([s / s[-1] * span, 0 * s, 0.3 - 0.4 * (s / s[-1]) * (1 - s / s[-1])], -1)
        sway = np.stack([0 * time, a * np.sin(w[0] * time), b * np.sin(w[1] * time)], -1)
        weight = np.where(s < 0.25, 1.0, -0.5)
        markers = line[None] + weight[None, :, None] * sway[:, None]
        return Trial(name, time, markers, s, gripped, None, None, np.zeros(len(time), bool))

    trials = tuple(trial(n) for n in ("train_0", "train_1", "test_0"))
    empty = Recording(
        path, 0.5, 0.004, 0.03, np.array([0, 0, -9.81]), None, None, None, None, False, "", trials[:2], trials[2:]
    )
    model = RopeModel(empty, vertices=OPTIONS["vertices"])
    motion = model.motion(trials)
    begin = initial_state.read_off(trials)
    sims = model.simulate(motion, Start(begin.pos, 0 * begin.vel), TRUE[None])[0] + noise * rng.normal(
        size=motion.markers.shape
    )
    sims[:, :, gripped] = motion.markers[:, :, gripped]
    made = tuple(replace(t, markers=m) for t, m in zip(trials, sims, strict=True))
    return replace(empty, train=made[:2], test=made[2:])


def test_true_numbers_are_found_again(tmp_path: Path) -> None:
    # G4 of the reference cases: stiffness within 1 % asks for better than the mesh; here model and data share it.
    result = calibrate(make_recording(tmp_path, noise=2e-4), **OPTIONS)
    found = result.parameters
    assert found["bending_stiffness"]["value"] == pytest.approx(TRUE[0], rel=0.02)
    # In 0.8 s damping takes a few tenths of the motion, and starts are known to a millimetre: it is known roughly.
    assert found["damping_rate"]["low"] < TRUE[2] < found["damping_rate"]["high"]
    assert result.test_mae_mm < 0.6 and result.test_mae_mm < 0.1 * result.before["test_mae_mm"]
    assert all(p["low"] < p["value"] < p["high"] for p in result.parameters.values())


def test_a_rope_held_at_one_end_is_calibrated(tmp_path: Path) -> None:
    result = calibrate(make_recording(tmp_path, ends=1), **OPTIONS)
    assert result.parameters["bending_stiffness"]["value"] == pytest.approx(TRUE[0], rel=0.03)


def test_train_trials_may_be_shorter_than_test_trials(tmp_path: Path) -> None:
    recording = make_recording(tmp_path)
    short = [
        replace(t, time=t.time[:25], markers=t.markers[:25], suspect=t.suspect[:25], gripper_quaternion=None)
        for t in recording.train
    ]
    short = [replace(t, gripper_marker=None) for t in short]
    tests = tuple(replace(t, gripper_quaternion=None, gripper_marker=None) for t in recording.test)
    found = calibrate(replace(recording, train=tuple(short), test=tests), **OPTIONS | {"refined": True})
    assert np.isfinite([found.train_mae_mm, found.test_mae_mm]).all()


def test_same_seed_same_numbers(tmp_path: Path) -> None:
    recording = make_recording(tmp_path)
    one, two = (calibrate(recording, seed=3, starts=4, iterations=1, vertices=13) for _ in range(2))
    assert one.parameters == two.parameters and one.test_mae_mm == two.test_mae_mm


def test_interruption_keeps_the_best_and_resume_ends_as_if_never_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, checkpoint = make_recording(tmp_path), tmp_path / "checkpoint.json"
    few: dict[str, Any] = {"starts": 4, "iterations": 2, "vertices": 13}
    looked: list[int] = []
    evaluate = levenberg_marquardt.evaluate

    def counted(*given: Any) -> list[Point]:
        looked.append(1)
        return evaluate(*given)

    monkeypatch.setattr(levenberg_marquardt, "evaluate", counted)
    whole = calibrate(recording, **few)
    count = len(looked)
    looked.clear()

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if stage.startswith("fitting") and done == 2:
            raise KeyboardInterrupt

    first = calibrate(recording, checkpoint=checkpoint, callback=stop, **few)
    assert first.interrupted and np.isfinite(first.test_mae_mm) and checkpoint.exists()
    second = calibrate(recording, checkpoint=checkpoint, resume=True, **few)
    assert not second.interrupted and second.parameters == whole.parameters
    assert second.test_mae_mm == whole.test_mae_mm
    assert len(looked) == count, "nothing is computed twice"


def test_interruption_while_starts_are_tried_keeps_the_best_that_was_shown(tmp_path: Path) -> None:
    shown: list[float] = []

    def stop(stage: str, done: int, total: int, message: str) -> None:
        if stage.startswith("trying") and done == 2:
            shown.append(float(message.split()[0]))
            raise KeyboardInterrupt

    found = calibrate(make_recording(tmp_path), callback=stop, starts=4, iterations=1, vertices=13)
    assert found.interrupted and found.train_mae_mm < 3 * shown[0]
    assert found.train_mae_mm < found.before["train_mae_mm"]


def test_interruption_before_any_result_is_passed_on(tmp_path: Path) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate(make_recording(tmp_path), callback=stop, **OPTIONS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rest": "bent"}, "rest is 'bent'"),
        ({"rest": "given"}, "rest_positions is missing"),
        ({"resume": True}, "no checkpoint"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        calibrate(make_recording(tmp_path), **OPTIONS, **options)


def test_a_checkpoint_of_other_data_is_refused(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint.json"
    calibrate(make_recording(tmp_path), starts=2, iterations=1, vertices=13, checkpoint=checkpoint)
    with pytest.raises(InputError, match="belongs to another recording"):
        calibrate(
            make_recording(tmp_path, seed=1), starts=2, iterations=1, vertices=13, checkpoint=checkpoint, resume=True
        )


def test_a_trial_that_is_suspect_throughout_is_left_out(tmp_path: Path) -> None:
    recording = make_recording(tmp_path)
    bad = replace(recording.train[1], suspect=np.ones(41, bool), markers=recording.train[1].markers + 0.1)
    result = calibrate(replace(recording, train=(recording.train[0], bad)), **OPTIONS)
    assert any("train_1" in note for note in result.notes)
    assert result.parameters["bending_stiffness"]["value"] == pytest.approx(TRUE[0], rel=0.05)


def test_a_trial_that_starts_with_a_mistracked_marker_is_simulated(tmp_path: Path) -> None:
    recording = make_recording(tmp_path)
    trial = recording.test[0]
    jumped = trial.markers.copy()
    jumped[:6, 3] += [0.05, 0.0, 0.08]  # its edges are tens of per cent longer than the rope's
    model = RopeModel(recording, vertices=13)
    first = initial_state.read_off([replace(trial, markers=jumped)])
    sim = model.simulate(model.motion([trial]), first, TRUE[None])[0, 0]
    edges = np.linalg.norm(np.diff(sim, axis=1), axis=-1)[:, 1:-1]  # the others are between gripped markers
    assert (edges <= np.diff(trial.marker_arclength)[1:-1] * (1 + 1e-3)).all()


def test_as_many_parameter_sets_as_vertices_are_still_one_per_scene(tmp_path: Path) -> None:
    recording = make_recording(tmp_path)
    model = RopeModel(recording, vertices=13)
    motion, begin = model.motion(recording.train[:1]), initial_state.read_off(recording.train[:1])
    many = TRUE * np.linspace(0.5, 2.0, len(model.arclength))[:, None]
    together = model.simulate(motion, begin, many, frames=8)
    np.testing.assert_allclose(together[[3]], model.simulate(motion, begin, many[[3]], frames=8), atol=1e-7)


def test_a_trial_that_fails_costs_much_and_not_everything() -> None:
    # Two trials of markers that move by a metre; what the third set shows of the second trial grows without end.
    measured = np.broadcast_to(np.linspace(0.0, 1.0, 5)[:, None, None], (2, 5, 4, 3))
    sims = measured + np.zeros((4, 1, 1, 1, 1))
    sims[1, 1], sims[2, 1, 3:] = np.nan, 1e3
    sims[3] = np.inf
    costs = levenberg_marquardt.costs(sims, measured)
    assert costs[0] == 0.0 and costs[1] == pytest.approx(0.5 * levenberg_marquardt._LOST) and np.isinf(costs[3])
    assert costs[2] == pytest.approx(0.5)  # as much as the markers move


@pytest.mark.parametrize("far", [np.nan, 1e3])
def test_trials_that_go_astray_tell_nothing_about_slopes(far: float) -> None:
    # x = a t + b; the second trial goes astray as soon as a is changed.
    time = np.linspace(0.0, 1.0, 5)[:, None, None] * np.ones((1, 4, 3))
    measured = np.stack([0.5 * time, time])
    params = (Param(1.0, -9.0, 9.0, "m/s", "linear", None, ""), Param(0.0, -9.0, 9.0, "m", "linear", None, ""))
    space = levenberg_marquardt.ParameterSpace(("a", "b"), params, (0.1, 0.1))

    def simulate(values: np.ndarray) -> np.ndarray:
        a, b = (values[:, k, None, None, None, None] for k in (0, 1))
        sims = a * np.stack([0.5 * time, time]) + b
        sims[np.abs(values[:, 0] - 1.0) > 1e-9, 1, 3:] = far
        return sims

    (point,) = levenberg_marquardt.evaluate(simulate, measured, space, np.array([[10.0, 0.0]]))
    assert point.cost == pytest.approx(0.0, abs=1e-12)
    assert point.curvature[0].all() and not point.curvature[1].any() and not point.gradient[1].any()


def test_starts_use_nothing_after_the_first_tenth_of_a_second(tmp_path: Path) -> None:
    recording = make_recording(tmp_path)
    trial = recording.test[0]
    later = trial.markers.copy()
    later[6:, ~trial.gripped] += 0.05
    model = RopeModel(recording, vertices=13)
    starts = []
    for markers in (trial.markers, later):
        changed = replace(trial, markers=markers)
        starts.append(initial_state.refine(model, model.motion([changed]), initial_state.read_off([changed]), TRUE))
    np.testing.assert_array_equal(starts[0].vel, starts[1].vel)
    np.testing.assert_array_equal(starts[0].pos, starts[1].pos)


def test_the_measured_rest_shape_turns_with_the_clamp(tmp_path: Path) -> None:
    # A rope that is an arc at rest and hangs from one clamp without weight keeps to its arc, whichever way it is held.
    recording = make_recording(tmp_path, ends=1)
    s = recording.train[0].marker_arclength
    arc = np.stack([0.3 * np.sin(s / 0.3), 0.3 * (1 - np.cos(s / 0.3)), 0 * s], -1)
    still = replace(recording.train[0], markers=np.repeat(arc[None], 41, 0))
    flat = replace(recording, rest_positions=arc, gravity=np.zeros(3), train=(still,), test=(still,))
    model = RopeModel(flat, vertices=13, rest="given")
    motion, begin = model.motion([still]), initial_state.read_off([still])
    errors = []
    for roll in (0.0, np.pi):
        sim = model.simulate(motion, begin, np.array([[2e-3, 1.2e-3, 0.8, 1.0, roll]]))[0, 0]
        errors.append(np.abs(sim - still.markers).max())
    assert min(errors) < 2e-3 < 0.05 < max(errors)


def test_space_keeps_bounds_and_turns_angles_round() -> None:
    space = levenberg_marquardt.ParameterSpace(
        ("damping_rate", "rest_roll"), (PARAMETERS["damping_rate"], PARAMETERS["rest_roll"])
    )
    values = np.array([1e6, np.pi + 0.1])
    limited = space.to_values(space.clip(space.to_raw(values)))
    assert limited[0] == pytest.approx(PARAMETERS["damping_rate"].high)
    assert limited[1] == pytest.approx(-np.pi + 0.1)


def test_levenberg_marquardt_finds_the_minimum_of_a_known_curve() -> None:
    space = levenberg_marquardt.ParameterSpace(("damping_rate",), (PARAMETERS["damping_rate"],))
    time = np.linspace(0, 1, 50)

    def decay(values: np.ndarray) -> np.ndarray:
        curve = np.exp(-values[:, 0, None] * time)
        return np.broadcast_to(curve[:, None, :, None, None], (len(values), 2, 50, 1, 3))

    measured = np.array(decay(np.array([[1.7]]))[0])
    points = levenberg_marquardt.evaluate(decay, measured, space, space.to_raw(np.array([[0.3]])))
    *_, last = levenberg_marquardt.improve_points(decay, measured, space, points, iterations=30, tolerance=1e-9)
    assert space.to_values(last[0].raw)[0] == pytest.approx(1.7, rel=1e-4)


def test_large_errors_leave_less_curvature_and_what_is_not_seen_none() -> None:
    space = levenberg_marquardt.ParameterSpace(("damping_rate",), (PARAMETERS["damping_rate"],))
    look = levenberg_marquardt.PointEvaluation(space, space.to_raw(np.array([[0.8]])))
    measured = np.linspace(0.0, 1.0, 20)[None, :, None, None] * np.ones((2, 1, 4, 3))
    measured[1, 5:] = np.nan  # a short trial
    off = np.array([0.0, 3e-3])[:, None, None, None] + 1e-4 * np.arange(len(look.values))[:, None, None, None, None]
    (point,) = look.points(np.nan_to_num(measured) + off, measured)
    # knee^2 / size^3 over 1 / size, with size^2 = error^2 + knee^2 and a knee of 2 mm.
    np.testing.assert_allclose(point.flatter, [1.0, 4 / 13], rtol=1e-6)


@pytest.mark.slow
def test_ranges_take_in_what_wrong_simulations_change() -> None:
    space = levenberg_marquardt.ParameterSpace(("damping_rate",), (PARAMETERS["damping_rate"],))
    time = np.linspace(0.0, 1.0, 20)[None, :, None, None] * np.ones((3, 1, 1, 3))

    def slide(values: np.ndarray) -> np.ndarray:  # 1 mm a second for each unit of the coordinate
        return 1e-3 * space.to_raw(values)[:, 0, None, None, None, None] * time

    raw = space.to_raw(np.array([[0.8]]))
    look, measured = levenberg_marquardt.PointEvaluation(space, raw), slide(np.array([[0.8]]))[0]
    (point,) = look.points(slide(look.values), measured)
    drifts = levenberg_marquardt.drift(look, slide(look.values), measured, [2e-5 * time, 0.0 * time])
    # Simulations that run 2 % of a unit too fast make the fit find so much less.
    np.testing.assert_allclose(drifts, [[-0.02], [0.0]], atol=1e-5)
    (low,), (high,) = levenberg_marquardt.interval(point, space, drifts)
    assert np.log([low, high]) == pytest.approx(np.log(0.8) + 1.645 * np.array([-0.02, 0.02]), abs=1e-4)


def test_the_sample_recording_is_predicted_far_better_than_by_a_catenary_and_ranges_hold_the_truth() -> None:
    result = calibrate(load_recording(SAMPLE), starts=12, iterations=4)
    assert result.test_mae_mm < 0.8 < 0.05 * result.baselines["catenary"]["test_mae_mm"]
    truth = {"bending_stiffness": 3e-3, "twisting_stiffness": 2e-3, "damping_rate": 0.6}
    for name, true in truth.items():
        found = result.parameters[name]
        assert found["low"] < true < found["high"] < 1.1 * found["low"], name
        assert found["value"] == pytest.approx(true, rel=0.015), name
    assert any("90 % intervals" in note for note in result.notes)


def test_numbers_on_a_mesh_that_was_asked_for_stay_and_ranges_grow(tmp_path: Path) -> None:
    recording, options = make_recording(tmp_path), OPTIONS | {"iterations": 2}
    plain, wide = (calibrate(recording, **options | {"refined": refined}) for refined in (False, True))
    for name, found in wide.parameters.items():
        less = plain.parameters[name]
        assert found["value"] == less["value"] and found["low"] < less["low"] < less["high"] < found["high"]


def test_shear_lowers_stiffness_with_the_square_of_thickness_over_wavelength() -> None:
    # Standing waves sin(k s): curvature and its change differ by k, but for the ends of the spline.
    s, k, radius = np.linspace(0.0, 1.0, 41), 4 * np.pi, 0.004
    wave = np.sin(k * s) * np.sin(np.linspace(0.0, 2 * np.pi, 20, endpoint=False))[:, None]
    markers = np.stack([np.broadcast_to(s, wave.shape), wave, 0 * wave], -1)[None]
    share = model_uncertainty.shear_share(markers, s, radius)
    assert share == pytest.approx(10 / 12 * (k * radius) ** 2, rel=0.02)
    assert model_uncertainty.shear_share(markers, s, 2 * radius) == pytest.approx(4 * share)


def test_a_number_that_does_not_show_is_not_known() -> None:
    curvature = np.diag([0.5, 1e-20])[None].repeat(3, 0)
    point = levenberg_marquardt.Point(np.zeros(2), 6e-5, np.zeros((3, 2)), curvature, np.full(3, 6e-5))
    known, unknown = refinement.noise_of(point)
    # 300 readings of 0.5 mm noise at a knee of 2 mm: sqrt(2 cost / (n c)).
    assert known == pytest.approx(np.sqrt(2 * 6e-5 / (300 * 0.5)), rel=1e-6) and unknown > 10
