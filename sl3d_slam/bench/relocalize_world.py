"""The towns of the relocalization benchmark: mapped on one day, asked about on another."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import Transform, distance_m, from_yaw, invert, transform_points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.matching.views import make_view
from sl3d_slam.simulation.drive import Drive, plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town

OTHER_TOWN = 5000  # added to a seed: a town that is in no map


class Query(NamedTuple):
    """A file with a scan, ``points`` and ``T_town_lidar``, and the town's number; -1 for none."""

    path: Path
    town: int


def map_town(
    road: str, seed: int, sensor: str, config: SlamConfig, step: Callable[[], None]
) -> LineMap:
    """Map a town from scans at their true poses, in the town's frame: as good as SLAM can get."""
    drive = plan_drive(build_town(builtin_road(road), seed), sensor)
    chosen = _keyframes(drive, config.keyframes.min_distance_m)
    extractor = LineExtractor(config.lines)
    views = []
    for scan in simulate_drive(drive, chosen):
        lines = extractor.extract(scan.points_lidar)
        views.append(make_view(scan.points_lidar, lines, config.matching.cloud_voxel_m))
        step()
    return LineMap.build(
        [view.lines for view in views],
        drive.T_town_lidar[chosen],
        np.array([view.up for view in views]),
        [view.cloud for view in views],
        config.map,
        MapOrigin(model=extractor.model, simulated=True),
    )


def write_queries(
    folder: Path, road: str, seed: int, town: int, count: int, sensor: str
) -> list[Query]:
    """Write scans of another day, every second one driven the other way, each turned at random."""
    built = build_town(builtin_road(road), seed)
    rng = np.random.default_rng([seed, 77])
    queries = []
    for direction, share in (("forward", (count + 1) // 2), ("reverse", count // 2)):
        drive = plan_drive(built, sensor, 1, direction)  # type: ignore[arg-type]
        chosen = np.linspace(5, len(drive) - 5, share).astype(int).tolist()
        for index, scan in zip(chosen, simulate_drive(drive, chosen), strict=True):
            T_turned_lidar = from_yaw(rng.uniform(-np.pi, np.pi), np.zeros(3))
            path = folder / f"{town}_{direction}_{index:06d}.npz"
            np.savez(
                path,
                points=transform_points(T_turned_lidar, scan.points_lidar).astype(np.float32),
                T_town_lidar=drive.T_town_lidar[index] @ invert(T_turned_lidar),
            )
            queries.append(Query(path, town))
    return queries


def read_query(path: Path) -> tuple[np.ndarray, Transform]:
    """Return the points and the true pose in the town."""
    with np.load(path, allow_pickle=False) as content:
        return content["points"].astype(np.float64), content["T_town_lidar"]


def _keyframes(drive: Drive, distance: float) -> list[int]:
    chosen = [0]
    for k in range(1, len(drive)):
        T_last_lidar = invert(drive.T_town_lidar[chosen[-1]]) @ drive.T_town_lidar[k]
        if distance_m(T_last_lidar) >= distance:
            chosen.append(k)
    return chosen
