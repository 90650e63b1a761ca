"""One loop detector over one drive, in a process of its own.

A runner as :mod:`sl3d_slam.bench.process` describes it; a step is a scan.
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.loop_detectors import Detection, detect
from sl3d_slam.bench.process import serve
from sl3d_slam.config import SlamConfig
from sl3d_slam.types import Scan


def run_task(tree: dict[str, Any], folder: Path, step: Callable[[], None]) -> dict[str, Any]:
    """Run the detector over the scans."""
    config = SlamConfig.model_validate(tree["config"])
    drive = Drive(**tree["drive"])
    scans = _counted(drive.stream(drive.open(config.input)), step)
    return {"detections": [asdict(found) for found in detect(tree["detector"], config, scans)]}


def _counted(scans: Iterable[Scan], step: Callable[[], None]) -> Iterator[Scan]:
    for scan in scans:
        yield scan
        step()


def to_detections(trees: list[dict[str, Any]]) -> list[Detection]:
    """Return detections as they were written as JSON."""
    return [
        Detection(
            **{
                **tree,
                "query_scans": tuple(tree["query_scans"]),
                "target_scans": tuple(tree["target_scans"]),
                "T_target_query": np.array(tree["T_target_query"], np.float64),
            }
        )
        for tree in trees
    ]


if __name__ == "__main__":
    serve(Path(sys.argv[1]), run_task)
