"""``bench lines`` on one drive: extract, pair up, count."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from sl3d_slam.bench.lines_figures import PairCounts, ScanCounts
from sl3d_slam.bench.lines_plan import LinesBench, PlannedPair, choose
from sl3d_slam.bench.lines_scans import (
    SeenScan,
    count_pair,
    look_at,
    read_points,
    refined,
    register,
)
from sl3d_slam.bench.lines_truth import TrueTown, count_scan, false_ones_on, open_truth
from sl3d_slam.bench.registration_plan import poses_of
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.lines.extract import LineExtractor

Extractors = Mapping[str, LineExtractor]
Progress = Callable[[str, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class DriveCounts:
    """What every method did on one drive: by distance and method, and against true lines."""

    name: str
    simulated: bool
    pairs: dict[tuple[float, str], list[PairCounts]] = field(
        default_factory=lambda: defaultdict(list)
    )
    scans: dict[str, list[ScanCounts]] = field(default_factory=lambda: defaultdict(list))
    false_on: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))


def measure_drive(
    bench: LinesBench, number: int, extractors: Extractors, progress: Progress
) -> DriveCounts:
    """Count what every method does on the drive of that number.

    Raises
    ------
    InputError
        where the drive cannot be read or no two scans are so far apart.
    """
    drive = bench.drives[number]
    opened = drive.open(bench.config.input)
    progress(f"{opened.name}: poses", 0)
    poses = poses_of(opened, bench.truth, bench.config)[: drive.count(opened)]
    groups = choose(bench, poses, number)
    if not groups:
        raise InputError(f"{opened.name}: no two of its scans are as far apart as --distances says")
    indices = {k for group in groups.values() for pair in group for k in (pair.source, pair.target)}
    scans = look_at(opened, indices, extractors, lambda: progress(f"{opened.name}: lines", 1))
    counts = DriveCounts(opened.name, opened.simulated)
    for distance_m, group in groups.items():
        for pair in group:
            both = scans[pair.source], scans[pair.target]
            T_target_source = invert(poses[pair.target]) @ poses[pair.source]
            if not opened.simulated:
                T_target_source = refined(*both, T_target_source)
            for method in extractors:
                counted = count_pair(*both, method, T_target_source)
                counts.pairs[distance_m, method].append(counted)
            if pair.registered:
                tried = _register(opened, pair, both, T_target_source, bench)
                for method, right in tried.items():
                    done = counts.pairs[distance_m, method]
                    done[-1] = done[-1]._replace(tried=1.0, dense=right[0], alone=right[1])
            progress(f"{opened.name}: pairs", 1)
    _measure_truth(open_truth(drive), scans, counts)
    return counts


def _register(
    opened: Dataset,
    pair: PlannedPair,
    both: tuple[SeenScan, SeenScan],
    T_target_source: Transform,
    bench: LinesBench,
) -> dict[str, tuple[float, float]]:
    """Register the pair by the lines of every method, turned alike."""
    points = read_points(opened, pair.source), read_points(opened, pair.target)
    return {
        method: register(
            (both[0].found[method], both[1].found[method]),
            points,
            T_target_source,
            bench.config,
            np.random.default_rng([bench.seed, pair.source, pair.target]),
        )
        for method in both[0].found
    }


def _measure_truth(
    town: TrueTown | None, scans: Mapping[int, SeenScan], counts: DriveCounts
) -> None:
    if town is None:
        return
    for index, scan in scans.items():
        truth = town.at(index)
        for method, found in scan.found.items():
            counts.scans[method].append(count_scan(truth, scan.used[method], found))
            counts.false_on[method].update(false_ones_on(truth, scan.used[method]))
