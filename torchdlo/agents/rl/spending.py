"""What a run of several stages uses of its budgets, over all processes that worked on it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

__all__ = ["Spending"]


@dataclass(frozen=True)
class Mark:
    """What was used up to a moment."""

    played: int
    seconds: float
    cpu_seconds: float


class Spending:
    """Episodes, seconds of the clock and of the CPU that were used, and how much may be."""

    def __init__(self, episodes: float = math.inf, minutes: float = math.inf) -> None:
        """Begin to count."""
        self.episodes, self.minutes = episodes, minutes
        self.played = 0
        """Episodes."""
        self.reserved = 0
        """Episodes that have to be left for what comes later."""
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def ended(self, episodes: int) -> str:
        """Return which budget does not allow so many more episodes, "" if all do; time may be exceeded by them."""
        if self.played + episodes + self.reserved > self.episodes:
            return "episodes"
        return "minutes" if self.mark().seconds >= 60 * self.minutes else ""

    def mark(self) -> Mark:
        """Return what was used so far."""
        return Mark(self.played, time.monotonic() - self._wall, time.process_time() - self._cpu)

    def since(self, mark: Mark) -> dict[str, Any]:
        """Return what was used since then, as plain data."""
        now = self.mark()
        return {
            "episodes": now.played - mark.played,
            "seconds": round(now.seconds - mark.seconds, 1),
            "cpu_seconds": round(now.cpu_seconds - mark.cpu_seconds, 1),
        }

    def add_time(self, spent: dict[str, Any]) -> None:
        """Count the time that another process has used for this, as `since` returned it there."""
        self._wall -= spent.get("seconds", spent.get("cpu_seconds", 0.0))
        self._cpu -= spent.get("cpu_seconds", 0.0)

    def add(self, spent: dict[str, Any]) -> None:
        """Count all that another process has used for this."""
        self.add_time(spent)
        self.played += spent.get("episodes", 0)
