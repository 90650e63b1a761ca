"""One SLAM system over one sequence, in a process of its own, so that memory is its own too.

Run as ``python -m sl3d_slam.bench.slam_runner FOLDER``: reads ``task.json`` there, leaves
``answer.json`` and ``run.npz``, and adds a byte a scan to ``progress``.
"""

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.memory import own_peak_mb, rss_mb
from sl3d_slam.bench.outback import out_and_back
from sl3d_slam.bench.systems import Outcome, make_system
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import Sl3dError
from sl3d_slam.files import write_whole
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.json_files import write_json
from sl3d_slam.io.open import open_dataset
from sl3d_slam.types import LoopRecord

TASK, ANSWER, ARRAYS, PROGRESS = "task.json", "answer.json", "run.npz", "progress"


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


def run_task(task: SlamTask, folder: Path) -> None:
    """Run the system, timing its own work only, and leave the answer in ``folder``."""
    system = make_system(task.system, SlamConfig.model_validate(task.config))
    opened = task.open()
    taken_ms, resident_mb = [], [rss_mb()]
    start_s = time.perf_counter()
    with (folder / PROGRESS).open("ab", buffering=0) as progress:
        for scan in opened.iterate(0, task.num_scans(opened)):
            before_s = time.perf_counter()
            system.process(scan)
            taken_ms.append(1e3 * (time.perf_counter() - before_s))
            resident_mb.append(rss_mb())
            progress.write(b".")
    before_s = time.perf_counter()
    collect = system.finish()
    end_s = time.perf_counter()
    times = {"finish_s": end_s - before_s, "wall_s": end_s - start_s}
    memory = {
        "peak_rss_mb": max(own_peak_mb(), *resident_mb),
        "start_rss_mb": resident_mb[0],
        "end_rss_mb": rss_mb(),
    }
    _write(folder, collect(), times | memory, (taken_ms, resident_mb[1:]))


def _write(
    folder: Path,
    outcome: Outcome,
    figures: dict[str, float],
    series: tuple[list[float], list[float]],
) -> None:
    np.savez(
        folder / ARRAYS,
        T_world_lidar=outcome.T_world_lidar,
        taken_ms=np.array(series[0]),
        resident_mb=np.array(series[1]),
    )
    loops = [
        asdict(loop) | {"T_target_query": loop.T_target_query.tolist()} for loop in outcome.loops
    ]
    tree = {"figures": figures, "map_bytes": outcome.map_bytes, "loops": loops}
    write_json(folder / ANSWER, tree)


def read_loops(tree: list[dict[str, Any]]) -> list[LoopRecord]:
    """Return loops as they were written to ``answer.json``."""
    return [
        LoopRecord(**(entry | {"T_target_query": np.array(entry["T_target_query"], np.float64)}))
        for entry in tree
    ]


def main(folder: Path) -> None:
    """Do the task in a folder; an error that a user can act on becomes the answer."""
    task = SlamTask(**json.loads((folder / TASK).read_text(encoding="utf-8")))
    try:
        run_task(task, folder)
    except Sl3dError as error:
        write_whole(folder / ANSWER, json.dumps({"error": str(error)}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
