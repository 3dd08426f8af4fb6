"""A diagnosis of films goes through all of its stages and says what it found; a short one, of half a second."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchdlo.report.pages import diagnosis as page
from torchdlo.sysid.diagnosis.budget import BUDGETS, Budget
from torchdlo.sysid.diagnosis.effect_library import library
from torchdlo.sysid.diagnosis.effect_search import diagnose
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.diagnosis.findings import findings_json, model_json, summary
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video import filmed_diagnosis, filmed_fit
from torchdlo.sysid.video.filmed_fit import Fit
from torchdlo.sysid.video.filmed_model import FilmedModel, extended
from torchdlo.sysid.video.filmed_problem import FilmedProblem, filmed_problem
from torchdlo.sysid.video.filming import film_recording
from torchdlo.sysid.video.fit_pool import FitPool
from torchdlo.sysid.video.footage import views_of
from torchdlo.vision.camera import looking_at
from torchdlo.vision.film import FilmLook

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"


@pytest.mark.slow
def test_a_diagnosis_of_films_says_what_it_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0)
    film_recording(load_recording(SAMPLE), [camera], tmp_path / "rope", FilmLook(noise=1.0), trials=1, seconds=0.5)
    recording = load_recording(tmp_path / "rope")
    monkeypatch.setattr(filmed_diagnosis, "FILMED_STARTS", 4)
    monkeypatch.setattr(filmed_diagnosis, "SILENT", 0.0)
    monkeypatch.setattr(filmed_diagnosis, "chained", lambda model, pool: model)
    monkeypatch.setitem(BUDGETS, "fast", Budget(4, 1, 1, 1, 1))
    others = [n for n in library() if n not in ("air_drag", "point_mass")]
    asked: dict[str, Any] = {"without": others, "journal": tmp_path / "journal"}
    found = diagnose(recording, workers=2, **asked)
    (candidates,) = found.candidates
    assert {c.name for c in candidates} == {"air_drag", "point_mass"} and all(c.reason for c in candidates)
    assert np.isfinite(found.before).all() and found.verdict in ("none", "effects", "partial", "unknown")
    content = json.loads(findings_json(found, recording))
    assert set(content["baseline"]) == {"bending_stiffness", "twisting_stiffness", "damping_rate"}
    assert len(content["cameras"]) == 8 and json.loads(model_json(found))["parameters"]
    assert summary(found, recording) in page.diagnosis_html(found, recording).replace("&#x27;", "'")
    # What was stopped at its end goes on from what it wrote down, and comes to the same.
    monkeypatch.setattr(filmed_fit, "_improved", lambda *_: pytest.fail("fitted again"))
    again = json.loads(findings_json(diagnose(recording, workers=1, resume=True, **asked), recording))
    assert again | {"seconds": 0} == content | {"seconds": 0}


def test_fits_leave_models_and_starts_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process models are shared between fits, in others each has its own: both have to come to the same."""
    none: Any = None
    own, test = (FilmedProblem(none, (), none, none, none, (), np.zeros(0), {}) for _ in range(2))

    def fitted(problem: FilmedProblem, raw: np.ndarray, iterations: int) -> Any:
        problem.offset = np.ones((1, iterations))
        return "better"

    monkeypatch.setattr(filmed_diagnosis, "fit", fitted)
    monkeypatch.setattr(filmed_diagnosis, "restart", lambda problem, found, *more: found)
    model = FilmedModel(own, SimpleNamespace(raw=np.zeros(1), costs=np.array([1e-3])), test)
    found = filmed_diagnosis._fitted_on(model, 3, 0.0)
    found.test.offset = np.ones((1, 2))
    assert found.fit == "better" and found.own.offset.shape == (1, 3)
    assert own.offset.size == test.offset.size == 0 and model.own is own and model.test is test
    alone = filmed_diagnosis._fitted_on(FilmedModel(own, model.fit, own), 3, None)
    assert alone.test is alone.own


def test_effects_that_do_not_pay_beside_later_ones_are_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def model(*effects: str) -> Any:
        return SimpleNamespace(effects=effects, fit=SimpleNamespace(cost=1e-4 * (9 - len(effects))))

    def less(base: Any, added: Any, sizes: Any, numbers: Any, raw: Any, dropped: Any) -> Any:
        return model(*(e for e in base.effects if e not in dropped))

    def refused(rival: Any, other: Any, *_: Any) -> str | None:
        (gone,) = set(other.effects) - set(rival.effects)
        return "closes 1% of the gap" if gone == "wind" or (gone, rival.effects) == ("drag", ("curvature",)) else None

    monkeypatch.setattr(filmed_diagnosis, "extended", less)
    monkeypatch.setattr(filmed_diagnosis, "_fitted_on", lambda model, *_: model)
    monkeypatch.setattr(filmed_diagnosis, "_begun_alike", lambda rival, _: rival)
    monkeypatch.setattr(filmed_diagnosis, "_refused", refused)
    for found, left in (
        (("wind", "curvature"), ("curvature",)),
        (("curvature", "wind"), ("curvature", "wind")),
        (("mass", "curvature"), ("mass", "curvature")),
        # What pays beside another one only goes with it.
        (("wind", "drag", "curvature"), ("curvature",)),
    ):
        floor = ErrorFloor(3e-4, 0.0, 0.0)
        base, spare = filmed_diagnosis._needed(
            model(*found), model(), list(found), floor, 3e-4, 3, lambda *_: None, FitPool(1)
        )
        assert base.effects == left and set(spare) == set(found) - set(left)


def test_a_model_without_an_effect_keeps_its_other_numbers() -> None:
    recording = load_recording(SAMPLE.with_name("sample_film"))
    views, _ = views_of(recording, recording.train[:1])
    own = filmed_problem(recording, recording.train[:1], views, options={"vertices": 13}).shortened(0.2)
    raw = own.space.to_raw(np.concatenate([2 * own.fixed[list(own.free)], np.full(8, 1e-3)]))
    plain = FilmedModel(own, Fit(raw, own.offset, np.zeros(1), np.zeros((1, 1, 1)), np.zeros((1, 0, 1, 1))), own)
    drag, mass = {"air_drag.c_d": 1.5}, {"point_mass.position": 0.3, "point_mass.mass": 2e-3}
    both = extended(extended(plain, ("air_drag",), drag, drag, None), ("point_mass",), mass, mass, None)
    less = extended(both, (), {}, {}, None, ("air_drag",))
    assert less.own.model.effects == ("point_mass",)
    values = dict(zip(both.own.space.names, both.values, strict=True))
    assert values.pop("air_drag.c_d") == pytest.approx(1.5)
    assert dict(zip(less.own.space.names, less.values, strict=True)) == pytest.approx(values)
    windy = filmed_diagnosis._dosed(less, SimpleNamespace(name="wind", sizes={}), {"wind.c_d": 1.2}, None)  # type: ignore[arg-type]
    calm = filmed_diagnosis._specialised(windy, "wind", "air_drag")
    assert calm.own.model.effects == ("point_mass", "air_drag")
    numbers = dict(zip(calm.own.space.names, calm.values, strict=True))
    assert numbers == pytest.approx(values | {"air_drag.c_d": 1.2})


def test_special_cases_of_laws_that_lead_are_fitted_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def model(cost: float, name: str = "") -> Any:
        return SimpleNamespace(fit=SimpleNamespace(cost=cost), name=name)

    monkeypatch.setattr(filmed_diagnosis, "_specialised", lambda fitted, general, special: model(2e-4, special))
    monkeypatch.setattr(filmed_diagnosis, "_fitted_on", lambda fitted, *_: fitted)
    # What did not lead has a fit to the first seconds only, whose cost says nothing.
    for leading, drag, kept in (
        (["wind", "point_mass"], 1e-5, 2e-4),
        (["wind", "air_drag"], 1e-4, 1e-4),
        (["wind", "air_drag"], 3e-4, 2e-4),
    ):
        fits = {"wind": model(1.9e-4), "point_mass": model(9e-4), "air_drag": model(drag)}
        led = filmed_diagnosis._with_special_cases(
            fits, leading, ["wind", "air_drag", "point_mass"], 3, 1e-3, FitPool(1)
        )
        assert fits["air_drag"].fit.cost == kept
        assert set(led) == {*leading, "air_drag"} and led == sorted(led, key=lambda n: fits[n].fit.cost)
    fits = {"wind": model(1.9e-4)}
    assert filmed_diagnosis._with_special_cases(fits, ["wind"], ["wind", "point_mass"], 3, 1e-3, FitPool(1)) == ["wind"]


def test_laws_that_say_as_much_of_unseen_films_are_not_told_apart() -> None:
    best = {"friction": (0.09e-3, 0.9, 0.34)}
    for damping, alike in (
        ((0.15e-3, 0.8, 0.40), ["friction", "damping"]),
        ((0.15e-3, 0.2, 0.40), ["friction"]),
        ((0.15e-3, 0.8, 0.20), ["friction"]),
        ((0.095e-3, 0.9, 0.20), ["friction", "damping"]),
    ):
        assert filmed_diagnosis._alike(best | {"damping": damping}, 0.01e-3) == alike


def test_each_train_trial_has_to_be_as_near_as_simulations_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that magnifies small errors does not hide what another one shows."""
    steady, shaky = ErrorFloor(0.3e-3, 0.0, 0.3e-3), ErrorFloor(0.3e-3, 0.0, 2e-3)
    monkeypatch.setattr(filmed_diagnosis, "_floors", lambda _: [steady, shaky])
    both, _ = filmed_diagnosis._floor(None)  # type: ignore[arg-type]
    assert both.noise == 0.3e-3 and abs(both.grid - np.sqrt((0.3e-3**2 + 2e-3**2) / 2)) < 1e-12
    for train, test, beside, nothing in (
        ((0.4e-3, 2e-3), 1e-3, False, True),
        ((1e-3, 1e-3), 1e-3, False, False),
        ((0.4e-3, 2e-3), 3e-3, False, False),
        ((1e-3, 1e-3), 1e-3, True, True),
    ):
        model: Any = SimpleNamespace(gaps={"train": np.array(train), "test": np.array([test])}.__getitem__)
        assert filmed_diagnosis._nothing_left(model, both, beside) is nothing


def test_a_rival_takes_the_starts_of_trials_that_it_fits_better_with(monkeypatch: pytest.MonkeyPatch) -> None:
    none: Any = None
    own, other = (FilmedProblem(none, (), none, none, none, (), np.zeros(0), {}) for _ in range(2))
    own.offset, other.offset = np.zeros((2, 6)), np.ones((2, 6))
    rival = FilmedModel(own, SimpleNamespace(raw=np.zeros(1), costs=np.array([1e-3, 1e-3])), own)
    effect = FilmedModel(other, none, other)
    monkeypatch.setattr(filmed_diagnosis, "fit", lambda problem, *_: "fitted on")
    for costs, taken in (([0.5e-3, 2e-3], [1, 0]), ([2e-3, 2e-3], None)):
        monkeypatch.setattr(filmed_diagnosis, "fit_starts", lambda *_, costs=costs: np.array(costs))
        found = filmed_diagnosis._begun_alike(rival, effect)
        if taken is None:
            assert found is rival
        else:
            assert found.fit == "fitted on" and found.own.offset[:, 0].tolist() == taken
    assert not own.offset.any() and other.offset.all()


def test_effects_are_fitted_from_fresh_starts_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Starts of a baseline make up for what it lacks: they are forgotten, and followed over longer and longer times."""
    none: Any = None
    own = FilmedProblem(none, (), none, none, none, (), np.zeros(0), {})
    model = FilmedModel(own, SimpleNamespace(raw=np.zeros(1), costs=np.array([2e-4])), own)
    assert filmed_diagnosis._afresh(model, 1.4) is model
    own.offset, asked = np.ones((2, 6)), []

    def fitted(problem: FilmedProblem, raw: np.ndarray, *_: Any, seconds: float, **__: Any) -> Any:
        asked.append((problem.offset.max(), float(raw[0]), seconds))
        problem.offset = problem.offset + 0.5
        return SimpleNamespace(raw=raw + 1)

    for name in ("correct", "add_correction"):
        monkeypatch.setattr(filmed_diagnosis, name, lambda *_: None)
    monkeypatch.setattr(filmed_diagnosis, "start_window", lambda _: 0.4)
    monkeypatch.setattr(filmed_diagnosis, "fit_starts", fitted)
    monkeypatch.setattr(filmed_diagnosis, "fit", fitted)
    monkeypatch.setattr(
        filmed_diagnosis, "look", lambda problem, raw, *_: SimpleNamespace(raw=raw, costs=np.array([1e-4]))
    )
    monkeypatch.setattr(FilmedProblem, "space", SimpleNamespace(to_values=lambda raw: raw))
    found = filmed_diagnosis._afresh(model, 1.4)
    assert [(offset, raw) for offset, raw, _ in asked] == [(0, 0), (0.5, 0), (1.0, 1), (1.5, 2)]
    np.testing.assert_allclose([seconds for *_, seconds in asked], [0.2, 0.4, 0.9, 1.4])
    worse = FilmedModel(own, SimpleNamespace(raw=np.zeros(1), costs=np.array([0.5e-4])), own)
    assert filmed_diagnosis._afresh(worse, 1.4) is worse
    assert found.fit.raw[0] == 3 and found.own.offset.max() == 2.0 and (own.offset == 1).all()
