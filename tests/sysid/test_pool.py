"""Fits that simulate together find what they find alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import recording as swaying
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation import worker_pool as pools
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model import initial_state as starts

OPTIONS = {"vertices": 17, "numerical_damping": 0.0, "clamp_fraction": 0.0}
BASE = ("bending_stiffness", "damping_rate")


def fits(pool: Pool) -> list[FitJob]:
    """A model without effects, two with one each, one of them from several starts, and one that needs frames."""
    jobs = []
    for effects, number, begun in (
        ((), None, (0.0,)),
        (("air_drag",), "air_drag.c_d", (0.5,)),
        (("point_mass",), "point_mass.mass", (1e-3, 2e-3, 4e-3)),
        (("rest_curvature",), "rest_curvature.curvature.0", (0.1,)),
    ):
        model = pool.local.model(effects)
        values = np.repeat(model.guess()[None], len(begun), 0)
        free, sizes = BASE, (1.0, 1.0)
        if number is not None:
            values[:, model.parameters.index(number)] = begun
            free, sizes = (*BASE, number), (1.0, 1.0, max(begun))
        jobs.append(FitJob(effects, values, free, sizes, 2, frames=40, keep=1 if len(begun) > 1 else None))
    return jobs


def test_fits_find_together_what_they_find_alone(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path, frames=40), OPTIONS, workers=1) as pool:
        jobs = fits(pool)
        together = dict(pool.fit(jobs))
        assert sorted(map(sorted, pool.groups(jobs))) == [[0, 1, 2], [3]]
        for k, job in enumerate(jobs):
            ((_, alone),) = pool.fit([job])
            assert alone.effects == together[k].effects == job.effects
            # An effect that is off adds nothing but the rounding of sums, which the fit's differences enlarge.
            np.testing.assert_allclose(together[k].values, alone.values, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(together[k].point.cost, alone.point.cost, rtol=1e-7)
        # A fit moves its numbers.
        assert np.abs(together[1].values / jobs[1].values[0] - 1).max() > 1e-2


def test_the_effects_of_fits_that_have_ended_are_simulated_no_more(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path, frames=40), OPTIONS, workers=1) as pool:
        plain, drag, mass, _ = fits(pool)
        search = pool.local.search([replace(plain, iterations=2), replace(drag, iterations=0), mass])
        asked, effects = next(search), []
        try:
            while True:
                effects.append(asked.effects)
                asked = search.send(pool.local.simulate(asked))
        except StopIteration as end:
            found = end.value
        # Drag needs one look, the mass one more to choose its start, and as many as it has iterations.
        assert effects[0] == ("air_drag", "point_mass") and effects[1] == ("point_mass",)
        assert [f.effects for f in found] == [(), ("air_drag",), ("point_mass",)]


def test_workers_share_the_scenes_of_a_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pools, "_FEW", 2)
    monkeypatch.setattr(pools, "_SMALL", 0)
    with Pool(swaying(tmp_path, frames=40), OPTIONS, workers=1) as pool:
        jobs = fits(pool)
        alone, plain = dict(pool.fit(jobs)), simulation(pool, jobs[2])
        ((_, whole),) = pool.simulate([plain])
        # Three sets of three trials, in parts that cut through a set.
        parts = [pool.local.simulate(plain, k, 4) for k in range(4)]
        assert [len(p) for p in parts] == [3, 2, 2, 2]
        np.testing.assert_allclose(np.concatenate(parts).reshape(whole.shape), whole, rtol=0, atol=1e-12)
    with Pool(swaying(tmp_path / "again", frames=40), OPTIONS, workers=2) as pool:
        # One alone, so that its scenes have to be shared; then all.
        shared = dict(pool.fit(jobs[2:3]))
        np.testing.assert_allclose(shared[0].values, alone[2].values, rtol=1e-6, atol=1e-9)
        shared = dict(pool.fit(jobs))
        assert sorted(map(sorted, pool.groups(jobs))) == [[0, 2], [1], [3]]
        for k, one in alone.items():
            np.testing.assert_allclose(shared[k].values, one.values, rtol=1e-6, atol=1e-9)
        monkeypatch.setattr(pools, "_MANY", 6)
        assert sorted(map(sorted, pool.groups(jobs))) == [[0], [1], [2], [3]]
        ((_, both),) = pool.simulate([plain])
        np.testing.assert_allclose(both, whole, rtol=0, atol=1e-12)


def simulation(pool: Pool, job: FitJob) -> SimulationJob:
    """The simulation of the starts of a fit, where another estimate says that trials begin."""
    model = pool.local.model(job.effects)
    start = starts.begin(model, pool.recording.train)
    discretisation_correction = (
        1e-3 * np.random.default_rng(0).normal(size=(len(start.pos), 40, 1, 3)) * np.ones((model.count, 1))
    )
    return SimulationJob(
        job.effects, job.values, "train", replace(start, discretisation_correction=discretisation_correction), frames=30
    )


def test_a_special_law_takes_over_the_numbers_of_a_general_one(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path, frames=10), OPTIONS, workers=1) as pool:
        model = pool.local.model(("wind", "point_mass"))
        bench = Workspace(pool, starts.begin(model, pool.recording.trials("all")))
        values = dict(zip(model.parameters, np.arange(10.0, 10.0 + len(model.parameters)), strict=True))
        names = ("bending_stiffness", "wind.velocity.1", "wind.c_d", "point_mass.mass")
        params = tuple(model.params[model.parameters.index(n)] for n in names)
        point = Point(np.zeros(4), 1.0, np.zeros((1, 4)), np.zeros((1, 4, 4)), np.ones(1))
        fitted = Fitted(
            model.effects, np.array(list(values.values())), ParameterSpace(names, params, (1.0, 2.0, 3.0, 4.0)), point
        )
        job = bench.exchange(fitted, "wind", "air_drag", 5)
        assert job.effects == ("air_drag", "point_mass") and job.iterations == 5
        assert job.free == ("bending_stiffness", "air_drag.c_d", "point_mass.mass") and job.sizes == (1.0, 3.0, 4.0)
        less = dict(zip(pool.local.model(job.effects).parameters, job.values[0], strict=True))
        assert less.pop("air_drag.c_d") == values["wind.c_d"] and less.items() <= values.items()


def test_a_special_law_may_call_its_numbers_otherwise(tmp_path: Path) -> None:
    # In a liquid the coefficient of drag belongs to its density: what takes its place begins as it is declared.
    rope = replace(swaying(tmp_path, frames=40), fluid_density=1000.0)
    with Pool(rope, OPTIONS, workers=1) as pool:
        bench = Workspace(pool)
        bench = bench.begin(pool.local.model(()).guess(), ())
        model = pool.local.model(("fluid_forces",))
        names = tuple(n for n in model.parameters if n != "twisting_stiffness")
        params = tuple(model.params[model.parameters.index(n)] for n in names)
        space = ParameterSpace(names, params, (1.0,) * len(names))
        fitted = Fitted(("fluid_forces",), model.guess(), space, None)  # type: ignore[arg-type]
        job = bench.exchange(fitted, "fluid_forces", "air_drag", 2)
        other = pool.local.model(job.effects)
        assert job.effects == ("air_drag",) and job.free == ("bending_stiffness", "damping_rate", "air_drag.c_d")
        assert dict(zip(other.parameters, job.values[0], strict=True))["air_drag.c_d"] == 1.2
        assert job.sizes[-1] == 1.2


def test_a_model_loses_an_effect_and_starts_from_several_baselines(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path, frames=10), OPTIONS, workers=1) as pool:
        model = pool.local.model(("air_drag", "point_mass"))
        start = starts.begin(model, pool.recording.trials("all"))
        bench = Workspace(pool, start, early=np.array([1.0, 2.0, 3.0]))
        values = np.arange(10.0, 10.0 + len(model.parameters))
        names = ("bending_stiffness", "air_drag.c_d", "point_mass.mass")
        params = tuple(model.params[model.parameters.index(n)] for n in names)
        point = Point(np.zeros(3), 1.0, np.zeros((1, 3)), np.zeros((1, 3, 3)), np.ones(1))
        joint = Fitted(model.effects, values, ParameterSpace(names, params, (1.0, 2.0, 3.0)), point)
        plain = Fitted((), np.array([4.0, 5.0, 6.0]), ParameterSpace((), ()), point)
        job = bench.reduction(joint, "air_drag", plain, 5)
        assert job.effects == ("point_mass",) and job.free == (names[0], names[2]) and job.sizes == (1.0, 3.0)
        kept = dict(zip(pool.local.model(job.effects).parameters, job.values.T, strict=True))
        np.testing.assert_array_equal(kept["damping_rate"], [values[2], 6.0, 3.0])
        at = model.parameters.index("point_mass.mass")
        np.testing.assert_array_equal(kept["point_mass.mass"], np.full(3, values[at]))
