"""How much memory this process and the processes it started hold; 1 MB is 10^6 bytes."""

import os
import resource
import sys
from pathlib import Path

_PROC = Path("/proc")


def rss_mb() -> float:
    """Return resident megabytes of this process and its children; its peak without /proc.

    The libraries that the processes share are counted once: of a child only what is its own.
    """
    try:
        return _resident_mb(os.getpid()) + sum(map(_private_mb, _children()))
    except OSError:
        return own_peak_mb()


def own_peak_mb() -> float:
    """Return the most that this process alone has held.

    What getrusage tells of a process is at least what its parent held when it began it.
    """
    try:
        rows = (_PROC / "self" / "status").read_text(encoding="ascii").splitlines()
        return next(1024 * int(row.split()[1]) / 1e6 for row in rows if row.startswith("VmHWM"))
    except OSError:
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else 1024 * peak / 1e6


def _resident_mb(process: int) -> float:
    pages = int((_PROC / str(process) / "statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _private_mb(process: int) -> float:
    rows = (_PROC / str(process) / "smaps_rollup").read_text(encoding="ascii").splitlines()
    return sum(1024 * int(row.split()[1]) for row in rows if row.startswith("Private_")) / 1e6


def _children() -> list[int]:
    tasks = (_PROC / str(os.getpid()) / "task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text(encoding="ascii").split()]
