"""The rules of a diagnosis on a pendulum: friction and drag are named, nothing is where nothing is hidden."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from torchdlo.errors import InputError
from torchdlo.physics.effects.base import Param
from torchdlo.sysid.diagnosis.other_systems import EffectSpec, points_trial, select

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
    assert both.after < 0.2 * both.before and max(both.rates.values()) < 0.01


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
    with pytest.raises(InputError, match="0 train and 0 test trials are given"):
        select(pendulum.system(RADIUS), [], [], NOISE)
