"""How commands end when they are stopped: with one sentence, what to type to go on, and the exit code of shells.

SIGTERM is taken like Ctrl-C: it raises `KeyboardInterrupt`, so that what is finished is kept.
"""

from __future__ import annotations

import errno
import shlex
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

__all__ = ["SIGNALS", "caught", "failed", "note", "stopped"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)

_RESUMABLE = (
    "calibrate",
    "diagnose",
    "design-experiment",
    "optimize",
    "plan",
    "propose",
    "train",
    "distill",
    "learn",
    "sweep",
)

_FULL = (errno.ENOSPC, errno.EDQUOT)

_by: signal.Signals | None = None
"""What stopped the command, if anything did."""
_told = False
_typed: list[str] = []
"""The command, without its name."""


def note(signum: int) -> None:
    """Remember what stops the command."""
    global _by
    _by = signal.Signals(signum)


def _code() -> int:
    return 128 + (_by or signal.SIGINT)


def stopped(kept: str, resume: bool = False) -> SystemExit:
    """Say that a command was stopped; return what ends it with 130 after Ctrl-C, and 143 after SIGTERM.

    Args:
        kept: what is left of the work.
        resume: whether the command goes on with --resume.
    """
    global _told
    _told = True
    how = "terminated" if _by == signal.SIGTERM else "interrupted"
    sys.stderr.write(f"{how}; {kept}{_again(resume)}\n")
    return SystemExit(_code())


def _goes_on() -> bool:
    """Return whether the command has an option --resume."""
    return bool(_typed) and (_typed[0] in _RESUMABLE or _typed[:2] == ["dataset", "make"])


def _again(resume: bool) -> str:
    if not resume:
        return ""
    if not _typed:
        return "; --resume goes on"
    words = [*_typed, *(["--resume"] if "--resume" not in _typed else [])]
    if "--" in _typed and "--resume" not in _typed:
        words.insert(words.index("--"), words.pop())
    return f"; go on with: {_plain(shlex.join(['torchdlo', *words]))}"


def failed(error: OSError) -> str:
    """Return a sentence about what the system refused."""
    if error.errno in _FULL:
        where = f"{error.filename}: " if error.filename else ""
        return _plain(f"{where}{error.strerror}; what was written before is kept, make room") + _again(_goes_on())
    return _plain(str(error))


def _plain(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in " ".join(text.splitlines()))


@contextmanager
def caught(args: list[str] | None = None) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end what is in the block with a sentence, also where no command looks after them."""
    global _by, _told, _typed
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _by, _told, _typed = None, False, list(sys.argv[1:] if args is None else args)
    before = {s: signal.getsignal(s) for s in SIGNALS}
    threads, threading.excepthook = threading.excepthook, _in_thread
    for each in before:
        signal.signal(each, _raise)
    try:
        yield
    except KeyboardInterrupt:
        raise stopped("nothing more was written") from None
    except SystemExit as end:
        if _by is not None and not _told and end.code == 128 + signal.SIGINT:
            raise stopped("nothing more was written") from None
        raise
    finally:
        threading.excepthook = threads
        for each, handler in before.items():
            with suppress(TypeError, ValueError):  # of one that was not set by Python
                signal.signal(each, handler)


def _in_thread(args: threading.ExceptHookArgs) -> None:
    """Leave what a full disk does to a writer in the background to the command, which hears of it too."""
    if not (isinstance(args.exc_value, OSError) and args.exc_value.errno in _FULL):
        threading.__excepthook__(args)


def _raise(signum: int, frame: Any) -> None:
    note(signum)
    raise KeyboardInterrupt
