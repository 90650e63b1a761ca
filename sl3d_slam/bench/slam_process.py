"""Starting a benchmark's process, watching it, and taking what it leaves."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from sl3d_slam.bench.slam_runner import ANSWER, ARRAYS, PROGRESS, TASK, SlamTask, read_loops
from sl3d_slam.types import LoopRecord

POLL_S = 0.2
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


def run_in_process(task: SlamTask, progress: Callable[[str, int], None]) -> Answer:
    """Run one task in a new Python process and wait for it."""
    with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as name:
        folder = Path(name)
        (folder / TASK).write_text(json.dumps(asdict(task)), encoding="utf-8")
        start_s = time.perf_counter()
        status, log = _run(folder, lambda steps: progress(task.system, steps))
        wall_s = time.perf_counter() - start_s
        return read_answer(folder, status, log, wall_s)


def _run(folder: Path, progress: Callable[[int], None]) -> tuple[int, str]:
    """Return exit status and log."""
    done = 0
    with (folder / "log").open("w+", encoding="utf-8", errors="replace") as log:
        command = [sys.executable, "-m", RUNNER, str(folder)]
        with subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT) as process:
            try:
                while process.poll() is None:
                    time.sleep(POLL_S)
                    done = _report(folder / PROGRESS, done, progress)
            except BaseException:
                process.kill()
                raise
        _report(folder / PROGRESS, done, progress)
        log.seek(0)
        return process.returncode, log.read()


def _report(path: Path, done: int, progress: Callable[[int], None]) -> int:
    now = path.stat().st_size if path.exists() else 0
    if now > done:
        progress(now - done)
    return now


def read_answer(folder: Path, exit_status: int, log: str, wall_s: float) -> Answer:
    """Return what a process left; one that died is named with its last words."""
    path = folder / ANSWER
    if exit_status != 0 or not path.is_file():
        lines = [line.strip() for line in log.splitlines() if line.strip()]
        last = lines[-1][:200] if lines else "it said nothing"
        how = f"killed by signal {-exit_status}" if exit_status < 0 else f"status {exit_status}"
        return Answer(f"failed ({how}): {last}")
    tree: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if "error" in tree:
        return Answer(str(tree["error"]))
    with np.load(folder / ARRAYS, allow_pickle=False) as arrays:
        series = Series(*(arrays[name] for name in ("T_world_lidar", "taken_ms", "resident_mb")))
    figures = {**tree["figures"], "loop_s": tree["figures"]["wall_s"], "wall_s": wall_s}
    return Answer("ok", series, read_loops(tree["loops"]), figures, tree["map_bytes"])
