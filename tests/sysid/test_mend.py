"""Trials in which a simulated rope was torn apart are simulated once more in finer steps, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.sysid.swaying import recording as swaying
from torchdlo.sysid.diagnosis.predictions import torn_apart
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import Fitted, Models, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.worker_pool import Pool

ARC = np.array([0.0, 0.1, 0.2, 0.4])


@pytest.mark.parametrize(
    ("place", "torn"),
    [([0.3, 0.0, 0.0], False), ([0.439, 0.0, 0.0], False), ([0.45, 0.0, 0.0], True), ([np.nan] * 3, True)],
)
def test_a_rope_is_torn_where_markers_are_further_apart_than_along_it(place: list[float], torn: bool) -> None:
    sims = np.zeros((2, 3, 4, 3))
    sims[..., 0] = ARC
    sims[1, 2, 3] = place
    assert torn_apart(sims, ARC).tolist() == [False, torn]


class Tearing(Models):
    """Models whose rope is torn in one trial unless steps are fine."""

    def simulate(self, job: SimulationJob, part: int = 0, parts: int = 1) -> np.ndarray:
        """Tear the last trial."""
        sims = super().simulate(job, part, parts)
        if dict(job.options).get("substep", 1.0) > 2e-3:
            sims[:, -1, -3:, -1] += 1.0
        return sims


def test_a_torn_trial_is_simulated_in_finer_steps(tmp_path: Path) -> None:
    options = {"vertices": 10}
    with Pool(swaying(tmp_path, frames=12), options, workers=1) as pool:
        pool.local, plain = Tearing(pool.recording, options), pool.local
        values = np.array([3e-3, 2e-3, 2.0])
        bench = Workspace(pool).begin(values, ())
        fitted = Fitted(
            (), values, ParameterSpace((), ()), Point(np.empty(0), 0.0, np.empty(0), np.empty(0), np.empty(0))
        )
        got = bench.prediction(fitted, "all")
        start, last = bench.starts["all"], bench.trials["all"][-1].name
        coarse = plain.simulate(SimulationJob((), values[None], "all", start))[0]
        step = ("substep", plain.model(()).dt / (4 * plain.model(()).substeps))
        fine = plain.simulate(SimulationJob((), values[None], "all", start, (step,)))[0]
    assert step[1] < 2e-3
    np.testing.assert_allclose(got[:-1], coarse[:-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(got[-1], fine[-1], rtol=0, atol=1e-9)
    assert np.abs(fine[-1] - coarse[-1]).max() > 1e-6
    assert bench.predictions.mended == {last}
    assert bench.predictions.notes() == [
        f"Simulated ropes were torn apart in {last}, by some model at least; they were simulated once more there in "
        "steps of a 4th."
    ]
