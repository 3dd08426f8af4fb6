"""Fits to films are shared out over processes, which come to what one does."""

from __future__ import annotations

import os
import signal
import time

import pytest

from torchdlo.errors import InputError
from torchdlo.sysid.video.fit_pool import FitPool


def squared(x: float, wait: float) -> tuple[float, int]:
    time.sleep(wait)
    return x * x, os.getpid()


def killed(x: float, wait: float) -> tuple[float, int]:
    os.kill(os.getpid(), signal.SIGKILL)
    return x, 0


def refused(x: float, wait: float) -> tuple[float, int]:
    raise InputError(f"{x} is refused.")


JOBS = [(float(k), 0.3 if k == 0 else 0.0) for k in range(4)]


def test_processes_come_to_what_one_does() -> None:
    with FitPool(1) as pool:
        alone = pool.all(squared, JOBS)
    with FitPool(2) as pool:
        shared, order = pool.all(squared, JOBS), [k for k, _ in pool.map(squared, JOBS)]
    assert [x for x, _ in shared] == [x for x, _ in alone] == [0.0, 1.0, 4.0, 9.0]
    assert {pid for _, pid in alone} == {os.getpid()} and os.getpid() not in {pid for _, pid in shared}
    assert sorted(order) == [0, 1, 2, 3] and order[0] != 0  # as they get ready


def test_a_single_fit_starts_no_process() -> None:
    with FitPool(2) as pool:
        ((_, (_, pid)),) = pool.map(squared, JOBS[:1])
    assert pid == os.getpid()


def test_a_worker_that_dies_is_a_sentence_and_errors_are_those_of_fits() -> None:
    with FitPool(2) as pool, pytest.raises(InputError, match="a worker process died"):
        pool.all(killed, JOBS)
    with FitPool(2) as pool, pytest.raises(InputError, match=r"is refused\."):
        pool.all(refused, JOBS)


def test_no_process_is_left_behind() -> None:
    with FitPool(2) as pool:
        pids = {pid for _, pid in pool.all(squared, JOBS)}
    end = time.monotonic() + 20
    while any(os.path.exists(f"/proc/{pid}") for pid in pids) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)
