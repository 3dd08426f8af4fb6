"""A measured rest shape is given up where a straight rope fits better, and only there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.sysid.test_diagnose import S, hanging
from torchdlo.sysid.diagnosis import baseline
from torchdlo.sysid.diagnosis.budget import model_options
from torchdlo.sysid.diagnosis.workspace import Workspace
from torchdlo.sysid.estimation.jobs import FitJob
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model.rope_model import RopeModel
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording

ARC = np.stack([0.12 * np.sin(S / 0.12), 0.12 * (1 - np.cos(S / 0.12)), 0 * S], -1)
"""Five radians of a circle."""


def made(path: Path, share: float) -> Recording:
    """Two trials of a rope of which so much of the arc is real."""
    trials = tuple(hanging(n, np.random.default_rng(k)) for k, n in enumerate(("train_0", "test_0")))
    gravity = np.array([0, 0, -9.81])
    empty = Recording(path, 0.6, 0.005, 0.03, gravity, None, 2e-4, ARC, None, False, "", trials[:1], trials[1:])
    model = RopeModel(empty, vertices=41, rest="given", numerical_damping=0.0)
    numbers = {"bending_stiffness": 1.5e-3, "twisting_stiffness": 1e-3, "damping_rate": 0.5, "rest_share": share}
    values = dict(zip(model.parameters, model.guess(), strict=True)) | numbers
    start = Start(np.stack([t.markers[0] for t in trials]), np.zeros((2, len(S), 3)), np.ones(2, bool))
    motion = replace(model.motion(trials), markers=np.full((2, 41, len(S), 3), np.nan))
    sims = model.simulate(motion, start, np.array([[values[n] for n in model.parameters]]))[0]
    seen = [replace(t, markers=sim) for t, sim in zip(trials, sims, strict=True)]
    return replace(empty, train=(seen[0],), test=(seen[1],))


@pytest.mark.slow
@pytest.mark.parametrize(("share", "rest"), [(0.0, "straight"), (1.0, "given")])
def test_a_rest_shape_is_given_up_only_where_a_straight_rope_fits_better(
    tmp_path: Path, share: float, rest: str
) -> None:
    recording = made(tmp_path, share)
    with Pool(recording, model_options(recording, 31), 1) as pool:
        bench = Workspace(pool)
        model = pool.local.model(())
        assert model.rest == "given"
        bench, found = baseline.calibrate_baseline(bench, 12, 4, np.random.default_rng(0), lambda *_: None)
        assert bench.pool.local.model(()).rest == rest and pool.local.model(()).rest == "given"
        numbers = dict(zip(bench.pool.local.model(found.effects).parameters, found.values, strict=True))
        assert numbers["bending_stiffness"] == pytest.approx(1.5e-3, rel=0.15)
        assert ("rest_share" in numbers) == (rest == "given")


@pytest.mark.slow
def test_a_rest_shape_that_was_given_up_is_tried_again_with_an_effect(tmp_path: Path) -> None:
    recording = made(tmp_path, 1.0)
    with Pool(recording, model_options(recording, 31), 1) as pool:
        bench = Workspace(pool.with_options(rest="straight"))
        model = bench.pool.local.model(())
        bench = bench.begin(model.guess(), ())
        names, start = tuple(model.parameters), bench.starts["train"]
        straight = bench.fit([FitJob((), model.guess()[None], names, (1.0,) * len(names), 4, start)])[0]
        before = np.sqrt(np.mean(bench.gaps(straight, "test") ** 2))
        bench, found = baseline.go_further(bench, straight, 6, lambda *_: None)
        assert bench.pool.local.model(()).rest == "given" == dict(found.options)["rest"]
        numbers = dict(zip(bench.pool.local.model(found.effects).parameters, found.values, strict=True))
        assert numbers["rest_share"] == pytest.approx(1.0, abs=0.1)
        left = np.sqrt(np.mean(bench.gaps(found, "test") ** 2))
        assert left < 0.2 * before
        # What was fitted before is still simulated without the shape.
        assert np.sqrt(np.mean(bench.gaps(straight, "test") ** 2)) > 2 * left
