"""What work will cost, before it begins: memory and time, refused where the machine lacks it, told where it is long.

Estimates are of the right size, not exact: they are to tell seconds from years, and megabytes from terabytes.
"""

from __future__ import annotations

import os
from pathlib import Path

from torchdlo import notices
from torchdlo.errors import InputError

__all__ = ["available_memory", "check", "duration_text", "size_text"]

TOLD = 60.0
"""Work longer than this is told before it begins [s]."""
LONGEST = 30 * 86400.0
"""Work longer than this is refused [s]."""


def available_memory() -> float:
    """Return the memory that can be used now [bytes]: that of the machine, or of the group that this process is in."""
    found = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024.0 * int(line.split()[1]))
    except (OSError, ValueError, IndexError):
        pass
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
        if limit != "max":
            # Files that were read lie in memory too, and make room when it is needed.
            rows = dict(row.split() for row in Path("/sys/fs/cgroup/memory.stat").read_text().splitlines())
            used = float(Path("/sys/fs/cgroup/memory.current").read_text()) - float(rows.get("inactive_file", 0))
            found.append(float(limit) - used)
    except (OSError, ValueError):
        pass
    if not found:
        try:
            found.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
        except (OSError, ValueError, AttributeError):
            return float("inf")
    return max(min(found), 0.0)


def check(where: str, work: str, *, memory: float = 0.0, seconds: float = 0.0, cure: str) -> None:
    """Refuse work that this machine cannot do, and say how long it takes if that is more than a minute.

    Args:
        where: the file, option or entry that asks for it.
        work: what makes it large, as in "1e9 vertices, 1000 steps".
        memory: what it needs at least [bytes].
        seconds: how long it takes about [s].
        cure: what to change.
    """
    where = "".join(c if c.isprintable() else "?" for c in where)
    has = available_memory() if memory > 2**26 else float("inf")
    if memory > has:
        raise InputError(
            f"{where}: {work} need about {size_text(memory)} of memory, and this machine has {size_text(has)} free; "
            f"{cure}."
        )
    if seconds > LONGEST:
        raise InputError(
            f"{where}: {work} take about {duration_text(seconds)} on this machine, and at most "
            f"{duration_text(LONGEST)} are begun; {cure}."
        )
    if seconds > TOLD:
        notices.once(f"budget {where}", f"{where}: {work} take about {duration_text(seconds)}.")


def duration_text(seconds: float) -> str:
    """Return a time for people."""
    for unit, length in (("years", 365.25 * 86400), ("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 1.5 * length:
            return f"{seconds / length:.2g} {unit}"
    return f"{seconds:.2g} s"


def size_text(count: float) -> str:
    """Return a number of bytes for people."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
