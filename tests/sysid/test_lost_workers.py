"""A worker process that dies is started again and its job repeated once."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.sysid.swaying import recording as swaying
from torchdlo.errors import InputError
from torchdlo.sysid.estimation.jobs import SimulationJob
from torchdlo.sysid.estimation.worker_pool import Pool


@dataclass(frozen=True)
class Job:
    """A number to square; the process dies as often as files are missing."""

    number: int
    folder: str
    deaths: int = 0
    options: tuple[tuple[str, Any], ...] = ()


def square(models: Any, job: Job) -> int:
    """Square the number, or die."""
    for k in range(job.deaths):
        mark = Path(job.folder) / f"{job.number}-{k}"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
    return job.number**2


@pytest.mark.slow
def test_work_of_lost_workers_is_repeated_once(tmp_path: Path) -> None:
    with Pool(swaying(tmp_path / "rope", frames=10), {"vertices": 9}, workers=2) as pool:
        jobs = [Job(k, str(tmp_path), deaths=1 if k in (1, 4) else 0) for k in range(6)]
        assert dict(pool.run(square, jobs)) == {k: k * k for k in range(6)}
        # Those that die while nobody asks them for anything are noticed, too.
        for queue in pool._queues:
            for process in (queue._processes or {}).values():
                process.kill()
                process.join()
        job = SimulationJob((), np.array([[1e-3, 1e-3, 0.5]] * 40))
        ((_, sims),) = pool.simulate([job])
        assert np.isfinite(sims).all()
        with pytest.raises(InputError, match=r"a worker process died twice at the same work.*--resume goes on"):
            list(pool.run(square, [Job(9, str(tmp_path), deaths=2)]))
