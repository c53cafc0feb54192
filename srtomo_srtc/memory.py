"""Refuse beforehand what does not fit in memory."""

from __future__ import annotations

import os
from pathlib import Path

_GIB = 2**30


def require(n_bytes: float, what: str) -> None:
    """Go on only if there is room.

    Args:
        n_bytes: needed at most at any one time, beyond what is in use.
        what: names the work in the message.

    Raises:
        MemoryError: one line with what is needed and what there is.
    """
    free = available()
    if n_bytes > free:
        raise MemoryError(f"{what}: needs {n_bytes / _GIB:.1f} GiB of memory, {free / _GIB:.1f} GiB are available")


def available() -> float:
    """Bytes that can be allocated without swapping: of the host, or of this process's control group if that is less."""
    free = _of_host()
    group = Path("/sys/fs/cgroup")
    try:
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        # the page cache counts as used, but is given back when memory runs short
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())["inactive_file"]
    except (OSError, ValueError, KeyError):
        return free
    return min(free, limit - used + int(cached))


def _of_host() -> float:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
