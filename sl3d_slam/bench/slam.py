"""``sl3d bench slam``: this package against kiss-slam and KISS-ICP on the same scans.

Every system runs in a process of its own, one after the other.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sl3d_slam.bench.drives import Comparison
from sl3d_slam.bench.slam_figures import COLUMNS, NOTES, accuracy, growth
from sl3d_slam.bench.slam_pictures import draw_bars, draw_paths, draw_series
from sl3d_slam.bench.slam_process import Answer, run_in_process
from sl3d_slam.bench.systems import OURS, PEERS
from sl3d_slam.bench.tables import Row, Table, write_tables
from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.io.dataset import Dataset

Progress = Callable[[str, int], None]


def run(
    bench: Comparison,
    out: Path,
    command: str = "sl3d bench slam",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Compare the systems; leave ``slam.csv``, ``.md`` and pictures in ``out``.

    ``progress(note, steps)`` is told of every ``steps`` scans done. A peer that is missing or
    fails has a row that says so.

    Raises
    ------
    InputError
        where a drive cannot be opened or a peer is not known.
    OutputError
        where ``out`` cannot be written.
    """
    bench.refuse_unknown_peers(PEERS)
    prepare_run_folder(out)
    rows: list[Row] = []
    for number, drive in enumerate(bench.drives):
        opened = drive.open(bench.config.input)
        truth = None if opened.truth is None else opened.truth[: drive.count(opened)]
        answers = {
            system: run_in_process(system, drive, bench.config, progress)
            for system in (OURS, *bench.peers)
        }
        rows += [_row(opened, name, answer, truth) for name, answer in answers.items()]
        title = f"{opened.name}{' (simulated)' if opened.simulated else ''}"
        name = f"slam_{number}_{opened.name.replace(' ', '_')}"
        write_whole(out / f"{name}_paths.png", draw_paths(answers, truth, title))
        write_whole(out / f"{name}_run.png", draw_series(answers, title))
    table = Table("SLAM systems side by side", COLUMNS, rows, NOTES)
    write_tables(out, "slam", [table], command)
    write_whole(out / "slam.png", draw_bars(rows))
    return table


def _row(opened: Dataset, system: str, answer: Answer, truth: np.ndarray | None) -> Row:
    row: Row = {
        "sequence": opened.name,
        "kind": "simulated" if opened.simulated else "real",
        "system": system,
        "status": answer.status,
    }
    if answer.series is None:
        return row
    poses = answer.series.T_world_lidar
    try:
        measured = accuracy(poses, answer.loops, truth)
    except InputError as error:
        measured = {"status": str(error)}
    count = len(answer.series.taken_ms)
    busy_s = 1e-3 * float(answer.series.taken_ms.sum()) + answer.figures["finish_s"]
    return {
        **row,
        **growth(answer.series.taken_ms, answer.series.resident_mb),
        **answer.figures,
        "ms_all": 1e3 * busy_s / count,
        "map_mb": None if answer.map_bytes is None else answer.map_bytes / 1e6,
        **measured,
    }
