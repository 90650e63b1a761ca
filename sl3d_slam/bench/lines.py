"""``sl3d bench lines``: line extractors side by side on the same scans, with their spread."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from sl3d_slam.bench.lines_columns import COLUMNS, NOTES, TRUE_COLUMNS, TRUE_NOTES
from sl3d_slam.bench.lines_drive import DriveCounts, measure_drive
from sl3d_slam.bench.lines_figures import PairCounts, pair_figures, scan_figures
from sl3d_slam.bench.lines_pictures import draw_lines_bench
from sl3d_slam.bench.lines_plan import LinesBench, make_extractor
from sl3d_slam.bench.lines_truth import in_words
from sl3d_slam.bench.tables import Row, Table, write_tables
from sl3d_slam.errors import Sl3dError
from sl3d_slam.files import prepare_run_folder, write_whole
from sl3d_slam.lines.extract import LineExtractor

Progress = Callable[[str, int], None]


def run(
    bench: LinesBench,
    out: Path,
    command: str = "sl3d bench lines",
    progress: Progress = lambda note, steps: None,
) -> list[Table]:
    """Compare the methods; leave ``lines.csv``, ``.md`` and ``.png`` in ``out``.

    The second table, against true lines, is there where a drive has them. A method that cannot be
    had, such as a network without weights, has a row that says why.

    Raises
    ------
    InputError
        where a drive cannot be read or has no two scans so far apart.
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    extractors: dict[str, LineExtractor] = {}
    absent: dict[str, str] = {}
    for method in bench.methods:
        try:
            extractors[method.name] = make_extractor(method, bench.config)
        except Sl3dError as error:
            absent[method.name] = str(error)
    drives = [
        measure_drive(bench, number, extractors, progress) for number in range(len(bench.drives))
    ]
    missing = [{"drives": "all", "method": name, "status": why} for name, why in absent.items()]
    rows = [*_pair_rows(drives, list(extractors)), *missing]
    source = f"truth {bench.truth}, seed {bench.seed}"
    tables = [Table(f"Line extractors ({source})", COLUMNS, rows, NOTES)]
    if any(drive.scans for drive in drives):
        true_rows = [*_true_rows(drives), *missing]
        title = "Line extractors against true lines (simulated)"
        tables.append(Table(title, TRUE_COLUMNS, true_rows, TRUE_NOTES))
    write_tables(out, "lines", tables, command)
    write_whole(out / "lines.png", draw_lines_bench(rows))
    return tables


def _pair_rows(drives: Sequence[DriveCounts], methods: Sequence[str]) -> Iterator[Row]:
    """Give one row a drive, distance and method; then those of drives of a kind together."""
    for drive in drives:
        yield from _rows_of(drive.name, drive.simulated, drive.pairs, methods)
    for simulated in (False, True):
        kind = [drive for drive in drives if drive.simulated == simulated]
        if len(kind) > 1:
            name = f"all {len(kind)} {'simulated' if simulated else 'real'}"
            pooled: dict[tuple[float, str], list[PairCounts]] = {}
            for drive in kind:
                for key, counts in drive.pairs.items():
                    pooled.setdefault(key, []).extend(counts)
            yield from _rows_of(name, simulated, pooled, methods)


def _rows_of(
    name: str,
    simulated: bool,
    counts: Mapping[tuple[float, str], Sequence[PairCounts]],
    methods: Sequence[str],
) -> Iterator[Row]:
    for distance_m in sorted({distance_m for distance_m, _ in counts}):
        for method in methods:
            baseline = () if method == methods[0] else counts[distance_m, methods[0]]
            yield {
                "drives": name,
                "kind": "simulated" if simulated else "real",
                "distance": f"{distance_m:g} m",
                "method": method,
                "status": "ok",
                **pair_figures(counts[distance_m, method], baseline),
            }


def _true_rows(drives: Sequence[DriveCounts]) -> Iterator[Row]:
    for drive in drives:
        for method, counts in drive.scans.items():
            yield {
                "drives": drive.name,
                "method": method,
                "status": "ok",
                **scan_figures(counts),
                "false_on": in_words(drive.false_on[method]),
            }
