"""Fits that simulate together find what they find alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.sysid.swaying import recording as swaying
from torchdlo.sysid.pool import Fit, Pool

OPTIONS = {"vertices": 17, "ahead": 0.0, "grip": 0.0, "compiled": False}
BASE = ("bending_stiffness", "damping_rate")


def fits(pool: Pool) -> list[Fit]:
    """A model without effects, two with one each, one of them from several starts, and one that needs frames."""
    jobs = []
    for effects, number, starts in (
        ((), None, (0.0,)),
        (("air_drag",), "air_drag.c_d", (0.5,)),
        (("point_mass",), "point_mass.mass", (1e-3, 2e-3, 4e-3)),
        (("rest_curvature",), "rest_curvature.curvature.0", (0.1,)),
    ):
        model = pool.local.model(effects)
        values = np.repeat(model.guess()[None], len(starts), 0)
        free, sizes = BASE, (1.0, 1.0)
        if number is not None:
            values[:, model.parameters.index(number)] = starts
            free, sizes = (*BASE, number), (1.0, 1.0, max(starts))
        jobs.append(Fit(effects, values, free, sizes, 2, frames=40, keep=1 if len(starts) > 1 else None))
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


def test_fits_are_spread_over_the_workers(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path, frames=40), OPTIONS, workers=2) as pool:
        assert sorted(map(sorted, pool.groups(fits(pool)))) == [[0, 2], [1], [3]]
