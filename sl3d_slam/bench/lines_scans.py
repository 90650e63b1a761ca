"""The scans of one drive as every method sees them, and what each did on a pair or a scan."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from sl3d_slam.bench.lines_agreement import TOP, agreeing_pairs, gaps_m, partner_ranks
from sl3d_slam.bench.lines_figures import PairCounts
from sl3d_slam.bench.lines_sight import Sight, is_seen, sight_of
from sl3d_slam.bench.pairs import random_turn
from sl3d_slam.bench.registration_figures import SUCCESS_DEG, SUCCESS_M
from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import (
    Points,
    Transform,
    distance_m,
    invert,
    rotation_angle_rad,
    transform_points,
)
from sl3d_slam.geometry.segments import transform_segments
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.matching.dense import align, coarse_cloud, prepare, thin
from sl3d_slam.registration import register_lines
from sl3d_slam.types import LineSet

CLOUD_VOXEL_M = 0.5
MAX_CORRECTION_M, MAX_CORRECTION_RAD = 2.0, np.radians(5.0)


@dataclass(frozen=True, slots=True, eq=False)
class SeenScan:
    """One scan: what can be seen in it, a coarse cloud, and the lines that each method found.

    ``used`` are those that are compared: as many of each method, its best by score.
    """

    sight: Sight
    cloud: Float32[np.ndarray, "N 3"]
    found: Mapping[str, LineSet]
    used: Mapping[str, LineSet]


def look(points_lidar: Points, extractors: Mapping[str, LineExtractor]) -> SeenScan:
    """Extract the lines of one scan by every method."""
    found = {name: extractor.extract(points_lidar) for name, extractor in extractors.items()}
    count = min((len(lines) for lines in found.values()), default=0)
    used = {name: best(lines, count) for name, lines in found.items()}
    return SeenScan(sight_of(points_lidar), coarse_cloud(points_lidar, CLOUD_VOXEL_M), found, used)


def best(lines: LineSet, count: int) -> LineSet:
    """Return the lines with the highest scores; of equal ones those that come first."""
    return lines.take(np.argsort(-lines.scores, kind="stable")[:count])


def read_points(drive: Dataset, index: int) -> Points:
    """Read one scan."""
    (scan,) = drive.iterate(index, index + 1)
    return scan.points_lidar


def look_at(
    drive: Dataset,
    indices: Iterable[int],
    extractors: Mapping[str, LineExtractor],
    step: Callable[[], None],
) -> dict[int, SeenScan]:
    """Extract the lines of the scans named, by every method."""
    scans = {}
    for index in sorted(set(indices)):
        scans[index] = look(read_points(drive, index), extractors)
        step()
    return scans


def refined(source: SeenScan, target: SeenScan, T_target_source: Transform) -> Transform:
    """Return a relative pose to centimetres, by GICP from a good one.

    GPS and odometry are off by decimetres over 30 m, more than lines are. An answer further than
    2 m or 5 degrees from the guess is not believed.
    """
    fixed, moving = prepare(target.cloud), thin(source.cloud)
    if fixed is None or moving is None:
        return T_target_source
    T_refined = align(fixed, moving, T_target_source).fit.T_target_source
    T_change = invert(T_target_source) @ T_refined
    near = distance_m(T_change) < MAX_CORRECTION_M
    return (
        T_refined if near and rotation_angle_rad(T_change) < MAX_CORRECTION_RAD else T_target_source
    )


def count_pair(
    source: SeenScan, target: SeenScan, method: str, T_target_source: Transform
) -> PairCounts:
    """Count what one method's lines of two scans have in common."""
    first, second = source.used[method], target.used[method]
    first_target = first.transformed(T_target_source)
    second_source = transform_segments(invert(T_target_source), second.endpoints)
    pairs = agreeing_pairs(gaps_m(first_target.endpoints, second.endpoints))
    seen = is_seen(target.sight, first_target.endpoints), is_seen(source.sight, second_source)
    ranks = np.concatenate(
        [
            partner_ranks(first.descriptors, second.descriptors, pairs),
            partner_ranks(second.descriptors, first.descriptors, pairs[:, ::-1]),
        ]
    )
    sizes = (len(first), len(second))
    return PairCounts(
        found=len(source.found[method]) + len(target.found[method]),
        used=sum(sizes),
        seen=float(seen[0].sum() + seen[1].sum()),
        again=float(seen[0][pairs[:, 0]].sum() + seen[1][pairs[:, 1]].sum()),
        matches=len(ranks),
        first=float((ranks <= 1).sum()),
        top=float((ranks <= TOP).sum()),
        chance_first=len(pairs) * sum(1.0 / max(size, 1) for size in sizes),
        chance_top=len(pairs) * sum(min(1.0, TOP / max(size, 1)) for size in sizes),
    )


def register(
    lines: tuple[LineSet, LineSet],
    points: tuple[Points, Points],
    T_target_source: Transform,
    config: SlamConfig,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Register a pair with clouds and by lines alone; 1 where within 2 m and 5 degrees.

    Both scans, lines and clouds, are turned about z at random first.
    """
    turns = random_turn(rng, True, 0.0), random_turn(rng, True, 0.0)
    source, target = lines[0].transformed(turns[0]), lines[1].transformed(turns[1])
    first, second = (
        np.ascontiguousarray(transform_points(T, part))
        for part, T in zip(points, turns, strict=True)
    )
    T_true = turns[1] @ T_target_source @ invert(turns[0])
    dense = register_lines(source, target, clouds=(first, second), settings=config.matching)
    alone = register_lines(source, target, settings=config.matching)
    return _is_right(dense.T_target_source, T_true), _is_right(alone.T_target_source, T_true)


def _is_right(T_answer: Transform | None, T_true: Transform) -> float:
    if T_answer is None:
        return 0.0
    T_error = invert(T_true) @ T_answer
    right = distance_m(T_error) <= SUCCESS_M
    return float(right and np.degrees(rotation_angle_rad(T_error)) <= SUCCESS_DEG)
