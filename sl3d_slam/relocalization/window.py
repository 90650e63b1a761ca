"""A short run of scans joined to one view: more sides of everything, seen from the last pose."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points, invert, transform_points
from sl3d_slam.lines.extract import LineExtractor, checked_points
from sl3d_slam.mapping.build import group_observations, observations_of
from sl3d_slam.mapping.landmarks import mean_lines
from sl3d_slam.matching.views import make_view
from sl3d_slam.odometry.odometry import Odometry
from sl3d_slam.types import LineSet, Scan, View

MIN_STEP_M = 0.5


def join_scans(scans: Sequence[np.ndarray], extractor: LineExtractor, config: SlamConfig) -> View:
    """Return one view of consecutive scans (N, 3), metres, in the lidar frame of the last.

    Odometry brings the scans together; one that hardly moved on from the one before it is left
    out, the last never. Lines seen several times count once, where most of them lie.

    Raises
    ------
    InputError
        where there is no scan, or one is no (N, 3) of finite floats.
    """
    if not scans:
        raise InputError("a window of scans needs at least one scan")
    clouds = [checked_points(scan) for scan in scans]
    if len(clouds) == 1:
        lines = extractor.extract(clouds[0])
        return make_view(clouds[0], lines, config.matching.cloud_voxel_m)
    T_last_scan = _odometry(clouds, config)
    kept = _spread(T_last_scan[:, :3, 3])
    found = [extractor.extract(clouds[k]) for k in kept]
    points = [transform_points(T_last_scan[k], clouds[k]) for k in kept]
    joined = make_view(np.concatenate(points[::-1]), found[-1], config.matching.cloud_voxel_m)
    return replace(joined, lines=_merged(found, T_last_scan[kept], joined.up, config))


def _odometry(clouds: list[Points], config: SlamConfig) -> Float64[np.ndarray, "K 4 4"]:
    """Return where each scan is in the frame of the last."""
    odometry = Odometry(config.odometry, config.input)
    poses = [
        odometry.register(Scan(k, 0.1 * k, cloud)).T_odom_lidar for k, cloud in enumerate(clouds)
    ]
    return invert(poses[-1]) @ np.array(poses)


def _spread(positions: Float64[np.ndarray, "K 3"]) -> list[int]:
    """Choose scans at least half a metre apart, from the last backwards; in order."""
    kept = [len(positions) - 1]
    for k in range(len(positions) - 2, -1, -1):
        if np.linalg.norm(positions[k] - positions[kept[-1]]) >= MIN_STEP_M:
            kept.append(k)
    return kept[::-1]


def _merged(
    found: list[LineSet],
    T_last_scan: Float64[np.ndarray, "K 4 4"],
    up: Float64[np.ndarray, "3"],
    config: SlamConfig,
) -> LineSet:
    """Return the lines of all scans in the frame of the last, each line once."""
    ups = np.einsum("kji,j->ki", T_last_scan[:, :3, :3], up)
    observations, _ = observations_of(found, T_last_scan, ups)
    groups = group_observations(observations, config.map)
    return mean_lines(observations.lines, observations.weights, groups)
