"""A search that was stopped goes on from what it wrote down, and only if it is the same search."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from tests.sysid.swaying import recording as swaying
from torchdlo.errors import InputError
from torchdlo.sysid.diagnosis import effect_library
from torchdlo.sysid.diagnosis import effect_search as search
from torchdlo.sysid.diagnosis.effect_library import PARAMETERS
from torchdlo.sysid.diagnosis.findings import findings, model_json
from torchdlo.sysid.estimation import result_cache as journals
from torchdlo.sysid.estimation import worker_pool as pools
from torchdlo.sysid.estimation.jobs import FitJob, Fitted, Models, SimulationJob
from torchdlo.sysid.estimation.levenberg_marquardt import ParameterSpace, Point
from torchdlo.sysid.estimation.result_cache import ResultCache, digest
from torchdlo.sysid.estimation.worker_pool import Pool
from torchdlo.sysid.model import model_file
from torchdlo.sysid.model.trial_batch import Start
from torchdlo.sysid.recordings.recording import Recording, load_recording

OPTIONS = {"seed": 0, "budget": "fast"}


@pytest.fixture
def recording(folder: Path) -> Recording:
    """A small recording."""
    return load_recording(folder)


def fitted() -> Fitted:
    """A result with all kinds of content, numbers that are not finite among them."""
    space = ParameterSpace(("damping_rate",), (PARAMETERS["damping_rate"],), (1.0,))
    point = Point(np.array([0.3]), float("inf"), np.ones((2, 1)), np.full((2, 1, 1), np.nan), np.array([1.0, np.inf]))
    return Fitted(("air_drag",), np.linspace(0, 1, 4), space, point)


def fit_job(value: float = 1.0) -> FitJob:
    """A job."""
    start = Start(np.zeros((2, 9, 3)), np.ones((2, 9, 3)), np.array([True, False]))
    return FitJob(("air_drag",), np.full((2, 4), value), ("damping_rate",), (1.0,), 6, start)


def test_results_come_back_to_the_last_bit(recording: Recording, tmp_path: Path) -> None:
    journal, job, result = ResultCache(tmp_path / "j", recording, OPTIONS), fit_job(), fitted()
    assert journal.results.recall(job) is None
    journal.results.keep(job, result)
    journal.close()
    again = ResultCache(tmp_path / "j", recording, OPTIONS, resume=True).results.recall(fit_job())
    assert digest(again) == digest(result) and again.space.params == result.space.params
    np.testing.assert_array_equal(again.point.curvature, result.point.curvature)


def test_other_content_is_another_job() -> None:
    job = fit_job()
    others = (
        fit_job(np.nextafter(1.0, 2.0)),
        replace(job, iterations=7),
        replace(job, start=None),
        replace(job, frames=3),
        SimulationJob(job.effects, job.values),
        replace(job, values=job.values.reshape(4, 2)),
    )
    assert len({digest(each) for each in (job, *others)}) == 1 + len(others)


def test_only_what_is_missing_is_computed(recording: Recording, tmp_path: Path) -> None:
    journal = ResultCache(tmp_path / "j", recording, OPTIONS)
    jobs = [fit_job(v) for v in (1.0, 2.0, 3.0)]
    asked: list[Any] = []

    def compute(rest: Sequence[FitJob]) -> Iterator[tuple[int, np.ndarray]]:
        asked.extend(rest)
        # Results come in any order.
        yield from ((k, 10 * rest[k].values) for k in reversed(range(len(rest))))

    first = journal.through(jobs, compute)
    assert next(first)[0] == 2  # the search is stopped after one result
    first.close()
    asked.clear()
    found = dict(journal.through(jobs, compute))
    assert asked == jobs[:2] and sorted(found) == [0, 1, 2]
    for k, job in enumerate(jobs):
        np.testing.assert_array_equal(found[k], 10 * job.values)


def test_a_pool_reads_what_another_one_computed(recording: Recording, tmp_path: Path) -> None:
    options = {"vertices": 15}
    job = SimulationJob((), np.array([[1e-3, 1e-3, 0.5]]))
    with Pool(recording, options, 1, ResultCache(tmp_path / "j", recording, OPTIONS)) as pool:
        ((_, computed),) = pool.simulate([job])
    with Pool(recording, options, 1, ResultCache(tmp_path / "j", recording, OPTIONS, resume=True)) as pool:
        pool.local.simulate = lambda job: pytest.fail("computed again")
        ((_, kept),) = pool.simulate([job])
    np.testing.assert_array_equal(kept, computed)


def test_a_damaged_result_is_computed_again(recording: Recording, tmp_path: Path) -> None:
    journal, job = ResultCache(tmp_path / "j", recording, OPTIONS), fit_job()
    journal.results.keep(job, fitted())
    (file,) = (tmp_path / "j").glob("*.npz")
    whole = file.read_bytes()
    for part in (b"", whole[: len(whole) // 2], b"not an archive"):
        file.write_bytes(part)
        assert journal.results.recall(job) is None


def test_another_search_is_refused(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "j"
    with pytest.raises(InputError, match=r"expected the journal of a search to resume, found none; leave out --resume"):
        ResultCache(path, recording, OPTIONS, resume=True)
    ResultCache(path, recording, OPTIONS).results.keep(fit_job(), fitted())
    shifted = replace(recording.test[0], markers=recording.test[0].markers + 1e-9)
    for other, options in (
        (replace(recording, test=(shifted, *recording.test[1:])), OPTIONS),
        (replace(recording, mass=0.06), OPTIONS),
        (recording, OPTIONS | {"seed": 1}),
        (recording, OPTIONS | {"budget": "full"}),
    ):
        with pytest.raises(InputError, match="belongs to another recording or to other options"):
            ResultCache(path, other, options, resume=True)
    # A copy of the folder elsewhere is the same recording.
    ResultCache(path, replace(recording, path=tmp_path / "elsewhere"), OPTIONS, resume=True).close()
    monkeypatch.setattr(journals, "program", lambda: "newer")
    with pytest.raises(InputError, match="written by another version of torchdlo"):
        ResultCache(path, recording, OPTIONS, resume=True)


def test_a_new_search_begins_with_an_empty_journal(recording: Recording, tmp_path: Path) -> None:
    ResultCache(tmp_path / "j", recording, OPTIONS).results.keep(fit_job(), fitted())
    assert ResultCache(tmp_path / "j", recording, OPTIONS).results.recall(fit_job()) is None


def test_foreign_folders_are_not_emptied(recording: Recording, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="expected a journal of torchdlo, found something else"):
        ResultCache(tmp_path, recording, OPTIONS)
    assert (tmp_path / "thesis.txt").exists()


class FakeModels(Models):
    """Answers of jobs that depend on nothing but the job, in no time; it counts them."""

    computed: ClassVar[list[str]] = []

    def simulate(self, job: SimulationJob, part: int = 0, parts: int = 1) -> np.ndarray:
        """Return the measured markers, moved by what the numbers are."""
        self.computed.append(digest(job))
        trials = self.recording.trials(job.split)
        shift = 1e-3 * np.sin(1e3 * job.values.sum(1) + len(job.effects))
        return np.stack([t.markers[: job.frames] for t in trials])[None] + shift[:, None, None, None, None]

    def search(self, jobs: Sequence[FitJob]) -> Generator[SimulationJob, np.ndarray, tuple[Fitted, ...]]:
        """Return the first start of every fit, a little changed."""
        self.computed += [digest(job) for job in jobs]
        yield SimulationJob(jobs[0].effects, jobs[0].values)
        return tuple(self._fitted(job) for job in jobs)

    def _fitted(self, job: FitJob) -> Fitted:
        model = self.model(job.effects)
        params = tuple(model.params[model.parameters.index(n)] for n in job.free)
        space, values = ParameterSpace(job.free, params, job.sizes), job.values[0] * 1.01
        raw = space.to_raw(values[[model.parameters.index(n) for n in job.free]])
        gradients = np.ones((len(self.recording.train), len(raw)))
        curvature = np.tile(np.eye(len(raw)), (len(gradients), 1, 1))
        return Fitted(job.effects, values, space, Point(raw, 1e-3, gradients, curvature, np.ones(len(gradients))))


def test_a_stopped_diagnosis_goes_on_and_its_model_starts_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pools, "Models", FakeModels)
    monkeypatch.setattr(effect_library, "library", lambda: ("air_drag", "point_mass", "time_delay"))
    recording, computed = swaying(tmp_path, frames=60), FakeModels.computed
    options = {"vertices": 21, "workers": 1, "journal": tmp_path / "j"}

    def stop(stage: str, done: int, *_: object) -> None:
        if stage.endswith("screening") and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search.diagnose(recording, **options, callback=stop)
    before = set(computed)
    computed.clear()
    resumed = search.diagnose(recording, **options, resume=True)
    # Nothing that was done is done again, and the rest leads to where an unbroken search leads.
    assert before and computed and not before & set(computed)
    whole = search.diagnose(recording, **options)
    keys = ("verdict", "effects", "gap", "candidates", "baseline")
    assert {k: findings(resumed, recording)[k] for k in keys} == {k: findings(whole, recording)[k] for k in keys}
    (tmp_path / "model.json").write_text(model_json(whole))
    given = model_file.load(tmp_path / "model.json")
    assert given.effects == whole.final.effects
    again = search.diagnose(recording, vertices=21, workers=1, given=given)
    assert again.baseline.effects == given.effects and again.options["vertices"] == 21
    # Two fits: one before what finer steps change is known, one after.
    np.testing.assert_allclose(again.baseline.values, whole.final.values * 1.01**2)
