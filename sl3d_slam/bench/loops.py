"""``sl3d bench loops``: which revisits are recognised, against MapClosures."""

import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from sl3d_slam.bench.drives import Comparison, Drive
from sl3d_slam.bench.loop_detectors import PEERS, Detection
from sl3d_slam.bench.loop_figures import COLUMNS, FALSE_COLUMNS, NOTES, Curve, false_ones, judge
from sl3d_slam.bench.loop_pictures import draw_curves
from sl3d_slam.bench.loop_revisits import find_revisits, that_overlap
from sl3d_slam.bench.loop_runner import to_detections
from sl3d_slam.bench.process import run_runner
from sl3d_slam.bench.systems import OURS
from sl3d_slam.bench.tables import Row, Table, write_tables
from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole

RUNNER = "sl3d_slam.bench.loop_runner"

Progress = Callable[[str, int], None]


def run(
    bench: Comparison,
    out: Path,
    command: str = "sl3d bench loops",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Detect loops on every drive; leave ``loops.csv``, ``.md`` and a picture for each drive.

    Raises
    ------
    InputError
        where a drive cannot be opened or has no true poses, or a peer is not known.
    OutputError
        where ``out`` cannot be written.
    """
    bench.refuse_unknown_peers(PEERS)
    prepare_run_folder(out)
    rows: list[Row] = []
    wrong: list[Row] = []
    for number, drive in enumerate(bench.drives):
        opened = drive.open(bench.config.input)
        if opened.truth is None:
            raise InputError(f"{opened.name}: has no true poses to judge loops by")
        truth = opened.truth[: drive.count(opened)]
        revisits = that_overlap(find_revisits(truth), drive.stream(opened), truth)
        kind = "simulated" if opened.simulated else "real"
        curves: dict[str, dict[str, Curve]] = {}
        for detector in (OURS, *bench.peers):
            head = {"sequence": opened.name, "kind": kind, "detector": detector}
            status, wall_s, found = _detections(bench, drive, detector, progress)
            if status != "ok":
                rows.append({**head, "status": status})
                continue
            figures, curves[detector] = judge(found, truth, revisits)
            wrong += [{**head, **row} for row in false_ones(found, truth)]
            rows += [{**head, **row, "wall_s": wall_s, "status": status} for row in figures]
        name = f"loops_{number}_{opened.name.replace(' ', '_')}.png"
        write_whole(out / name, draw_curves(curves, f"Loops of {opened.name} ({kind})"))
    table = Table("Loops that are recognised", COLUMNS, rows, NOTES)
    listed = Table("False detections that were accepted", FALSE_COLUMNS, wrong)
    write_tables(out, "loops", [table, listed], command)
    return table


def _detections(
    bench: Comparison, drive: Drive, detector: str, progress: Progress
) -> tuple[str, float, list[Detection]]:
    task = {
        "detector": detector,
        "config": bench.config.model_dump(),
        "drive": asdict(drive),
    }
    with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as folder:
        end = run_runner(RUNNER, Path(folder), task, lambda steps: progress(detector, steps))
    if end.problem:
        return end.problem, end.wall_s, []
    return "ok", end.wall_s, to_detections(end.answer["detections"])
