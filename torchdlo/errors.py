"""Errors whose text is written for the user: one sentence, no traceback."""

from __future__ import annotations

__all__ = ["InputError"]


class InputError(ValueError):
    """Something the user gave is wrong; the message says what, where and how to fix it."""
