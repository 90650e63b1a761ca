"""One line extractor, or KISS-ICP, over scans, in a process of its own.

A runner as :mod:`sl3d_slam.bench.process` describes it; a step is a scan.
"""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.extract_stages import STAGES, Stopwatch
from sl3d_slam.bench.lines_plan import LineMethod, make_extractor
from sl3d_slam.bench.process import serve
from sl3d_slam.bench.systems import make_system
from sl3d_slam.config import SlamConfig
from sl3d_slam.io.open import read_scan
from sl3d_slam.memory import own_peak_mb
from sl3d_slam.types import Scan

WARM_UP_SCANS = 2
KISS_ICP = "kiss-icp"


def run_task(tree: dict[str, Any], folder: Path, step: Callable[[], None]) -> dict[str, Any]:
    """Time every scan, reading left out; the extractors do the first two twice, to compile."""
    config = SlamConfig.model_validate(tree["config"])
    watch = Stopwatch()
    if tree["kind"] == KISS_ICP:
        return {**_timed(make_system(KISS_ICP, config).process, tree, config, step), "lines": None}
    weights = None if tree["weights"] is None else Path(tree["weights"])
    extractor = make_extractor(LineMethod(tree["name"], tree["kind"], weights), config)
    for _, scan in zip(range(WARM_UP_SCANS), _scans(tree, config), strict=False):
        extractor.extract(scan.points_lidar)
    found: list[int] = []
    with watch.watching(STAGES[tree["kind"]]):
        times = _timed(
            lambda scan: found.append(len(extractor.extract(scan.points_lidar))), tree, config, step
        )
    stages_ms = {stage: 1e3 * s / max(len(found), 1) for stage, s in watch.taken_s.items()}
    return {**times, "lines": sum(found) / max(len(found), 1), "stages_ms": stages_ms}


def _timed(
    process: Callable[[Scan], None],
    tree: dict[str, Any],
    config: SlamConfig,
    step: Callable[[], None],
) -> dict[str, Any]:
    wall_ms, processor_ms, points = [], [], []
    for scan in _scans(tree, config):
        before_s, before_processor_s = time.perf_counter(), time.process_time()
        process(scan)
        processor_ms.append(1e3 * (time.process_time() - before_processor_s))
        wall_ms.append(1e3 * (time.perf_counter() - before_s))
        points.append(len(scan.points_lidar))
        step()
    return {
        "wall_ms": wall_ms,
        "processor_ms": processor_ms,
        "points": sum(points) / max(len(points), 1),
        "peak_mb": own_peak_mb(),
        "stages_ms": {},
    }


def _scans(tree: dict[str, Any], config: SlamConfig) -> Iterator[Scan]:
    for index, name in enumerate(tree["files"]):
        yield Scan(index, 0.1 * index, read_scan(Path(name), config.input))
    for entry in tree["drives"]:
        drive = Drive(**entry)
        yield from drive.stream(drive.open(config.input))


if __name__ == "__main__":
    serve(Path(sys.argv[1]), run_task)
