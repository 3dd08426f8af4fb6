"""Ray with two simulated nodes: the same bytes as in one process, also when a node is lost."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

import pytest

ray = pytest.importorskip("ray", reason="needs the extra ray")
pytest.importorskip("pyarrow", reason="data sets need the extra dataset")
pytest.importorskip("pytorch_kinematics", reason="arms need the extra robots")

DATA = Path(__file__).parents[1] / "data"
sys.path.insert(0, str(DATA))

from short_task import SHORT, Dots, plan  # noqa: E402

from torchdlo import envs  # noqa: E402
from torchdlo.agents.data.making import make_dataset  # noqa: E402
from torchdlo.agents.distributed import make_executor  # noqa: E402


class Lesson:
    """What workers do: they get to know the tasks of tests first."""

    def __init__(self, fn) -> None:
        self.fn = fn

    def __call__(self, item):
        """Do it."""
        from short_task import SHORT

        from torchdlo import envs

        envs.TASKS.update(SHORT)
        return self.fn(item)


class Taught:
    """An executor whose workers know the tasks of tests."""

    def __init__(self, inner) -> None:
        self.inner = inner

    def map(self, fn, items):
        """Teach and do."""
        return self.inner.map(Lesson(fn), items)

    def close(self) -> None:
        """Nothing."""


@pytest.mark.slow
def test_a_lost_node_changes_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ray.cluster_utils import Cluster

    for name, kind in SHORT.items():
        monkeypatch.setitem(envs.TASKS, name, kind)
    root = DATA.parents[2]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (root, DATA, Path(__file__).parent))))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    second = cluster.add_node(**node)
    cluster.wait_for_nodes()

    def lose() -> None:
        time.sleep(12)
        cluster.remove_node(second, allow_graceful=False)

    thread = threading.Thread(target=lose)
    try:
        make_dataset(plan(episodes=10), tmp_path / "one", painter=Dots())
        with make_executor(address=cluster.address) as workers:
            thread.start()
            make_dataset(plan(episodes=10), tmp_path / "two", painter=Dots(1.0), executor=Taught(workers))
    finally:
        thread.join()
        cluster.shutdown()
    one, two = (
        {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
        for folder in (tmp_path / "one", tmp_path / "two")
    )
    assert one == two
