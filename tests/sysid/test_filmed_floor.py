"""A fit that is far from its films says so: what finer simulations change of it is no floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis.error_floor import ErrorFloor
from torchdlo.sysid.diagnosis.verdict import UNKNOWN_FLOOR
from torchdlo.sysid.recordings.recording import load_recording
from torchdlo.sysid.video import filmed, filmed_beginnings
from torchdlo.sysid.video.filmed_beginnings import NEAR, alike, left_out
from torchdlo.sysid.video.filmed_diagnosis import _far, _rescaled, _verdict
from torchdlo.sysid.video.filmed_fit import Fit

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"


def test_a_blunt_floor_is_said() -> None:
    said = _far(6.6e-3, ErrorFloor(3e-4, 0.0, 6.6e-3))
    assert said.startswith("Finer simulations of the calibrated model differ from it by 6.6 mm, 22 times")
    assert _far(np.inf, ErrorFloor(3e-4, 0.0, np.inf)) == UNKNOWN_FLOOR


def test_nothing_is_explained_by_a_blunt_floor() -> None:
    noise = 3e-4
    assert _verdict([], 5e-3, 5e-3, ErrorFloor(noise, 0.0, 6.7e-3), 6.7e-3) == "unknown"
    assert _verdict([], 4e-4, 4e-4, ErrorFloor(noise, 0.0, 4e-4), 4e-4) == "none"
    assert _verdict(["air_drag"], 5e-3, 4e-3, ErrorFloor(noise, 0.0, 6.7e-3), 6.7e-3) == "partial"


def test_lost_trials_begin_anew_and_failed_ones_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial whose simulation fails gets another start, whatever is near; one that stays lost is handed on or said."""
    model = SimpleNamespace(mesh=SimpleNamespace(clamps=()), effects=())
    own = SimpleNamespace(
        model=model,
        options={},
        trials=(0,),
        lasts=1.0,
        offset=np.zeros((1, 0)),
        space=SimpleNamespace(to_values=lambda raw: raw),
        spines=SimpleNamespace(priors=slice(1, 1)),
    )
    none = np.zeros(0)
    lost, fair = (Fit(none, none, np.array([c]), np.full((1, 1, 1), 1e-3), none) for c in (np.inf, 1e-3))
    far = replace(fair, residual=np.full((1, 1, 1), 0.1))
    recording = load_recording(SAMPLE)
    for first, then, near, wanted in (
        (lost, fair, np.inf, "sharper"),
        (lost, fair, 5e-3, "sharper"),
        (lost, lost, 5e-3, lost),
        (fair, fair, 5e-3, "sharper"),
        (far, fair, 5e-3, far),
    ):
        monkeypatch.setattr(filmed, "fit", lambda *_, out=first, **__: out)
        monkeypatch.setattr(filmed, "restart", lambda *_, out=then: out)
        monkeypatch.setattr(filmed, "misleading_films", lambda _: [])
        monkeypatch.setattr(filmed, "sharper", lambda own, *_: replace(fair, raw=np.ones(1)))
        found = filmed._fitted(own, none, 1, lambda *_: None, near)
        assert found.raw.size == 1 if wanted == "sharper" else found is wanted
    filmed.require_simulated(recording, fair)
    with pytest.raises(InputError, match="from every start"):
        filmed.require_simulated(recording, lost)


def test_shares_add_up_to_what_is_explained_of_the_films_that_count() -> None:
    first, final = (SimpleNamespace(gaps=lambda _, gap=gap: np.array([gap])) for gap in (5e-3, 3e-3))
    noise = ErrorFloor(1e-3, 0.0, 0.0)
    shares: Any = _rescaled({"point_mass": 0.6, "air_drag": 0.2}, first, final, noise)
    assert abs(sum(shares.values()) - 16 / 24) < 1e-9 and abs(shares["point_mass"] - 3 * shares["air_drag"]) < 1e-9
    assert _rescaled({}, first, final, noise) == {}
    assert _rescaled({"air_drag": 0.5}, final, first, noise) == {"air_drag": 0.0}


def test_films_that_are_left_out_are_told_as_they_are() -> None:
    def said(seconds: float, gap: float) -> list[str]:
        model = SimpleNamespace(own=SimpleNamespace(lasts=seconds), gaps=lambda _: np.array([gap]))
        return left_out(model, SimpleNamespace(lasts=2.0))

    assert said(2.0, 2 * NEAR) == []
    assert "over longer times no model" in said(1.0, 0.5 * NEAR)[0]
    assert "even over these no model" in said(1.0, 2 * NEAR)[0]


def test_a_baseline_is_a_chain_where_the_model_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def model(effects: tuple[str, ...], cost: float) -> SimpleNamespace:
        rope = SimpleNamespace(effects=effects, parameters=("bending_stiffness", "link_chain.length"))
        own = SimpleNamespace(model=rope, full=lambda _: np.array([[1.0, -0.01]]))
        return SimpleNamespace(own=own, fit=SimpleNamespace(cost=cost, raw=None), values=np.zeros(2))

    plain, chain = model((), 2e-3), model(("air_drag", "link_chain"), 1e-3)
    lengths = []
    monkeypatch.setattr(filmed_beginnings, "linked", lambda first, length: lengths.append(length) or first)
    monkeypatch.setattr(filmed_beginnings, "replace", lambda first, fit: model(("link_chain",), fit.cost))
    for cost, better in ((1.5e-3, True), (3e-3, False)):
        monkeypatch.setattr(filmed_beginnings, "fit", lambda *_, cost=cost: SimpleNamespace(cost=cost, raw=None))
        found = alike(plain, chain)
        assert (found is not plain) is better
    assert lengths == [-0.01, -0.01]
    assert alike(plain, model(("air_drag",), 1e-3)) is plain
    assert alike(chain, chain) is chain
