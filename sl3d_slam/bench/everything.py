"""``sl3d bench all``: every benchmark once, on one simulated drive, with no data needed."""

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
from sl3d_slam.bench.tables import Table
from sl3d_slam.config import SlamConfig
from sl3d_slam.files import prepare_run_folder
from sl3d_slam.simulation.drive import plan_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town
from sl3d_slam.simulation.write import Layout, write_drive

Progress = Callable[[str, int], None]
EXTRACT_SCANS = 30


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is done: the road, the sensor, pairs at each distance, those distances.

    ``map_lines`` are the sizes of the maps that scans of ``map_towns`` towns are asked in.
    """

    road: str
    sensor: str
    num_pairs: int
    distances_m: tuple[float, ...]
    map_lines: tuple[int, ...]
    map_towns: int


QUICK = Extent("demo", "hdl32", 10, (10.0, 20.0), (1_000, 10_000), 1)
FULL = Extent("loop", "hdl64", 50, (10.0, 20.0, 30.0, 40.0), (10_000, 100_000), 3)
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
    extent = QUICK if quick else FULL
    prepare_run_folder(out)
    drive = _simulated(out / "data", extent, seed, progress)
    pairs = RegistrationBench(
        drives=[drive], distances_m=extent.distances_m, num_pairs=extent.num_pairs, seed=seed
    )
    return [
        slam.run(Comparison([drive], tuple(systems.PEERS)), out / "slam", command, progress),
        registration.run(pairs, make_plan(pairs), out / "registration", command, progress),
        loops.run(Comparison([drive], loop_detectors.PEERS), out / "loops", command, progress),
        *_lines(drive, extent, seed, out, command, progress),
        _relocalize(extent, seed, out, command, progress),
        *scale.run(out / "scale", quick, seed, command, progress),
        *_backend(quick, out, command, progress),
    ]


def _backend(quick: bool, out: Path, command: str, progress: Progress) -> list[Table]:
    extent = backend.QUICK if quick else backend.FULL
    return backend.run(out / "backend", extent, command=command, progress=progress)


def _lines(
    drive: Drive, extent: Extent, seed: int, out: Path, command: str, progress: Progress
) -> list[Table]:
    """Compare the line extractors; without trained weights the learned one's row says so."""
    methods = make_methods(KINDS, ())
    found = LinesBench([drive], methods, extent.distances_m, extent.num_pairs, 5, seed=seed)
    timed = extract.ExtractBench(methods, drives=[replace(drive, scans=EXTRACT_SCANS)])
    return [
        *lines.run(found, out / "lines", command, progress),
        *extract.run(timed, out / "extract", command, progress),
    ]


def _relocalize(extent: Extent, seed: int, out: Path, command: str, progress: Progress) -> Table:
    """Ask scans of another day in towns of their own, on the short road."""
    asked = relocalize.RelocalizeBench(
        extent.map_lines, extent.map_towns, TOWN_QUERIES, seed, "demo", extent.sensor, SlamConfig()
    )
    return relocalize.run(asked, out / "relocalize", command, progress)


def _simulated(root: Path, extent: Extent, seed: int, progress: Progress) -> Drive:
    """Return the drive, simulated where it is not there yet."""
    name = f"{extent.road}{seed}"
    layout = Layout(root, name)
    if not layout.folder.is_dir():
        planned = plan_drive(build_town(builtin_road(extent.road), seed), extent.sensor)
        write_drive(planned, layout, lambda: progress("simulating", 1))
    return Drive(str(root.resolve()), name)
