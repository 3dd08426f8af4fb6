"""Ray with two simulated nodes: the same bytes as in one process, also when a node is lost or the driver killed."""

from __future__ import annotations

import os
import subprocess
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


NODE = {"num_cpus": 1, "object_store_memory": 100 * 2**20}


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch):
    """A cluster of one node, whose workers find the tasks of tests."""
    from ray.cluster_utils import Cluster

    for name, kind in SHORT.items():
        monkeypatch.setitem(envs.TASKS, name, kind)
    root = DATA.parents[2]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (root, DATA, Path(__file__).parent))))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    found = Cluster(initialize_head=True, head_node_args=NODE | {"include_dashboard": False})
    yield found
    found.shutdown()


def content(folder: Path) -> dict[Path, bytes]:
    """All files of a folder."""
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.slow
def test_a_lost_node_changes_no_byte(tmp_path: Path, cluster) -> None:
    second = cluster.add_node(**NODE)
    cluster.wait_for_nodes()

    def lose() -> None:
        time.sleep(12)
        cluster.remove_node(second, allow_graceful=False)

    thread = threading.Thread(target=lose)
    make_dataset(plan(episodes=10), tmp_path / "one", painter=Dots())
    with make_executor(address=cluster.address) as workers:
        thread.start()
        make_dataset(plan(episodes=10), tmp_path / "two", painter=Dots(1.0), executor=Taught(workers))
        thread.join()
    assert content(tmp_path / "one") == content(tmp_path / "two")


def main() -> None:
    """Make a set on a cluster in a process of its own: OUT ADDRESS [--resume]."""
    envs.TASKS.update(SHORT)
    os.umask(0o22)
    with make_executor(address=sys.argv[2]) as workers:
        options = {"painter": Dots(1.0), "executor": Taught(workers), "resume": "--resume" in sys.argv}
        make_dataset(plan(episodes=10), Path(sys.argv[1]), **options)


@pytest.mark.slow
def test_a_killed_driver_goes_on_to_the_same_bytes(tmp_path: Path, cluster) -> None:
    cluster.add_node(**NODE)
    cluster.wait_for_nodes()
    os.umask(0o22)
    make_dataset(plan(episodes=10), tmp_path / "one", painter=Dots())
    command = [sys.executable, __file__, str(tmp_path / "two"), cluster.address]
    driver, begun = subprocess.Popen(command), time.monotonic()
    while not list(tmp_path.glob("two/unfinished/short/*")) and time.monotonic() < begun + 300:
        assert driver.poll() is None
        time.sleep(0.05)
    driver.kill()
    driver.wait()
    finished = len(list(tmp_path.glob("two/unfinished/short/[0-9]*")))
    assert 0 < finished and not (tmp_path / "two/meta/info.json").exists()
    subprocess.run([*command, "--resume"], check=True)
    assert content(tmp_path / "one") == content(tmp_path / "two")


if __name__ == "__main__":
    main()
