"""A missing effect is named and added; what surrounds the search keeps its promises."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchdlo.errors import InputError
from torchdlo.physics.effects import EFFECTS
from torchdlo.report.pages import diagnosis as report
from torchdlo.sysid.diagnosis import clamp_models, effect_library, effect_search, error_floor
from torchdlo.sysid.diagnosis.backward_elimination import EliminationResult, Revision
from torchdlo.sysid.diagnosis.budget import BUDGETS
from torchdlo.sysid.diagnosis.candidate_fits import extension_jobs
from torchdlo.sysid.diagnosis.findings import findings, findings_json, model_json, summary
from torchdlo.sysid.diagnosis.score_test import Score
from torchdlo.sysid.diagnosis.significance import Agreement, chance
from torchdlo.sysid.diagnosis.verdict import verdict_word
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import Fitted
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point, interval
from torchdlo.sysid.model import equilibrium
from torchdlo.sysid.model.discretisation import make_mesh
from torchdlo.sysid.model.gripper_motion import drive
from torchdlo.sysid.model.initial_state import read_off
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, Trial

S = np.array([0.0, 0.02, 0.08, 0.16, 0.24, 0.32, 0.4, 0.48, 0.56, 0.6])
GRIPPED = np.arange(10) < 2


def hanging(name: str, rng: np.random.Generator, frames: int = 41) -> Trial:
    """A rope that hangs from a clamp, which begins to sway and to turn after a tenth of a second."""
    time = np.arange(frames) * 0.02
    w, size = rng.uniform(7, 12, 2), rng.uniform(0.05, 0.1, 2)
    begun = np.clip(time - 0.1, 0, None)
    sway = np.stack([size[0] * (1 - np.cos(w[0] * begun)), size[1] * (1 - np.cos(w[1] * begun)), 0 * time], -1)
    turn = Rotation.from_rotvec((np.pi / 3 + 0.25 * (1 - np.cos(w[1] * begun)))[:, None] * np.array([0.0, 1.0, 0.0]))
    axis = turn.apply([1.0, 0.0, 0.0])
    markers = np.empty((frames, len(S), 3))
    markers[:, GRIPPED] = sway[:, None] + S[GRIPPED][:, None] * axis[:, None]
    markers[:, ~GRIPPED] = markers[:, 1:2] - (S[~GRIPPED] - 0.02)[:, None] * np.array([0.0, 0.0, 1.0])
    quaternion = turn.as_quat(scalar_first=True)[:, None]
    return Trial(name, time, markers, S, GRIPPED, quaternion, np.array([0]), np.zeros(frames, bool))


def make_recording(path: Path, effects: dict[str, float], noise: float = 2e-4, grip: float = 0.0) -> Recording:
    """Three trials of a rope with an effect, on a finer mesh and with shorter steps than the search uses."""
    rng = np.random.default_rng(5)
    trials = tuple(hanging(n, rng) for n in ("train_0", "train_1", "test_0"))
    gravity = np.array([0, 0, -9.81])
    empty = Recording(path, 0.6, 0.005, 0.03, gravity, None, noise, None, None, False, "", trials[:2], trials[2:])
    names = sorted({key.split(".")[0] for key in effects})
    model = RopeModel(empty, vertices=61, effects=names, substep=2.5e-3, numerical_damping=0.0, clamp_fraction=grip)
    values = dict(zip(model.parameters, model.guess(), strict=True))
    values |= {"bending_stiffness": 2e-3, "twisting_stiffness": 1.5e-3, "damping_rate": 0.5} | effects
    start = Start(np.stack([t.markers[0] for t in trials]), np.zeros((3, len(S), 3)), np.ones(3, bool))
    # The correction of starts reads the markers: none is seen while the recording is made.
    motion = replace(model.motion(trials), markers=np.full((3, 41, len(S), 3), np.nan))
    sims = model.simulate(motion, start, np.array([[values[n] for n in model.parameters]]))[0]
    made = []
    for trial, sim in zip(trials, sims, strict=True):
        seen = sim + noise * rng.normal(size=sim.shape)
        seen[:, GRIPPED] = trial.markers[:, GRIPPED]
        made.append(replace(trial, markers=seen))
    return replace(empty, train=tuple(made[:2]), test=tuple(made[2:]))


@pytest.mark.parametrize("name", effect_library.library())
def test_the_library_knows_how_to_search_for_every_effect(name: str, tmp_path: Path) -> None:
    empty = make_empty(tmp_path)
    folded = empty.train[0].markers.copy()
    folded[:, -1] = folded[:, 3]
    still = (replace(empty.train[0], still=True, markers=folded),)
    in_air = effect_library.spec(name).requires == "air"
    recording = replace(empty, table_height=0.0, fluid_density=None if in_air else 1000.0, train=still)
    mesh = make_mesh(recording.train[0], recording.length, 31)
    numbers = {n.name: n for n in effect_library.numbers(name, recording)}
    doses = effect_library.perturbations(name, recording, mesh, 10.0, {"bending_stiffness": 2e-3})
    assert effect_library.applicable(name, recording, mesh) and numbers and doses
    for dose in doses:
        for key, value in dose.values.items():
            assert numbers[key].param.low <= value <= numbers[key].param.high
            assert key in numbers
    assert EFFECTS[name].params.keys() >= {key.split(".")[1] for key in numbers}


@pytest.mark.parametrize("name", ["air_drag", "wind"])
def test_air_does_nothing_in_a_liquid(name: str, tmp_path: Path) -> None:
    air = make_empty(tmp_path)
    mesh = make_mesh(air.train[0], air.length, 31)
    assert effect_library.applicable(name, air, mesh)
    assert effect_library.applicable(name, replace(air, fluid_density=1.2), mesh)
    assert not effect_library.applicable(name, replace(air, fluid_density=1000.0), mesh)


def make_empty(path: Path) -> Recording:
    """Trials without a simulated rope."""
    trials = tuple(hanging(n, np.random.default_rng(0)) for n in ("train_0", "test_0"))
    gravity = np.array([0, 0, -9.81])
    return Recording(path, 0.6, 0.005, 0.03, gravity, None, None, None, None, False, "", trials[:1], trials[1:])


def test_reciprocal_numbers_are_searched_from_infinity() -> None:
    param = EFFECTS["stretch"].params["EA"]
    space = ParameterSpace(("stretch.EA",), (param,), (1e-3,))
    raw = space.to_raw(np.array([[param.off], [500.0]]))
    assert raw[0, 0] == pytest.approx(0.0, abs=1e-12) and raw[1, 0] == pytest.approx(2.0)
    np.testing.assert_allclose(space.to_values(raw), [[param.off], [500.0]])


def test_measured_rotations_place_the_clamp(tmp_path: Path) -> None:
    # Markers 2 cm apart with 1 mm of noise would turn the clamp by 4 degrees.
    recording = make_empty(tmp_path)
    trial, mesh = recording.train[0], make_mesh(recording.train[0], 0.6, 31)
    shaken = trial.markers + 1e-3 * np.random.default_rng(1).normal(size=trial.markers.shape)
    for substeps in (1, 4):
        held, director = drive(mesh, replace(trial, markers=shaken), substeps)
        axis = (held[:, -1] - held[:, 0]) / np.linalg.norm(held[:, -1] - held[:, 0], axis=-1, keepdims=True)
        true = Rotation.from_quat(trial.gripper_quaternion[:, 0], scalar_first=True)
        np.testing.assert_allclose(axis[::substeps], true.apply([1.0, 0, 0]), atol=1e-9)
        np.testing.assert_allclose(director[::substeps, 0], true.apply([0, 1.0, 0]), atol=1e-9)
        assert len(held) == (len(trial.time) - 1) * substeps + 1


def test_a_clamp_holds_from_the_middle_of_its_markers(tmp_path: Path) -> None:
    # Where hinges are as far apart as the clamp's markers, the hinge at the clamp is one like any other.
    recording = make_empty(tmp_path)
    mesh = make_mesh(recording.train[0], 0.6, 31)
    shares = mesh.clamp_shares(0.0)
    assert mesh.clamp_hinges == (1,) and shares[1] == pytest.approx(1.0, abs=0.01)
    assert mesh.clamp_shares(1.0)[1] == pytest.approx(0.5, abs=0.01)
    fine = make_mesh(recording.train[0], 0.6, 61)
    # From the middle, 1 cm before the hinge, to 0.5 cm behind it: 1.5 cm in place of 1 cm.
    assert fine.clamp_shares(0.0)[fine.clamp_hinges[0]] == pytest.approx(3 / 2, rel=0.01)


def test_smooth_starts_are_explained_exactly(tmp_path: Path) -> None:
    recording = make_empty(tmp_path)
    mesh, free = make_mesh(recording.train[0], 0.6, 31), np.flatnonzero(~GRIPPED)
    shapes = equilibrium.smooth_shapes(mesh, free)
    at = shapes[mesh.marker_vertex][free]
    np.testing.assert_allclose(at.T @ at, np.eye(at.shape[1]), atol=1e-9)
    assert np.abs(shapes[list(mesh.held)]).max() == 0.0
    a, b = np.random.default_rng(0).normal(size=(2, 1, at.shape[1], 3))
    time = 0.01 * np.arange(11)
    gap = (at @ a)[:, None] + time[:, None, None] * (at @ b)[:, None]
    gap[:, 3, 2] = np.nan
    shift, drift = equilibrium.explain_gap(gap, at, 0.01, shapes)
    np.testing.assert_allclose(shift, shapes @ a, atol=1e-9)
    np.testing.assert_allclose(drift, shapes @ b, atol=1e-7)


def test_noise_is_read_off_fourth_differences(tmp_path: Path) -> None:
    recording = make_empty(tmp_path)
    rng = np.random.default_rng(0)
    long = hanging("train_0", rng, frames=801)
    noisy = replace(long, markers=long.markers + 3e-4 * rng.normal(size=long.markers.shape))
    # Of 8 x 3 x 800 differences the median deviation is known to 1 %; what is smooth adds 0.02^4 of its fourth
    # gradient.
    assert error_floor.marker_noise(replace(recording, train=(noisy,))) == pytest.approx(3e-4, rel=0.05)


def test_an_unknown_budget_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="budget is 'huge'; expected one of fast, full"):
        effect_search.diagnose(make_empty(tmp_path), budget="huge")


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "named"), [({"air_drag.c_d": 6.0}, ["air_drag"]), ({}, [])])
def test_a_hidden_effect_is_named_and_none_where_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, effects: dict[str, float], named: list[str]
) -> None:
    # Two names keep it short; the mesh and the steps are not those of the recording.
    monkeypatch.setattr(effect_library, "library", lambda: ("air_drag", "point_mass"))
    monkeypatch.setattr(effect_search, "BUDGETS", {"fast": effect_search.Budget(3, 2, 3, 3, 1)})
    recording = make_recording(tmp_path, effects)
    stages = []
    result = effect_search.diagnose(recording, vertices=31, workers=1, callback=lambda *step: stages.append(step))
    assert result.effects == named and result.verdict == ("effects" if named else "none")
    found = findings(result, recording)
    assert set(found["gap"]) >= {"test_rmse_before_m", "test_rmse_after_m", "noise_floor_m", "per_trial"}
    if named:
        assert found["effects"][0]["parameters"]["c_d"]["value"] == pytest.approx(6.0, rel=0.2)
        # Most of what is above the noise of 0.2 mm is closed; the rest is the grid, which is not the recording's.
        before, after = (found["gap"][f"test_rmse_{when}_m"] ** 2 - 2e-4**2 for when in ("before", "after"))
        assert after < 0.3 * before
    assert json.loads(findings_json(result, recording))["verdict"] == result.verdict
    assert set(json.loads(model_json(result))["effects"]) >= set(named)
    page = report.diagnosis_html(result, recording)
    # With nothing to show before and after, one map is enough.
    assert (
        page.count("data:image/png") == (2 if named else 1)
        and "point mass" in page
        and summary(result, recording)[:7] in page
    )
    assert {stage[0] for stage in stages} >= {"calibrating the baseline", "measuring the floor"}


@pytest.mark.slow
def test_a_clamp_that_turns_is_told_from_one_in_which_the_rope_bends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As soft as 5 mm of rope: half way between a clamp that is stiff up to its last marker and one that is not.
    monkeypatch.setattr(effect_search, "BUDGETS", {"fast": effect_search.Budget(3, 1, 3, 3, 1)})
    recording = make_recording(tmp_path, {"gripper_compliance.stiffness": 0.4}, grip=1.0)
    looked = {"gripper_compliance", "nonuniform_stiffness"}
    without = [name for name in effect_library.library() if name not in looked]
    result = effect_search.diagnose(recording, vertices=31, workers=1, without=without)
    assert result.effects == ["gripper_compliance"]
    said = findings(result, recording)
    assert said["effects"][0]["parameters"]["stiffness"]["value"] == pytest.approx(0.4, rel=0.2)
    assert {c["name"] for c in said["candidates"]} == looked and "air_drag" in said["options"]["without"]


def test_an_effect_that_is_not_there_cannot_be_left_out(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="without: windy is no effect that can be looked for; did you mean wind"):
        effect_search.diagnose(make_empty(tmp_path), without=["windy"])


def test_what_a_clamp_may_be_in_which_the_rope_bends_moves_alike(tmp_path: Path) -> None:
    recording = make_recording(tmp_path, {})
    said, sims = [], []
    for grip, effects in ((0.0, ()), (1.0, ("gripper_compliance",))):
        model = RopeModel(recording, vertices=31, effects=effects, clamp_fraction=grip)
        numbers = dict(zip(model.parameters, model.guess(), strict=True)) | {"bending_stiffness": 2e-3}
        # 1 cm of rope from the middle of the clamp to its end: 2e-3 / 0.01 N m/rad. The grippers do not twist the rope.
        numbers |= {"gripper_compliance.stiffness": 0.2} if effects else {}
        values = np.array([numbers[name] for name in model.parameters])
        said.append(clamp_models.clamp_notes(model, SimpleNamespace(effects=effects, values=values)))
        motion = model.motion(recording.train)
        sims.append(model.simulate(motion, read_off(recording.train), values[None])[0])
    assert ["0.2 N m/rad (gripper compliance)" in note for note in said[0]] == [True] and not said[1]
    np.testing.assert_allclose(sims[0], sims[1], atol=1e-6)
    assert not clamp_models.clamp_notes(
        RopeModel(recording, vertices=31, clamp_fraction=1.0), SimpleNamespace(effects=(), values=values)
    )


@pytest.mark.parametrize(
    ("name", "dose", "fitted"),
    [
        ("wind", {"c_d": 1.0, "velocity.1": 0.5}, {"c_d", "velocity.0", "velocity.1", "velocity.2"}),
        ("nonuniform_stiffness", {"slope": 0.1}, {"slope"}),
        ("point_mass", {"mass": 0.01, "position": 0.3}, {"mass", "position"}),
    ],
)
def test_vectors_are_fitted_whole_and_what_no_dose_uses_is_not(
    name: str, dose: dict[str, float], fitted: set[str], tmp_path: Path
) -> None:
    bench = SimpleNamespace(recording=make_empty(tmp_path), extension=lambda base, score, numbers, *_: numbers)
    doses = {f"{name}.{k}": v for k, v in dose.items()}
    score = Score(name, 0.5, doses, ((doses, np.zeros(0)),), {}, np.zeros(0))
    (numbers,) = extension_jobs(bench, None, score, 4, None)
    assert set(numbers) == {f"{name}.{k}" for k in fitted}


def test_a_slope_and_a_spot_are_fitted_side_by_side(tmp_path: Path) -> None:
    def extension(base: object, score: Score, numbers: list[str], *_: object) -> tuple[list[str], int]:
        return [n.split(".")[1] for n in numbers], len(score.starts)

    bench = SimpleNamespace(recording=make_empty(tmp_path), extension=extension)
    gradient, spot = {"nonuniform_stiffness.slope": 0.1}, {"nonuniform_stiffness.factor": -1.0}
    spot |= {"nonuniform_stiffness.position": 0.4, "nonuniform_stiffness.width": 0.1}
    score = Score(
        "nonuniform_stiffness", 0.5, gradient, tuple((d, np.zeros(0)) for d in (gradient, spot, gradient)), {}, None
    )
    jobs = extension_jobs(bench, None, score, 4, None)
    assert jobs == [(["slope"], 2), (["position", "width", "factor"], 1)]


def twentieth(worse: float, best: float) -> float:
    """A tie that is a twentieth of what is explained."""
    return 0.05 * (worse - best)


def test_fits_tie_by_what_they_save_and_by_what_they_leave() -> None:
    bench = SimpleNamespace(level=0.5e-3)
    # A twentieth of what is saved; noise of 0.5 mm costs sqrt(0.5^2 + 2^2) - 2 = 0.06 mm, and half of that is less.
    assert Workspace.tie(bench, 1.2e-3, 0.9e-3) == pytest.approx(0.05 * 0.3e-3)
    assert Workspace.tie(bench, 10e-3, 0.0) == pytest.approx(0.5 * (np.hypot(0.5, 2) - 2) * 1e-3)
    assert Workspace.tie(bench, 10e-3, 0.6e-3) == pytest.approx(0.3e-3)
    bench.level = float("inf")
    assert Workspace.tie(bench, 10e-3, 0.0) == pytest.approx(0.5e-3)


def test_an_effect_is_left_out_once_only_from_the_same_model() -> None:
    asked = []

    def fit(jobs: list[str]) -> list[str]:
        asked.extend(jobs)
        return [SimpleNamespace(point=SimpleNamespace(cost=1e-3), of=job) for job in jobs]

    bench = SimpleNamespace(start=object(), discounted={}, fit=fit, reduction=lambda fitted, name, *_: (fitted, name))
    revision = Revision(bench, BUDGETS["fast"], ["plain"], lambda *_: None)
    fitted = SimpleNamespace(effects=("wind", "stretch"), options=(), values=np.ones(3))
    again = SimpleNamespace(effects=("wind", "stretch"), options=(), values=np.ones(3))
    assert revision.without(fitted, "wind") is revision.without(again, "wind") and len(asked) == 1
    assert revision.without(fitted, "stretch").of == (fitted, "stretch")
    bench.start = object()
    revision.without(fitted, "wind")
    assert len(asked) == 3
    bench.discounted = {"train_1": 20}
    revision.without(fitted, "wind")
    assert len(asked) == 4


SURE = Agreement(1e-4, "block", 16, np.ones(2), 0.01, 1e-4, 16)
"""A test that leaves no doubt."""


@pytest.mark.parametrize(
    ("loss", "better", "named"), [(0.5e-3, 0.0, None), (0.5e-3, 0.3e-3, "other"), (9e-3, 0.0, "bd")]
)
def test_what_steps_may_do_is_no_finding_nor_what_explains_no_more(
    loss: float, better: float, named: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["bending_stiffness", "bending_damping.coefficient"]
    model = SimpleNamespace(parameters=names, numerical_damping=0.05, dt=0.01, substeps=2)
    costs = {"internal_friction": 1.0e-3 - better, "bending_damping": 0.98e-3}
    fits = {
        name: SimpleNamespace(
            point=SimpleNamespace(cost=cost), values=np.array([2e-3, 2e-3 * loss]), effects=(name,), options=()
        )
        for name, cost in costs.items()
    }
    judge = object.__new__(effect_search._Search)
    local = SimpleNamespace(model=lambda *_: model)
    judge.bench = SimpleNamespace(tie=twentieth, pool=SimpleNamespace(local=local))
    judge._gain = lambda *_: 0.6
    order = sorted(fits, key=lambda name: costs[name])
    rival = SimpleNamespace(point=SimpleNamespace(cost=2e-3))
    said = judge._below_steps(fits, order, dict.fromkeys(order), rival)
    left = [name for name in order if name not in said]
    assert left == {None: [], "other": ["internal_friction"], "bd": order}[named]
    if named != "bd":
        assert "no larger than the damping of the steps" in said["bending_damping"]


@pytest.mark.parametrize(("p", "units", "refused"), [(1e-4, 16, False), (0.02, 16, True), (0.25, 2, False)])
def test_what_may_be_chance_is_refused_where_that_can_be_told(p: float, units: int, refused: bool) -> None:
    tests = {"air_drag": replace(SURE, p=p, units=units)}
    assert bool(chance(tests, 16)) == refused


@pytest.mark.parametrize(("speed", "first"), [(0.02, "air_drag"), (0.4, "wind")])
def test_a_general_law_is_named_only_where_its_other_numbers_tell(
    speed: float, first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = {name: effect_library.numbers(name, make_empty(tmp_path)) for name in ("wind", "air_drag")}
    values = {"wind": [speed, -speed, 0.0, 1.6], "air_drag": [1.7]}
    gradients = 0.1 * np.random.default_rng(0).normal(size=(4, 4))

    def fitted(name: str, cost: float) -> Fitted:
        params = tuple(n.param for n in numbers[name])
        space = ParameterSpace(tuple(n.name for n in numbers[name]), params, (1.0,) * len(params))
        k, raw = len(params), space.to_raw(np.array(values[name]))
        # By how much trials would have numbers differ: some hundredths.
        return Fitted(
            (name,), raw, space, Point(raw, cost, gradients[:, :k], np.tile(np.eye(k), (4, 1, 1)), np.ones(4))
        )

    fits = {"wind": fitted("wind", 0.8e-3), "air_drag": fitted("air_drag", 1e-3)}
    low, high = interval(fits["wind"].point, fits["wind"].space)
    assert (low[0] < 0) == (first == "air_drag") and high[0] < 1.0
    judge = object.__new__(effect_search._Search)
    judge.bench = SimpleNamespace(tie=twentieth)
    asked = {"_refused": None, "_gain": 0.5, "_agreement": SURE, "_below_steps": {}, "_closest": None}
    for name, value in asked.items():
        monkeypatch.setattr(judge, name, lambda *_, value=value: value, raising=False)
    # Wind fits better than drag, by more than a tie.
    best, _, _, also = judge._judged([], fits, ["wind", "air_drag"], fitted("air_drag", 2e-3))
    assert best is fits[first] and also == (["wind"] if first == "air_drag" else [])


def test_an_effect_matters_beside_a_baseline_that_went_astray() -> None:
    # On one trial the baseline was off by half a metre; fitted further it was not. The effect closes most of the rest.
    gaps = {"baseline": [5e-3, 0.5], "rival": [5e-3, 30e-3], "more": [5e-3, 10e-3], "less": [5e-3, 29.9e-3]}
    gaps["third"] = [2e-3, 2e-3]
    bench = SimpleNamespace(gaps=lambda f, split: np.array(gaps[f]), level=1e-3, floor=SimpleNamespace(noise=1e-3))
    revision = Revision(bench, BUDGETS["fast"], ["baseline", "rival"], lambda *_: None)
    assert revision.matters("rival", "more", "test")
    assert not revision.matters("rival", "less", "test")
    # Beside a gap of 20 mm, 2 mm are little, but not if hardly anything is left without them; what the floor hides is.
    gaps |= {"baseline": [20e-3, 20e-3], "rival": [19e-3, 19e-3], "one": [3e-3, 2e-3], "two": [1.2e-3, 1e-3]}
    assert revision.matters("one", "two", "test") and not revision.matters("one", "third", "test")
    gaps |= {"one": [1.3e-3, 1.3e-3], "two": [1e-3, 1e-3]}
    assert not revision.matters("one", "two", "test")


def test_nothing_counts_as_explained_where_the_floor_is_not_known() -> None:
    assert verdict_word([], 2e-3, 1e-3) == "none" and verdict_word([], 4e-3, 1e-3) == "unknown"
    assert verdict_word([], 0.2, float("inf")) == "unknown"
    assert verdict_word(["stretch"], 1e-3, float("inf")) == "partial"


def test_effects_that_leave_the_gap_as_it_was_do_not_explain_it() -> None:
    assert [verdict_word(["wind"], 2e-3, 1e-3, share) for share in (0.3, 0.9, 1.1)] == ["effects", "partial", "partial"]
    assert verdict_word([], 2e-3, 1e-3, 1.0) == "none"


@pytest.mark.parametrize(("cost", "named"), [(0.7e-3, "air_drag"), (1.5e-3, "wind")])
def test_a_special_law_takes_the_place_of_a_general_one_that_fits_no_better(cost: float, named: str) -> None:
    def model(left: float, *effects: str) -> SimpleNamespace:
        return SimpleNamespace(point=SimpleNamespace(cost=left), effects=effects)

    plain = model(cost, "air_drag", "time_delay")
    bench = SimpleNamespace(exchange=lambda *job: job[1:3], fit=lambda jobs: [plain] * len(jobs), tie=twentieth)
    revision = Revision(bench, BUDGETS["fast"], [model(9e-3), model(6e-3)], lambda *_: None)
    found = EliminationResult({"wind": 0.5, "time_delay": 0.4}, {"wind": ["tilted_gravity"], "time_delay": []})
    wind = model(0.5e-3, "wind", "time_delay")
    assert revision.plainer(wind, found, ["wind", "time_delay"]) is wind, "air drag is not to be looked for"
    fitted = revision.plainer(wind, found, ["wind", "time_delay", "air_drag"])
    assert list(found.shares) == [named, "time_delay"] == list(found.ties) == list(fitted.effects)
    assert found.ties[named] == ["tilted_gravity", "wind"][: 1 + (named == "air_drag")]


@pytest.mark.parametrize(("cost", "named"), [(1e-3, "tilted_gravity"), (2.15e-3, "tilted_gravity"), (2.6e-3, "wind")])
def test_an_effect_gives_way_to_another_that_fits_better_beside_the_rest(cost: float, named: str, monkeypatch) -> None:
    def model(left: float, names: int, *effects: str) -> SimpleNamespace:
        space = SimpleNamespace(names=tuple(range(names)))
        return SimpleNamespace(point=SimpleNamespace(cost=left), effects=effects, space=space, options=())

    tried = []

    def instead(_: Revision, fitted: SimpleNamespace, old: str, names: list[str]) -> SimpleNamespace:
        tried.append((old, names))
        rest = [n for n in fitted.effects if n != old]
        return model(cost if old == "wind" else 9e-3, 3, *rest, "tilted_gravity" if old == "wind" else "air_drag")

    monkeypatch.setattr(Revision, "_instead", instead)
    bench = SimpleNamespace(gaps=lambda f, _: np.array([5e-3]), level=1e-3, diverged=lambda *_: False, tie=twentieth)
    bench.with_options = lambda _: bench
    revision = Revision(bench, BUDGETS["fast"], [model(9e-3, 3), model(6e-3, 3)], lambda *_: None)
    found = EliminationResult({"wind": 0.5, "point_mass": 0.3}, {"wind": ["rest_curvature"], "point_mass": []})
    # Of 4 mm that are explained, 0.2 mm are a tie: fewer numbers win that.
    fitted = revision.exchanged(model(2e-3, 5, "wind", "point_mass"), found, ["wind", "tilted_gravity", "air_drag"])
    assert set(fitted.effects) == {named, "point_mass"} and [*found.shares] == [named, "point_mass"]
    assert found.ties[named] == (
        ["rest_curvature", "wind"] if cost == 2.15e-3 else ["rest_curvature"][: named == "wind"]
    )
    # What was exchanged is not looked at again; what stands beside it is.
    assert [old for old, _ in tried] == (["wind"] if named == "wind" else ["wind", "point_mass"])
    assert "wind" not in tried[0][1]
    bench.gaps = lambda *_: np.array([1e-3])
    assert revision.exchanged(fitted, found, ["air_drag"]) is fitted and len(tried) == 1 + (named != "wind")
