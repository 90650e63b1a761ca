"""``sl3d bench all``: every benchmark once, on one simulated drive, with no data needed."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from sl3d_slam.bench import (
    backend,
    extract,
    lines,
    loop_detectors,
    loops,
    registration,
    relocalize,
    scale,
    slam,
    systems,
)
from sl3d_slam.bench.drives import Comparison, Drive
from sl3d_slam.bench.lines_plan import KINDS, LinesBench, make_methods
from sl3d_slam.bench.registration_plan import RegistrationBench, make_plan
from sl3d_slam.bench.tables import Column, Row, Table, write_tables
from sl3d_slam.config import SlamConfig
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive

Progress = Callable[[str, int], None]
EXTRACT_SCANS = 30
COLUMNS = (Column("benchmark", "benchmark"), Column("seconds", "s", "{:.0f}"))


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is done: the road, the sensor, pairs at each distance, those distances.

    ``peer_pairs`` are those that peers register, where not all: Open3D's take up to 12 s each.
    ``map_lines`` are the sizes of the maps that scans of ``map_towns`` towns are asked in.
    """

    road: str
    sensor: str
    num_pairs: int
    peer_pairs: int | None
    distances_m: tuple[float, ...]
    map_lines: tuple[int, ...]
    map_towns: int


QUICK = Extent("demo", "hdl32", 10, 3, (10.0, 20.0), (1_000, 10_000), 1)
FULL = Extent("loop", "hdl64", 50, None, (10.0, 20.0, 30.0, 40.0), (10_000, 100_000), 3)
TOWN_QUERIES = 20


def run(
    out: Path,
    quick: bool,
    seed: int = 0,
    command: str = "sl3d bench all",
    progress: Progress = lambda note, steps: None,
) -> list[Table]:
    """Simulate a drive into ``out/data`` where it is not yet, and run every benchmark on it.

    Each benchmark gets a folder of its own in ``out``. ``quick`` takes a small town, so that local
    maps of 100 m, which MapClosures and kiss-slam need for a loop, hardly occur.

    Raises
    ------
    OutputError
        where ``out`` cannot be written.
    """
    prepare_run_folder(out)
    tables: list[Table] = []
    taken: list[Row] = []
    for name, measure in _parts(out, quick, seed, command, progress).items():
        start_s = time.perf_counter()
        tables += measure()
        taken.append({"benchmark": name, "seconds": time.perf_counter() - start_s})
        write_tables(out, "all", [Table("What each benchmark took", COLUMNS, taken)], command)
    return tables


def _parts(
    out: Path, quick: bool, seed: int, command: str, progress: Progress
) -> dict[str, Callable[[], list[Table]]]:
    """Return the benchmarks by name, in their order; the simulation of the drive is the first."""
    extent = QUICK if quick else FULL
    drive = Drive(str((out / "data").resolve()), f"{extent.road}{seed}")
    methods = make_methods(KINDS, ())
    told = (command, progress)

    def simulation() -> list[Table]:
        _simulate(drive, extent, seed, progress)
        return []

    def registered() -> list[Table]:
        pairs = RegistrationBench(
            drives=[drive],
            distances_m=extent.distances_m,
            num_pairs=extent.num_pairs,
            seed=seed,
            peer_pairs=extent.peer_pairs,
        )
        return [registration.run(pairs, make_plan(pairs), out / "registration", *told)]

    def line_sets() -> list[Table]:
        found = LinesBench([drive], methods, extent.distances_m, extent.num_pairs, 5, seed=seed)
        return lines.run(found, out / "lines", *told)

    def extracted() -> list[Table]:
        timed = extract.ExtractBench(methods, drives=[replace(drive, scans=EXTRACT_SCANS)])
        return extract.run(timed, out / "extract", *told)

    def relocalized() -> list[Table]:
        asked = relocalize.RelocalizeBench(
            extent.map_lines,
            extent.map_towns,
            TOWN_QUERIES,
            seed,
            "demo",
            extent.sensor,
            SlamConfig(),
        )
        return [relocalize.run(asked, out / "relocalize", *told)]

    def back_ends() -> list[Table]:
        size = backend.QUICK if quick else backend.FULL
        return backend.run(out / "backend", size, command=command, progress=progress)

    of_drive = Comparison([drive], tuple(systems.PEERS))
    of_loops = Comparison([drive], loop_detectors.PEERS)
    return {
        "simulation": simulation,
        "slam": lambda: [slam.run(of_drive, out / "slam", *told)],
        "registration": registered,
        "loops": lambda: [loops.run(of_loops, out / "loops", *told)],
        "lines": line_sets,
        "extract": extracted,
        "relocalize": relocalized,
        "scale": lambda: scale.run(out / "scale", quick, seed, *told),
        "backend": back_ends,
    }


def _simulate(drive: Drive, extent: Extent, seed: int, progress: Progress) -> None:
    """Simulate the drive where it is not there yet."""
    layout = Layout(Path(drive.data), str(drive.sequence))
    if not layout.folder.is_dir():
        planned = plan_drive(build_town(builtin_road(extent.road), seed), extent.sensor)
        write_drive(planned, layout, lambda: progress("simulating", 1))
