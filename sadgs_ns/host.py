"""What this process may take of its host, memory and cores, read without torch, whose import takes seconds."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

_CONTROL_GROUPS = (
    ("memory.max", "memory.current", "memory.stat", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
)
"""Files that tell a container's memory, for versions 2 and 1 of control groups: the limit, what is in use, and
statistics, with the name of the line that counts cached files, which the system can drop."""


def num_cores() -> int:
    """Return how many cores this process may use, which may be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_host_bytes(root: Path = Path("/")) -> float:
    """Bytes that this process may take, read from `proc` and a container's `sys` below `root`; infinity if unknown."""
    available = math.inf
    with contextlib.suppress(OSError):
        available = 1024.0 * _numbers(root / "proc/meminfo").get("MemAvailable", math.inf)
    for limit, used, statistics, forgettable in _CONTROL_GROUPS:
        folder = root / "sys/fs/cgroup"
        with contextlib.suppress(OSError, ValueError):  # There is no such group, or its limit is "max".
            left = int((folder / limit).read_text()) - int((folder / used).read_text())
            available = min(available, left + _numbers(folder / statistics)[forgettable])
    return available


def _numbers(path: Path) -> dict[str, int]:
    """Read the numbers in a file of the kernel whose lines are a name and a number."""
    rows = (line.replace(":", " ").split() for line in path.read_text().splitlines())
    return {row[0]: int(row[1]) for row in rows if len(row) > 1}
