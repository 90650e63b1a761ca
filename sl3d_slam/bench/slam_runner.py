"""One SLAM system over one sequence, in a process of its own, so that memory is its own too.

A runner as :mod:`sl3d_slam.bench.process` describes it; a step is a scan.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.process import serve
from sl3d_slam.bench.systems import make_system
from sl3d_slam.config import SlamConfig
from sl3d_slam.memory import own_peak_mb, rss_mb
from sl3d_slam.types import LoopRecord

ARRAYS = "run.npz"


def run_task(tree: dict[str, Any], folder: Path, step: Callable[[], None]) -> dict[str, Any]:
    """Run the system, timing its own work only; arrays go to a file, the rest is returned."""
    config = SlamConfig.model_validate(tree["config"])
    system = make_system(tree["system"], config)
    drive = Drive(**tree["drive"])
    taken_ms, resident_mb = [], [rss_mb()]
    start_s = time.perf_counter()
    for scan in drive.stream(drive.open(config.input)):
        before_s = time.perf_counter()
        system.process(scan)
        taken_ms.append(1e3 * (time.perf_counter() - before_s))
        resident_mb.append(rss_mb())
        step()
    before_s = time.perf_counter()
    collect = system.finish()
    end_s = time.perf_counter()
    figures = {
        "finish_s": end_s - before_s,
        "wall_s": end_s - start_s,
        "peak_rss_mb": max(own_peak_mb(), *resident_mb),
        "start_rss_mb": resident_mb[0],
        "end_rss_mb": rss_mb(),
    }
    outcome = collect()
    np.savez(
        folder / ARRAYS,
        T_world_lidar=outcome.T_world_lidar,
        taken_ms=np.array(taken_ms),
        resident_mb=np.array(resident_mb[1:]),
    )
    loops = [asdict(loop) for loop in outcome.loops]
    return {"figures": figures, "map_bytes": outcome.map_bytes, "loops": loops}


def read_loops(tree: list[dict[str, Any]]) -> list[LoopRecord]:
    """Return loops as they were written to ``answer.json``."""
    return [
        LoopRecord(**(entry | {"T_target_query": np.array(entry["T_target_query"], np.float64)}))
        for entry in tree
    ]


if __name__ == "__main__":
    serve(Path(sys.argv[1]), run_task)
