"""One SLAM system over one sequence, in a process of its own, so that memory is its own too.

A runner as :mod:`sl3d_slam.bench.process` describes it; a step is a scan.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.memory import own_peak_mb, rss_mb
from sl3d_slam.bench.outback import out_and_back
from sl3d_slam.bench.process import serve
from sl3d_slam.bench.systems import make_system
from sl3d_slam.config import SlamConfig
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.open import open_dataset
from sl3d_slam.types import LoopRecord

ARRAYS = "run.npz"


@dataclass(frozen=True, slots=True)
class SlamTask:
    """What one process has to do; ``config`` is the content of a settings file."""

    system: str
    data: str
    dataset: str
    sequence: str | None
    scans: int | None
    out_and_back: bool
    config: dict[str, Any]

    def open(self) -> Dataset:
        """Open the sequence, cut and turned as the task says."""
        settings = SlamConfig.model_validate(self.config)
        opened = open_dataset(Path(self.data), settings.input, self.dataset, self.sequence)
        return out_and_back(opened, self.scans) if self.out_and_back else opened

    def num_scans(self, opened: Dataset) -> int:
        """Return how many scans are processed."""
        limited = None if self.out_and_back else self.scans
        return len(opened) if limited is None else min(limited, len(opened))


def run_task(tree: dict[str, Any], folder: Path, step: Callable[[], None]) -> dict[str, Any]:
    """Run the system, timing its own work only; arrays go to a file, the rest is returned."""
    task = SlamTask(**tree)
    system = make_system(task.system, SlamConfig.model_validate(task.config))
    opened = task.open()
    taken_ms, resident_mb = [], [rss_mb()]
    start_s = time.perf_counter()
    for scan in opened.iterate(0, task.num_scans(opened)):
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
