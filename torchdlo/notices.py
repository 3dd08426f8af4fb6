"""What a user is told once per process, through the logger `torchdlo`, which writes to stderr unless told otherwise."""

from __future__ import annotations

import logging

__all__ = ["once"]

_log = logging.getLogger("torchdlo")
_said: set[str] = set()


def once(topic: str, sentence: str) -> None:
    """Log a warning unless one on this topic was logged before."""
    if topic not in _said:
        _said.add(topic)
        _log.warning("%s", sentence)
