"""Workers on the nodes of a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from torchdlo.agents.distributed.executors import _Closing
from torchdlo.errors import InputError

__all__ = ["RayWorkers", "join_cluster"]

Item = TypeVar("Item")
Result = TypeVar("Result")
AGAIN = 5
"""How often an item is done again if its node is lost."""


def join_cluster(address: str) -> tuple[Any, bool]:
    """Join a cluster; return the module ray, and whether it was joined here, and is to be left again.

    Args:
        address: see `executors.make_executor`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise InputError(
            "--address needs ray; install it with pip install 'torchdlo[ray]', or leave out --address to work in "
            "processes of this machine."
        ) from None
    if ray.is_initialized():
        return ray, False
    local = address == "local"
    own: dict[str, Any] = {"include_dashboard": False, "object_store_memory": 200 * 2**20} if local else {}
    try:
        ray.init(None if local else address, log_to_driver=False, ignore_reinit_error=True, **own)
    except Exception as error:  # Ray raises what it meets, also an exception of no narrower kind
        said = f"no Ray could be started ({error})" if local else f"no Ray cluster answers there ({error})"
        raise InputError(f"--address {address}: {said}.") from None
    return ray, True


class RayWorkers(_Closing):
    """Does each item as a task of Ray on one core. Tasks of a lost node are run again on another one."""

    def __init__(self, address: str, workers: int | None = None) -> None:
        """Join a cluster.

        Args:
            address: see `executors.make_executor`.
            workers: most items that are being worked on at a time; as many as the cluster has cores if not given.
        """
        self._ray, self._owned = join_cluster(address)
        self.workers = workers

    def map(self, fn: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
        """Yield results as they get done."""
        ray = self._ray
        remote = ray.remote(num_cpus=1, max_retries=AGAIN)(_called)
        todo, running = list(range(len(items)))[::-1], dict[Any, int]()
        try:
            while todo or running:
                most = self.workers or max(1, int(ray.cluster_resources().get("CPU", 1)))
                while todo and len(running) < most:
                    k = todo.pop()
                    running[remote.remote(fn, items[k])] = k
                done, _ = ray.wait(list(running), num_returns=1)
                for demonstration in done:
                    k = running.pop(demonstration)
                    try:
                        result = ray.get(demonstration)
                    except ray.exceptions.RayTaskError as error:
                        raise error.cause from None
                    yield k, result
        finally:
            for demonstration in running:
                ray.cancel(demonstration, force=True)

    def close(self) -> None:
        """Leave the cluster, if it was joined here."""
        if self._owned:
            self._ray.shutdown()


def _called(fn: Callable[[Any], Any], item: Any) -> Any:
    import torch

    torch.set_num_threads(1)
    return fn(item)
