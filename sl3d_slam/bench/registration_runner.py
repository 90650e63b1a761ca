"""One peer, or both methods of ours, over a list of pairs, in a process of its own.

A runner as :mod:`sl3d_slam.bench.process` describes it; a step is a pair.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.pairs import ScanPair
from sl3d_slam.bench.process import serve
from sl3d_slam.bench.registration_methods import Attempt, Pairwise, make_methods
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points, transform_points
from sl3d_slam.io.dataset import Dataset

KEPT_SCANS = 16
WARM_UP_PAIRS = 2


def run_task(tree: dict[str, Any], folder: Path, step: Callable[[], None]) -> dict[str, Any]:
    """Register every pair; the first two are done twice, so that compiling is not timed."""
    config = SlamConfig.model_validate(tree["config"])
    methods = make_methods(tree["methods"], config, tree["seed"])
    pairs = [to_pair(entry) for entry in tree["pairs"]]
    drives = {int(key): Drive(**drive).open(config.input) for key, drive in tree["drives"].items()}
    read = _reader(drives)
    for pair in pairs[:WARM_UP_PAIRS]:
        attempt(methods, pair, read)
    attempts = []
    for pair in pairs:
        attempts.append([asdict(one) for one in attempt(methods, pair, read)])
        step()
    return {"attempts": attempts}


def attempt(methods: Pairwise, pair: ScanPair, read: Callable[[int, int], Points]) -> list[Attempt]:
    """Register one pair of turned scans by each method."""
    source = transform_points(pair.T_turned_source, read(pair.source_drive, pair.source))
    target = transform_points(pair.T_turned_target, read(pair.target_drive, pair.target))
    return methods(np.ascontiguousarray(source), np.ascontiguousarray(target))


def _reader(drives: dict[int, Dataset]) -> Callable[[int, int], Points]:
    @lru_cache(maxsize=KEPT_SCANS)
    def read(drive: int, index: int) -> Points:
        scans = list(drives[drive].iterate(index, index + 1))
        if not scans:
            count = len(drives[drive])
            raise InputError(f"{drives[drive].name}: no scan {index}; it has {count}")
        return scans[0].points_lidar

    return read


def to_pair(tree: dict[str, Any]) -> ScanPair:
    """Return a pair as it was written as JSON."""
    matrices = {
        key: None if value is None else np.array(value, np.float64)
        for key, value in tree.items()
        if key.startswith("T_")
    }
    return ScanPair(**{**tree, **matrices})


def to_attempts(trees: Sequence[dict[str, Any]]) -> list[Attempt]:
    """Return attempts as they were written as JSON."""
    return [
        Attempt(
            None if tree["T_target_source"] is None else np.array(tree["T_target_source"]),
            tree["extract_s"],
            tree["match_s"],
            tree["can_refuse"],
        )
        for tree in trees
    ]


if __name__ == "__main__":
    serve(Path(sys.argv[1]), run_task)
