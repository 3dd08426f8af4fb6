"""What an effect explains is tested on trials that did not choose it; ranges and limits say what is a finding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from tests.report.fake_diagnosis import BASELINE, fake_diagnosis, fitted
from tests.sysid.swaying import recording as swaying
from torchdlo.report.pages.diagnosis import diagnosis_html
from torchdlo.sysid.diagnosis import selection
from torchdlo.sysid.diagnosis.backward_elimination import EliminationResult
from torchdlo.sysid.diagnosis.detection_limit import detection_limits, least_gap, limit_gap
from torchdlo.sysid.diagnosis.effect_search import _Search
from torchdlo.sysid.diagnosis.findings import findings, limits_text, mean_absolute_errors, summary
from torchdlo.sysid.diagnosis.misleading_trials import errors_by_frame, misleading_trials
from torchdlo.sysid.diagnosis.plausibility import implausible, not_told, unresolved
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.diagnosis.significance import (
    Agreement,
    agreement,
    benjamini_hochberg,
    chance,
    f_test,
    sign_flips,
)
from torchdlo.sysid.diagnosis.verdict import BestCandidate, Candidate
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.levenberg_marquardt import interval
from torchdlo.sysid.recordings.metrics import mean_absolute_error
from torchdlo.sysid.recordings.recording import Recording, Trial


@pytest.fixture(scope="module")
def rope() -> Recording:
    """A rope that sways."""
    return swaying(Path("rope"), frames=201)


def test_sign_flips_count_what_is_at_least_as_large() -> None:
    # Of eight flips of 1, 2 and 3, only these themselves sum to 6; four sum to 0 or more with signs +-1, +-2, 3.
    assert sign_flips(np.array([1.0, 2.0, 3.0])) == 1 / 8
    assert sign_flips(np.array([1.0, -2.0, 3.0])) == 3 / 8
    assert sign_flips(-np.ones(3)) == 1.0 and sign_flips(np.zeros(4)) == 1.0
    assert sign_flips(np.array([1.0, 2.0, 0.0, 3.0])) == 1 / 8
    # Of many units flips are drawn: of 20 equal ones, all but two positive, 1 + 20 + 190 of 2^20 are as good.
    many = np.r_[np.ones(18), -np.ones(2)]
    assert sign_flips(many) == pytest.approx(211 / 2**20, abs=1e-4)


def test_chance_is_found_significant_as_often_as_it_should_be() -> None:
    rng = np.random.default_rng(0)
    p = np.array([sign_flips(rng.normal(size=12)) for _ in range(400)])
    assert np.mean(p <= 0.05) < 0.09 and 0.4 < np.mean(p) < 0.6


def test_the_f_test_is_one_side_of_a_regression_on_a_constant() -> None:
    doses = np.array([0.8, 1.3, 1.0, 0.7])
    t = stats.ttest_1samp(doses, 0.0, alternative="greater")
    assert f_test(doses) == pytest.approx(t.pvalue)
    # With one degree of freedom t is Cauchy: 1 / pi of its tangent.
    assert f_test(np.array([0.9, 1.1])) == pytest.approx(np.arctan(0.1) / np.pi)
    assert np.isnan(f_test(np.array([1.0])))


def test_candidates_that_were_only_looked_at_count() -> None:
    p = np.array([0.001, 0.2, 0.004])
    full = stats.false_discovery_control(np.r_[p, np.ones(13)])
    np.testing.assert_allclose(benjamini_hochberg(p, 16), full[:3])


def shaken(trials: tuple[Trial, ...], dose: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Simulations without and with an effect that shifts markers as they move, of which the trials hold a dose."""
    change = np.stack([0.01 * np.gradient(t.markers, t.time, axis=0) for t in trials])
    less = np.stack([t.markers for t in trials]) - dose * change + 1e-4 * rng.normal(size=change.shape)
    return less, less + change


def test_trials_say_which_dose_they_ask_for(rope: Recording) -> None:
    less, more = shaken(rope.test, 0.8, np.random.default_rng(0))
    found = agreement(less, more, rope.test)
    assert found.unit == "block" and found.units == 10 and found.p == 1 / 2**10
    np.testing.assert_allclose(found.doses, 0.8, rtol=0.02)
    assert found.p_trials < 0.01
    nothing = agreement(*shaken(rope.test, 0.0, np.random.default_rng(1)), rope.test)
    assert nothing.p > 0.01 and np.abs(nothing.doses).max() < 0.05
    worse = agreement(*shaken(rope.test, -0.5, np.random.default_rng(1)), rope.test)
    assert worse.p > 0.99
    many = agreement(*shaken(rope.test * 4, 0.8, np.random.default_rng(0)), rope.test * 4, looked_at=12)
    assert many.unit == "trial" and many.units == 8 and many.could_tell(12)
    # Eight trials cannot tell one of 17 candidates from chance, blocks of them can.
    more = agreement(*shaken(rope.test * 4, 0.8, np.random.default_rng(0)), rope.test * 4, looked_at=17)
    assert more.unit == "block" and more.units == 40 and more.could_tell(17)
    null = agreement(*shaken(rope.test * 4, 0.0, np.random.default_rng(1)), rope.test * 4, looked_at=17)
    assert "may explain the test trials by chance" in chance({"air_drag": null}, 17)["air_drag"]
    assert chance({"air_drag": more}, 17) == {}


def swung(count: int, rng: np.random.Generator, *, start: float, dose: float = 0.0) -> tuple[np.ndarray, list[Trial]]:
    """What an effect changes of swinging markers, and trials that are off by noise and a start error that swings on."""
    time, free = np.arange(320) * 0.01, np.linspace(0, 1, 6)[:, None] * np.array([1.0, 0.0, 0.2])
    changes, trials = [], []
    for k in range(count):
        swing = np.exp(-0.5 * time) * np.cos((5 + 0.5 * rng.normal()) * time + rng.uniform(0, 2 * np.pi))
        changes.append(2e-3 * (time * swing)[:, None, None] * free)
        off = start * rng.normal() * swing[:, None, None] * free + 5e-4 * rng.normal(size=(320, 6, 3))
        markers, held = off + dose * changes[-1], np.zeros(6, bool)
        trials.append(Trial(f"test_{k}", time, markers, free[:, 0], held, None, None, np.zeros(320, bool)))
    return np.array(changes), trials


@pytest.mark.parametrize(("count", "start"), [(2, 3e-3), (5, 3e-3), (2, 0.0)])
def test_residuals_that_swing_on_are_not_taken_for_many_samples(count: int, start: float) -> None:
    rng, found = np.random.default_rng(0), []
    for _ in range(150):
        changes, trials = swung(count, rng, start=start)
        found.append(agreement(np.zeros_like(changes), changes, trials, looked_at=17))
    p, units = np.array([x.p for x in found]), np.mean([x.units for x in found])
    assert 0.015 <= np.mean(p <= 0.05) <= 0.08 and np.mean(p <= 1e-3) < 0.025
    if start:
        # Trials are the units then; short blocks would find one of twenty at 1e-4 and less.
        assert units < 2 * count and np.mean([x.p_short <= 1e-4 for x in found]) > 0.05
    else:
        assert units > 14


def test_effects_are_told_from_chance_where_trials_ask_for_the_same_dose() -> None:
    rng = np.random.default_rng(0)
    changes, trials = swung(2, rng, start=0.0, dose=1.0)
    same = agreement(np.zeros_like(changes), changes, trials, looked_at=17)
    assert same.units == 16 and same.p < 1e-4 and chance({"air_drag": same}, 17) == {}
    # Two trials that ask for other doses, or one alone, cannot tell; nothing is held against the effect.
    other = [replace(t, markers=k * t.markers) for k, t in zip((0.7, 1.3), trials, strict=True)]
    apart = agreement(np.zeros_like(changes), changes, other, looked_at=17)
    alone = agreement(np.zeros_like(changes[:1]), changes[:1], trials[:1], looked_at=17)
    assert (apart.units, alone.units) == (2, 1) and not apart.could_tell(17)
    assert chance({"a": apart, "b": alone}, 17) == {}
    # Blocks in which nothing changes say nothing.
    changes[:, 160:] = 0.0
    assert agreement(np.zeros_like(changes), changes, trials, looked_at=17).units == 8


def test_a_candidate_that_too_few_trials_test_is_still_spoken_of() -> None:
    few = Agreement(2.0**-7, "block", 7, np.ones(1), np.nan, 2.0**-7, 7)
    best = Candidate("air_drag", 0.5, 0.29, 0.93, "helps on too few trials", few)
    others = [Candidate(f"e{k}", 0.1, None, None, "its doses explain less") for k in range(16)]
    search = object.__new__(_Search)
    told = search._closest({"air_drag": fitted(BASELINE | {"air_drag.c_d": 1.8}, ("air_drag",))}, [best, *others])
    assert told is not None and told.against.endswith("; there are too few test trials to exclude chance")
    sure = replace(best, test=replace(few, p=2.0**-10, units=10, p_short=2.0**-10, short_units=10))
    told = search._closest({"air_drag": fitted(BASELINE | {"air_drag.c_d": 1.8}, ("air_drag",))}, [sure, *others])
    assert told is not None and told.against == "helps on too few trials"


def test_markers_that_are_held_or_not_seen_say_nothing(rope: Recording) -> None:
    less, more = shaken(rope.test, 0.8, np.random.default_rng(0))
    lost = [replace(t, markers=np.where(np.arange(15)[:, None] == 9, np.nan, t.markers)) for t in rope.test]
    found = agreement(less, more + 0.1 * rope.test[0].gripped[:, None], lost)
    np.testing.assert_allclose(found.doses, 0.8, rtol=0.02)


def test_a_range_that_holds_nothing_or_what_cannot_be_is_no_finding() -> None:
    def drag(value: float) -> str | None:
        return implausible(fitted(BASELINE | {"air_drag.c_d": value}, ("air_drag",)), "air_drag")

    # Trials differ by some tenths.
    assert drag(1.4) is None and drag(0.01) == "has a range that holds the value at which it does nothing"
    assert drag(20.0) == "has a c d at the edge of what can be"
    # What errors of steps may do widens it.
    drifts = np.array([[0.0, 0.0, 0.0, 5.0]])
    assert "does nothing" in implausible(fitted(BASELINE | {"air_drag.c_d": 1.4}, ("air_drag",)), "air_drag", drifts)
    # Off is infinity: its range is looked at as one over it.
    assert implausible(fitted(BASELINE | {"stretch.EA": 2.0}, ("stretch",)), "stretch") is None
    assert "does nothing" in implausible(fitted(BASELINE | {"stretch.EA": 1e6}, ("stretch",)), "stretch")
    # One trial tells no range.
    assert implausible(fitted(BASELINE | {"air_drag.c_d": 1e-4}, ("air_drag",), trials=1), "air_drag") is None


def test_ranges_end_where_numbers_do_and_hold_their_values() -> None:
    play = fitted(
        BASELINE | {"gripper_damping.stiffness": 10.0, "gripper_damping.loss_time": 0.01}, ("gripper_damping",)
    )
    far = replace(play.point, gradient=10 * play.point.gradient)
    low, high = interval(far, play.space, np.array([[0.0, 0.0, 0.0, 1.0, 1.0]]))
    stiffness, loss = (play.space.names.index(f"gripper_damping.{n}") for n in ("stiffness", "loss_time"))
    assert 0 < low[stiffness] < 1.0 and high[stiffness] == pytest.approx(1e18)
    assert low[loss] == 0.0 and 0.01 < high[loss] <= play.space.params[loss].high
    # Directions turn round.
    turn = fitted(BASELINE | {"anisotropic_bending.direction": 0.01}, ("anisotropic_bending",))
    low, high = interval(turn.point, turn.space, np.full((1, 4), 0.5))
    assert low[3] < 0.0 < 0.01 < high[3]


def test_a_number_whose_range_is_all_that_can_be_is_not_told(rope: Recording) -> None:
    numbers = BASELINE | {"internal_friction.moment": 0.1, "internal_friction.kappa_c": 1.0}
    friction = fitted(numbers, ("internal_friction",))
    friction = replace(friction, point=replace(friction.point, gradient=0.1 * friction.point.gradient))
    drifts = np.array([[0.0, 0.0, 0.0, 0.0, 5.0]])
    assert implausible(friction, "internal_friction", drifts) is None
    assert not_told(friction, "internal_friction", drifts) == ["internal_friction.kappa_c"]
    assert not_told(friction, "internal_friction", 0.1 * drifts) == []
    assert not_told(fitted(numbers, ("internal_friction",), trials=1), "internal_friction", drifts) == []
    found = fake_diagnosis(
        rope, effects=["internal_friction"], ties={"internal_friction": []}, shares={"internal_friction": 0.9}
    )
    found = replace(found, final=friction, drifts=drifts, model=SimpleNamespace(parameters=[*numbers]))
    assert "kappa_c not told)" in summary(found, rope) and "<td>not told</td>" in diagnosis_html(found, rope)
    kappa = findings(found, rope)["effects"][0]["parameters"]["kappa_c"]
    assert kappa["value"] is None and kappa["low"] < 0.2 and kappa["high"] > 20


def test_damping_as_small_as_that_of_steps_is_not_told_from_it() -> None:
    model = SimpleNamespace(
        parameters=[*BASELINE, "bending_damping.coefficient"], numerical_damping=0.05, dt=0.01, substeps=2
    )

    def damping(loss: float) -> str | None:
        fit = fitted(BASELINE | {"bending_damping.coefficient": loss * BASELINE["bending_stiffness"]})
        return unresolved(fit, "bending_damping", model)

    # Steps of 5 ms damp with a twentieth of that, 0.25 ms.
    assert damping(1.1e-3) is None and "(0.7 ms, they 0.25 ms)" in damping(0.7e-3)
    assert unresolved(fitted(BASELINE), "air_drag", model) is None


def test_there_is_a_limit_where_a_simulation_failed_or_no_floor_is_known() -> None:
    gaps = np.array([3e-3, np.inf, 5e-3])
    rest = float(np.sqrt(17e-6))
    assert limit_gap(gaps, 1e-3, 2e-3, 0.15) == pytest.approx(least_gap(rest, 1e-3, 2e-3, 0.15))
    assert limit_gap(gaps, 1e-3, np.inf, 0.15) == pytest.approx(least_gap(rest, 1e-3, 1e-3, 0.15))
    assert not np.isfinite(limit_gap(np.array([np.inf]), 1e-3, 2e-3, 0.15))


def test_detection_limits_grow_with_what_is_left(rope: Recording) -> None:
    # What closes 15 % of 4 mm above 1 mm of noise: sqrt(0.15 / 0.85 * 15) mm; but no less than the floor.
    assert least_gap(4e-3, 1e-3, 1e-3, 0.15) == pytest.approx(np.sqrt(0.15 / 0.85 * 15) * 1e-3)
    assert least_gap(1.1e-3, 1e-3, 1e-3, 0.15) == pytest.approx(1e-3)

    def score(name: str, *probes: tuple[dict[str, float], float]) -> Score:
        return Score(name, 0.0, {}, (), {}, np.zeros(0), tuple(probes))

    scores = [
        score("stretch", ({"stretch.EA": 100.0}, 1e-3)),
        score("point_mass", *(({"point_mass.mass": 2e-3, "point_mass.position": 0.1}, g) for g in (1e-3, 4e-3))),
        score("air_drag", ({"air_drag.c_d": 0.5}, 0.5e-3)),
        score("wind", ({"wind.velocity.0": 1.0, "wind.c_d": 1.2}, 0.5e-3)),
        score("anisotropic_bending", ({"anisotropic_bending.ratio": 1.2}, 1e-3)),
    ]
    limits = {x.name: (x.easiest, x.hardest) for x in detection_limits(scores, 2e-3, rope)}
    assert [*limits] == ["air_drag", "wind", "anisotropic_bending", "point_mass", "stretch"]
    assert limits["air_drag"] == pytest.approx((2.0, 2.0)) and limits["stretch"] == pytest.approx((50.0, 50.0))
    assert limits["point_mass"] == pytest.approx((1e-3, 4e-3))
    # What wind pushes grows with its square, what two stiffnesses do with the logarithm of their ratio.
    assert limits["wind"] == pytest.approx((2.0, 2.0)) and limits["anisotropic_bending"][0] == pytest.approx(1.44)
    assert detection_limits(scores, float("inf"), rope) == []


def test_what_would_have_to_be_larger_than_it_can_be_cannot_be_seen(rope: Recording) -> None:
    def score(name: str, *probes: tuple[dict[str, float], float]) -> Score:
        return Score(name, 0.0, {}, (), {}, np.zeros(0), tuple(probes))

    scores = [
        # A coefficient of 0.5 shows 2 um: it would have to be 500 to show 2 mm, and 20 is the most.
        score("air_drag", ({"air_drag.c_d": 0.5}, 2e-6)),
        # Beads of more than twice the rope's mass are none: near a clamp none is heavy enough.
        score("point_mass", *(({"point_mass.mass": 0.01 * rope.mass}, g) for g in (1e-3, 1e-9))),
        # Clamps softer than the softest; a dose that shows nothing at all; a ratio that overflows.
        score("gripper_compliance", ({"gripper_compliance.stiffness": 1.0}, 1e-6)),
        score("time_delay", ({"time_delay.delay": 2e-3}, 0.0)),
        score("anisotropic_bending", ({"anisotropic_bending.ratio": 1.2}, 1e-9)),
        score("tilted_gravity", ({"tilted_gravity.angles.0": 0.01}, 1e-3)),
    ]
    failed = score("wind", ({"wind.velocity.0": 3.0}, np.nan))
    limits = detection_limits([*scores, failed], 2e-3, rope)
    assert "wind" not in [x.name for x in limits]  # its dose was too much to simulate, which is no reason to hide
    by_name = {x.name: (x.easiest, x.hardest, x.greatest) for x in limits}
    assert by_name["air_drag"] == (None, None, 20.0) and by_name["time_delay"] == (None, None, 0.2)
    assert by_name["gripper_compliance"] == (None, None, 1e-3) and by_name["anisotropic_bending"] == (None, None, 20.0)
    assert by_name["point_mass"] == (pytest.approx(0.02 * rope.mass), None, pytest.approx(2 * rope.mass))
    assert by_name["tilted_gravity"] == (pytest.approx(0.02), pytest.approx(0.02), pytest.approx(0.2 * 2**0.5))
    found = fake_diagnosis(rope, limits=limits)
    said = limits_text(found)
    assert "tilted gravity (angles 0.02 rad)" in said and "kg at best, elsewhere it cannot be seen)" in said
    hidden = "air drag, anisotropic bending, gripper compliance, time delay."
    assert said.endswith(
        f"What cannot be seen in this recording, as it would have to be larger than it can be: {hidden}"
    )
    plain = {x["name"]: x for x in findings(found, rope)["detection_limits"]}
    assert plain["air_drag"]["easiest"] is None and plain["air_drag"]["note"] == "cannot be seen in this recording"
    assert plain["point_mass"]["note"] is None and plain["point_mass"]["hardest"] is None
    assert "<td>cannot be seen in this recording</td>" in diagnosis_html(found, rope)


def followed(trials: tuple[Trial, ...], off: dict[int, np.ndarray]) -> np.ndarray:
    """Simulations that are 0.5 mm off, and more in some trials (F,) [m]."""
    rng = np.random.default_rng(0)
    sims = np.stack([t.markers + 5e-4 * rng.normal(size=t.markers.shape) for t in trials])
    for k, error in off.items():
        sims[k] += error[:, None, None]
    return sims


@pytest.mark.parametrize(
    ("start", "rise", "when", "why"),
    [(0.0, 0.01, 0.0, "start"), (1.2, 0.05, 1.2, "snaps over"), (0.8, 4.0, 1.08, "drift apart")],
)
def test_a_trial_that_no_model_follows_is_told_and_why(
    rope: Recording, start: float, rise: float, when: float, why: str
) -> None:
    time = rope.train[0].time
    error = 20e-3 * np.clip((time - start + 0.01) / rise, 0, 1)
    sims = followed(rope.train, {1: error})
    errors = np.stack([errors_by_frame(s, rope.train, None) for s in (sims, sims + 1e-4)])
    (found,) = misleading_trials(errors, rope.train, 5e-4)
    assert found.name == "train_1" and why in found.why and found.time == pytest.approx(when, abs=0.08)
    assert misleading_trials(errors[:, :2], rope.train[:2], 5e-4) == []


def test_trials_that_some_model_follows_mislead_nobody(rope: Recording) -> None:
    off = np.full(len(rope.train[0].time), 10e-3)
    sims = [followed(rope.train, {1: off}), followed(rope.train, {})]
    errors = np.stack([errors_by_frame(s, rope.train, None) for s in sims])
    assert misleading_trials(errors, rope.train, 5e-4) == []
    all_off = np.stack([errors_by_frame(followed(rope.train, dict.fromkeys(range(3), off)), rope.train, None)])
    assert misleading_trials(all_off, rope.train, 5e-4) == []


def test_the_verdict_has_the_test_and_the_measure_of_the_literature(rope: Recording) -> None:
    less, more = shaken(rope.test, 0.8, np.random.default_rng(0))
    test = agreement(less, more, rope.test)
    found = fake_diagnosis(rope, tests={"air_drag": test})
    said = summary(found, rope)
    assert "with p 0.00098 (sign flips of 10 blocks), at a false discovery rate of 0.0078 with all 8 candidates" in said
    assert f"; an F test of the doses that trials ask for gives p {test.p_trials:.2g}." in said
    maes = {
        when: np.mean([mean_absolute_error(found.predictions[when][t.name], t) for t in rope.test])
        for when in ("before", "after")
    }
    assert mean_absolute_errors(found, rope) == pytest.approx(maes)
    assert f"per coordinate: {1e3 * maes['before']:.2f} → {1e3 * maes['after']:.2f} mm" in said
    plain = findings(found, rope)
    assert plain["gap"]["test_mae_after_m"] == pytest.approx(maes["after"])
    assert plain["effects"][0]["test"]["false_discovery_rate"] == pytest.approx(8 / 2**10)
    # Two blocks cannot exclude chance, which is said.
    few = fake_diagnosis(rope, tests={"air_drag": replace(test, p=0.25, units=2)})
    assert any("too few to exclude" in doubt for doubt in findings(few, rope)["confidence"]["doubts"])


def test_what_comes_closest_is_never_left_out_of_an_unknown(rope: Recording) -> None:
    test = agreement(*shaken(rope.test, 0.8, np.random.default_rng(0)), rope.test)
    best = BestCandidate("air_drag", {"c_d": 1.8}, 0.29, 0.93, "helps on too few trials", test)
    found = fake_diagnosis(
        rope, verdict="unknown", effects=[], ties={}, final=fitted(BASELINE), leading=best, drifts=np.zeros((2, 3))
    )
    said = summary(found, rope)
    assert "The best candidate is air drag (c_d 1.8), which closes 93% of the gap above noise on the test" in said
    assert "29% on the train trials; it is not named because it helps on too few trials" in said
    assert findings(found, rope)["best_candidate"]["heldout_gain"] == 0.93


def test_limits_are_said_in_one_sentence(rope: Recording) -> None:
    score = Score("point_mass", 0.0, {}, (), {}, np.zeros(0), (({"point_mass.mass": 2e-3}, 1e-3),))
    found = fake_diagnosis(rope, limits=detection_limits([score], 2e-3, rope))
    assert limits_text(found).endswith("by place or direction: point mass (mass 0.004 kg).")
    assert limits_text(fake_diagnosis(rope)) == ""


def test_an_effect_that_closes_next_to_nothing_tells_of_no_other() -> None:
    # Bending damping that closes 7 % says nothing of inner friction, one that closes a quarter does.
    assert not selection.tells_of_kin([0.049, 0.073]) and not selection.tells_of_kin([-1.0])
    assert selection.tells_of_kin([-0.3, 0.25])
    assert selection.tells_of_kin([0.0, np.nan]) and selection.tells_of_kin([np.nan, 0.0])  # simulations failed
    # What could be named itself always does.
    assert selection.tells_of_kin([selection.PAYS])


def test_where_nothing_can_matter_nothing_does() -> None:
    # Whatever a fit closes, a tenth of the squared noise stays at least nine tenths of it.
    rng = np.random.default_rng(0)
    for _ in range(2000):
        noise = 1e-3 * rng.uniform(0.1, 1.0)
        level, before = noise * rng.uniform(1.0, 3.0), noise * rng.uniform(0.5, 5.0)
        after = np.sqrt(0.9) * noise * rng.uniform(1.0, 1.5)
        if selection.nothing_can_matter(before, noise, level):
            assert not selection.matters(before, before, min(before, after), noise, level)
    # Just above, it may; where no floor is known, nothing is said.
    assert selection.matters(1.4e-3, 1.4e-3, 0.95e-3, 1e-3, 1e-3) and not selection.nothing_can_matter(
        1.4e-3, 1e-3, 1e-3
    )
    assert selection.nothing_can_matter(1.3e-3, 1e-3, 1e-3)
    assert not selection.nothing_can_matter(1.0, 1e-3, np.inf)


def test_trials_that_fail_without_an_effect_do_not_count_for_it() -> None:
    train = np.full(3, 8e-3), np.full(3, 4e-3)
    before, after = np.array([np.inf, 5e-3, 5e-3]), np.array([9e-3, 7e-3, 7e-3])
    assert selection.gain(before, after, 5e-4) == pytest.approx(-24 / 24.75)
    assert not selection.matters(*selection.compared([before], before, after), 5e-4, 8e-4)
    assert selection.refused(train, (before, after), 5e-4, True) == "does not help on the test trials"
    assert selection.refused(train, (before, 0.4 * after), 5e-4, True) is None
    # What fails with the effect alone speaks against it.
    assert selection.refused(train, (after, before), 5e-4, True) == "does not help on the test trials"
    nothing = np.full(2, np.inf), np.full(2, 1e-3)
    assert "cannot be compared" in str(selection.refused(train, nothing, 5e-4, True))
    assert not selection.matters(*selection.compared([nothing[0]], *nothing), 5e-4, 8e-4)


def test_an_effect_is_held_against_what_is_left_without_it_and_nothing_else() -> None:
    drag = fitted(BASELINE | {"air_drag.c_d": 1.4}, ("air_drag",))
    plain, beside = fitted(BASELINE), fitted(BASELINE | {"stretch.EA": 100.0}, ("stretch",))

    class Known:
        def known_without(self, *_: object) -> None:
            return None

        def without(self, *_: object) -> Fitted:
            return plain

    class Search(_Search):
        revision = Known()

    search = object.__new__(Search)
    # The stretch beside which it was found has been dropped.
    assert search._rival(drag, "air_drag", EliminationResult(rivals={"air_drag": beside})) is plain
    kept = fitted(BASELINE)
    assert search._rival(drag, "air_drag", EliminationResult(rivals={"air_drag": kept})) is kept
