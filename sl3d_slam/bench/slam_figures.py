"""The figures of one system on one sequence, and how the table of ``bench slam`` shows them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.tables import Column
from sl3d_slam.errors import InputError
from sl3d_slam.report.metrics import Poses, TruePoses, ate_rmse_m, count_false_loops, kitti_errors
from sl3d_slam.types import LoopRecord

EARLY_SCAN = 500
WINDOW_SCANS = 500
SLOPE_SCANS = 2000
SLOPE_MIN_SCANS = 100

COLUMNS = (
    Column("sequence", "sequence"),
    Column("kind", "data", main=False),
    Column("system", "system"),
    Column("scans", "scans", "{:d}", main=False),
    Column("ate_m", "ATE m", "{:.2f}"),
    Column("translation_percent", "KITTI t %", "{:.2f}", main=False),
    Column("rotation_deg_per_100m", "KITTI r deg/100 m", "{:.2f}", main=False),
    Column("loops_accepted", "loops", "{:d}"),
    Column("loops_false", "false", "{:d}"),
    Column("ms_mean", "ms/scan", "{:.0f}", main=False),
    Column("ms_p99", "p99 ms", "{:.0f}", main=False),
    Column("ms_max", "max ms", "{:.0f}", main=False),
    Column("ms_growth", "late/early", "{:.2f}", main=False),
    Column("ms_all", "ms/scan with the end", "{:.0f}"),
    Column("wall_s", "wall s", "{:.0f}", main=False),
    Column("peak_rss_mb", "peak MB", "{:.0f}"),
    Column("end_rss_mb", "end MB", "{:.0f}", main=False),
    Column("rss_500_mb", "MB at 500", "{:.0f}", main=False),
    Column("rss_kb_per_scan", "kB/scan at the end", "{:.0f}", main=False),
    Column("map_mb", "map MB", "{:.2f}"),
    Column("status", "status"),
)
GROWTH_COLUMNS = (
    Column("sequence", "sequence"),
    Column("kind", "data", main=False),
    Column("scans", "scans", "{:d}"),
    Column("ms_mean", "ms/scan", "{:.0f}"),
    Column("ms_p99", "p99 ms", "{:.0f}", main=False),
    Column("ms_max", "max ms", "{:.0f}"),
    Column("ms_early", "early ms", "{:.0f}", main=False),
    Column("ms_late", "late ms", "{:.0f}", main=False),
    Column("ms_growth", "late/early", "{:.2f}"),
    Column("rss_500_mb", "MB at 500", "{:.0f}", main=False),
    Column("peak_rss_mb", "peak MB", "{:.0f}"),
    Column("rss_kb_per_scan", "kB/scan at the end", "{:.0f}"),
    Column("finish_s", "end s", "{:.1f}", main=False),
    Column("loops_accepted", "loops", "{:d}"),
    Column("status", "status"),
)
NOTES = (
    "ATE: RMSE of positions after rigid alignment. KITTI errors: over stretches of 100 to 800 m.",
    "False: accepted loops more than 2 m or 5 deg from the true relative pose. kiss-slam's loops "
    "join local maps of 100 m; each is judged between the scans in whose frames the two maps lie.",
    "ms/scan, p99, max: the system's own work on each scan, reading left out. 'With the end' adds "
    "the last optimisation and, for sl3d-slam, the building of its map, spread over the scans.",
    "Wall: the whole process, reading and start-up included; what sl3d-slam compiles in the first "
    "run on a machine is start-up.",
    "Late/early: mean time of the last 500 scans by that of scans 500 to 1,000.",
    "Memory: resident, of the process and its children, reader and libraries included.",
)


def accuracy(
    T_world_lidar: Poses, loops: Sequence[LoopRecord], truth: TruePoses | None
) -> dict[str, Any]:
    """Return ATE, KITTI errors and loop counts; what needs the truth is None where unknown.

    Raises
    ------
    InputError
        where a system left another number of poses than there are scans.
    """
    accepted = sum(loop.status == "accepted" for loop in loops)
    figures: dict[str, Any] = {"loops_accepted": accepted}
    if truth is None:
        return figures
    if not np.isfinite(T_world_lidar).all():
        raise InputError("the trajectory holds poses that are not finite")
    kitti = kitti_errors(T_world_lidar, truth)
    return figures | {
        "ate_m": ate_rmse_m(T_world_lidar, truth),
        "translation_percent": kitti[0] if kitti else None,
        "rotation_deg_per_100m": 100.0 * kitti[1] if kitti else None,
        "loops_false": count_false_loops(loops, truth),
    }


def growth(
    taken_ms: Float64[np.ndarray, "N"], resident_mb: Float64[np.ndarray, "M"]
) -> dict[str, Any]:
    """Return how time and memory went over the run.

    ``rss_kb_per_scan`` is the slope of a line through the memory of the last 2,000 scans or of the
    second half, whichever is shorter. ``ms_growth`` divides the mean time of the last 500 scans,
    ``ms_late``, by that of scans 500 to 1,000, ``ms_early``; None where the run is shorter than
    1,500 scans.
    """
    count = len(taken_ms)
    window = min(SLOPE_SCANS, count // 2)
    slope = None
    if window >= SLOPE_MIN_SCANS:
        slope = 1e3 * float(np.polyfit(np.arange(window), resident_mb[-window:], 1)[0])
    early_ms = late_ms = None
    if count >= EARLY_SCAN + 2 * WINDOW_SCANS:
        early_ms = float(taken_ms[EARLY_SCAN : EARLY_SCAN + WINDOW_SCANS].mean())
        late_ms = float(taken_ms[-WINDOW_SCANS:].mean())
    return {
        "scans": count,
        "ms_mean": float(taken_ms.mean()),
        "ms_p99": float(np.percentile(taken_ms, 99)),
        "ms_max": float(taken_ms.max()),
        "rss_500_mb": float(resident_mb[EARLY_SCAN]) if count > EARLY_SCAN else None,
        "rss_last_mb": float(resident_mb[-1]),
        "rss_kb_per_scan": slope,
        "ms_early": early_ms,
        "ms_late": late_ms,
        "ms_growth": late_ms / early_ms if early_ms and late_ms else None,
    }
