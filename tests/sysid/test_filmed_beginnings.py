"""Where something large is missing, only the beginnings of films lead back to it; chains are corrected as chains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdlo.sysid.diagnosis.workspace import CHAIN
from torchdlo.sysid.estimation.observation import FilmView, Spines
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.recordings.recording import Recording, Trial, load_recording
from torchdlo.sysid.video import filmed_beginnings
from torchdlo.sysid.video.filmed_beginnings import NEAR, _followed, _links_tell, chained, nearer
from torchdlo.sysid.video.filmed_fit import film_gaps, fit
from torchdlo.sysid.video.filmed_model import FilmedModel, Films
from torchdlo.sysid.video.filmed_problem import FilmedProblem, add_correction, filmed_problem, start_of
from torchdlo.sysid.video.filmed_scores import film_scores
from torchdlo.sysid.video.films import with_stations
from torchdlo.sysid.video.fit_pool import FitPool
from torchdlo.vision.camera import lens, looking_at, project

SAMPLE = Path(__file__).parents[2] / "torchdlo" / "data" / "sample_rope"
OPTIONS = {"vertices": 41, "numerical_damping": 0.05}
MASS = {"point_mass.position": 0.25, "point_mass.mass": 0.012}


def gripped(seconds: float, trials: int) -> Recording:
    """Return the embedded recording with its grippers alone, and places between them where the rope may be seen."""
    recording = load_recording(SAMPLE)
    frames = round(seconds * 100) + 1

    def cut(trial: Trial) -> Trial:
        held = trial.gripped
        index = np.cumsum(held) - 1
        more = None if trial.gripper_marker is None else index[trial.gripper_marker]
        quaternion = None if trial.gripper_quaternion is None else trial.gripper_quaternion[:frames]
        alone = replace(
            trial,
            time=trial.time[:frames],
            markers=trial.markers[:frames, held],
            marker_arclength=trial.marker_arclength[held],
            gripped=np.ones(held.sum(), bool),
            gripper_quaternion=quaternion,
            gripper_marker=more,
            suspect=trial.suspect[:frames],
        )
        return with_stations(alone, recording.length)

    train = tuple(cut(t) for t in recording.train[:trials])
    return replace(recording, train=train, test=train[:1])


def filmed(recording: Recording, effects: dict[str, float]) -> FilmedProblem:
    """Return the problem of films of a rope with effects: its places, as a camera sees them without any error."""
    model = RopeModel(recording, effects=tuple({n.split(".")[0] for n in effects}), **OPTIONS)
    truth = dict(zip(model.parameters, model.guess(), strict=True)) | effects
    start = replace(start_of(model, recording.train, ()), still=np.ones(len(recording.train), bool))
    numbers = np.array([[truth[n] for n in model.parameters]])
    sims = model.simulate(model.motion(recording.train), replace(start, vel=0 * start.vel), numbers)[0]
    camera = replace(looking_at("a", [0.15, -1.35, 1.0], [0.0, 0.0, 0.88], focal=650.0), fps=50.0)
    every = sims[:, ::2]
    pixel, _ = project(lens([camera]), torch.as_tensor(every.reshape(1, -1, 3)))
    places = pixel.numpy().reshape(*every.shape[:3], 2)
    tangents = np.gradient(places, axis=2)
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    view = FilmView(camera, np.ones(places.shape[:2], bool), places, tangents, 3.0)
    return filmed_problem(recording, recording.train, [view], options=OPTIONS)


def test_a_shortened_problem_reads_what_the_whole_one_does() -> None:
    whole = filmed(gripped(0.4, 1), {})
    short = whole.shortened(0.2)
    assert whole.shortened(whole.lasts) is whole
    assert abs(short.lasts - 0.2) < 1e-9 and len(short.trials[0].time) == 21
    values = np.concatenate([1.2 * whole.fixed, np.zeros(8)])[None]
    full, cut = (p.spines.read(p.simulate(values), values[:, -8:])[0, 0, :, :, 0] for p in (whole, short))
    data, target = slice(0, short.spines.priors.start), short.spines.target[0, :, :, 0]
    seen = np.isfinite(target[:, data])
    assert seen.any() and len(cut) == 11 and np.abs(cut[:, data][seen]).max() > 1e-4
    # The last of them is read by a spline that looks ahead.
    assert np.allclose(full[:10, data][seen[:10]], cut[:10, data][seen[:10]], atol=1e-6)
    again = short.over(whole, whole.lasts)
    assert len(again.trials[0].time) == 41 and again.spines.target.shape == whole.spines.target.shape


def test_a_chain_is_not_corrected_for_its_mesh() -> None:
    own = filmed(gripped(0.1, 1), {})
    link = float(np.mean(np.diff(own.model.arclength)))
    chain = own.with_effects((CHAIN,), {}, [f"{CHAIN}.length"])
    chain.fixed[chain.model.parameters.index(f"{CHAIN}.length")] = -link
    for problem, wrong in ((own, 1.0), (chain, 0.0)):
        values = np.concatenate([problem.fixed[list(problem.free)], np.zeros(8)])
        add_correction(problem, values)
        found = problem.discretisation_correction
        assert found is not None and abs(found.wrong - wrong) < 1e-6 and np.abs(found.grid).max() > 0


def test_links_are_fitted_where_they_may_explain_something(monkeypatch: pytest.MonkeyPatch) -> None:
    """To first order a chain of twice as long links tells of them; a rope with a mass on it does not."""
    monkeypatch.setattr(filmed_beginnings, "_as_chain", lambda *_: pytest.fail("fitted"))
    recording, told = gripped(0.6, 1), []
    link = float(np.diff(RopeModel(recording, **OPTIONS).arclength).min())
    for effects in ({f"{CHAIN}.length": 2 * link}, MASS):
        own = filmed(recording, effects)
        best = fit(own, own.space.to_raw(np.concatenate([own.fixed, np.zeros(8)])), 4)
        told.append(any(_links_tell(FilmedModel(own, best, own), length) for length in (link, -link)))
    assert told == [True, False]
    plain = FilmedModel(own, best, own)
    assert chained(plain, FitPool(1)) is plain


def test_a_wrong_picture_does_not_end_what_is_followed() -> None:
    whole = filmed(gripped(0.5, 1), {})
    whole.spines.views[0].places[0, 14] += 90.0
    spines = whole.spines
    whole.spines = Spines(spines.views, whole.model.dt, whole.extent, spines.free)
    raw = whole.space.to_raw(np.concatenate([whole.fixed, np.zeros(8)]))
    assert film_gaps(whole, fit(replace(whole), raw, 2)).max() > NEAR
    assert film_gaps(whole, _followed(whole, raw)).max() < 0.2 * NEAR
    assert whole.dropped == {f"{whole.trials[0].name}, camera a": [14]}


@pytest.mark.slow
def test_beginnings_lead_to_a_mass_that_is_missing() -> None:
    whole = filmed(gripped(1.6, 2), MASS)
    first = np.concatenate([whole.fixed, np.zeros(8)])
    best = fit(whole, whole.space.to_raw(first), 8)
    assert film_gaps(whole, best).max() > NEAR
    films = Films(whole, whole.trials, list(whole.spines.views))
    base = nearer(films, best, lambda *_: None)
    assert base.own.lasts < whole.lasts
    names = ["point_mass", "nonuniform_stiffness", "rest_curvature", "air_drag", "gripper_compliance"]
    leads = [s.name for s in film_scores(base, names, base.own.lasts, lambda *_: None, FitPool(1))]
    # Those that lead are fitted next. A soft spot does nearly as well; which of them is first differs by machine.
    assert "point_mass" in leads[:2]
