"""``sl3d bench growth``: one drive mapped to several lengths, time and memory over each run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.slam_figures import GROWTH_COLUMNS, growth
from sl3d_slam.bench.slam_pictures import draw_series
from sl3d_slam.bench.slam_process import Answer, run_in_process
from sl3d_slam.bench.systems import OURS
from sl3d_slam.bench.tables import Row, Table, write_tables
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.report.style import BLUE, GREEN, ORANGE, PURPLE, VERMILION

COLOURS = (GREEN, ORANGE, BLUE, VERMILION, PURPLE)
NOTES = (
    "Early and late: mean of scans 500 to 1,000 and of the last 500.",
    "kB/scan: slope of memory over the last 2,000 scans or the second half, what is shorter.",
    "Memory: resident, of the process and its children, reader and libraries included.",
)

Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True)
class GrowthBench:
    """What is mapped: the first so many scans of a drive, for each of the lengths."""

    drive: Drive
    lengths: Sequence[int]
    config: SlamConfig = field(default_factory=SlamConfig)

    def num_steps(self) -> int:
        """Return how many scans are processed in all. Raises InputError."""
        return sum(drive.count(drive.open(self.config.input)) for drive in self.drives())

    def drives(self) -> list[Drive]:
        """Return the drive cut to each length, shortest first."""
        return [replace(self.drive, scans=length) for length in sorted(self.lengths)]


def run(
    bench: GrowthBench,
    out: Path,
    command: str = "sl3d bench growth",
    progress: Progress = lambda note, steps: None,
) -> Table:
    """Map every length in a process of its own; leave ``growth.csv``, ``.md`` and a picture.

    Raises
    ------
    InputError
        where the drive cannot be opened, is shorter than the longest length, or there is no length.
    OutputError
        where ``out`` cannot be written.
    """
    opened = bench.drive.open(bench.config.input)
    if not bench.lengths or max(bench.lengths) > len(opened):
        raise InputError(
            f"{opened.name}: has {len(opened)} scans; expected lengths of at most so many"
        )
    prepare_run_folder(out)
    kind = "simulated" if opened.simulated else "real"
    answers: dict[str, Answer] = {}
    for drive in bench.drives():
        label = f"{drive.scans} scans"
        answers[label] = run_in_process(OURS, drive, bench.config, progress)
    rows = [
        {"sequence": opened.name, "kind": kind, **_figures(answer), "status": answer.status}
        for answer in answers.values()
    ]
    table = Table("Growth of time and memory", GROWTH_COLUMNS, rows, NOTES)
    write_tables(out, "growth", [table], command)
    colours = dict(zip(answers, COLOURS * len(answers), strict=False))
    write_whole(out / "growth.png", draw_series(answers, f"{opened.name} ({kind})", colours))
    return table


def _figures(answer: Answer) -> Row:
    if answer.series is None:
        return {}
    loops = sum(loop.status == "accepted" for loop in answer.loops)
    measured = growth(answer.series.taken_ms, answer.series.resident_mb)
    return {**measured, **answer.figures, "loops_accepted": loops}
