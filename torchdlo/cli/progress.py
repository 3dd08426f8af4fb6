"""What long commands show while they run, and how they are stopped."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from torchdlo.cli import ending

__all__ = ["at_work", "deferred_interrupt", "progress"]

_QUIET = 10.0
"""Shortest time between two lines in a log [s]."""


@contextmanager
def progress() -> Iterator[Callable[[str, int, int, str], None]]:
    """A bar with the time left on stderr; a callback(stage, done, total, message) moves it.

    Off a terminal, as in a log, it is a line now and then.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines()
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[message]}", markup=False),
    )
    with Progress(*columns, console=console) as bar:
        tasks: dict[str, Any] = {}

        def callback(stage: str, done: int, total: int, message: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, message=message)
            bar.update(tasks[stage], completed=done, total=total, message=message)

        yield callback


def _lines() -> Callable[[str, int, int, str], None]:
    begun = said = time.monotonic()

    def callback(stage: str, done: int, total: int, message: str = "") -> None:
        nonlocal said
        now = time.monotonic()
        if now - said > _QUIET:
            said = now
            sys.stderr.write(f"{now - begun:6.0f} s  {stage} {done}/{total} {message}".rstrip() + "\n")

    return callback


def at_work(folder: Path, *names: str) -> AbstractContextManager[None]:
    """Hold the lock of a folder that results go to, see `torchdlo.journal.at_work`."""
    from torchdlo import journal

    return journal.at_work(folder, *names)


@contextmanager
def deferred_interrupt(
    callback: Callable[[str, int, int, str], None],
) -> Iterator[Callable[[str, int, int, str], None]]:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt only inside the callback; a second one raises at once."""
    if threading.current_thread() is not threading.main_thread():
        yield callback
        return
    asked = False
    previous = {s: signal.getsignal(s) for s in ending.SIGNALS}

    def ask(signum: int, frame: Any) -> None:
        nonlocal asked
        ending.note(signum)
        if asked:
            raise KeyboardInterrupt
        asked = True
        sys.stderr.write("stopping after this iteration; Ctrl-C again to stop at once\n")

    def checked(stage: str, done: int, total: int, message: str = "") -> None:
        nonlocal asked
        callback(stage, done, total, message)
        if asked:
            # Said once: what is left to do with the best so far reports its progress, too.
            asked = False
            raise KeyboardInterrupt

    for each in previous:
        signal.signal(each, ask)
    try:
        yield checked
    finally:
        for each, handler in previous.items():
            signal.signal(each, handler)
