"""The rules of a diagnosis on a pendulum: friction and drag are named, nothing is where nothing is hidden."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from torchdlo.errors import InputError
from torchdlo.physics.effects.base import Param
from torchdlo.sysid.diagnosis.other_systems import EffectSpec, System, points_trial, select
from torchdlo.sysid.recordings.recording import Trial

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

import pendulum

RADIUS, NOISE = 0.42, 4.9e-4


def found(path: Path, hidden: dict[str, float], effects: tuple[EffectSpec, ...] = pendulum.EFFECTS, rounds: int = 2):
    """What is named in a recording of four seconds."""
    pendulum.write(path, hidden, duration=4.0)
    trials = pendulum.read(path, RADIUS)
    train, test = ([t for t in trials if t.name.startswith(split)] for split in ("train", "test"))
    return select(pendulum.system(RADIUS, effects), train, test, NOISE, rounds=rounds)


def test_the_simulation_is_that_of_another_integrator() -> None:
    time = np.arange(0, 3, 0.02)
    rate = lambda _, y: [y[1], -22 * np.sin(y[0]) - 0.1 * y[1] - 0.08 * abs(y[1]) * y[1]]  # noqa: E731
    angle = solve_ivp(rate, (0, 3), [1.2, 0.0], "DOP853", time, rtol=1e-10, atol=1e-10).y[0]
    points = pendulum.on_circle(angle, RADIUS)
    numbers = {"stiffness": np.array([22.0]), "damping": np.array([0.1]), "air_drag.coefficient": np.array([0.08])}
    sims = pendulum.system(RADIUS).simulate(numbers, [points_trial("a", time, points)])
    np.testing.assert_allclose(sims[0, 0], points, atol=2e-5)


def test_hidden_friction_and_drag_are_both_named(tmp_path: Path) -> None:
    both = found(tmp_path / "p.csv", {"bearing_friction": 0.5, "air_drag": 0.15})
    assert set(both.effects) == {"bearing_friction", "air_drag"} and both.verdict == "effects"
    assert both.numbers["air_drag.coefficient"][0] == pytest.approx(0.15, rel=0.2)
    assert both.numbers["bearing_friction.deceleration"][0] == pytest.approx(0.5, rel=0.2)
    assert both.after < 0.2 * both.before and max(both.rates.values()) < 0.06


def test_nothing_is_named_where_nothing_is_hidden(tmp_path: Path) -> None:
    none = found(tmp_path / "p.csv", {}, rounds=1)
    assert none.verdict == "none" and none.effects == [] and len(none.candidates) == len(pendulum.EFFECTS)


def test_another_effect_is_one_declaration_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bearing that brakes with the cube of the speed."""
    cubic = EffectSpec(
        "cubic_drag",
        "theta'' = -coefficient theta'^3",
        {"coefficient": Param(0.0, 0.0, 1.0, "s", "linear", 0.0, "Drag over inertia.")},
        ({"coefficient": 0.01},),
    )
    monkeypatch.setitem(pendulum.LAWS, "cubic_drag", ("coefficient", lambda k, x, v: -k * v**3))
    path = tmp_path / "p.csv"
    pendulum.write(path, {}, duration=4.0)
    trials = [t for t in pendulum.read(path, RADIUS) if t.name != "train_0"]
    system = pendulum.system(RADIUS, (cubic,))
    numbers = {"stiffness": 23.4, "damping": 0.04, "cubic_drag.coefficient": 0.02}
    sims = system.simulate({k: np.array([v]) for k, v in numbers.items()}, trials)[0]
    rng = np.random.default_rng(0)
    trials = [replace(t, markers=s + NOISE * rng.standard_normal(s.shape)) for t, s in zip(trials, sims, strict=True)]
    # The noise of the first frame would start it elsewhere.
    trials = [replace(t, markers=np.r_[s[:1], t.markers[1:]]) for t, s in zip(trials, sims, strict=True)]
    named = select(system, trials[:2], trials[2:], NOISE, rounds=1)
    assert named.effects == ["cubic_drag"]
    assert named.numbers["cubic_drag.coefficient"][0] == pytest.approx(0.02, rel=0.05)


def test_a_recording_that_cannot_be_read_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("trial,time\n")
    with pytest.raises(InputError, match="column angle is missing; expected trial, time and angle"):
        pendulum.read(path, RADIUS)
    path.write_text("trial,time,angle\na,0.0,much\n")
    with pytest.raises(InputError, match=r"line 2: time '0\.0' and angle 'much'; expected numbers"):
        pendulum.read(path, RADIUS)
    path.write_text("trial,time,angle\n" + "".join(f"a,{0.02 * k},0.1\n" for k in range(30)))
    with pytest.raises(InputError, match="0 rows before time 0"):
        pendulum.read(path, RADIUS)
    with pytest.raises(InputError, match=r"a: points have shape \(3, 2\); expected \(3, points, 3\)"):
        points_trial("a", np.arange(3.0), np.zeros((3, 2)))
    time, still = 0.02 * np.arange(30), np.zeros((30, 1, 3))
    for wrong, points, said in (
        (np.r_[time[:10], time[10:] + 0.05], still, r"even steps of 0.02 s, found 0.07 s before frame 10"),
        (np.r_[time[:-1], np.nan], still, "at least 5 finite times that rise from 0 s"),
        (time, np.full((30, 1, 3), np.nan), "free points in at least 5 frames, found them in 0"),
        (time, np.full((30, 1, 3), np.inf), "expected finite numbers in metres"),
    ):
        with pytest.raises(InputError, match=f"a: .*{said}"):
            points_trial("a", wrong, points)
    with pytest.raises(InputError, match="0 train and 0 test trials are given"):
        select(pendulum.system(RADIUS), [], [], NOISE)


def fallen(numbers: dict[str, np.ndarray], trials: Sequence[Trial]) -> np.ndarray:
    """A ball that falls with drag."""
    found = np.zeros((len(numbers["g"]), len(trials), len(trials[0].time), 1, 3))
    step = float(trials[0].time[1]) / 10
    for b in range(len(trials)):
        place, speed = np.zeros(len(found)), np.zeros(len(found))
        for f in range(found.shape[2]):
            found[:, b, f, 0, 2] = place
            for _ in range(10):
                speed = speed - step * (numbers["g"] + numbers["drag.k"] * speed * np.abs(speed))
                place = place + step * speed
    return found


@pytest.mark.parametrize("tests", [1, 9])
def test_a_name_that_too_few_trials_test_is_doubted(tests: int) -> None:
    baseline = {"g": Param(9.5, 5.0, 15.0, "m/s^2", "log", None, "Gravity.")}
    drag = EffectSpec("drag", "a = -k v|v|", {"k": Param(0.0, 0.0, 5.0, "1/m", "linear", 0.0, "Drag.")}, ({"k": 0.05},))
    time, rng = np.arange(36) / 60, np.random.default_rng(0)
    empty = points_trial("a", time, np.zeros((36, 1, 3)))
    true = fallen({"g": np.array([9.81]), "drag.k": np.array([0.3])}, [empty])[0, 0]
    trials = [replace(empty, name=f"{k}", markers=true + 1e-3 * rng.normal(size=true.shape)) for k in range(3 + tests)]
    found = select(System(fallen, baseline, (drag,)), trials[:3], trials[3:], 1e-3)
    assert found.effects == ["drag"]
    few = "the test trials are too few to exclude that drag is chance"
    assert found.doubts == ([few] if tests == 1 else []) and (found.rates["drag"] > 0.05) == (tests == 1)
