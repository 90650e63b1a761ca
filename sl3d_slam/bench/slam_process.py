"""One system on one drive in a process of its own, and what it leaves."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.process import run_runner
from sl3d_slam.bench.slam_runner import ARRAYS, read_loops
from sl3d_slam.config import SlamConfig
from sl3d_slam.types import LoopRecord

RUNNER = "sl3d_slam.bench.slam_runner"


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """What a run left for each scan."""

    T_world_lidar: Float64[np.ndarray, "P 4 4"]
    taken_ms: Float64[np.ndarray, "N"]
    resident_mb: Float64[np.ndarray, "N"]


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What came of one process; ``status`` is ``ok`` or says what went wrong."""

    status: str
    series: Series | None = None
    loops: Sequence[LoopRecord] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    map_bytes: int | None = None


def run_in_process(
    system: str, drive: Drive, config: SlamConfig, progress: Callable[[str, int], None]
) -> Answer:
    """Run one system over a drive in a new Python process and wait for it."""
    task = {"system": system, "drive": asdict(drive), "config": config.model_dump()}
    with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as name:
        folder = Path(name)
        end = run_runner(RUNNER, folder, task, lambda steps: progress(system, steps))
        if end.problem:
            return Answer(end.problem)
        with np.load(folder / ARRAYS, allow_pickle=False) as arrays:
            names = ("T_world_lidar", "taken_ms", "resident_mb")
            series = Series(*(arrays[name] for name in names))
    tree = end.answer
    figures = {**tree["figures"], "loop_s": tree["figures"]["wall_s"], "wall_s": end.wall_s}
    return Answer("ok", series, read_loops(tree["loops"]), figures, tree["map_bytes"])
