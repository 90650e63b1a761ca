"""``sl3d bench extract``: what extracting the lines of a scan costs, stage by stage."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.extract_runner import KISS_ICP
from sl3d_slam.bench.lines_plan import LineMethod
from sl3d_slam.bench.process import run_runner
from sl3d_slam.bench.tables import Column, Row, Table, write_tables
from sl3d_slam.config import SlamConfig
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.report.style import (
    GREY,
    colour_of,
    new_figure,
    picture_style,
    style_axes,
    to_png,
)

RUNNER = "sl3d_slam.bench.extract_runner"
COLUMNS = (
    Column("method", "method"),
    Column("num_scans", "scans", "{:d}", main=False),
    Column("points", "points", "{:.0f}", main=False),
    Column("lines", "lines/scan", "{:.0f}"),
    Column("processor_ms", "processor ms", "{:.0f}"),
    Column("processor_ms_p99", "p99", "{:.0f}"),
    Column("wall_ms", "wall ms", "{:.0f}"),
    Column("wall_ms_p99", "p99", "{:.0f}"),
    Column("times_kiss_icp", "x KISS-ICP", "{:.2f}"),
    Column("peak_mb", "peak MB", "{:.0f}"),
    Column("status", "status"),
)
STAGE_COLUMNS = (
    Column("method", "method"),
    Column("stage", "stage"),
    Column("processor_ms", "processor ms", "{:.1f}"),
    Column("share_percent", "%", "{:.0f}"),
)
NOTES = (
    "Each method has a process of its own; reading is left out; extractors do two scans before the "
    "clock starts. Processor ms: of all threads together, which other load changes less than wall "
    "ms. Threads that wait for each other on a loaded machine count, though: with "
    "NUMBA_NUM_THREADS=1 they do not.",
    "x KISS-ICP: processor time of a scan over that of KISS-ICP on the same scans in this run.",
    "Peak: everything that the process holds, Python and its libraries with it.",
)
STAGE_NOTES = ("Mean of a scan. 'rest' is what lies between the stages.",)

Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True)
class ExtractBench:
    """What is timed: extractors, on single scan files and on drives."""

    methods: Sequence[LineMethod]
    files: Sequence[Path] = ()
    drives: Sequence[Drive] = ()
    config: SlamConfig = field(default_factory=SlamConfig)

    def num_steps(self) -> int:
        """Return how many scans all methods together will process. Raises InputError."""
        counts = [drive.count(drive.open(self.config.input)) for drive in self.drives]
        return (len(self.files) + sum(counts)) * (len(self.methods) + 1)


def run(
    bench: ExtractBench,
    out: Path,
    command: str = "sl3d bench extract",
    progress: Progress = lambda note, steps: None,
) -> list[Table]:
    """Time every method and KISS-ICP; leave ``extract.csv``, ``.md`` and ``.png`` in ``out``.

    A method that cannot be had has a row that says why.

    Raises
    ------
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    rows: list[dict[str, Any]] = []
    stages: list[Row] = []
    for method in (*bench.methods, LineMethod(KISS_ICP, KISS_ICP)):
        task = {
            "name": method.name,
            "kind": method.kind,
            "weights": None if method.weights is None else str(method.weights.resolve()),
            "files": [str(path.resolve()) for path in bench.files],
            "drives": [asdict(drive) for drive in bench.drives],
            "config": bench.config.model_dump(),
        }
        with tempfile.TemporaryDirectory(prefix="sl3d_bench_") as folder:
            end = run_runner(RUNNER, Path(folder), task, partial(progress, method.name))
        rows.append({"method": method.name, "status": end.problem or "ok"})
        if not end.problem:
            rows[-1] |= _times(end.answer)
            stages += _stage_rows(method.name, end.answer, rows[-1]["processor_ms"])
    tables = [
        Table("Line extraction, a scan", COLUMNS, compared(rows), NOTES),
        Table("Its stages", STAGE_COLUMNS, stages, STAGE_NOTES),
    ]
    write_tables(out, "extract", tables, command)
    write_whole(out / "extract.png", draw_stages(tables[0].rows, stages))
    return tables


def compared(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Return the rows with each method's processor time over KISS-ICP's, where that was had."""
    kiss_ms = next((row.get("processor_ms") for row in rows if row["method"] == KISS_ICP), None)
    return [
        {**row, "times_kiss_icp": row["processor_ms"] / kiss_ms}
        if kiss_ms and "processor_ms" in row
        else row
        for row in rows
    ]


def _times(answer: Mapping[str, Any]) -> dict[str, Any]:
    wall_ms, processor_ms = np.array(answer["wall_ms"]), np.array(answer["processor_ms"])
    return {
        "num_scans": len(wall_ms),
        "points": answer["points"],
        "lines": answer["lines"],
        "processor_ms": float(processor_ms.mean()),
        "processor_ms_p99": float(np.percentile(processor_ms, 99)),
        "wall_ms": float(wall_ms.mean()),
        "wall_ms_p99": float(np.percentile(wall_ms, 99)),
        "peak_mb": answer["peak_mb"],
    }


def _stage_rows(method: str, answer: Mapping[str, Any], total_ms: float) -> list[Row]:
    stages_ms: dict[str, float] = answer["stages_ms"]
    if not stages_ms:
        return []
    rest_ms = total_ms - sum(stages_ms.values())
    return [
        {"method": method, "stage": stage, "processor_ms": ms, "share_percent": 100 * ms / total_ms}
        for stage, ms in [*stages_ms.items(), ("rest", rest_ms)]
    ]


def draw_stages(rows: Sequence[Row], stages: Sequence[Row]) -> bytes:
    """Return a PNG: processor time of a scan, a bar a method, its stages side by side."""
    known = [row for row in rows if "processor_ms" in row]
    names = list(dict.fromkeys(row["stage"] for row in stages))
    with picture_style():
        figure = new_figure(11.0, 1.2 + 0.7 * max(len(known), 1), "Line extraction of a scan")
        axes = figure.subplots()
        for place, row in enumerate(known):
            left = 0.0
            own = [stage for stage in stages if stage["method"] == row["method"]]
            for stage in own:
                colour = colour_of(names.index(stage["stage"]))
                axes.barh(place, stage["processor_ms"], left=left, color=colour)
                left += stage["processor_ms"]
            if not own:
                axes.barh(place, row["processor_ms"], color=GREY)
        for number, name in enumerate(names):
            axes.barh(0, 0.0, color=colour_of(number), label=name)
        axes.set_yticks(range(len(known)), [row["method"] for row in known])
        axes.invert_yaxis()
        axes.set_xlabel("processor ms, mean of a scan")
        style_axes(axes)
        if names:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        return to_png(figure)
