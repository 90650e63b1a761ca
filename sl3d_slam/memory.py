"""How much memory this process and the processes it started hold; 1 MB is 10^6 bytes."""

import ctypes
import os
import resource
import sys
from pathlib import Path

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h
LARGE_BYTES = 2_000_000  # the points of a scan take 3 MB; with 4 MB here a run holds 50 MB more
SPARE_BYTES = 32_000_000

_PROC = Path("/proc")


def keep_large_arrays_apart() -> None:
    """Have arrays of the size of a scan get pages of their own, which go back when they are freed.

    Left alone glibc takes larger and larger ones from its heap, where what stays lies between them:
    the heap grows in steps of tens of megabytes.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)  # not on macOS, not with musl
    if set_option is not None:
        set_option(M_MMAP_THRESHOLD, LARGE_BYTES)
        set_option(M_TRIM_THRESHOLD, SPARE_BYTES)


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
        return 1024 * _status_kb("self")["VmHWM"] / 1e6
    except OSError:
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else 1024 * peak / 1e6


def children_peak_mb() -> float:
    """Return the sum of the most that each running child has held of its own; 0 without /proc."""
    try:
        return sum(map(_private_peak_mb, _children()), 0.0)
    except OSError:
        return 0.0


def _private_peak_mb(process: int) -> float:
    kb = _status_kb(process)
    if "VmHWM" not in kb:  # it has ended and waits to be collected
        return 0.0
    return 1024 * (kb["VmHWM"] - kb["RssFile"] - kb["RssShmem"]) / 1e6


def _status_kb(process: int | str) -> dict[str, int]:
    rows = (_PROC / str(process) / "status").read_text(encoding="utf-8").splitlines()
    return {row.split(":")[0]: int(row.split()[1]) for row in rows if row.endswith(" kB")}


def _resident_mb(process: int) -> float:
    pages = int((_PROC / str(process) / "statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _private_mb(process: int) -> float:
    rows = (_PROC / str(process) / "smaps_rollup").read_text(encoding="ascii").splitlines()
    return sum(1024 * int(row.split()[1]) for row in rows if row.startswith("Private_")) / 1e6


def _children() -> list[int]:
    tasks = (_PROC / str(os.getpid()) / "task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text(encoding="ascii").split()]
